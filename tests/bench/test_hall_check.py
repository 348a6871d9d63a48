"""`bench hall` on the simulated drive: every fault is named from a live drive and from its recording, and all ends off.

The drive is another process's as far as the bench knows; faults are put in by its configuration. Truths are figures
of that configuration.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from click.shell_completion import ShellComplete
from hall_motor import TABLE_I
from shared import same_cause, table
from virtual_run import RecordingScreen, WatchedLink, at_rest, never_armed, physical, simulated

from bench.cli import cli, main
from bench.errors import BenchError, UnsafeError
from bench.findings.health import Health, examine
from bench.hall.source import Options, opened
from bench.hall.trace import trace
from bench.record.reader import Run
from bench.signal.verdict import Verdict
from protocol.messages import DriveState, SetpointMode
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink
from tests.choice import sampled

pytestmark = pytest.mark.slow

TARGET = f"serial:/dev/ttyHALL-{os.getpid()}"  # its own: a rig holds its target


CASES = table("hall_check")
FAULTS = {name: (config, cause) for name, config, cause in CASES["faults"]}
"""What the simulated drive has, and what a check must say; of all there are recordings (test_kept_recordings.py)."""


def look(options: Options, confirm: object = None) -> Health:
    with opened(options, RecordingScreen(), confirm) as source:  # type: ignore[arg-type]
        return examine(trace(source.turned.capture))


@pytest.mark.parametrize(("config", "cause"), sampled("faults", FAULTS, 3, campaign="hall"))
def test_each_fault_is_named_from_the_drive_and_from_its_recording(tmp_path: Path, config: str, cause: str) -> None:
    (tmp_path / "faulty.toml").write_text(config)
    run = tmp_path / "run.run"
    live = look(Options("sim", config=tmp_path / "faulty.toml", save=run))
    for health in (live, look(Options(str(run)))):
        assert health.verdict is Verdict.FAIL
        [finding] = health.findings
        assert same_cause(finding.cause, cause), finding.cause
        assert finding.evidence
        assert finding.advice
        assert [edge.up.n for edge in health.measured.edges] == pytest.approx(
            [edge.up.n for edge in live.measured.edges], abs=2
        )


def test_a_healthy_drive_is_measured_to_what_its_configuration_says(tmp_path: Path) -> None:
    run = tmp_path / "run.run"
    for health in (look(Options("sim", save=run)), look(Options(str(run)))):
        assert health.verdict is Verdict.PASS
        assert abs(math.degrees(health.emf.zero)) < 0.5
        for edge, delta in zip(health.measured.edges, TABLE_I, strict=True):
            assert math.degrees(edge.delta(edge.up)) == pytest.approx(delta - 0.25, abs=0.06)
            assert math.degrees(edge.delta(edge.down)) == pytest.approx(delta + 0.25, abs=0.06)
            assert 0.01 < math.degrees(edge.up.half_width) < 0.04
            assert 0.04 < math.degrees(edge.up.jitter) < 0.1  # 0.05 deg, and the encoder's counts of 0.15 deg
            assert edge.up.n >= 40 <= edge.down.n
        assert health.turns.ratio == pytest.approx(1.0, abs=0.01)
        assert health.codes.illegal == health.codes.skipped == health.pulses.n == 0


@pytest.mark.parametrize("changed", [
    {}, {"mechanics__tau_coulomb": 0.06}, {"firmware__L_s_hat": 0.5e-3, "mechanics__tau_coulomb": 0.06},
    {"firmware__R_s_hat": 0.25, "mechanics__tau_coulomb": 0.06}, {"firmware__dead_time__dead_time_comp": 0.0},
], ids=["seed", "friction", "inductance", "resistance", "dead time"])  # fmt: skip
def test_a_healthy_drive_is_healthy_whatever_its_noise_load_and_parameters(changed: dict[str, float]) -> None:
    with reached(simulated(7, **changed)):
        found = look(Options(TARGET, yes=True))
    assert found.verdict is Verdict.PASS
    assert abs(math.degrees(found.emf.zero)) < 1.0


# -- drives that cannot turn as they should ---------------------------------------------------------------------


@contextlib.contextmanager
def reached(device: SimulatedDevice, on_call: object = None) -> Iterator[list[WatchedLink]]:
    """`TARGET` is this device, each time it is opened."""
    links: list[WatchedLink] = []

    def link(target: str) -> VirtualLink:
        links.append(WatchedLink(device, on_call or (lambda number: None)))  # type: ignore[arg-type]
        return links[-1]

    with patch("bench.rig.connection.open_link", link):
        yield links


def test_a_trip_is_told_and_no_error_and_the_drive_is_left_as_it_was() -> None:
    device = simulated(wiring__hall_open=1, encoder__present=0)  # on an encoder it would not trip
    with reached(device), opened(Options(TARGET, yes=True), RecordingScreen(), None) as source:
        assert any("tripped HALL" in remark for remark in source.turned.remarks)
        assert at_rest(device)
    assert (device.bench.parameters["i_max"], device.bench.parameters["observer"]) == (8.0, 2.0)
    assert at_rest(device)


def test_a_drive_that_runs_away_by_its_encoder_is_stopped_and_turned_otherwise() -> None:
    device = simulated(encoder__offset_deg=180.0)
    fastest = 0.0

    def measure(number: int) -> None:
        nonlocal fastest
        fastest = max(fastest, abs(device.bench.truth.omega_m))

    with reached(device, measure), opened(Options(TARGET, yes=True), RecordingScreen(), None) as source:
        assert source.turned.how == "the drive by its encoder, then the drive by its Hall sensors"
        assert "ran away and was stopped" in source.turned.remarks[0]
        [finding] = examine(trace(source.turned.capture)).findings
        assert finding.code == "encoder_zero"
    assert 1.0 < fastest * 60 / math.tau / 240.0 < 1.4  # nowhere near the 3151 r/min that it could
    assert at_rest(device)


def test_a_drive_without_an_encoder_turns_by_its_hall_sensors_and_leaves_doubt() -> None:
    with reached(simulated(encoder__present=0)), opened(Options(TARGET, yes=True), RecordingScreen(), None) as source:
        assert source.turned.how == "the drive by its Hall sensors"
        found = examine(trace(source.turned.capture))
    assert found.verdict is Verdict.INVALID
    assert "no encoder was recorded" in found.missing[0]


@pytest.mark.parametrize(("option", "words"), [
    ({"current_a": 100.0}, r"current 100 A is beyond the drive's limit of 8 A \(its parameter i_max\)"),
    ({"speed_rpm": 4000.0}, r"speed 4000 r/min is beyond the drive's limit of 3151"),
    ({"speed_rpm": 5.0}, r"--speed 5 is too slow: at least 15 r/min are needed, for 6 electrical revolutions in 4 s"),
])  # fmt: skip
def test_what_a_drive_cannot_do_or_nobody_can_measure_is_refused(option: dict[str, float], words: str) -> None:
    with reached(simulated()) as links, pytest.raises(BenchError, match=words):
        look(Options(TARGET, yes=True, **option))  # type: ignore[arg-type]
    assert never_armed(*links)


def test_the_slowest_speed_that_is_not_refused_is_enough() -> None:
    with reached(simulated()):
        assert look(Options(TARGET, yes=True, speed_rpm=15.0, current_a=2.1)).verdict is Verdict.PASS


def forced(device: SimulatedDevice, speed: Callable[[list[float]], float | None]) -> tuple[object, list[float]]:
    """The load machine forces what `speed` makes of the speeds that the drive was told so far; None lets go."""
    machine, told = device.bench, []
    drive = machine.setpoint

    def setpoint(mode: SetpointMode, value: float, value2: float = 0.0) -> None:
        told.append(value)
        drive(mode, value, value2)

    def turn(number: int) -> None:
        force = speed(told)
        machine.load_enter_state(DriveState.IDLE if force is None else DriveState.RUNNING)
        if force is not None:
            machine.load_setpoint(SetpointMode.SPEED, force)

    machine.setpoint = setpoint  # type: ignore[method-assign]
    return turn, told


@pytest.mark.parametrize(("force", "now"), [(40.0, "+3[0-9]{2}"), (20.0, "+191")], ids=["grows", "does not stop"])
def test_a_motor_that_does_not_stand_is_not_told_to_turn_the_other_way(force: float, now: str) -> None:
    device = simulated()
    turn, told = forced(device, lambda told: force if device.bench.outputs_on and told and told[-1] == 0.0 else None)
    with reached(device, turn), opened(Options(TARGET, yes=True), RecordingScreen(), None) as source:
        remark = source.turned.remarks[0]
        assert re.search(
            rf"encoder: commanded to stop, it went from \+2[34]\d to \{now} r/min and was switched off$", remark
        )
    assert min(told) == 0.0
    assert at_rest(device)


def test_a_motor_is_stopped_by_the_speed_that_it_was_told_and_not_by_the_one_that_it_has() -> None:
    device = simulated()
    turn, _ = forced(device, lambda told: 24.0 if len(told) < 2 and not device.bench.faults else None)
    with reached(device, turn), opened(Options(TARGET, yes=True), RecordingScreen(), None) as source:
        assert "at +60 r/min it ran away and was stopped" in source.turned.remarks[0]
    assert at_rest(device)


# -- consent, and the end of it ---------------------------------------------------------------------------------


def test_a_recording_that_is_there_is_not_replaced_unasked(tmp_path: Path) -> None:
    (tmp_path / "run.run").mkdir()
    (tmp_path / "run.run" / "run.jsonl").write_text("precious")
    device = simulated()
    for passive in (False, True):
        with reached(device) as links, pytest.raises(BenchError, match=r"run.run exists: choose another name, or"):
            look(Options(TARGET, yes=True, passive=passive, save=tmp_path / "run.run"))
        assert links == []
    assert (tmp_path / "run.run" / "run.jsonl").read_text() == "precious"


def test_nothing_is_energised_without_consent() -> None:
    device = physical()
    for confirm in (None, lambda question: False):
        with reached(device) as links, pytest.raises(UnsafeError):
            look(Options(TARGET), confirm)
        assert never_armed(*links)
    asked: list[str] = []

    def agree(question: str) -> bool:
        asked.append(question)
        return True

    with reached(device) as links:
        assert look(Options(TARGET), agree).verdict is Verdict.PASS
    assert "up to 240 r/min, phase current up to 2 A" in asked[0]
    assert any(DriveState.RUNNING in link.states for link in links)
    assert at_rest(device)


def by_hand(device: SimulatedDevice) -> object:
    """Somebody turns the shaft: up, then down."""

    def turn(number: int) -> None:
        machine = device.bench
        if number == 60:
            machine.load_enter_state(DriveState.RUNNING)
        if number >= 60:
            machine.load_setpoint(SetpointMode.SPEED, 8.0 if number % 80 < 40 else -8.0)

    return turn


def test_passive_watches_a_drive_that_keeps_its_fault_and_changes_nothing_in_it() -> None:
    device = physical()
    machine = device.bench
    machine.set_load_param("hall_invert", 1.0)
    before = dict(machine.parameters)
    with reached(device, by_hand(device)) as links:
        found = look(Options(TARGET, passive=True, duration=30.0))
    assert [finding.cause for finding in found.findings] == [
        "sensor a inverted, or sensors 60 deg apart, a in the middle"
    ]
    assert never_armed(*links)
    assert machine.parameters == before
    assert min(found.turns.up, found.turns.down) >= 5.0
    assert links[-1].clock() < 25.0  # it did not wait for the time to be up


@pytest.mark.parametrize(("deg", "encoder", "seen"), [(40.0, 1, 0.2), (100.0, 0, 0.5), (100.0, 1, 0.6)])
def test_a_shaft_that_is_only_rocked_is_watched_on_and_no_sensor_is_accused(
    deg: float, encoder: int, seen: float
) -> None:
    device = simulated(faults__shaft__rock_deg=deg, faults__shaft__rock_hz=2.0, encoder__present=encoder)
    screen = RecordingScreen()
    with reached(device) as links, opened(Options(TARGET, passive=True, duration=12.0), screen, None) as source:
        found = examine(trace(source.turned.capture))
    assert links[-1].clock() > 12.0
    assert (found.verdict, found.findings) == (Verdict.INVALID, ())
    told = re.search(r"reverse, over (\d\.\d): go on in one direction, 0 s left$", screen.lines[-1])
    assert told is not None
    assert float(told[1]) == pytest.approx(seen, abs=0.35)


def test_forward_in_reverse_and_forward_again_tell_a_slip_at_the_reversal_from_hysteresis() -> None:
    """The last leg is short: it costs a second and a half."""
    with reached(simulated()), opened(Options(TARGET, yes=True), RecordingScreen(), None) as source:
        theta, tick = source.turned.capture.theta, source.turned.capture.samples.tick
    top = int(np.argmax(theta))
    bottom = top + int(np.argmin(theta[top:]))
    assert 4.0 < (theta[-1] - theta[bottom]) / math.tau < 10.0
    assert len(theta) - bottom < 1.6 * 16_000
    for at in (tick[top], tick[bottom]):
        with reached(simulated(faults__encoder__slip_deg=3.0, faults__encoder__slip_at=float(at) / 20e6)):
            [found] = look(Options(TARGET, yes=True)).findings
        told = re.search(r"^the encoder slipped by (\d\.\d) deg \(electrical\) at (\d\.\d\d) s$", found.cause)
        assert told is not None
        assert (float(told[1]), float(told[2])) == (pytest.approx(3.0, abs=0.1), pytest.approx(at / 20e6, abs=0.2))


# -- the command ------------------------------------------------------------------------------------------------


def bench(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(["hall", *arguments])
    read = capsys.readouterr()
    return int(ended.value.code or 0), read.out, read.err


def test_the_command_prints_a_verdict_and_its_exit_code_is_that(tmp_path, capsys) -> None:
    (tmp_path / "faulty.toml").write_text("[wiring]\nhall_swap = 2\nhall_glitch = 30.0\n")
    data = tmp_path / "health.json"
    code, out, _ = bench(capsys, "check", "sim", "--config", str(tmp_path / "faulty.toml"), "--json", str(data))
    assert code == 1
    assert "FAULT: sensors b and c exchanged" in out.splitlines()
    assert "FAULT: false pulses on the Hall wires (EMI)" in out.splitlines()
    assert max(map(len, out.splitlines())) <= 79
    assert json.loads(data.read_text())["outcome"] == "fault"
    code, out, _ = bench(capsys, "check", "sim", "--json", "-")
    assert (code, json.loads(out)["outcome"]) == (0, "healthy")
    assert json.loads(out)["edges"][2]["up"]["angle_deg"] == pytest.approx(120.0 - 7.2 + 0.25, abs=0.1)


def test_advice_is_for_who_turns_the_shaft(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = bench(capsys, "check", "sim", "--passive", "--duration", "0.5")
    assert code == 2
    advice = " ".join(out.split("inconclusive: ")[1].split())
    assert advice.startswith(
        "only 0.0 electrical revolutions: turn the shaft forward and reverse, at least one revolution each way, "
        "and allow more time (--duration)"
    )
    assert "--passive" not in advice
    with opened(Options("sim"), RecordingScreen(), None) as source:
        short = source.turned.capture.between(0.0, source.turned.capture.t[0] + 0.05)
        [advice] = examine(trace(short), source.turned.further).missing
    assert advice.endswith("with more current (--current), faster (--speed), by a load machine, or by hand (--passive)")


def test_a_file_of_that_name_does_not_hide_the_simulated_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("sim", "run"):
        Path(name).write_text("no recording")
    assert not Options("sim").recorded
    assert Options("run").recorded


def test_a_signal_ends_with_the_outputs_off_and_says_where_the_recording_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    device, run = simulated(), tmp_path / "a.run"

    def interrupt(call: int) -> None:
        if links[-1].states[-200:] == [DriveState.RUNNING] * 200:
            signal.raise_signal(signal.SIGTERM)

    with reached(device, interrupt) as links:
        code, _, err = bench(capsys, "check", TARGET, "--yes", "--save", str(run))
    assert code == 128 + signal.SIGTERM
    assert err.splitlines()[-1] == f"error: interrupted by SIGTERM; outputs off; recording: {run}"
    assert at_rest(device)
    assert len(Run(run).samples) > 100


@pytest.mark.parametrize(("arguments", "words"), CASES["refused"])
def test_what_makes_no_sense_is_refused_in_a_line_and_no_file_is_lost(capsys, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    for name in ("run.run", "rig.toml"):
        Path(name).write_text("# precious")
    code, out, err = bench(capsys, *arguments.split())
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert err.startswith("error: ")
    assert words in err
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(
        ("run.run", "rig.toml"), "# precious"
    )


def test_completion_knows_targets_and_recordings(tmp_path: Path) -> None:
    for name in ("a.run", "b.run", "b.txt"):
        (tmp_path / name).touch()
    for subcommand in ("check", "learn"):
        complete = ShellComplete(cli, {}, "bench", "_BENCH_COMPLETE")
        assert [item.value for item in complete.get_completions(["hall", subcommand], "si")] == ["sim"]
        found = complete.get_completions(["hall", subcommand], f"{tmp_path}/")
        assert [item.value for item in found] == [f"{tmp_path}/a.run", f"{tmp_path}/b.run"]


def test_nothing_is_streamed_while_it_is_measured(tmp_path: Path) -> None:
    """Nobody reads then: what a real drive streamed would be lost, and the recording would end with a gap."""
    path = tmp_path / "a.run"
    with opened(Options("sim", save=path), RecordingScreen(), None) as source:
        source.drive.client.wait(lambda: False, 1.0)
    run = Run(path)
    newest = int(source.turned.capture.samples.tick[-1])  # type: ignore[union-attr]
    assert (run.span[1] - newest) / run.info.tick_hz < 0.2

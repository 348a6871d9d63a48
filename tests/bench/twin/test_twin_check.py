"""A twin follows the commands of a recording: state, speeds, currents, load, parameters; and the command itself."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import bench
from bench.cli import main
from bench.errors import BenchError
from bench.record.reader import captures
from bench.record.recording import run_of
from bench.signal.chunks import part
from bench.twin.check import check
from bench.twin.commands import asked
from protocol.messages import DriveState, SetpointMode

CHANNELS = "+theta_true,+omega_true,+tau_load_true"


@pytest.fixture
def same(tmp_path: Path) -> Path:
    """The configuration of the default drive."""
    file = tmp_path / "same.toml"
    file.write_text("")
    return file


def test_a_drive_is_its_own_twin_under_everything_that_is_recorded(tmp_path: Path, same: Path) -> None:
    """With another seed of the noise, nothing differs beyond noise; the load, the observer and a gain have changed."""
    with bench.connect("sim", seed=3, save=tmp_path / "a.run", channels=CHANNELS) as rig:
        rig.wait(0.1)
        rig.drive.start("encoder")
        rig.drive.speed(rpm=600)
        rig.wait(0.5)
        rig.load.torque(0.15)
        rig.wait(0.5)
        rig.drive.set("k_p_speed", 0.1)
        rig.drive.observe("vector-tracking")
        rig.drive.speed(rpm=1000)
        rig.wait(0.5)
        rig.load.off()
        rig.wait(0.3)
        rig.drive.current(0.5)
        rig.wait(0.3)
    found = check(run_of(tmp_path / "a.run"), same, seed=4)
    for name in ("i_q", "i_a", "omega_enc", "tau_load_true", "u_alpha"):
        assert abs(found[f"{name}, rms"].relative) < 0.01, name
    assert [row.name for row in found.differing] == []
    assert found.remarks == []


def test_a_recording_that_begins_while_the_motor_turns_finds_its_twin_turning(tmp_path: Path, same: Path) -> None:
    with bench.connect("sim", seed=3) as rig:
        rig.drive.start("encoder")
        rig.drive.speed(rpm=700)
        rig.wait(1.0)
        turning = rig.record(0.5)
    found = check(run_of(turning), same)
    assert abs(found["omega_enc, rms"].relative) < 1e-3
    assert abs(found["i_q, rms"].relative) < 0.03
    assert found.edges[0] == pytest.approx(found.edges[1], abs=2)


@pytest.mark.parametrize("zero", [0.0, 0.5, -2.0])
def test_a_twin_begins_where_the_encoder_has_the_rotor_whatever_zero_the_firmware_adds(
    tmp_path: Path, zero: float
) -> None:
    """At rest an estimate is that of a sector, and its error tells where in the sector the rotor is."""
    with bench.connect("sim", config={"firmware": {"encoder_zero": zero}, "mechanics": {"theta_0_deg": -77.0}}) as rig:
        idle = rig.record(0.1)
    (tmp_path / "twin.toml").write_text(f"[firmware]\nencoder_zero = {zero}\n")
    _, recorded, twin = check(run_of(idle), tmp_path / "twin.toml", repeats=1).traces["theta_avg"]
    np.testing.assert_allclose(twin, recorded, atol=0.3)


def test_figures_are_the_same_however_a_recording_is_cut(tmp_path: Path, same: Path, monkeypatch) -> None:
    """Also where a parameter changes between the last sample of a piece and the first of the next."""
    with bench.connect("sim", seed=3, save=tmp_path / "a.run") as rig:
        rig.wait(0.1)
        rig.drive.start("encoder")
        rig.drive.speed(rpm=600)
        for gain in (0.1, 0.05, 0.2):
            rig.wait(0.2)
            rig.drive.set("k_p_speed", gain)
            rig.drive.observe("vector-tracking")
            rig.drive.speed(rpm=3000 * gain)
        rig.wait(0.3)
    run = run_of(tmp_path / "a.run")
    (whole,) = captures(run)
    rows = check(run, same, seed=4, repeats=1).rows
    cuts = [int(np.searchsorted(whole.samples.tick, change.tick, "right")) for change in run.parameters.changes]
    ends = [0, *sorted({cut for cut in cuts if 0 < cut < len(whole)}), len(whole)]
    assert len(ends) > 4
    pieces = [replace(whole, samples=part(whole.samples, *both)) for both in pairwise(ends)]
    monkeypatch.setattr("bench.twin.check.captures", lambda _: iter(pieces))
    cut = check(run, same, seed=4, repeats=1).rows
    assert {row.name: row.difference.b for row in cut} == pytest.approx({row.name: row.difference.b for row in rows})


def test_what_was_asked_for_is_read_from_what_was_streamed() -> None:
    with bench.connect("sim", seed=3) as rig, rig.recording() as stretch:
        rig.wait(0.05)
        rig.drive.start("encoder")
        rig.drive.speed(rpm=300)
        rig.wait(0.6)
        rig.drive.current(0.75, -0.5)
        rig.wait(0.1)
        rig.drive.stop()
        rig.wait(0.05)
    told = asked(stretch.capture, n_p=6)
    assert sum(one.periods for one in told) == len(stretch.capture)
    states = [one.state for one in told]
    assert states[0] == states[-1] == DriveState.IDLE
    speeds = [one for one in told if one.mode == SetpointMode.SPEED]
    assert max(one.value for one in speeds) == pytest.approx(300 * 2 * np.pi / 60, rel=1e-3)
    currents = [one for one in told if one.mode == SetpointMode.CURRENT and one.value > 0.7]
    assert sum(one.periods for one in currents) > 0.09 * 16000
    assert {(one.value, one.i_d) for one in currents} == {(0.75, -0.5)}


def test_a_recording_without_references_cannot_be_followed(tmp_path: Path, same: Path) -> None:
    with bench.connect("sim", channels="hall,status,i_q") as rig:
        few = rig.record(0.1)
    with pytest.raises(BenchError, match="no channel omega_ref, i_q_ref, i_d_ref"):
        check(run_of(few), same)


def test_another_pwm_rate_is_refused(tmp_path: Path) -> None:
    (tmp_path / "slow.toml").write_text("[clock]\npwm_hz = 8000\n")
    with bench.connect("sim") as rig:
        idle = rig.record(0.1)
    with pytest.raises(BenchError, match="8000 Hz"):
        check(run_of(idle), tmp_path / "slow.toml")


def test_the_command_fits_and_checks(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    with bench.connect("sim", seed=3, save="a.run") as rig:
        rig.wait(0.1)
        rig.drive.start("encoder")
        for rpm in (400, 800, -600):
            rig.drive.speed(rpm=rpm)
            rig.wait(0.5)
        rig.drive.stop()
        rig.wait(0.2)
    main(["twin", "fit", "a.run", "-o", "twin.toml", "--json", "fit.json"])
    out = capsys.readouterr().out
    assert "motor.R_s" in out
    assert "not told: a load's torque" in out
    told = json.loads(Path("fit.json").read_text())
    quantity = {one["name"]: one for one in told["quantities"]}["motor.psi_f"]
    assert abs(quantity["value"] - 6.55e-3) < quantity["half_width_95"] < quantity["absolute_half_width_95"]
    main(["twin", "check", "a.run", "twin.toml", "--repeats", "1", "-o", "both.png", "--json", "check.json"])
    assert Path("both.png").read_bytes()[:4] == b"\x89PNG"
    rows = {row["quantity"]: row for row in json.loads(Path("check.json").read_text())["rows"]}
    assert rows["i_q, rms"]["twin"] == pytest.approx(rows["i_q, rms"]["recorded"], rel=0.03)
    assert "Hall edges: " in capsys.readouterr().out


@pytest.mark.parametrize(("words", "said"), [
    (["fit", "none.run"], "none.run: no such file"),
    (["check", "none.run", "none.toml"], "none.run"),
])  # fmt: skip
def test_bad_input_is_an_error_of_one_line(tmp_path: Path, monkeypatch, capsys, words: list[str], said: str) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["twin", *words])
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1

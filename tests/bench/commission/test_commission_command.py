"""`bench commission` as a command: what it asks, prints and writes, what it leaves in the drive, how it is stopped."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from click.testing import CliRunner, Result
from PIL import Image

import bench
from bench.cli import cli
from bench.commission.command import Options, commission
from bench.commission.commissioned import Commissioned
from bench.commission.sequence import STEPS, chosen
from bench.errors import BenchError, UnsafeError
from bench.param import dump
from sim.ports.device import SimulatedDevice
from tests.bench.virtual_run import TARGET, RecordingScreen, WatchedLink, never_armed, physical, simulated

R, L, DEAD, PSI, J, N_P = 0.158, 0.176e-3, 1e-6, 6.55e-3, 2e-4, 6
"""Of the simulated drive as it is."""


def invoked(*arguments: str) -> Result:
    return CliRunner().invoke(cli, ["commission", *arguments])


def run_on(
    link: WatchedLink,
    confirm: Callable[[str], bool] | None = None,
    screen: RecordingScreen | None = None,
    **options: Any,
) -> Commissioned:
    given: dict[str, Any] = {"target": TARGET, "current_a": 8.0, "speed_rpm": 3000.0} | options
    with patch("bench.commission.command.open_target", lambda *_: link):
        return commission(Options(**given), screen or RecordingScreen(), confirm)


def left_alone(device: SimulatedDevice, before: dict[str, float]) -> bool:
    """Outputs off, and every parameter as it was."""
    return not device.bench.outputs_on and dict(device.bench.parameters) == before


# -- the command ----------------------------------------------------------------------------------------------------


@pytest.mark.long("a recording and seven pictures")
def test_what_it_writes_can_be_loaded_looked_at_and_read(tmp_path: Path) -> None:
    out, data, report = tmp_path / "found.toml", tmp_path / "found.json", tmp_path / "report"
    ended = invoked("sim", "-o", str(out), "--json", str(data), "--report", str(report))
    assert ended.exit_code == 0, ended.output
    assert "drive's units" in ended.stdout
    assert "resistance of a phase" in ended.stdout
    told = json.loads(data.read_text())
    assert told["quantities"]["R_s"]["value"] == pytest.approx(R, rel=5e-3)
    assert told["quantities"]["R_s"]["absolute_half_width"] > told["quantities"]["R_s"]["half_width"]
    assert json.loads((report / "found.json").read_text())["quantities"] == told["quantities"]
    parameters = tomllib.loads(out.read_text())["parameters"]
    assert parameters["R_s_hat"] == pytest.approx(R, rel=5e-3)
    assert parameters["L_s_hat"] == pytest.approx(L, rel=15e-3)
    assert parameters["dead_time_hat"] == pytest.approx(DEAD, rel=15e-3)
    assert parameters["psi_f_hat"] == pytest.approx(PSI, rel=7e-3)
    assert parameters["J_hat"] == pytest.approx(J, rel=15e-3)
    assert parameters["n_p"] == N_P
    assert {"bw_current", "k_p_speed", "k_p_vt", "encoder_zero", "edge_up_1", "edge_down_6", "i_trip"} <= {*parameters}
    assert not {"u_dc_max", "i_cont", "i2t_max"} & {*parameters}  # no measurement tells what drive and winding bear
    assert "in the drive's own volts and amperes" in out.read_text()
    assert dict(dump.read(out).parameters) == pytest.approx(parameters)
    for step in STEPS:
        with Image.open(report / f"{step.name}.png") as image:
            assert image.size[0] > 500
        evidence = json.loads((report / f"{step.name}.json").read_text())
        assert evidence["panels"][0]["series"]
    recorded = bench.open(report / "commission.run")
    assert set(recorded.marks["name"]) >= {step.name for step in STEPS}
    again = invoked("sim", "--report", str(report))
    assert again.exit_code
    assert "commission.run exists" in str(again.exception)


def test_the_file_is_loaded_by_bench_param(tmp_path: Path) -> None:
    out = tmp_path / "found.toml"
    assert invoked("sim", "--step", "r", "-o", str(out)).exit_code == 0
    device = simulated(firmware__R_s_hat=0.3, firmware__L_s_hat=1e-3)
    with patch("bench.param.sources.open_target", lambda *_: WatchedLink(device)):
        ended = CliRunner().invoke(cli, ["param", "load", str(out), TARGET, "--yes"])
    assert ended.exit_code == 0, ended.output
    assert device.bench.parameters["R_s_hat"] == pytest.approx(R, rel=5e-3)
    assert device.bench.parameters["L_s_hat"] == pytest.approx(1e-3)  # that was not measured


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--step", "rr"], "no step 'rr' of a commissioning"), (["--current", "0"], "must be above 0"),
     (["--speed", "9000"], "speed 9000 r/min is beyond the drive's limit"),
     (["--current", "9"], "current 9 A is beyond the drive's limit of 8 A"), (["--current", "-1"], "must be above 0")],
)  # fmt: skip
def test_what_cannot_be_asked_for_is_told(arguments: list[str], words: str) -> None:
    ended = invoked("sim", *arguments)
    assert ended.exit_code
    assert words in ended.output or words in str(ended.exception)


def test_steps_bring_along_what_they_need() -> None:
    assert [step.name for step in chosen(["l"])] == ["offsets", "first-current", "resistance", "inductance"]
    assert [step.name for step in chosen(["R", "offsets"])] == ["offsets", "first-current", "resistance"]
    assert [step.name for step in chosen(["noise"])] == ["offsets"]
    assert [step.name for step in chosen(["spin"])][-2:] == ["turn", "spin"]
    assert [step.name for step in chosen(["check"])][-2:] == ["inductance", "check"]
    assert chosen(None) == STEPS
    with pytest.raises(BenchError, match="did you mean"):
        chosen(["inductanse"])


def test_offsets_alone_energise_nothing() -> None:
    link = WatchedLink(physical())
    done = run_on(link, steps=("offsets",))
    assert never_armed(link)
    assert set(done.outcomes) == {"offsets"}


# -- agreement ------------------------------------------------------------------------------------------------------


def test_a_physical_drive_needs_somebody_who_agrees() -> None:
    for confirm, words in ((None, "no terminal to confirm"), (lambda question: False, "not confirmed")):
        link = WatchedLink(physical())
        before = dict(link.device.bench.parameters)
        with pytest.raises(UnsafeError, match=words):
            run_on(link, confirm=confirm)
        assert never_armed(link)
        assert left_alone(link.device, before)


def test_a_physical_drive_needs_to_be_told_the_current() -> None:
    link = WatchedLink(physical())
    with pytest.raises(BenchError, match="name it with --current"):
        run_on(link, current_a=None, yes=True)
    assert never_armed(link)


def test_a_physical_drive_needs_to_be_told_the_speed_before_it_is_spun() -> None:
    link = WatchedLink(physical())
    with pytest.raises(BenchError, match=r"name it with --speed R/MIN, or take steps .*--step offsets,.*,check"):
        run_on(link, speed_rpm=None, yes=True)
    assert never_armed(link)


@pytest.mark.parametrize(
    ("steps", "question", "rpm"),
    [(("l",), "to be held at rest", 0), (("turn",), "up to 189.* r/min", 190), (("spin",), "up to 1500 r/min", 1500)],
)
def test_the_question_has_the_speed_that_the_steps_need(steps: tuple[str, ...], question: str, rpm: float) -> None:
    asked: list[str] = []
    link = WatchedLink(physical())
    with pytest.raises(UnsafeError, match="not confirmed"):
        run_on(link, confirm=lambda words: bool(asked.append(words)), steps=steps, speed_rpm=1500.0)
    assert re.search(question, asked[0])
    assert never_armed(link)


@pytest.mark.long("a commissioning from the beginning to the end")
def test_before_it_turns_and_before_it_turns_fast_somebody_is_asked() -> None:
    questions: list[str] = []

    @contextmanager
    def ask(words: str) -> Iterator[Callable[[float], bool]]:
        questions.append(words)
        yield lambda timeout: True

    with patch("bench.commission.command.open_target", lambda *_: WatchedLink(physical())):
        done = commission(
            Options(TARGET, current_a=8.0, speed_rpm=1000.0), RecordingScreen(), lambda question: True, ask
        )
    assert not done.refused
    (turn,), (spin,) = ([q for q in questions if f"free for {name}," in q] for name in ("turn", "spin"))
    assert turn.endswith("with up to 8 A, and turns")
    assert spin.endswith("and up to 1000 r/min")
    assert done.found["psi_f"].covers(PSI)


def test_a_held_shaft_still_gets_all_that_can_be_told_at_rest() -> None:
    link = WatchedLink(simulated(mechanics__tau_coulomb=0.4))
    before = dict(link.device.bench.parameters)
    done = run_on(link)
    assert "does not follow" in done.refused["turn"]
    assert set(done.outcomes) == {"offsets", "first-current", "resistance", "inductance", "check"}
    assert left_alone(link.device, before)


def test_every_step_says_what_it_will_do_before_it_does() -> None:
    link, screen, questions = WatchedLink(physical()), RecordingScreen(), []
    done = run_on(
        link, confirm=lambda question: not questions.append(question), screen=screen, steps=("first-current",)
    )
    assert not done.refused
    assert "phase current up to 8 A" in questions[0]
    assert [note.partition(":")[0] for note in screen.notes] == ["will do first-current", "offsets", "first-current"]
    assert "until 2.4 A flow" in " ".join(screen.notes)


# -- what is left ---------------------------------------------------------------------------------------------------


@pytest.mark.long("a commissioning from the beginning to the end")
def test_the_drive_is_as_it_was() -> None:
    link = WatchedLink(simulated())
    before = dict(link.device.bench.parameters)
    done = run_on(link)
    assert not done.refused
    assert left_alone(link.device, before)


def test_so_it_is_after_a_refusal_and_what_was_found_before_stands() -> None:
    """A trip in the middle: the drive's own limit of the current is below what the resistance needs."""
    link = WatchedLink(simulated(firmware__protection__i_trip=4.0))
    before = dict(link.device.bench.parameters)
    done = run_on(link)
    assert "tripped: OVERCURRENT" in done.refused["resistance"]
    assert set(done.outcomes) == {"offsets", "first-current"}
    assert "R_rough" in done.found
    assert left_alone(link.device, before)

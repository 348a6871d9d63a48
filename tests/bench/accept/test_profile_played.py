"""An acceptance test may play a motion profile: it measures by the names of its steps, within what it announced."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from accepting import Accepting, SpoiltLink
from virtual_run import at_rest, never_armed, simulated

from protocol.messages import Fault

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[3] / "docs" / "motion.md"

TEST = """
from pathlib import Path

@limit("dip", "r/min", hi=120)
@limit("at_work", "r/min", lo=395, hi=405)
@energises(rpm=RPM_ANNOUNCED, current=4)
@needs("load", "encoder")
def test_by_profile(drive, record, measure):
    played = record.play(Path(__file__).with_name("motion.toml"))
    speed = played["load on"]["omega_enc"] / drive.n_p / RPM
    measure("dip", 400 - speed.min(), played.capture)
    measure("at_work", speed[-1600:].mean(), played["load on"])
"""
PROFILE = """
max_current_A = 3
steps = [
  { speed_rpm = 400, ramp_s = 0.2, for_s = 0.6, observer = "vector-tracking", set = { k_p_speed = 0.25 } },
  { load_current_A = 2, for_s = 0.5, mark = "load on" },
  { load_current_A = 0, for_s = 0.2 },
]
"""


def written(directory: Path) -> None:
    (directory / "motion.toml").write_text(PROFILE)


def test_it_passes_and_leaves_the_bench_as_it_was(accepting: Accepting) -> None:
    written(accepting.directory)
    link = SpoiltLink(simulated())
    before = link.left()
    run = accepting(TEST.replace("RPM_ANNOUNCED", "400"), link, yes=True)
    assert run.code == 0, run.result
    assert 10 < run.measured[next(name for name in run.measured if name.endswith("dip"))].value < 100
    assert link.left() == before
    (test,) = run.result.tests
    assert {"k_p_speed", "observer", "i_max"} >= test.parameters.keys() >= {"k_p_speed", "i_max"}


def test_the_test_of_the_page_runs_as_it_is_printed(accepting: Accepting) -> None:
    (block,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (accepting.directory / "motion.toml").write_bytes((PAGE.parent / "examples" / "motion.toml").read_bytes())
    (file := accepting.directory / "own_as_printed_on_motion.py").write_text(block)
    run = accepting(file)
    assert (run.code, set(run.measured)) == (0, {"load_step.dip"})
    assert 20.0 < run.measured["load_step.dip"].value < 120.0


def test_it_keeps_to_what_was_announced(accepting: Accepting) -> None:
    written(accepting.directory)
    link = SpoiltLink(simulated())
    run = accepting(TEST.replace("RPM_ANNOUNCED", "350"), link, yes=True)
    assert run.code == 2
    (test,) = run.result.tests
    assert "step 1: speed_rpm comes to 400 r/min, beyond 350 r/min, what was announced or agreed to" in test.why
    assert never_armed(link)


def test_a_trip_in_it_fails_the_test_and_switches_off(accepting: Accepting) -> None:
    written(accepting.directory)

    def trip(call: int) -> None:
        if link.device.bench.parameters["k_p_speed"] > 0.24 and link.device.bench.truth.omega_m > 30.0:
            link.device.drive.fault(Fault.OVERCURRENT)

    link = SpoiltLink(simulated(), trip)
    before = link.left()
    run = accepting(TEST.replace("RPM_ANNOUNCED", "400"), link, yes=True)
    (test,) = run.result.tests
    assert (str(test.verdict), "OVERCURRENT" in test.why) == ("FAIL", True), test.why
    assert at_rest(link.device)
    assert link.left()[1] == before[1]

"""The shipped suite on healthy drives: it passes, also where they are better, and measures ours as it did.

That it fails where something is wrong is for `test_sabotage`.
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import bands
import pytest
from accepting import Accepting
from benches import on_an_unkind_bench

from bench.acceptance.results import Verdict, tightest
from protocol.device.compiled import CompiledLink
from sim.config.params import BenchParams
from sim.ports.device import SimulatedDevice
from sim.ports.networks import ByteNetwork
from sim.ports.virtual import VirtualLink
from tests.tools import needs

pytestmark = pytest.mark.slow

SOME = "hall_wire_broken or hall_glitches or torque_constant or fig09"  # noise, draws of the sensors, parameters
IDEAL_HALL = "[hall]\ndelta_deg = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]\nhysteresis_deg = 0.0\njitter_deg = 0.0\n"
MOST_BYTES = 5.5e6  # of a report with all its plots, which is to go by mail
BETTER = {
    "ideal Hall sensors": IDEAL_HALL,
    "no noise, ideal inverter": "[inverter]\ndead_time = 0.0\n[current_sensor]\nnoise_rms = 0.0\nbits = 24\n",
}


def test_an_untouched_drive_passes_everything_and_everything_is_explained(accepting: Accepting) -> None:
    run = accepting(report=Path("report"))
    assert run.code == 0
    assert {test.verdict for test in run.result.tests} == {Verdict.PASS}
    assert Path("report/report.html").stat().st_size < MOST_BYTES
    assert {m.verdict for m in run.result.measurements} == {Verdict.PASS}

    assert [name for name, often in Counter(test.name for test in run.result.tests).items() if often > 1] == []
    assert [name for name, often in Counter(m.name for m in run.result.measurements).items() if often > 1] == []
    assert [name for name, often in Counter(test.label for test in run.result.tests).items() if often > 1] == []
    assert [test.label for test in run.result.tests if "_" in test.label or "[" in test.label] == []
    assert [test.name for test in run.result.tests if not test.title] == []
    assert [m.name for m in run.result.measurements if not m.limits.about] == []
    bounds = [(m.name, bound) for m in run.result.measurements for bound in (m.limits.lo, m.limits.hi)]
    assert [name for name, bound in bounds if bound is not None and not math.isfinite(bound)] == []
    assert [m.name for m in run.result.measurements if m.limits.of] == []  # all are known

    # ours, as it was: outside is a change that somebody made, and no verdict
    known = bands.read()
    assert known.keys() == run.measured.keys(), "write the bands anew: python -m tests.bench.acceptance.bands"
    values = {name: m.value for name, m in run.measured.items() if m.value is not None}
    assert {n: (known[n][0], v, known[n][1]) for n, v in values.items() if not known[n][0] <= v <= known[n][1]} == {}

    some = accepting(keyword=SOME, jobs=2).measured
    assert len(some) > 30
    assert repr(some) == repr({name: run.measured[name] for name in some})


def behind_c(params: BenchParams, seed: int = 0) -> VirtualLink:
    """As `VirtualLink.of`, but its device side is the one in C."""
    return VirtualLink(SimulatedDevice(params, seed, network=ByteNetwork(CompiledLink(1 << 21))))


@pytest.mark.parametrize(
    ("better", "compiled"),
    [
        ("ideal Hall sensors", False),
        pytest.param(
            "no noise, ideal inverter", True, marks=needs("C compiler"), id="no noise, ideal inverter, behind C"
        ),
    ],
)
def test_a_drive_that_is_better_passes_and_is_nowhere_near_a_limit_for_that(
    better: str, compiled: bool, accepting: Accepting, monkeypatch: pytest.MonkeyPatch
) -> None:
    if compiled:
        monkeypatch.setattr(VirtualLink, "of", behind_c)
    Path("better.toml").write_text(BETTER[better])
    run = accepting(config=Path("better.toml"))
    assert {name: m.value for name, m in run.measured.items() if m.verdict is not Verdict.PASS} == {}
    assert run.code == 0
    worst = tightest(run.result.measurements)
    assert worst is not None
    assert worst.share is not None
    assert worst.share > 0.0


def test_a_motor_of_four_pole_pairs_that_is_as_unkind_as_a_bench_passes(accepting: Accepting) -> None:
    Path("unkind.toml").write_text(on_an_unkind_bench("anaheim-bly172s-24v"))
    run = accepting(config=Path("unkind.toml"))
    assert {name: m.value for name, m in run.measured.items() if m.verdict is not Verdict.PASS} == {}
    assert run.code == 0


def test_an_encoder_that_is_late_is_the_benchs_error_and_hall_sensors_that_are_late_fail(
    accepting: Accepting, tmp_path: Path
) -> None:
    runs = {}
    for name in ("encoder", "hall"):
        config = tmp_path / f"{name}.toml"
        config.write_text(f"[{name}]\nlatency = 1e-4\n")
        runs[name] = accepting(keyword="angles_are_of_one_time", config=config)
    (late,) = runs["encoder"].result.tests
    assert late.verdict is Verdict.ERROR
    assert "the encoder is 10" in late.why
    assert "back-EMF" in late.why
    measured = runs["hall"].measured
    assert measured["angles_are_of_one_time.encoder"].verdict is Verdict.PASS
    assert measured["angles_are_of_one_time.hall"].verdict is Verdict.FAIL

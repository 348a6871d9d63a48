"""Recordings that are kept, whatever the simulated drive became: observers' figures stay within bounds on both sides,
and each fault of the Hall sensors is named."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from shared import same_cause, table

import bench
from bench.cli import main
from bench.score import expect

DATA = Path(__file__).parents[1] / "data"
RUNS = ("steady", "reversal")


@pytest.mark.parametrize("run", RUNS)
def test_the_figures_are_what_they_were(run: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["score", str(DATA / f"{run}.run"), "--expect", str(DATA / f"{run}.toml")])
    assert end.value.code == 0, capsys.readouterr().out


@pytest.mark.parametrize("run", RUNS)
def test_another_gain_is_out_of_bounds(run: str) -> None:
    """By 5 %, up and down: a bound on one side would tell one of them only."""
    bounds = expect.read(DATA / f"{run}.toml")
    assert all(math.isfinite(lo) and math.isfinite(hi) for lo, hi in bounds.values())
    capture = bench.read(DATA / f"{run}.run")
    k_p = capture.parameters["k_p_vt"]
    for factor in (0.95, 1.05):
        board = bench.score(bench.estimate(capture, "vector_tracking", k_p=factor * k_p), observers=["replayed_vt"])
        figures = board.pooled["replayed_vt"]["transient"]
        lo, hi = bounds["vector_tracking.transient.rms"]
        assert not lo <= figures["rms"] <= hi, (factor, figures["rms"], lo, hi)


@pytest.mark.parametrize(("name", "cause"), [(name, cause) for name, _, cause in table("hall_check")["faults"]])
def test_each_fault_of_hall_sensors_is_named(name: str, cause: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["hall", "check", str(DATA / "faults" / f"{name}.run"), "--json", "-"])
    said = json.loads(capsys.readouterr().out)
    assert end.value.code == 1
    [finding] = said["findings"]
    assert same_cause(finding["cause"], cause), finding["cause"]

"""Observers on recordings that are kept: their figures stay within bounds on both sides, whatever the drive became."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

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

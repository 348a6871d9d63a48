"""What the 16-bit fixed point costs the vector-tracking observer: angle, and time of a step.

python -m tests.benchmarks fixed_point, or python -m tests.benchmarks.bench_fixed_point for the table of every run

The simulated drive runs at a forced speed under the floating-point observer, with the misplaced sensors, dead time and
noise of its default configuration; both observers then see the same telemetry.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.native import value
from sim.observers import vector_tracking_q15
from sim.observers.sample import Sample
from tests.benchmarks.replay import Telemetry, telemetry
from tests.benchmarks.table import Row, cost
from tests.sim.drive.rig import PWM_HZ
from tests.sim.observers import q15_harness
from tests.sim.observers.ideal_motor import error_deg
from tests.sim.test_accuracy import VECTOR, running, settled

SPEEDS = (50, 100, 200, 500, 1000, 2000, 3000)  # r/min
LOADS = (1.0, 4.0, 8.0)  # A
OBSERVERS = ("vector_tracking", "vector_tracking_q15")
GOAL = 125.0  # ns a step
SETTLE = 1.0  # s of a recording until both observers are settled
MEASURED = 2.0


class Run(NamedTuple):
    """Angles in electrical degrees, after both have settled."""

    rpm: int
    i_q: float
    difference: NDArray[np.float64]  # fixed less floating
    floating: NDArray[np.float64]  # actual less estimated
    fixed: NDArray[np.float64]


@cache
def _recorded(rpm: int, i_q: float) -> Telemetry:
    bench = running(VECTOR)
    return telemetry(bench, [settled(bench, rpm, i_q, 1.0, SETTLE + MEASURED)])


def run(rpm: int, i_q: float) -> Run:
    """Both observers on one recording."""
    seen = _recorded(rpm, i_q)
    floating, fixed = (seen.estimates(name) for name in OBSERVERS)
    settled = slice(round(SETTLE * PWM_HZ), None)
    assert floating.on[settled].all()
    assert fixed.on[settled].all()
    return Run(
        rpm,
        i_q,
        error_deg(fixed.theta, floating.theta)[settled],
        error_deg(seen.theta, floating.theta)[settled],
        error_deg(seen.theta, fixed.theta)[settled],
    )


def nanoseconds(repeat: int) -> tuple[float, float, float]:
    """A step of the floating-point kernel, of the fixed-point one, and of the C file by gcc -O2; the best of runs."""
    seen = _recorded(1000, 4.0)
    params = seen.params("vector_tracking_q15")
    n = seen.reset.size
    rows = np.array([[0, *vector_tracking_q15.counts(params, value(Sample, seen.samples[k]))] for k in range(n)])
    with tempfile.TemporaryDirectory() as folder:
        program = q15_harness.build(Path(folder, "harness"), "-O2")
        state = vector_tracking_q15.init()
        c = min(q15_harness.nanoseconds(program, params.q, state, rows, 10) for _ in range(1 + repeat // 6))
    floating, fixed = (seen.nanoseconds(name, repeat) for name in OBSERVERS)
    return floating, fixed, c


def rows(short: bool) -> Iterator[Row]:
    """The worst of all runs, and the times."""
    speeds, loads, repeat = (SPEEDS[-1:], LOADS[-1:], 1) if short else (SPEEDS, LOADS, 30)
    runs = [run(rpm, i_q) for rpm in speeds for i_q in loads]
    mean = max(abs(r.difference.mean()) for r in runs)
    std = max(r.difference.std() for r in runs)
    largest = max(np.abs(r.difference).max() for r in runs)
    worse = max(r.fixed.std() - r.floating.std() for r in runs)
    yield Row("fixed less floating, mean: largest", mean, "deg", 0.02, at_most=True)
    yield Row("fixed less floating, std: largest", std, "deg", 0.03, at_most=True)
    yield Row("fixed less floating: largest", largest, "deg", 0.1, at_most=True)
    yield Row("fixed less floating, std of the error", worse, "deg", 0.005, at_most=True)
    floating, fixed, c = nanoseconds(repeat)
    yield cost("a step, floating point", floating, "ns")
    yield cost("a step, fixed point", fixed, "ns", GOAL)
    yield cost("a step, fixed point, C by gcc -O2", c, "ns", GOAL)


def main() -> None:
    """Print a row for every run, as docs/fixed-point.md has it."""
    print("| r/min | A | fixed less floating: mean / std / max, deg | error, floating: mean / std / max | fixed |")
    print("|---|---|---|---|---|")
    for rpm in SPEEDS:
        for i_q in LOADS:
            r = run(rpm, i_q)
            d, a, b = ((x.mean(), x.std(), np.abs(x).max()) for x in (r.difference, r.floating, r.fixed))
            print(
                f"| {rpm} | {i_q:g} | {d[0]:.4f} / {d[1]:.4f} / {d[2]:.3f} "
                f"| {a[0]:.3f} / {a[1]:.3f} / {a[2]:.2f} | {b[0]:.3f} / {b[1]:.3f} / {b[2]:.2f} |"
            )


if __name__ == "__main__":
    main()

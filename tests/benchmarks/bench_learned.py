"""The learned-edge observer beside vector tracking: position errors against the plant, and what a step costs.

`python -m tests.benchmarks learned`. Both are run on the same telemetry, the control on the learned edges; `SOURCE`
puts another angle into the loop.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from protocol.signals import AngleSource
from tests.benchmarks.replay import PWM_HZ, Run
from tests.benchmarks.table import Row, cost
from tests.sim.observers.ideal_motor import error_deg

SOURCE = AngleSource.LEARNED_EDGES
SPEEDS = (100, 200, 500, 1000, 2000, 3000)  # r/min
CURRENTS = (1, 4, 8)  # A
WRONG = {"R_s_hat": 0.158 * 1.3, "L_s_hat": 0.176e-3 * 1.2, "psi_f_hat": 6.55e-3 * 0.9}
LOAD = 0.05895  # N·m/A
SLICE = 8000  # samples of a timed run: so short that other load on the machine misses some
REPEAT = 500  # of it


def steady(speeds: Sequence[int], **parameters: float) -> Run:
    """Learn at 1000 r/min and 2 A for 3 s, then speeds and currents in turn."""
    run = Run(SOURCE, **parameters)
    run.forced(1000, 2, 3.5)
    for rpm in speeds:
        for i_q in CURRENTS:
            run.forced(rpm, i_q, 0.6)
            run.forced(rpm, i_q, 1.0, f"{rpm} r/min, {i_q} A")
    return run


def transient() -> Run:
    """Learn at 1000 r/min near no load, then the paper's steps, a reversal, a stop and a start."""
    run = Run(SOURCE)
    run.spin(1000, 3.5)
    run.spin(500, 1.0)
    run.spin(1000, 0.6, "500 to 1000 r/min")
    run.spin(500, 1.0)
    for amperes in (4, 7.5):
        run.spin(500, 0.6, f"500 r/min, no load to {amperes} A", load=amperes * LOAD)
        run.spin(500, 0.6)
    run.spin(-500, 1.0, "reversal at 500 r/min")
    run.spin(0, 0.6)
    run.spin(500, 0.6, "stop, and start to 500 r/min")
    return run


def _errors(run: Run) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Errors in degrees of both observers by stretch."""
    telemetry = run.telemetry()
    out = telemetry.estimates("learned_edges")
    for mark, part in run.marks.items():
        own = error_deg(telemetry.theta[part], out.theta[part])
        yield mark, own, error_deg(telemetry.theta[part], telemetry.theta_vt[part])


def _worst(run: Run) -> Iterator[tuple[str, float, float, float]]:
    """By speed, at whichever current it is worst: deviation and largest error, and vector tracking's deviation."""
    by_speed: dict[str, list[tuple[float, float, float]]] = {}
    for mark, own, other in _errors(run):
        by_speed.setdefault(mark.partition(",")[0], []).append((own.std(), np.abs(own).max(), other.std()))
    for speed, figures in by_speed.items():
        std, largest, of_vector_tracking = np.max(figures, axis=0).tolist()
        yield speed, std, largest, of_vector_tracking


def rows(short: bool) -> Iterator[Row]:
    """Standard deviations and largest errors, with those of vector tracking behind; the time of a step."""
    speeds, repeat = (SPEEDS[-1:], 5) if short else (SPEEDS, REPEAT)
    currents = f"worst of {', '.join(map(str, CURRENTS))} A"
    for speed, std, largest, other in _worst(steady(speeds)):
        yield Row(f"{speed}, {currents}: error", std, "deg std", 0.5, at_most=True)
        yield Row(f"{speed}, {currents}: largest", largest, "deg", 1.5, at_most=True)
        yield Row(f"{speed}, {currents}: vector tracking", other, "deg std")
    for speed, _, largest, _ in _worst(steady(speeds, **WRONG)):
        yield Row(f"{speed}, {currents}, R, L, psi wrong: largest", largest, "deg", 3.0, at_most=True)
    for mark, own, other in _errors(transient()):
        goal = 36.0 if "start" in mark or "reversal" in mark else 3.0
        yield Row(f"{mark}: largest", float(np.abs(own).max()), "deg", goal, at_most=True)
        yield Row(f"{mark}: vector tracking, largest", float(np.abs(other).max()), "deg")
    run = Run(SOURCE)
    run.forced(1000, 4, SLICE / PWM_HZ)
    telemetry = run.telemetry()
    yield cost("a step of learned edges", telemetry.nanoseconds("learned_edges", repeat), "ns", 120.0)
    yield cost("a step of vector tracking", telemetry.nanoseconds("vector_tracking", repeat), "ns")

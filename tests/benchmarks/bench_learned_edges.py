"""The learned-edge observer beside vector tracking: position errors against the plant, and what a step costs.

`python -m tests.benchmarks learned`. Both are run on the same telemetry, the control on the learned edges; `SOURCE`
puts another angle into the loop.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from protocol.signals import AngleSource
from sim.observers import learned_edges, vector_tracking
from sim.observers.catalogue import CATALOGUE
from tests.benchmarks.replay import Run, Telemetry
from tests.benchmarks.table import Row
from tests.sim.observers.ideal_motor import error_deg

SOURCE = AngleSource.LEARNED_EDGES
PWM_HZ = 16_000
WRONG = {"R_s_hat": 0.158 * 1.3, "L_s_hat": 0.176e-3 * 1.2, "psi_f_hat": 6.55e-3 * 0.9}
LOAD = 0.05895  # N·m/A
SLICE = 8000  # samples of a timed run: so short that other load on the machine misses some
REPEAT = 500


def steady(overrides: dict[str, object] | None = None, seed: int = 1, **parameters: float) -> Run:
    """Learn at 1000 r/min and 2 A for 3 s, then speeds and currents in turn."""
    run = Run(overrides, seed, SOURCE, **parameters)
    run.forced(1000, 2, 3.5)
    for rpm in (100, 200, 500, 1000, 2000, 3000):
        for i_q in (1, 4, 8):
            run.forced(rpm, i_q, 0.6)
            run.forced(rpm, i_q, 1.0, f"{rpm} r/min, {i_q} A")
    return run


def transient() -> Run:
    """Learn at 1000 r/min near no load, then the paper's steps, a reversal, a stop and a start."""
    run = Run(None, 1, SOURCE)
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


def replayed(run: Run, telemetry: Telemetry) -> learned_edges.Estimates:
    """The observer on a run's telemetry, with the drive's parameters."""
    params = CATALOGUE["learned_edges"].make_params(PWM_HZ, run.bench.parameters)
    return learned_edges.run(params, learned_edges.init(), telemetry.samples, telemetry.reset)[1]


def _errors(run: Run) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Errors in degrees of both observers by stretch."""
    telemetry = run.telemetry()
    out = replayed(run, telemetry)
    for mark, part in run.marks.items():
        own = error_deg(telemetry.theta[part], out.theta[part])
        yield mark, own, error_deg(telemetry.theta[part], telemetry.theta_vt[part])


def nanoseconds() -> tuple[float, float]:
    """A step of this observer and of vector tracking, compiled, in `run`."""
    run = Run(None, 1, SOURCE)
    run.forced(1000, 4, SLICE / PWM_HZ)
    telemetry = run.telemetry()
    own = CATALOGUE["learned_edges"].make_params(PWM_HZ, run.bench.parameters)
    other = CATALOGUE["vector_tracking"].make_params(PWM_HZ, run.bench.parameters)
    best = [np.inf, np.inf]
    for _ in range(REPEAT):
        for k, (module, params) in enumerate(((learned_edges, own), (vector_tracking, other))):
            begin = time.perf_counter()
            module.run(params, module.init(), telemetry.samples, telemetry.reset)
            best[k] = min(best[k], (time.perf_counter() - begin) / telemetry.reset.size)
    return best[0] * 1e9, best[1] * 1e9


def rows() -> Iterator[Row]:
    """Standard deviations and largest errors, with those of vector tracking behind; the time of a step."""
    for mark, own, other in _errors(steady()):
        yield Row(f"{mark}: error", float(own.std()), "deg std", 0.5, at_most=True)
        yield Row(f"{mark}: largest", float(np.abs(own).max()), "deg", 1.5, at_most=True)
        yield Row(f"{mark}: vector tracking", float(other.std()), "deg std")
    for mark, own, _ in _errors(steady(**WRONG)):
        yield Row(f"{mark}, R, L, psi wrong: largest", float(np.abs(own).max()), "deg", 3.0, at_most=True)
    for mark, own, other in _errors(transient()):
        goal = 36.0 if "start" in mark or "reversal" in mark else 3.0
        yield Row(f"{mark}: largest", float(np.abs(own).max()), "deg", goal, at_most=True)
        yield Row(f"{mark}: vector tracking, largest", float(np.abs(other).max()), "deg")
    own_ns, other_ns = nanoseconds()
    yield Row("a step of learned edges", own_ns, "ns", 120.0, at_most=True)
    yield Row("a step of vector tracking", other_ns, "ns")

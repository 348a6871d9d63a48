"""How exact: the plant beside scipy's solve_ivp, the estimators beside the plant. The rigs are those of the tests."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tests.benchmarks.table import Row
from tests.sim.drive.rig import error_deg
from tests.sim.plant.test_integrator import voltage_steps
from tests.sim.test_accuracy import VECTOR, running, settled


def rows(short: bool) -> Iterator[Row]:
    """Largest differences of the plant; standard deviations of the position errors at 4 A, speed forced."""
    seconds = 0.5 if short else 2.0
    _, _, current, angle, *_ = voltage_steps(1, 176e-6)
    yield Row("plant, one step a period: current", current, "A", 1e-6, at_most=True)
    yield Row("plant, one step a period: angle", angle, "rad", 1e-6, at_most=True)
    for rpm, limit in ((50, 3.5), (500, 3.3), (1000, 4.4)):
        recorded = settled(running(VECTOR), rpm, 4.0, 1.0, seconds)
        vector, average = (float(np.std(error_deg(recorded, name))) for name in ("theta_vt", "theta_avg"))
        yield Row(f"average speed, {rpm} r/min: error, 4 A", average, "deg std")
        yield Row(f"vector tracking, {rpm} r/min: error, 4 A", vector, "deg std", limit, at_most=True)

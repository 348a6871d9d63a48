"""Which of a drive's angles is late: the encoder's, that of the Hall edges, or that of the back-EMF.

What is seen tau late lies omega tau behind the rotor. A constant delay does not show in a speed, and nothing in the
stream knows the rotor: only differences between angles can be measured, over speeds that differ. Hall edges carry time
stamps of their own; the back-EMF e = u - (R_s + j omega L_s) i is made of the same samples as the encoder's angle, and
knows neither sensor. So two differences tell three delays, if the back-EMF is taken to be on time: an encoder that is
late makes both lead by as much, late Hall sensors make the edges lag alone. An estimate that leads where neither does
is the estimator's own doing.

The angle by the back-EMF is off by what the inductance is wrong by, in proportion to the q current: that is fitted
beside the delay, where the two can be separated. It is also off by what the inverter's voltage is not known to, over
the size of the back-EMF: at low speed more than a delay is worth, and then it counts as unknown. Nothing here judges a
sensor's place.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.signal.capture import Capture
from bench.signal.edge_fit import SPREAD
from bench.signal.hall_edges import Measured, measure
from bench.signal.trace import SLOW, Trace
from bench.signal.windows import Window

F64 = NDArray[np.float64]

UNSURE = 0.03
"""V across the back-EMF, by which the inverter may be off: what a dead time's compensation leaves."""
LEAST = 200  # samples that a delay is fitted to
ALIKE = 0.97  # correlation of speed and q current above which their effects cannot be separated
AGREE, CLOSE = 25e-6, 0.1  # s within which two delays are one, or as a share of them


class Delays(NamedTuple):
    """Delay in s of Hall edges and back-EMF against the encoder; NaN where unknown."""

    edges: float
    back_emf: float
    by_count: float = 0.0
    """By which that of the edges may be off because the encoder's angle has steps."""


def delays(capture: Capture) -> Delays:
    """Measure them, over all samples and edges of a shaft that turns."""
    trace = Trace()
    trace.add(Window(capture, slice(0, len(capture))))
    return delays_of(trace)


def delays_of(trace: Trace, measured: Measured | None = None, since: int = 0) -> Delays:
    """Measure them, that of the back-EMF from the tick `since` on; `measured`: the edges, where they are already."""
    if trace.samples < LEAST or not trace.encoder:
        return Delays(math.nan, math.nan)
    edges = measure(trace) if measured is None else measured
    known = edges.delay_half_width < max(AGREE, CLOSE * abs(edges.delay))
    return Delays(
        edges.delay if known else math.nan, _by_back_emf(trace, since), edges.delay_by_count if known else 0.0
    )


def _by_back_emf(trace: Trace, since: int) -> float:
    some = trace.some
    use = some.settled & (np.abs(some.omega) > SLOW) & (some.tick >= since)
    still = trace.back_emf(use)
    if still is None:
        return math.nan
    size = np.abs(still)
    strong = size > UNSURE
    still, size, omega = still[strong], size[strong], some.omega[use][strong]
    torque = (some.i * np.exp(-1j * some.theta)).imag[use][strong]
    if len(omega) < LEAST or omega.std() < SPREAD * np.abs(omega).max():
        return math.nan
    terms = [np.ones(len(omega)), omega]
    if torque.std() > 0.0 and abs(np.corrcoef(torque, omega)[0, 1]) < ALIKE:
        terms.append(torque)
    angles = [-np.angle(still / still.mean()), UNSURE / size, UNSURE / size * np.sign(omega)]
    slope, *errors = _fitted(terms, angles, size)[1]
    return float(slope) if np.abs(errors).max() < AGREE else math.nan


def _fitted(terms: list[F64], angles: list[F64], weight: F64) -> F64:
    """Coefficients (terms, angles) of the combinations of `terms` that are nearest to `angles`, (n,) each."""
    left, right = (np.stack(columns, 1) * weight[:, None] for columns in (terms, angles))
    return np.linalg.lstsq(left, right, rcond=None)[0].astype(np.float64)

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
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.signal.capture import Capture
from bench.signal.position import wrap
from bench.signal.trace import SLOW, Edges, Trace
from bench.signal.waveforms.sectors import edge_passages
from bench.signal.windows import Window

F64 = NDArray[np.float64]

SPREAD = 0.1
"""Of speeds about their mean, as a share of them, below which no delay is fitted."""
UNSURE = 0.03
"""V across the back-EMF, by which the inverter may be off: what a dead time's compensation leaves."""
LEAST, LEAST_EDGES = 200, 36  # samples and edges that a delay is fitted to
FAR = math.radians(30.0)  # from the others of its kind, from which on an edge is none of them
ALIKE = 0.97  # correlation of speed and q current above which their effects cannot be separated
AGREE = 25e-6  # s within which two delays are one


class Delays(NamedTuple):
    """Delay in s of Hall edges and back-EMF against the encoder; NaN where unknown."""

    edges: float
    back_emf: float


def delays(capture: Capture) -> Delays:
    """Measure them, over all samples and edges of a shaft that turns."""
    trace = Trace()
    trace.add(Window(capture, slice(0, len(capture))))
    return delays_of(trace)


def delays_of(trace: Trace, since: int = 0) -> Delays:
    """Measure them, that of the back-EMF from the tick `since` on."""
    if trace.samples < LEAST or not trace.encoder:
        return Delays(math.nan, math.nan)
    return Delays(_by_edges(trace.edges), _by_back_emf(trace, since))


def _by_edges(edges: Edges) -> float:
    opened, way = edge_passages(edges.old, edges.new)
    good = way * edges.omega > SLOW
    if np.count_nonzero(good) < LEAST_EDGES:
        return math.nan
    kinds, place, omega = (2 * opened + (way > 0))[good], wrap(edges.theta[good]), edges.omega[good]
    groups = []
    for kind in np.unique(kinds):
        of = kinds == kind
        off = wrap(place[of] - np.angle(np.exp(1j * place[of]).mean()))
        near = np.abs(off - np.median(off)) < FAR
        groups.append((off[near], omega[of][near]))
    delay, error = within_groups(groups)
    return delay if 2.0 * error < AGREE else math.nan


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


def within_groups(groups: Sequence[tuple[F64, F64]]) -> tuple[float, float]:
    """Slope of angles over speeds, s, common to groups (angles, speeds) that each have a place of their own.

    With its standard error; NaN where the speeds of each group are too much alike.
    """
    groups = [(angles, omega) for angles, omega in groups if len(omega) > 1]
    if not groups:
        return math.nan, math.nan
    angles = np.concatenate([angles - angles.mean() for angles, _ in groups])
    speeds = np.concatenate([omega - omega.mean() for _, omega in groups])
    size = np.concatenate([omega for _, omega in groups])
    freedom = len(angles) - len(groups) - 1
    if freedom < 2 * len(groups) or speeds.std() < SPREAD * math.sqrt(float(np.mean(size**2))):
        return math.nan, math.nan
    square = float(np.sum(speeds**2))
    slope = float(np.sum(angles * speeds)) / square
    rest = angles - slope * speeds
    return slope, math.sqrt(float(np.sum(rest**2)) / freedom / square)


def _fitted(terms: list[F64], angles: list[F64], weight: F64) -> F64:
    """Coefficients (terms, angles) of the combinations of `terms` that are nearest to `angles`, (n,) each."""
    left, right = (np.stack(columns, 1) * weight[:, None] for columns in (terms, angles))
    return np.linalg.lstsq(left, right, rcond=None)[0].astype(np.float64)

"""Where the six edges of the Hall inputs lie, passed upwards and downwards, with confidence.

An edge is named by the input that changes and how: the one that opens sector I is "c falls" to a shaft that turns up,
and "c rises" to one that turns down; both are one place on the rotor. So every edge is measured whatever the wiring is
and whichever sensor is dead. Angles are electrical rad by the encoder; without one, by the shares that the sectors have
of a revolution, and then the mean of all edges lies where it belongs.

Edges seen late by a constant time lie later the faster the shaft turns. Where they were met at speeds that differ the
angles are those at standstill (`bench.signal.edge_fit`). Confidence is that of Student's t. Nothing here knows what is
right, but that the sensors of a ring are 120 deg apart: how far the ring is turned is the mean of them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.signal import hall_inputs
from bench.signal.batches import student
from bench.signal.edge_fit import OPENS, EdgeFit, fitted, fitted_blind
from bench.signal.hall_inputs import Inputs
from bench.signal.position import wrap, wrapped
from bench.signal.trace import INPUTS, Floats, Trace
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS
from protocol.frames import data_frame

if TYPE_CHECKING:
    import pandas as pd

SEEMS = math.radians(9.0)
"""rad by which the mean of the edges may be off where the drive takes the ring to stand: else it stands elsewhere."""


@dataclass(frozen=True)
class Passages:
    """One edge, passed in one direction."""

    angle: float
    """Mean at standstill, rad in [-pi, pi); NaN for none."""
    half_width: float
    """Of the 95 % confidence interval of that mean, rad; NaN for fewer than two."""
    jitter: float
    """Standard deviation, what speed and delay explain taken out, rad; NaN for fewer than two."""
    n: int


@dataclass(frozen=True)
class Edge:
    """One of the six edges."""

    sector: int
    """0..5, that it opens when the wiring is as specified."""
    up: Passages
    down: Passages

    @property
    def name(self) -> str:
        """Such as "c falls", of a shaft that turns up."""
        number, rises = OPENS[self.sector]
        return f"{INPUTS[number]} {'rises' if rises else 'falls'}"

    offset: float = 0.0
    """rad, where sector I opens with ideal sensors: `hall_offset` of the drive, or of the ring that it has."""

    @property
    def ideal(self) -> float:
        """Where it belongs with that offset, rad in [0, 2 pi)."""
        return (self.offset + self.sector * SECTOR_WIDTH) % math.tau

    @property
    def hysteresis(self) -> float:
        """Passed upwards minus passed downwards, rad; NaN unless both were."""
        return wrapped(self.up.angle - self.down.angle)

    def delta(self, passages: Passages) -> float:
        """Ideal minus actual angle, rad in [-pi, pi): that of Table I of Kim et al. 2011, 10.1109/TIE.2010.2098367."""
        return wrapped(self.ideal - passages.angle)

    @property
    def mean_delta(self) -> float:
        """Mean of both directions, or of the one that there is, rad; NaN for none."""
        both = [self.delta(passages) for passages in (self.up, self.down) if passages.n]
        return mean_angle(np.array(both)) if both else math.nan


@dataclass(frozen=True)
class Measured:
    """The six edges, in the order of their sectors."""

    edges: tuple[Edge, ...]
    ring: float
    """rad, of the edge that opens sector I with ideal sensors, as `hall_offset`; NaN where nothing tells."""
    delay: float
    """s by which edges are seen late, in the mean; NaN where the speeds do not tell, the angles are then those at
    speed."""
    delay_half_width: float
    """Of its 95 % confidence interval, s, what the steps of the encoder's angle may add left out:"""
    delay_by_count: float
    """s, at most: an edge that always lies at one place within a count is off by up to half of it while the shaft is
    slow, and not while it is fast."""
    outliers: int
    """Passages left out because they lay far from where their edge was fitted."""
    duty: tuple[float, ...]
    """Share of an electrical turn in which the input a, b, c is 1; NaN unless both its edges were met."""
    widths: tuple[float, ...]
    """Of sectors I to VI, rad; NaN unless both edges were met."""
    inputs: Inputs
    fit: EdgeFit | None
    """None where too few edges were passed."""
    blind: bool
    """Whether no encoder told the angle."""
    tick_hz: int
    """Of the ticks of its edges."""
    scale: float
    """What its angle was divided by: 1 or -1 where it turns as the sectors do, else their ratio; NaN without one."""

    @property
    def placement(self) -> Floats:
        """(3,) rad by which each sensor stands ahead of its place in the ring, the mean of both edges; NaN for none."""
        return _by_sensor(self.fit)[0]

    @property
    def unevenness(self) -> Floats:
        """(3,) rad by which each sensor's rising edge is ahead, and its falling one behind."""
        return _by_sensor(self.fit)[1]

    @property
    def placement_each_way(self) -> Floats:
        """(2, 3) rad, as `placement`, passed upwards and downwards; NaN where an edge was not."""
        if self.fit is None:
            return np.full((2, 3), math.nan)
        half = _SENSORS @ (np.nan_to_num(self.fit.hysteresis) / 2.0)
        met = np.where((self.fit.n.T > 0).all(axis=1), 1.0, math.nan)[:, None]
        both: Floats = (self.placement + np.array([half, -half])) * met
        return both if self.inputs.ratio > 0.0 or self.blind else both[::-1]

    def half_width(self, weights: Floats) -> Floats:
        """Of 95 % confidence intervals, rad (k,), of sums of places, or of places and hysteresis, with `weights`."""
        if self.fit is None:
            return np.full(len(weights), math.nan)
        return student(max(1, self.fit.passages - 1)) * self.fit.sd(weights)

    @property
    def placement_half_width(self) -> tuple[Floats, Floats]:
        """Of 95 % confidence intervals of `placement`, and of it each way, rad (3,)."""
        return self.half_width(_SENSORS), self.half_width(np.hstack([_SENSORS, _SENSORS / 2.0]))

    @property
    def duty_half_width(self) -> Floats:
        """(3,) of 95 % confidence intervals of `duty`."""
        return self.half_width(_DUTY) / math.tau

    @property
    def widths_half_width(self) -> Floats:
        """(6,) of 95 % confidence intervals of `widths`, rad."""
        return self.half_width(np.roll(np.eye(SECTORS), 1, axis=1) - np.eye(SECTORS))

    @property
    def ring_half_width(self) -> float:
        """Of the 95 % confidence interval of `ring`, rad; NaN where that is not known."""
        return math.nan if math.isnan(self.ring) else float(self.half_width(np.full((1, SECTORS), 1.0 / SECTORS))[0])

    def to_pandas(self) -> pd.DataFrame:
        """A row for each edge and direction: angles in electrical degrees, NaN for what is not known."""
        names = ("edge", "direction", "ideal", "late", "half_width_95", "jitter", "n")
        rows = [
            (edge.name, way, *map(math.degrees, (edge.ideal, -edge.delta(p), p.half_width, p.jitter)), p.n)
            for edge in self.edges
            for way, p in (("forward", edge.up), ("reverse", edge.down))
        ]
        return data_frame(dict(zip(names, zip(*rows, strict=True), strict=True)))

    def least(self) -> int:
        """Passages of the edge and direction with the fewest."""
        return min(passages.n for edge in self.edges for passages in (edge.up, edge.down))

    def widest(self) -> float:
        """The widest half confidence interval of all, rad; inf where one is not known."""
        widths = [passages.half_width for edge in self.edges for passages in (edge.up, edge.down)]
        return math.inf if any(map(math.isnan, widths)) else max(widths)


def measure(trace: Trace) -> Measured:
    """Measure the edges."""
    edges, n_p = trace.edges, trace.parameters.get("n_p")
    inputs = hall_inputs.read(edges, trace.tick_hz)
    pairs = None if n_p is None else max(1, round(n_p))
    blind, scale = not abs(inputs.ratio) > hall_inputs.STOPPED, math.nan
    if blind:
        fit, sign = fitted_blind(inputs, trace.tick_hz, pairs, trace.time_step), 1.0
    else:
        sign = math.copysign(1.0, inputs.ratio)
        scale = sign if abs(abs(inputs.ratio) - 1.0) < hall_inputs.ALIKE else inputs.ratio
        fit = fitted(inputs, scale, pairs, trace.time_step)
    found = _edges(inputs, fit, sign)
    ring = sign * mean_angle(fit.place - SECTOR_WIDTH * np.arange(SECTORS)) if fit is not None else math.nan
    offset = trace.parameters.get("hall_offset", 0.0)
    if not blind and sign > 0.0:
        offset = offset if abs(wrapped(ring - offset)) < SEEMS else ring
        found = tuple(Edge(edge.sector, edge.up, edge.down, offset) for edge in found)
    places = [edge.ideal - edge.mean_delta for edge in found]
    widths = tuple((places[(s + 1) % SECTORS] - places[s]) % math.tau for s in range(SECTORS))
    duty = tuple(
        (places[OPENS.index((k, False))] - places[OPENS.index((k, True))]) % math.tau / math.tau
        for k in range(len(INPUTS))
    )
    delay = half_width = by_count = math.nan
    if fit is not None and not blind:
        delay = float(np.mean(fit.delay))
        alike = np.ptp(fit.delay) == 0.0  # one was fitted to all
        error = float(fit.delay_sd[0, 0] if alike else np.sqrt(np.sum(fit.delay_sd**2)) / fit.delay.size)
        half_width = student(max(1, fit.passages)) * error
        by_count = 0.5 * trace.count / max((fit.fastest - fit.slowest) / QUANTILES_APART, 1e-9)
    outliers = 0 if fit is None else fit.aside
    return Measured(
        found, math.nan if blind else ring, delay, half_width, by_count, outliers, duty, widths, inputs, fit, blind,
        trace.tick_hz, scale,
    )  # fmt: skip


def _edges(inputs: Inputs, fit: EdgeFit | None, sign: float) -> tuple[Edge, ...]:
    """The edges as the pins show them to the encoder: an input that is inverted rises where its sensor falls."""
    none = Passages(math.nan, math.nan, math.nan, 0)
    found = [Edge(s, none, none) for s in range(SECTORS)]
    if fit is None:
        return tuple(found)
    for opened, (number, rises) in enumerate(OPENS):
        seen = OPENS.index((number, rises ^ bool(inputs.inverted >> number & 1) ^ (sign < 0.0)))
        half = 0.0 if math.isnan(fit.hysteresis[opened]) else fit.hysteresis[opened] / 2.0
        spread = 0.0 if math.isnan(fit.hysteresis_sd[opened]) else fit.hysteresis_sd[opened] / 2.0
        ways = []
        for way, column in ((1.0, 0), (-1.0, 1)):
            n, jitter = int(fit.n[opened, column]), float(fit.jitter[opened, column])
            angle = sign * (fit.place[opened] + way * half) if n else math.nan
            error = math.hypot(float(fit.place_sd[opened]), spread)
            ways.append(Passages(wrapped(angle), student(n - 1) * error if n > 1 else math.nan, jitter, n))
        up, down = ways if sign > 0.0 else ways[::-1]
        found[seen] = Edge(seen, up, down)
    return tuple(found)


def _by_sensor(fit: EdgeFit | None) -> tuple[Floats, Floats]:
    """Where the sensors stand against the mean of them, and half of what their edges differ by, rad (3,)."""
    if fit is None:
        return np.full(3, math.nan), np.full(3, math.nan)
    off = wrap(fit.place - SECTOR_WIDTH * np.arange(SECTORS))
    off = wrap(off - mean_angle(off))
    rises, falls = (off[[OPENS.index((number, high)) for number in range(3)]] for high in (True, False))
    return wrap(falls + wrap(rises - falls) / 2.0), -wrap(rises - falls) / 2.0


def _of_sensors() -> tuple[Floats, Floats]:
    """(3, 6) each: what places weigh in where a sensor stands against the mean of all, and in how long it is 1."""
    rises, falls = (
        np.array([np.arange(SECTORS) == OPENS.index((number, high)) for number in range(3)], float)
        for high in (True, False)
    )
    return (rises + falls) / 2.0 - 1.0 / SECTORS, falls - rises


_SENSORS, _DUTY = _of_sensors()


def largest(values: Iterable[float]) -> float:
    """The largest of those that are known; NaN for none."""
    return max((value for value in values if not math.isnan(value)), default=math.nan)


def mean_angle(angles: Floats) -> float:
    """Circular mean in [-pi, pi) of angles (n,) in rad; NaN for none."""
    return wrapped(float(np.angle(np.exp(1j * angles).mean()))) if len(angles) else math.nan


QUANTILES_APART = 3.1
"""Standard deviations between the slowest and the fastest twentieth of speeds, of an even distribution."""

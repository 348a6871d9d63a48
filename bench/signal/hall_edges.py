"""Where the six edges of the Hall inputs lie, passed upwards and downwards, with confidence.

An edge is named by the input that changes and how: the one that opens sector I is "c falls" to a shaft that turns up,
and "c rises" to one that turns down; both are one place on the rotor. So every edge is measured whatever the wiring is
and whichever sensor is dead. Angles are electrical rad by the encoder.

Edges seen late by a constant time lie later the faster the shaft turns. That delay is fitted over all edges, by least
squares, where they were met at speeds that differ, and the angles are those at standstill. Confidence is that of
Student's t with the scatter of the passages. Nothing here knows what is right.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bench.signal.delays import within_groups
from bench.signal.position import wrap
from bench.signal.trace import INPUTS, Edges, Floats
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS
from protocol.frames import data_frame

if TYPE_CHECKING:
    import pandas as pd

CONFIDENCE = 0.95
FAR = 6.0  # times the scatter,
LEAST_FAR = math.radians(1.0)  # but at least so far from the median, lies a passage that is left out

OPENS = ((2, False), (1, True), (0, False), (2, True), (1, False), (0, True))
"""By sector: the input (0..2) that changes where it opens, and whether it rises, to a shaft that turns up."""


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

    @property
    def ideal(self) -> float:
        """Where it belongs, rad."""
        return self.sector * SECTOR_WIDTH

    @property
    def hysteresis(self) -> float:
        """Passed upwards minus passed downwards, rad; NaN unless both were."""
        return _wrapped(self.up.angle - self.down.angle)

    def delta(self, passages: Passages) -> float:
        """Ideal minus actual angle, rad in [-pi, pi): that of Table I of Kim et al. 2011, 10.1109/TIE.2010.2098367."""
        return _wrapped(self.ideal - passages.angle)

    @property
    def mean_delta(self) -> float:
        """Mean of both directions, or of the one that there is, rad; NaN for none."""
        both = [self.delta(passages) for passages in (self.up, self.down) if passages.n]
        return mean_angle(np.array(both)) if both else math.nan


@dataclass(frozen=True)
class Measured:
    """The six edges, in the order of their sectors."""

    edges: tuple[Edge, ...]
    delay: float
    """s by which edges are seen late; NaN where the speeds do not tell, the angles are then those at speed."""
    delay_half_width: float
    """Of its 95 % confidence interval, s."""
    outliers: int
    """Passages left out because they lay far from all others of their edge."""
    duty: tuple[float, ...]
    """Share of an electrical turn in which the input a, b, c is 1; NaN unless both its edges were met."""
    widths: tuple[float, ...]
    """Of sectors I to VI, rad; NaN unless both edges were met."""

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


def measure(edges: Edges) -> Measured:
    """Measure the edges; those without an angle count for nothing."""
    groups: dict[tuple[int, bool], tuple[Floats, Floats, float]] = {}
    outliers = 0
    for sector, (number, rises) in enumerate(OPENS):
        changes = (edges.old ^ edges.new) >> number & 1 == 1
        rising = edges.new >> number & 1 == 1
        for upwards in (True, False):
            met = changes & (rising == (rises if upwards else not rises)) & ((edges.omega > 0) == upwards)
            met &= np.isfinite(edges.theta)
            theta, omega = edges.theta[met], edges.omega[met]
            centre = mean_angle(theta)
            off = wrap(theta - centre)
            if len(off):
                middle = float(np.median(off))
                scatter = 1.4826 * float(np.median(np.abs(off - middle)))
                near = np.abs(off - middle) <= max(FAR * scatter, LEAST_FAR)
                outliers += int(np.count_nonzero(~near))
                off, omega = off[near], omega[near]
            groups[sector, upwards] = (off, omega, centre)
    delay, spread = within_groups([(off, omega) for off, omega, _ in groups.values()])
    found = tuple(
        Edge(s, *(_passages(*groups[s, upwards], delay, spread) for upwards in (True, False))) for s in range(SECTORS)
    )
    places = [edge.ideal - edge.mean_delta for edge in found]
    widths = tuple((places[(s + 1) % SECTORS] - places[s]) % math.tau for s in range(SECTORS))
    duty = tuple(
        (places[OPENS.index((k, False))] - places[OPENS.index((k, True))]) % math.tau / math.tau
        for k in range(len(INPUTS))
    )
    return Measured(found, delay, spread * _t(10**6), outliers, duty, widths)


def largest(values: Iterable[float]) -> float:
    """The largest of those that are known; NaN for none."""
    return max((value for value in values if not math.isnan(value)), default=math.nan)


def mean_angle(angles: Floats) -> float:
    """Circular mean in [-pi, pi) of angles (n,) in rad; NaN for none."""
    return _wrapped(float(np.angle(np.exp(1j * angles).mean()))) if len(angles) else math.nan


def _passages(off: Floats, omega: Floats, centre: float, delay: float, spread: float) -> Passages:
    """`off`: angles about `centre`; `delay` and its standard error in s."""
    n = len(off)
    if n == 0:
        return Passages(math.nan, math.nan, math.nan, 0)
    late = 0.0 if math.isnan(delay) else delay
    still = off - late * omega
    angle = _wrapped(centre + float(still.mean()))
    if n == 1:
        return Passages(angle, math.nan, math.nan, 1)
    jitter = float(still.std(ddof=1))
    by_delay = 0.0 if math.isnan(delay) else spread * float(omega.mean())
    return Passages(angle, _t(n - 1) * math.hypot(jitter / math.sqrt(n), by_delay), jitter, n)


def _t(freedom: int) -> float:
    """Two-sided quantile of Student's t, at `CONFIDENCE`, with `freedom` >= 1 degrees."""
    from scipy.special import stdtrit  # 0.2 s that no start of `bench live` is to pay

    return float(stdtrit(freedom, (1.0 + CONFIDENCE) / 2.0))


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % math.tau - math.pi

"""The angle of a shaft by its own Hall edges, where they come steadily: what estimates can be compared with where no
encoder is.

The mean time of the edges of a whole turn is that of an even ring's edge in the middle of it, whatever the places of
sensors and magnets; between such times the angle is a cubic. So the angle is that by the mean place of the edges. What
all edges share, as the angle of the ring and a common delay, is not in it, and what repeats with each turn counts as
places, a swing of the speed too: its standard deviation has what such a swing may be.

Only edges that come one way, one sector at a time, two turns before and two after, tell an angle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import tee
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.signal import hall_inputs
from bench.signal.capture import Capture
from bench.signal.chunks import breaks, join, with_columns
from bench.signal.edge_fit import CHANGE, SWING, SWINGS, EdgeFit, even_times, fitted_blind
from bench.signal.position import wrap
from bench.signal.trace import Floats, trace_of
from bench.signal.units import pole_pairs
from bench.signal.waveforms.sectors import SECTOR_WIDTH, SECTORS, edge_angle, edge_passages, hall_offset
from protocol.descriptor import Channel
from protocol.signals import Flag, RawType, Unit
from protocol.streams import EdgeChunk

ANGLE, SD = "theta_by_edges", "theta_by_edges_sd"
CHANNELS = tuple(
    Channel(0xFE00 + k, name, Unit.RAD, RawType.F32, 1.0, Flag.CHANNEL) for k, name in enumerate((ANGLE, SD))
)
"""What is added to samples: electrical rad in [-pi, pi) and its standard deviation, NaN where no angle is told."""
MOST = math.radians(3.0)
"""Standard deviation above which no angle is told."""
SPAN = 4.0
"""s that the four turns around an edge may take."""
MUCH = 0.5
"""Of the samples that electrical turns tell, that turns of the shaft must tell to be used."""
LATE, SURE = math.radians(0.5), 3.0
"""rad at the highest speed, and standard errors, by which one kind of edges must be later than the other."""
BENT, JITTER = 0.03, 0.02
"""What of the scatter of the bend of time over a turn may be in an edge's mean time, 0.006 where the bend changes
smoothly; and what of an edge's variance the bend adds to it."""
UNSEEN = 2.0
"""Times the mean square of what is seen of a swing, as places may hide some of it."""
ALIKE = 3.0
"""Edges that the end of one magnet makes, where turns are not those of the shaft."""


class Knots(NamedTuple):
    """Where an even ring's edges were passed, (k,) each, in the order of time."""

    tick: Floats
    angle: Floats
    """Electrical rad, not wrapped within a run."""
    slope: Floats
    """rad a tick."""
    sd: Floats
    """rad."""
    told: NDArray[np.bool_]
    """Whether the angle from it to the next one is told."""


@dataclass(frozen=True)
class ByEdges:
    """How a recording's own edges tell its angle."""

    per_turn: int
    """Edges of both kinds in the turns that are whole."""
    kind: str
    """Edges that are used: "falling", "rising", or "" for all."""
    fit: EdgeFit
    step: float
    """s between the times that edges can have."""
    zero: float
    """rad, ideal angle of the edge that opens sector I."""
    n_p: int
    """Pole pairs, where the turns are those of the shaft; 0: they are electrical."""

    @cached_property
    def scatter(self) -> float:
        """rad², of one edge of these turns, in the mean of the recording."""
        own = 0.0 if self.n_p else float(np.mean(np.square(self.fit.pairs)))
        jitter = self.fit.jitter[np.isfinite(self.fit.jitter)]
        return own + (float(np.mean(np.square(jitter))) if len(jitter) else 0.0)

    def _swing(self, off: Floats, n: int) -> Floats:
        """Mean square that edges, (m,) rad late and n in a turn, repeat once and twice in a turn of the shaft, of the
        turn around each that has half of one on either side: places, or a shaft that swings.
        """
        half = n // 2
        found = np.zeros(len(off) - 2 * half)
        for times in range(1, min(3, self.n_p)):
            wave = off * np.exp(-1j * math.tau * times / n * np.arange(len(off)))
            sums = np.concatenate([[0.0], np.cumsum(wave)])
            found += 2.0 * UNSEEN * np.square(np.abs(sums[n:] - sums[:-n]) / n)[: len(found)]
        return found

    @property
    def late(self) -> tuple[float, float]:
        """s by which rising edges come later than falling ones, and its standard error; NaN where nothing tells."""
        return rising_late(self.fit)

    def added(self, captures: Iterable[Capture]) -> Iterator[Capture]:
        """The captures, which follow each other, with `CHANNELS`."""
        held: list[Capture] = []
        edges: list[EdgeChunk] = []
        for capture in captures:
            held.append(capture)
            edges.append(capture.edges)
            wait = int(SPAN * capture.tick_hz)
            while len(held) > 1 and held[-1].samples.tick[-1] - held[0].samples.tick[-1] > wait:
                yield self._told(held.pop(0), join(edges))
                first = held[0].samples.tick[0] - 2 * wait
                edges = [part for part in edges if len(part) and part.tick[-1] >= first] or edges[-1:]
        for capture in held:
            yield self._told(capture, join(edges))

    def _told(self, capture: Capture, edges: EdgeChunk) -> Capture:
        samples = capture.samples
        theta, sd = angles(self.knots(edges), samples.tick)
        config = replace(samples.config, channels=(*samples.config.channels, *CHANNELS))
        return replace(capture, samples=with_columns(samples, config, (theta, sd)))

    def knots(self, edges: EdgeChunk) -> Knots:
        """Those of edges in a row."""
        edge, way = edge_passages(edges.hall_old & 7, edges.hall_new & 7)
        parts = [_nothing()]
        if len(edge):
            # each passage of a run goes on from the one before, in its direction
            goes_on = (way[1:] == way[:-1]) & (way[1:] != 0) & (edges.hall_old[1:] == edges.hall_new[:-1])
            goes_on[breaks(edges.index) - 1] = False
            starts = np.flatnonzero(np.concatenate([[True], ~goes_on]))
            for first, last in zip(starts, [*starts[1:], len(edge)], strict=True):
                if last - first > 4 * self.per_turn:
                    with np.errstate(divide="ignore", invalid="ignore"):  # edges of one tick tell no angle
                        parts.append(self._run(edges, slice(first, last), edge, int(way[first])))
        return Knots(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _run(self, edges: EdgeChunk, rows: slice, edge: NDArray[np.int64], way: int) -> Knots:
        """Knots of one run of edges."""
        at, n = np.arange(rows.start, rows.stop), self.per_turn
        if self.kind:
            fell = (edges.hall_old[rows] & ~edges.hall_new[rows] & 7) != 0
            at, n = at[fell == (self.kind == "falling")], n // 2
        tick_hz, begin = edges.config.tick_hz, edges.tick[at[0]]
        t = (edges.tick[at] - begin) / tick_hz
        if len(t) < 4 * n + 1:
            return _nothing()
        j = np.arange(n, len(t) - n)
        even, bend = even_times(t, j, n)
        angle = edge_angle(edge[at[0]], self.zero) + way * SECTOR_WIDTH * (at - at[0])[j]
        slope = np.gradient(angle, even)
        omega, bend = np.abs(slope[n:-n]), bend * n**2
        square = np.square(np.diff(bend))
        jitter = _rolling(square, 2 * n) / 12.0
        mean, scatter = _rolling(bend, 2 * n + 1), _rolling(np.square(bend), 2 * n + 1)
        spread = np.maximum(scatter - np.square(mean), 0.0)
        each = 1.0 / n if self.n_p else min(1.0, ALIKE / n)
        jitter *= 1.0 if self.n_p else ALIKE  # edges of one magnet do not scatter
        jitter = np.maximum(jitter, self.scatter / np.square(omega))
        time = jitter * (each + JITTER) + BENT**2 * spread + self.step**2 / 12.0
        half = n // 2
        late = self._swing((t[j] - even) * np.abs(slope), n)[n - half : half - n or None]
        swing = np.square(SWING * np.square(math.tau * SWINGS / omega)) + late
        sd = np.full(len(j), math.nan)
        sd[n:-n] = np.sqrt(np.square(omega) * time + swing)
        whole = t[j[n:-n] + 2 * n] - t[j[n:-n] - 2 * n]
        steady = (scatter < np.square(CHANGE * whole / 8.0)) & (whole <= SPAN) & (sd[n:-n] <= MOST)
        ok = np.concatenate([np.zeros(n, bool), steady, np.zeros(n, bool)])
        ok[:-1] &= np.diff(even) > 0.0
        told = ok & np.append(ok[1:], False)
        return Knots(even * tick_hz + begin, angle, slope / tick_hz, np.nan_to_num(sd, nan=math.inf), told)


def by_edges(captures: Callable[[], Iterable[Capture]], parameters: Mapping[str, float], path: str) -> ByEdges:
    """How the edges of captures that follow each other tell the angle; `path` names them.

    Whole turns are those of the shaft where the pole pairs are known, by `parameters` or by edges that repeat, unless
    its speed never stays for so long. Where one kind of edges comes later than the other, the earlier one is used
    alone. BenchError where nothing can be told.
    """
    trace = trace_of(captures())
    inputs = hall_inputs.read(trace.edges, trace.tick_hz)
    given = pole_pairs(parameters)
    fit = fitted_blind(inputs, trace.tick_hz, given, trace.time_step)
    if fit is None:
        raise BenchError(f"{path} cannot be scored by its own edges: no two electrical turns in one direction")
    n_p = given or fit.n_p
    late, error = rising_late(fit)
    apart = math.isfinite(late) and abs(late) * fit.fastest > LATE and abs(late) > SURE * error
    kind = ("falling" if late > 0.0 else "rising") if apart else ""
    electrical = ByEdges(SECTORS, kind, fit, trace.time_step, hall_offset(parameters), 0)
    if not n_p:
        return electrical
    of_shaft = replace(electrical, per_turn=SECTORS * n_p, n_p=n_p)
    if n_p == 1:
        return of_shaft
    told = np.zeros(2)
    by_shaft, by_turn = tee(captures())
    for both in zip(of_shaft.added(by_shaft), electrical.added(by_turn), strict=True):
        told += [np.count_nonzero(np.isfinite(one.samples.raw[ANGLE])) for one in both]
    return of_shaft if told[0] > MUCH * told[1] else electrical


def rising_late(fit: EdgeFit) -> tuple[float, float]:
    """s by which rising edges come later than falling ones, and its standard error; NaN where nothing tells."""
    rises, falls = fit.delay.mean(axis=0)
    return float(rises - falls), float(2.0 * np.sqrt(np.mean(np.square(fit.delay_sd)) / 2.0))


def angles(knots: Knots, tick: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Electrical angle and its standard deviation at ticks (n,), rad; NaN where none is told."""
    theta, sd = np.full((2, len(tick)), math.nan)
    if not len(knots.tick):
        return theta, sd
    k = np.searchsorted(knots.tick, tick, "right") - 1
    use = (k >= 0) & knots.told[np.maximum(k, 0)]
    k, at = k[use], tick[use]
    long = knots.tick[k + 1] - knots.tick[k]
    u = (at - knots.tick[k]) / long
    far = knots.angle[k + 1] - knots.angle[k]
    begins, ends = knots.slope[k] * long, knots.slope[k + 1] * long
    theta[use] = wrap(
        knots.angle[k] + u * (begins + u * (3.0 * far - 2.0 * begins - ends + u * (begins + ends - 2.0 * far)))
    )
    sd[use] = np.maximum(knots.sd[k], knots.sd[k + 1])
    return theta, sd


def _rolling(values: Floats, n: int) -> Floats:
    """Means of n values in a row."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    means: Floats = (sums[n:] - sums[:-n]) / n
    return means


def _nothing() -> Knots:
    none = np.zeros(0)
    return Knots(none, none, none, none, np.zeros(0, bool))

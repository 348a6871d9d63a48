"""What a shaft and its Hall sensors did, put together window by window: edges with angle, speed and current.

Edges of which no angle is known (beside a gap, or before the first sample) and edges of a shaft that hardly moves are
counted apart. Nothing here judges.

What is counted is counted over all of it; to measure from, evenly spread ones are kept, at most `MOST` samples and
`MOST_EDGES` edges: whenever there are more, half of them go.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.signal.capture import Capture
from bench.signal.channels import reference_angle
from bench.signal.chunks import BEGIN, as_bytes, contiguous, streams_none
from bench.signal.position import running
from bench.signal.records import Records
from bench.signal.windows import Window, windows
from protocol.streams import EdgeChunk, SampleChunk

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

STATOR = ("u_alpha", "u_beta", "i_a", "i_b")
"""Channels that the back-EMF is made of."""
LOOKED_AT = ("hall", "status", "i_d", "i_q", *STATOR)
"""Channels that are looked at, and the encoder's angle."""
SLOW = 5.0
"""Electrical rad/s, below which the direction of a shaft is not sure."""
SLOPE = 8e-3
"""s on either side of a sample over which the speed is taken."""
AROUND = 2.0 * SLOPE
"""s on either side of a piece, from which the speed at its ends is told."""
HELD = 0.1
"""s between two samples that a shaft is taken to go on for as fast as it was at the later one."""
MOST, MOST_EDGES, BLOCK = 500_000, 300_000, 60
"""Samples and edges that are measured from at most; of edges so many in a row are kept."""
BITS = 32
"""Of the number of a block, below that of the stretch: a block is a stretch where not all are kept."""
INPUTS = "abc"


@dataclass(frozen=True)
class Edges:
    """Edges of the Hall inputs, each array (m,)."""

    tick: Ints
    old: Ints
    """Code before, 0..7."""
    new: Ints
    theta: Floats
    """Electrical angle by the encoder, rad, unwrapped; NaN without an encoder."""
    omega: Floats
    """Electrical speed by the encoder, rad/s; NaN without an encoder."""
    current: Floats
    """Size of the current vector, A; NaN where no current was recorded."""
    stretch: Ints
    """Number of the stretch without a gap that it lies in."""


@dataclass(frozen=True)
class Some:
    """Some of the samples, evenly spread, each array (k,)."""

    tick: Ints
    hall: Ints
    """Codes."""
    theta: Floats
    """Electrical angle by the encoder, rad, unwrapped; NaN without an encoder."""
    omega: Floats
    """Electrical speed by the encoder, rad/s; NaN without an encoder."""
    current: Floats
    """Size of the current vector, A; NaN where no current was recorded."""
    u: NDArray[np.complex128]
    i: NDArray[np.complex128]
    """Voltage and current vectors, V and A; NaN where they were not recorded."""
    settled: NDArray[np.bool_]
    """Whether the outputs were on, and had been for eight samples."""


Arrays = TypeVar("Arrays", Some, Edges)


class Trace:
    """A stretch of time in which a shaft turned, put together window by window; it may be read in between.

    `most`, `most_edges`: samples and edges that are kept to measure from; 0: `MOST` and `MOST_EDGES`.
    """

    def __init__(self, most: int = 0, most_edges: int = 0) -> None:
        self._most, self._most_edges = most or MOST, most_edges or MOST_EDGES
        self._every = self._every_block = 1
        self.breaks = 0
        """Gaps, of samples and of edges."""
        self.came = 0
        """Edges, kept or not."""
        self.tick_hz = 0
        self.samples = 0
        """How many there are."""
        self.codes = np.zeros(8, np.int64)
        """(8,) how many samples had each code; 0 where the channel `hall` was not recorded."""
        self.encoder = False
        """Whether there is one."""
        self.up = self.down = 0.0
        """Electrical turns by the encoder, each way; 0 without one."""
        self.sample_time = 0.0
        """s from sample to sample."""
        self.changed = np.zeros((8, 8), np.int64)
        """(8, 8) how many edges there are, of all, from each code to each."""
        self.records = Records()
        """What edges and the channel `hall` tell of each other."""
        self.ticks = self.lost_edges = 0
        """Device time that is known, see `seconds`; and edges that were lost."""
        self._end: int | None = None  # tick of the last sample
        self._edge = BEGIN  # of the last edge
        self.unplaced = self.slow = 0
        """Edges left out: their angle is not known, beside a gap or without samples; the shaft hardly moved."""
        self.parameters: Mapping[str, float] = {}
        """The drive's, by name."""
        self.pwm_hz = 0
        self.edge_step = 0.0
        """See `Capture`."""
        self.dropped: list[tuple[int, int, str]] = []
        """What was lost, as a `Capture` has it."""
        self._some: list[Some] = []
        self._edges: list[Edges] = []
        self._kept = self._kept_edges = 0
        self._angle: float | None = None  # the last one, unwrapped

    @property
    def some(self) -> Some:
        """Some of the samples, evenly spread."""
        self._some = [_together(Some, self._some)]
        return self._some[0]

    @property
    def edges(self) -> Edges:
        """Edges, some in a row each, evenly spread; no angle is known beside a gap."""
        self._edges = [_together(Edges, self._edges)]
        return self._edges[0] if self._every_block > 1 else _in_a_row(self._edges[0])

    @property
    def time_step(self) -> float:
        """s between the times that edges can have: one tick, or the period at which a drive looks at its inputs."""
        ticks = np.diff(self.edges.tick)
        return max(self.edge_step, float(np.gcd.reduce(ticks)) / self.tick_hz) if len(ticks) else 0.0

    def add(self, window: Window) -> Edges:
        """Add a window, which has `SLOPE` on either side of its own samples, or more. Returns its edges."""
        capture, own = window.capture, window.own
        config, tick = capture.samples.config, capture.samples.tick
        self.parameters, self.pwm_hz, self.tick_hz = capture.parameters, config.pwm_hz, config.tick_hz
        self.edge_step = capture.edge_step
        self.encoder = bool(reference_angle(config.channels))
        if not self.sample_time:
            self.sample_time = (float(np.median(np.diff(tick))) if len(tick) > 1 else 1.0) / capture.tick_hz
        self.dropped += capture.dropped
        hall = np.zeros(len(capture), np.int64)
        if "hall" in capture:
            hall = capture.samples.raw["hall"].astype(np.int64)
            self.codes += np.bincount(np.clip(hall[own], 0, 7), minlength=8)
        theta = omega = np.full(len(capture), math.nan)
        if self.encoder:
            theta = self._unwrapped(capture.theta, own)
            omega = np.concatenate([speed(theta[rows], capture.t[rows]) for rows in contiguous(capture.samples)])
            way = omega[own] * self._steps(tick, own) / math.tau
            moving = np.abs(omega[own]) >= SLOW
            self.up += float(way[moving & (way > 0)].sum())
            self.down -= float(way[moving & (way < 0)].sum())
        self._add_some(capture, own, hall, theta, omega)
        edges = self._add_edges(capture, theta, omega)
        self.samples += own.stop - own.start
        self._cover(capture, own)
        self.records.add(capture, own, hall if "hall" in capture else None)
        return edges

    def _steps(self, tick: Ints, own: slice) -> Floats:
        """s from each own sample's predecessor to it; a gap in which the speed may have changed counts as no more."""
        before = tick[own.start - 1 : own.stop - 1] if own.start else np.append(tick[0], tick[: own.stop - 1])
        steps: Floats = (tick[own] - before) / self.tick_hz
        return np.where((steps > 0.0) & (steps <= HELD), steps, self.sample_time)

    def _cover(self, capture: Capture, own: slice) -> None:
        """Add the device time of a window: all since the one before, but for that in which records are missing."""
        tick, end = capture.samples.tick, int(capture.samples.tick[own.stop - 1])
        first = int(tick[own.start]) - round(self.sample_time * self.tick_hz)
        begin = first if self._end is None or self._end > end else self._end
        missed = capture.samples if streams_none(capture.edges.config) else capture.edges
        at = [gap.position for gap in missed.gaps if gap.position < len(missed)]
        before = [int(missed.tick[k - 1]) if k else max(begin, self._edge) for k in at]
        lost = sum(max(0, min(int(missed.tick[k]), end) - max(a, begin)) for k, a in zip(at, before, strict=True))
        self.ticks += max(0, end - begin - lost)
        self.lost_edges += sum(gap.lost_samples for gap in capture.edges.gaps)
        self._end = end
        if len(missed):
            self._edge = int(missed.tick[-1])

    def _unwrapped(self, theta: Floats, own: slice) -> Floats:
        """The angle as it goes on from the window before: what does not repeat with it does so over all of them."""
        if self._angle is not None and own.start:
            theta = theta + math.tau * round((self._angle - theta[own.start - 1]) / math.tau)
        self._angle = float(theta[own.stop - 1])
        return theta

    def _add_some(self, capture: Capture, own: slice, hall: Ints, theta: Floats, omega: Floats) -> None:
        at = np.arange(len(hall))[own][-self.samples % self._every :: self._every]
        some, on = _at(capture, at), driven(capture)[at]
        u = i = np.full(len(at), complex(math.nan, math.nan))
        if all(name in capture for name in STATOR):
            u, i = stator(some)
        self._some.append(Some(some.samples.tick, hall[at], theta[at], omega[at], _current(some), u, i, on))
        self._kept += len(at)
        while self._kept > self._most:
            self._every *= 2
            self._some = [_of(self.some, slice(None, None, 2))]
            self._kept = len(self._some[0].tick)

    def _add_edges(self, capture: Capture, theta: Floats, omega: Floats) -> Edges:
        raw = capture.edges
        tick, old, new = raw.tick, raw.hall_old.astype(np.int64) & 7, raw.hall_new.astype(np.int64) & 7
        used = np.ones(len(tick), bool)
        angle = rate = np.full(len(tick), math.nan)
        if self.encoder and len(tick):
            known = _known(capture.samples.tick, tick, self.sample_time * capture.tick_hz)
            angle, rate = (
                np.where(known, np.interp(tick, capture.samples.tick, values), math.nan) for values in (theta, omega)
            )
            used = known & (np.abs(rate) >= SLOW)
            self.unplaced += int(np.count_nonzero(~known))
            self.slow += int(np.count_nonzero(known & ~used))
        np.add.at(self.changed, (old[used], new[used]), 1)
        breaks = np.sort(np.append(_after_gaps(capture.samples), _after_gaps(raw)))
        stretch = self.breaks + np.searchsorted(breaks, tick, "right")
        self.breaks += len(breaks)
        near = np.clip(np.searchsorted(capture.samples.tick, tick), 0, len(capture) - 1)
        current = _current(_at(capture, near))
        added = Edges(tick, old, new, angle, rate, current, (stretch << BITS) + raw.index // BLOCK)
        self._edges.append(self._evenly(added))
        self.came += len(tick)
        self._kept_edges += len(self._edges[-1].tick)
        while self._kept_edges > self._most_edges:
            self._every_block *= 2
            self._edges = [self._evenly(_together(Edges, self._edges))]
            self._kept_edges = len(self._edges[0].tick)
        return _in_a_row(added)

    def _evenly(self, edges: Edges) -> Edges:
        """Those of the blocks that are kept."""
        return _of(edges, (edges.stretch & (1 << BITS) - 1) % self._every_block == 0)

    @property
    def count(self) -> float:
        """rad between two angles that the encoder knows; 0 without one."""
        theta = np.unique(np.round(self.some.theta % math.tau, 4))
        return float(np.median(np.diff(theta))) if self.encoder and 2 < len(theta) < len(self.some.theta) / 2 else 0.0

    @property
    def seconds(self) -> float:
        """Device time of which all Hall edges are known; without a stream of them, all samples."""
        return self.ticks / self.tick_hz if self.tick_hz else 0.0

    @property
    def measured(self) -> float:
        """Time of the edges that were kept, s."""
        return self.seconds * (self._kept_edges / self.came if self.came else 1.0)

    def changes(self) -> list[int]:
        """How often each input changed."""
        both = np.arange(8)
        flips = both[:, None] ^ both
        return [int(self.changed[flips >> number & 1 == 1].sum()) for number in range(len(INPUTS))]

    def back_emf(self, use: NDArray[np.bool_], backwards: bool = False) -> NDArray[np.complex128] | None:
        """The back-EMF e = u - (R_s + j omega L_s) i of `some`, those to `use`, in the encoder's frame, V, (k,).

        It is real and above 0 where the encoder is right; `backwards`: an encoder that counts down is. None where
        voltage, current, R_s_hat or L_s_hat are not known.
        """
        resistance, inductance = (self.parameters.get(name) for name in ("R_s_hat", "L_s_hat"))
        some, way = self.some, -1.0 if backwards else 1.0
        if resistance is None or inductance is None or np.isnan(some.u).all():
            return None
        omega = way * some.omega[use]
        e = some.u[use] - (resistance + 1j * omega * inductance) * some.i[use]
        # the voltage is that of the period that ends at the sample: it is half a period old
        angle = way * some.theta[use] - 0.5 * omega / self.pwm_hz
        still: NDArray[np.complex128] = e * np.exp(-1j * angle) * np.sign(omega) / 1j
        return still


def trace_of(captures: Iterable[Capture]) -> Trace:
    """The trace of captures that follow each other. BenchError without samples, and without the channel `hall`."""
    found = Trace()
    for window in windows(captures, AROUND):
        if "hall" not in window.capture:
            raise BenchError("the channel 'hall' was not recorded: record it (bench live --save, all channels)")
        found.add(window)
    if not found.samples:
        raise BenchError("nothing was recorded")
    return found


def _together(kind: type[Arrays], parts: list[Arrays]) -> Arrays:
    if len(parts) == 1:
        return parts[0]
    return kind(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(kind)))


def _of(arrays: Arrays, which: NDArray[np.bool_] | slice) -> Arrays:
    return type(arrays)(*(getattr(arrays, field.name)[which] for field in fields(arrays)))


def _in_a_row(edges: Edges) -> Edges:
    """With the stretches of edges of which all were kept."""
    return replace(edges, stretch=edges.stretch >> BITS)


def _known(at: Ints, tick: Ints, period: float) -> NDArray[np.bool_]:
    """Which edges lie between two samples, at ticks `at`, that follow each other."""
    if len(at) < 2:
        return np.zeros(len(tick), bool)
    after = np.clip(np.searchsorted(at, tick), 1, len(at) - 1)
    known: NDArray[np.bool_] = (
        (tick >= at[after - 1]) & (tick <= at[after]) & (at[after] - at[after - 1] < 1.5 * period)
    )
    return known


def _after_gaps(chunk: SampleChunk | EdgeChunk) -> Ints:
    """Ticks of what comes first after a gap."""
    positions = [gap.position for gap in chunk.gaps if gap.position < len(chunk)]
    return chunk.tick[positions]


def _at(capture: Capture, rows: Ints) -> Capture:
    """Only these of the samples, in this order."""
    samples = capture.samples
    raw = as_bytes(samples.raw)[rows].view(samples.raw.dtype)
    samples = replace(samples, index=samples.index[rows], tick=samples.tick[rows], raw=raw, gaps=())
    return replace(capture, samples=samples)


def _current(capture: Capture) -> Floats:
    """Size of the current vector: by its dq components, else by two phases."""
    if "i_d" in capture and "i_q" in capture:
        return np.hypot(capture["i_d"], capture["i_q"])
    if "i_a" in capture and "i_b" in capture:
        return np.hypot(capture["i_a"], (capture["i_a"] + 2.0 * capture["i_b"]) / math.sqrt(3.0))
    return np.full(len(capture), math.nan)


def speed(theta: Floats, t: Floats, slope: float = SLOPE) -> Floats:
    """Speed at each sample from the samples `slope` s before and after it."""
    reach = max(1, round(slope * (len(t) - 1) / float(t[-1] - t[0]))) if len(t) > 1 else 1
    gone, took = (x[2 * reach :] - x[: -2 * reach] for x in (np.pad(theta, reach, "edge"), np.pad(t, reach, "edge")))
    return np.asarray(gone / np.maximum(took, 1e-9))


def stator(capture: Capture) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Voltage and current vectors, (n,) each, V and A."""
    i_a, i_b = capture["i_a"], capture["i_b"]
    return capture["u_alpha"] + 1j * capture["u_beta"], i_a + 1j * (i_a + 2.0 * i_b) / math.sqrt(3.0)


def driven(capture: Capture) -> NDArray[np.bool_]:
    """Where the outputs were on, and had been for eight samples."""
    on = running(capture.samples)
    return np.convolve(on, np.ones(9), "full")[: len(on)] > 8.5

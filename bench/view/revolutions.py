"""Whole electrical revolutions among the newest samples: where each begins and ends, and the angle in between.

One begins where sector I opens, and ends there, one on or one back. The angle is that of the reference, else that of
the Hall edges, between which the shaft is taken to turn evenly, else that of the first estimate.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.record.info import RunInfo
from bench.signal.position import unwrapped
from bench.signal.waveforms.sectors import SECTORS, hall_offset, sector_of_code
from bench.view import schema
from protocol.streams import EdgeChunk, SampleChunk

FOLLOWED = math.pi / 2  # electrical rad from sample to sample, above which an angle is not followed
MOST = 100_000  # samples, and edges, that are kept
REST = 1.0  # s, in which a shaft goes on by less than a sector if it rests
BY_HALL = "Hall edges"
GAP, NO_ANGLE = "samples are missing", "neither an angle nor a Hall edge"
NOT_FINITE = "the angle is not a finite number"
AT_REST, SLOW = "at rest", "one takes longer"

Values = NDArray[Any]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Revolution(NamedTuple):
    """Samples `first` to before `stop` lie between the angles `begin` and `end`, whole numbers, one apart."""

    first: int
    stop: int
    begin: int
    end: int


class Look(NamedTuple):
    """What there is to see: the newest samples, and the last two whole revolutions among them, in order."""

    tick: I64
    angle: F64
    """In revolutions from where sector I opens, (n,), followed; NaN where it is not known."""
    whole: list[Revolution]
    source: str
    """Whose angle it is; empty without any."""
    why: str
    """Why there is none, or none since."""


def whole_revolutions(angle: F64) -> list[Revolution]:
    """All whole ones among angles (n,) in revolutions, followed; none in which a step is too large to be followed.

    A shaft that comes back to where one began has made none; where it dithers there, the last time counts.
    """
    number = np.floor(angle)
    step = np.diff(number)
    at = np.flatnonzero(step) + 1
    boundary = np.maximum(number[at], number[at - 1])
    lost = np.concatenate([[0], np.cumsum(~(np.abs(np.diff(angle)) <= FOLLOWED / math.tau))])
    whole = (np.abs(np.diff(boundary)) == 1) & (lost[at[1:]] == lost[at[:-1] - 1])
    return [
        Revolution(int(at[k]), int(at[k + 1]), int(boundary[k]), int(boundary[k + 1])) for k in np.flatnonzero(whole)
    ]


def hall_angle(old: NDArray[np.uint8], new: NDArray[np.uint8]) -> tuple[I64, F64]:
    """Which of the edges (n,) with these codes lead to another sector, and the angle of each of these in revolutions.

    Only those since an edge led half a revolution on, or back: nobody knows which.
    """
    sector = sector_of_code(new & 7)
    at = np.flatnonzero(sector >= 0)
    if not len(at):
        return at, np.zeros(0)
    before = sector_of_code(old[at[:1]] & 7)
    sector = np.concatenate([before if before[0] >= 0 else sector[at[:1]], sector[at]])
    step = (np.diff(sector) + 2) % SECTORS - 2
    begin = int(np.flatnonzero(step == SECTORS // 2)[-1]) + 1 if (step == SECTORS // 2).any() else 0
    passed = np.cumsum(np.concatenate([sector[begin : begin + 1], step[begin:]]))
    led = np.flatnonzero(step[begin:])
    return at[begin:][led], (passed[led] + passed[led + 1] + 1) / (2.0 * SECTORS)


def too_fast(theta: F64, omega: Values | None, seconds: float) -> str:
    """Why an angle (n,) rad, unwrapped, cannot be followed from sample to sample, `seconds` apart; '' if it can.

    A step of nearly a whole revolution looks like a small one, but for the speed `omega`, (n,) electrical rad/s.
    """
    if len(theta) < 2:
        return ""
    step = float(np.abs(np.diff(theta)).max())
    if omega is not None:
        step = max(step, float(np.abs(omega).mean()) * seconds)
    if step <= FOLLOWED:
        return ""
    return f"the angle turns {math.degrees(step):.0f} deg from sample to sample: more samples a second are needed"


class Revolutions:
    """Keeps what has come since the last two whole revolutions began, in bounded memory."""

    def __init__(self, run: RunInfo) -> None:
        self._run = run
        self._offset = hall_offset(run.parameters)
        self._speed = run.speeds[-1] if run.speeds else ""
        self.restart()

    def restart(self) -> None:
        """Start anew: the drive has rebooted."""
        self._samples: deque[tuple[I64, Mapping[str, Values]]] = deque()
        self._edges: list[tuple[I64, NDArray[np.uint8], NDArray[np.uint8]]] = []
        self._index = 0  # of the newest sample
        self._needed = 0  # tick from which on samples are
        self._gap = False  # and no whole revolution since

    def samples(self, chunk: SampleChunk, values: Mapping[str, Values]) -> None:
        """Take samples and their `values`, (n,) each, the same quantities each time."""
        first = max((gap.position for gap in chunk.gaps), default=0)
        if chunk.gaps or self._index != int(chunk.index[0]) - chunk.config.index_step:  # left out, if not lost
            self._gap = bool(self._samples) or first > 0
            self._samples.clear()
        self._index = int(chunk.index[-1])
        self._samples.append((chunk.tick[first:], {name: value[first:] for name, value in values.items()}))
        while sum(len(tick) for tick, _ in self._samples) > MOST and len(self._samples) > 1:
            self._samples.popleft()

    def edges(self, chunk: EdgeChunk) -> None:
        """Take Hall edges."""
        first = max((gap.position for gap in chunk.gaps), default=0)
        if chunk.gaps:
            self._edges.clear()
        self._edges.append((chunk.tick[first:], chunk.hall_old[first:], chunk.hall_new[first:]))
        if sum(len(tick) for tick, *_ in self._edges) > 2 * MOST:
            self._edges = [tuple(column[-MOST:] for column in self.hall())]  # type: ignore[list-item]

    def hall(self) -> tuple[I64, NDArray[np.uint8], NDArray[np.uint8]]:
        """Ticks of the Hall edges, codes before and after, (n,) each; by the samples' codes where no edges come."""
        if self._edges:
            tick, old, new = (np.concatenate(column) for column in zip(*self._edges, strict=True))
            return tick, old, new
        if not self._samples or "hall" not in self._run.words:
            return np.zeros(0, np.int64), np.zeros(0, np.uint8), np.zeros(0, np.uint8)
        code = self.values(["hall"], 0, None)["hall"].astype(np.uint8)
        at = np.flatnonzero(np.diff(code)) + 1
        return self._tick()[at], code[at - 1], code[at]

    def values(self, names: list[str], first: int, stop: int | None) -> dict[str, Values]:
        """These quantities of the kept samples `first` to before `stop`, (n,) each."""
        found: dict[str, list[Values]] = {name: [] for name in names}
        at = 0
        for tick, values in self._samples:
            if at + len(tick) > first and (stop is None or at < stop):
                of = slice(max(0, first - at), None if stop is None else stop - at)
                for name, parts in found.items():
                    parts.append(values[name][of])
            at += len(tick)
        return {name: np.concatenate(parts) for name, parts in found.items()}

    @property
    def newest(self) -> int | None:
        """Tick of the newest sample; None before the first."""
        return int(self._samples[-1][0][-1]) if self._samples else None

    @property
    def code(self) -> int | None:
        """The Hall code of the newest sample; None where samples do not hold it."""
        return int(self._samples[-1][1]["hall"][-1]) if "hall" in self._run.words else None

    def look(self) -> Look:
        """Find the last two whole revolutions, after the first sample. What is older than the last two is not kept."""
        self._forget()
        tick = self._tick()
        seconds = (tick[-1] - tick[0]) / max(1, len(tick) - 1) / self._run.tick_hz
        angle, source, why = self._angle(tick, seconds)
        whole = [] if why else whole_revolutions(angle)[-2:]
        self._gap = self._gap and not whole
        found = Look(tick, angle, whole, source, why or (GAP if self._gap else self._pace(tick, angle)))
        self._needed = int(tick[whole[0].first - 1]) if whole else self._needed
        return found

    def _tick(self) -> I64:
        return np.concatenate([tick for tick, _ in self._samples])

    def _angle(self, tick: I64, seconds: float) -> tuple[F64, str, str]:
        """The angle at these ticks, whose it is, and why it is of no use."""
        reference, unknown = self._run.position_reference, np.full(len(tick), np.nan)
        if self._run.hall and not reference:
            at, old, new = self.hall()
            led, passed = hall_angle(old, new)
            if len(led):
                return np.interp(tick, at[led], passed), BY_HALL, ""
        channel = reference or next(iter(self._run.position_estimates), None)
        if channel is None:
            return unknown, "", NO_ANGLE
        speed = [self._speed] if self._speed else []
        values = self.values([channel, *speed], 0, None)
        theta = unwrapped(values[channel].astype(np.float64))
        if not math.isfinite(theta[-1]):
            return unknown, schema.label(channel), NOT_FINITE
        newest = max(0, len(theta) - round(REST / seconds)) if seconds else 0
        why = too_fast(theta[newest:], values[self._speed][newest:] if speed else None, seconds)
        return (theta - self._offset) / math.tau, schema.label(channel), why

    def _pace(self, tick: I64, angle: F64) -> str:
        """Whether the shaft rests or is slow, if no whole revolution comes."""
        since = np.searchsorted(tick, tick[-1] - REST * self._run.tick_hz)
        return AT_REST if np.ptp(angle[since:]) * SECTORS < 1.0 else SLOW

    def _forget(self) -> None:
        """Keep no samples and edges from before what is needed, but for one edge, whose code holds there."""
        while int(self._samples[0][0][-1]) < self._needed:
            self._samples.popleft()
        while len(self._edges) > 1 and int(self._edges[1][0][0]) <= self._needed:
            self._edges.pop(0)

"""What is put together of one observer over a recording, block by block: its figures, and what its plots show."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.replay.estimators import Estimate
from bench.score.metrics import Changes, LagBySpeed, LagInTime
from bench.score.phases import SPEED_EDGES, Phases, speed_bin, speed_numbers
from bench.signal.error_bins import BINS, ErrorByAngle, Errors, angle_bins
from bench.signal.position import Moments
from bench.signal.units import RPM
from bench.signal.waveforms import sector_of_angle
from bench.signal.waveforms.sectors import SECTORS
from sim.native import address
from sim.observers import against
from sim.observers.against import NONE

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bytes = NDArray[np.uint8]

UNSTEADY = SECTORS
"""Group of the samples in motion that are not steady; before it those of the sectors, behind it `OTHERS`."""
OTHERS = ("transient", "start_up", "reversal")
MOST_SPEEDS = len(SPEED_EDGES)  # bins of the speed, each way
SPEEDS = UNSTEADY + 1 + len(OTHERS) + MOST_SPEEDS
"""The group of a bin of the speed is its number more; behind them is the error of the speed."""
GROUPS = SPEEDS + MOST_SPEEDS + 2


@dataclass(frozen=True)
class Block:
    """n samples without a gap, and those around them that their lag is told from: m in all, `own` are the n.

    Angles in electrical rad, speeds in electrical rad/s, (m,) each, as are `phases`.
    """

    theta: F64
    omega: F64
    phases: Phases
    own: slice
    rate: float
    pole_pairs: int
    hall_offset: float
    t: float
    """Device time of the first of its own, s."""
    points: I64
    """Of the plots over time: the point that each of its own samples, (n,), belongs to."""

    def where(self, phase: str) -> I64:
        """Those of its own samples, from 0, that are in a phase."""
        return np.flatnonzero(getattr(self.phases, phase)[self.own])

    @cached_property
    def rpm_by(self) -> float:
        """r/min of the shaft for an electrical rad/s."""
        return 1.0 / (RPM * self.pole_pairs)

    @cached_property
    def keys(self) -> tuple[Bytes, Bytes, Bytes]:
        """Of its own samples: the two groups that each is in, and the bin of the encoder's angle, (n,) each."""
        steady, n = self.where("steady"), self.own.stop - self.own.start
        theta, rpm = self.theta[self.own][steady], self.omega[self.own][steady] * self.rpm_by
        first, second, angle = np.full(n, NONE, np.uint8), np.full(n, NONE, np.uint8), np.zeros(n, np.uint8)
        first[self.phases.moving[self.own]] = UNSTEADY
        for k, phase in enumerate(OTHERS, UNSTEADY + 1):
            at = self.where(phase)
            second[at] = k
        alone = (first == NONE) & (second != NONE)
        first[alone], second[alone] = second[alone], NONE
        first[steady] = sector_of_angle(theta, self.hall_offset)
        number = speed_numbers(rpm)
        second[steady] = np.where(number == 0, NONE, SPEEDS + number)
        angle[steady] = angle_bins(theta) + BINS * (rpm < 0.0)
        return first, second, angle

    @cached_property
    def changes(self) -> Changes | None:
        """Its speed where it changes; None where it does not."""
        return self.changes_where(np.ones(self.own.stop - self.own.start, bool))

    def changes_where(self, known: NDArray[np.bool_]) -> Changes | None:
        """The same of those of its own samples, (n,), that are `known`."""
        where = np.zeros(len(self.omega), bool)
        phases = self.phases
        where[self.own] = (phases.transient | phases.start_up | phases.reversal)[self.own] & known
        return Changes(self.omega, where, self.rate) if where.any() else None


class Tally:
    """The figures of an observer: angles in electrical degrees, speeds in r/min, lags in s."""

    def __init__(self) -> None:
        against.fold.load()
        self._counts = np.zeros((GROUPS, against.BINS), np.int64)
        self._errors = tuple(map(Errors, self._counts))
        self._angle_lag, self._speed_lag = LagBySpeed(), LagInTime()
        self.by_angle = ErrorByAngle()

    def add(self, block: Block, estimate: Estimate, over_time: OverTime) -> None:
        """Add a block, with the estimate of its own samples, (n,) each, to this and to what is plotted over time."""
        n = len(estimate.theta)
        self._fold(block, estimate, over_time, n)
        if block.changes is None:
            return
        known = np.isfinite(estimate.omega)
        if (changes := block.changes if known.all() else block.changes_where(known)) is not None:
            whole = np.zeros(len(block.omega))
            whole[block.own] = estimate.omega
            self._speed_lag.add(changes, changes.against(whole))

    def _fold(self, block: Block, estimate: Estimate, over_time: OverTime, n: int) -> None:
        theta, omega = (np.ascontiguousarray(values[block.own]) for values in (block.theta, block.omega))
        step = estimate.theta.strides[0] // 8
        if step < 1 or estimate.theta.strides != estimate.omega.strides:
            step, estimate = 1, Estimate(*map(np.ascontiguousarray, estimate))
        scratch = np.empty(2 * against.PORTION + 4 * GROUPS)
        least = np.array([errors.least for errors in self._errors])
        beyond, whose = np.empty(3 * n), np.empty(3 * n, np.uint8)
        found = np.empty(4 * GROUPS + against.TAIL)
        against.fold(
            *addresses(theta, omega, *block.keys, block.points), n,
            *addresses(estimate.theta, estimate.omega), step, block.rpm_by, GROUPS,
            *addresses(scratch, scratch, self._counts, least, beyond, whose, self.by_angle.sums, over_time.ends),
            over_time.ends.shape[1], address(found),
        )  # fmt: skip
        many, peak, at, *lag = found[4 * GROUPS :].tolist()
        beyond, whose = beyond[: int(many)], whose[: int(many)]
        for k, (count, mean, m2, largest) in enumerate(found[: 4 * GROUPS].reshape(-1, 4).tolist()):
            if count:
                self._errors[k].counted(Moments(int(count), mean, m2, largest), beyond[whose == k])
        self._angle_lag.merge(LagBySpeed.of(*lag))
        over_time.take(peak, block.t + at / block.rate)

    def merge(self, other: Tally) -> None:
        """Add what another has."""
        for ours, theirs in zip(self._errors, other._errors, strict=True):
            ours.merge(theirs)
        self._angle_lag.merge(other._angle_lag)
        self._speed_lag.merge(other._speed_lag)
        self.by_angle.merge(other.by_angle)

    @property
    def steady(self) -> Errors:
        """Error in steady running: that in its six sectors."""
        return _merged(*self._errors[:SECTORS])

    @property
    def moving(self) -> Errors:
        """Error in all motion."""
        return _merged(self.steady, self._errors[UNSTEADY])

    def figures(self, starts: int, reversals: int) -> dict[str, Any]:
        """All of them."""
        transient, start_up, reversal = (errors.figures() for errors in self._errors[UNSTEADY + 1 :][: len(OTHERS)])
        return {
            "moving": self.moving.figures(),
            "error": self.steady.figures(),
            "transient": transient,
            "start_up": {"events": starts, **start_up},
            "reversal": {"events": reversals, **reversal},
            "speed": self._errors[-1].figures(),
            "lag": {"angle_us": _microseconds(self._angle_lag.lag()), "speed_us": _microseconds(self._speed_lag.lag())},
            "by_speed": {
                speed_bin(k): errors.figures()
                for k, errors in enumerate(self._errors[:-1], -SPEEDS)
                if abs(k) <= MOST_SPEEDS and k and errors.n
            },
            "by_sector": {str(k): errors.figures() for k, errors in enumerate(self._errors[:SECTORS], 1)},
        }


class Envelope:
    """The least and the largest of a quantity at each point of a plot over time, so that no peak is lost, (points,)."""

    def __init__(self, points: int, ends: F64 | None = None) -> None:
        """`ends` (2, points): where they lie."""
        self.lo, self.hi = np.empty((2, points)) if ends is None else ends
        self.lo[:], self.hi[:] = np.inf, -np.inf

    def add(self, points: I64, values: F64) -> None:
        """Add values (n,), one or more, and the points that they belong to, which rise."""
        starts = np.flatnonzero(np.diff(points, prepend=-1))
        at = points[starts]
        self.lo[at] = np.minimum(self.lo[at], np.minimum.reduceat(values, starts))
        self.hi[at] = np.maximum(self.hi[at], np.maximum.reduceat(values, starts))


class OverTime:
    """What a plot over time shows of an observer: error in electrical degrees, speed in r/min, the largest error."""

    def __init__(self, points: int) -> None:
        self.ends = np.empty((4, points))
        self.error, self.speed = Envelope(points, self.ends[:2]), Envelope(points, self.ends[2:])
        self.peak = self.peak_t = 0.0
        """Electrical degrees, s of device time."""

    def take(self, peak: float, t: float) -> None:
        """Take in the largest error of a block."""
        if peak > self.peak:
            self.peak, self.peak_t = peak, t


def addresses(*arrays: NDArray[Any]) -> list[int]:
    """Where the elements of arrays begin."""
    return [address(array) for array in arrays]


def _merged(*errors: Errors) -> Errors:
    whole = Errors()
    for part in errors:
        whole.merge(part)
    return whole


def _microseconds(seconds: float | None) -> float | None:
    return None if seconds is None else 1e6 * seconds

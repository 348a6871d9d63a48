"""What is put together of one observer over a recording, block by block: its figures, and what its plots show."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.replay.estimators import Estimate
from bench.score.metrics import Changes, LagBySpeed, LagInTime
from bench.score.phases import Phases, in_order, speed_bins
from bench.signal.error_bins import ErrorByAngle, Errors, angle_bins
from bench.signal.position import position_error
from bench.signal.units import RPM
from bench.signal.waveforms import sector_of_angle
from bench.signal.waveforms.sectors import SECTORS

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


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
    def steady(self) -> I64:
        """Its own samples in steady running."""
        return self.where("steady")

    @cached_property
    def phased(self) -> dict[str, I64]:
        """Its own samples in the other phases, and those in motion that are not steady."""
        moving = self.phases.moving & ~self.phases.steady
        others = {name: self.where(name) for name in ("transient", "start_up", "reversal")}
        return {"unsteady": np.flatnonzero(moving[self.own]), **others}

    @cached_property
    def by_sector(self) -> dict[str, I64]:
        """Its steady samples by the sector of the encoder's angle."""
        sector = sector_of_angle(self.theta[self.own][self.steady], self.hall_offset)
        return {str(k + 1): self.steady[sector == k] for k in range(SECTORS)}

    @cached_property
    def by_speed(self) -> dict[str, I64]:
        """Its steady samples by bins of the speed."""
        rpm = self.omega[self.own][self.steady] * self.rpm_by
        return {name: self.steady[at] for name, at in speed_bins(rpm).items()}

    @cached_property
    def by_angle(self) -> tuple[I64, NDArray[np.bool_]]:
        """Bin of the encoder's angle of its steady samples, and whether they turn in reverse."""
        return angle_bins(self.theta[self.own][self.steady]), self.omega[self.own][self.steady] < 0.0

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
        self._sectors = {str(k + 1): Errors() for k in range(SECTORS)}
        self._speeds: dict[str, Errors] = {}
        self._phases = {name: Errors() for name in ("unsteady", "transient", "start_up", "reversal")}
        self._speed = Errors()
        self._angle_lag, self._speed_lag = LagBySpeed(), LagInTime()
        self.by_angle = ErrorByAngle()

    def add(self, block: Block, estimate: Estimate, degrees: F64) -> None:
        """Add a block, with the estimate of its own samples and the error of that angle, (n,)."""
        for name, at in block.phased.items():
            self._phases[name].add(degrees[at])
        for name, at in block.by_sector.items():
            self._sectors[name].add(degrees[at])
        for name, at in block.by_speed.items():
            self._speeds.setdefault(name, Errors()).add(degrees[at])
        steady, omega = block.steady, block.omega[block.own]
        bins, reverse = block.by_angle
        self.by_angle.add(bins, degrees[steady], reverse)
        slip = (omega - estimate.omega)[steady] * block.rpm_by
        self._speed.add(slip[np.isfinite(slip)])
        self._angle_lag.add(omega[steady], np.radians(degrees[steady]))
        known = np.isfinite(estimate.omega)
        changes = block.changes if known.all() else block.changes_where(known)
        if changes is not None:
            whole = np.zeros(len(block.omega))
            whole[block.own] = estimate.omega
            self._speed_lag.add(changes, changes.against(whole))

    def merge(self, other: Tally) -> None:
        """Add what another has."""
        for name, errors in other._speeds.items():
            self._speeds.setdefault(name, Errors()).merge(errors)
        for ours, theirs in ((self._sectors, other._sectors), (self._phases, other._phases)):
            for name, errors in theirs.items():
                ours[name].merge(errors)
        self._speed.merge(other._speed)
        self._angle_lag.merge(other._angle_lag)
        self._speed_lag.merge(other._speed_lag)
        self.by_angle.merge(other.by_angle)

    @property
    def steady(self) -> Errors:
        """Error in steady running: that in its six sectors."""
        return _merged(*self._sectors.values())

    @property
    def moving(self) -> Errors:
        """Error in all motion."""
        return _merged(self.steady, self._phases["unsteady"])

    def figures(self, starts: int, reversals: int) -> dict[str, Any]:
        """All of them."""
        phases = {name: errors.figures() for name, errors in self._phases.items()}
        return {
            "moving": self.moving.figures(),
            "error": self.steady.figures(),
            "transient": phases["transient"],
            "start_up": {"events": starts, **phases["start_up"]},
            "reversal": {"events": reversals, **phases["reversal"]},
            "speed": self._speed.figures(),
            "lag": {"angle_us": _microseconds(self._angle_lag.lag()), "speed_us": _microseconds(self._speed_lag.lag())},
            "by_speed": {name: self._speeds[name].figures() for name in in_order(self._speeds)},
            "by_sector": {name: errors.figures() for name, errors in self._sectors.items()},
        }


class Envelope:
    """The least and the largest of a quantity at each point of a plot over time, so that no peak is lost, (points,)."""

    def __init__(self, points: int) -> None:
        self.lo, self.hi = np.full(points, np.inf), np.full(points, -np.inf)

    def add(self, points: I64, values: F64) -> None:
        """Add values (n,), one or more, and the points that they belong to, which rise."""
        starts = np.flatnonzero(np.diff(points, prepend=-1))
        at = points[starts]
        self.lo[at] = np.minimum(self.lo[at], np.minimum.reduceat(values, starts))
        self.hi[at] = np.maximum(self.hi[at], np.maximum.reduceat(values, starts))


class OverTime:
    """What a plot over time shows of an observer: error in electrical degrees, speed in r/min, the largest error."""

    def __init__(self, points: int) -> None:
        self.error, self.speed = Envelope(points), Envelope(points)
        self.peak = self.peak_t = 0.0
        """Electrical degrees, s of device time."""

    def add(self, block: Block, estimate: Estimate, degrees: F64) -> None:
        """Add a block, see `Tally.add`."""
        self.error.add(block.points, degrees)
        self.speed.add(block.points, estimate.omega * block.rpm_by)
        at = int(np.abs(degrees).argmax())
        if (size := float(abs(degrees[at]))) > self.peak:
            self.peak, self.peak_t = size, block.t + at / block.rate


def error_of(block: Block, estimate: Estimate) -> F64:
    """The error of an estimate of a block's own samples, electrical degrees, (n,)."""
    degrees: F64 = np.degrees(position_error(block.theta[block.own], estimate.theta))
    return degrees


def _merged(*errors: Errors) -> Errors:
    whole = Errors()
    for part in errors:
        whole.merge(part)
    return whole


def _microseconds(seconds: float | None) -> float | None:
    return None if seconds is None else 1e6 * seconds

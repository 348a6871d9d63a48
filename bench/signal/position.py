"""Position errors, and their statistics over a run, by estimate and segment.

Nothing here keeps samples: memory stays bounded however long the run is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.signal.channels import reference_angle
from protocol.codes import DriveState
from protocol.signals import STATUS_STATE_MASK, Flag, Unit
from protocol.streams import SampleChunk


def wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """`angle` in rad, any shape, wrapped to [-pi, pi); what is not finite comes out as NaN."""
    with np.errstate(invalid="ignore"):
        turned: NDArray[np.float64] = angle + math.pi
        if np.ndim(turned) and turned.size and -math.tau <= (lo := turned.min()) <= (hi := turned.max()) < 2 * math.tau:
            if hi >= math.tau:  # to the last bit what % makes of these, and a tenth of its time
                np.subtract(turned, math.tau, out=turned, where=turned >= math.tau)
            if lo < 0.0:
                np.add(turned, math.tau, out=turned, where=turned < 0.0)
        else:
            turned = turned % math.tau
    return turned - math.pi


def unwrapped(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """`angle` (n,) in rad, followed over its wraps; NaN from the first that is not finite on.

    To the last bit as `numpy.unwrap` has it, which computes each step as if it were a wrap.
    """
    step = np.diff(angle)
    at = np.flatnonzero(~(np.abs(step) < math.pi))
    turn = wrap(step[at])
    turn[(turn == -math.pi) & (step[at] > 0.0)] = math.pi
    turns = np.concatenate([[0.0], np.cumsum(turn - step[at])])
    followed: NDArray[np.float64] = angle + np.repeat(turns, np.diff(np.concatenate([[0], at + 1, [len(angle)]])))
    return followed


def wrapped(angle: float) -> float:
    """One angle in rad, wrapped to [-pi, pi)."""
    return (angle + math.pi) % math.tau - math.pi


def position_error(actual: NDArray[Any], estimated: NDArray[Any]) -> NDArray[Any]:
    """Actual minus estimated angle, rad in [-pi, pi), of angles of any one shape."""
    return wrap(actual - estimated)


def position_errors(chunk: SampleChunk) -> dict[str, NDArray[np.float64]]:
    """`position_error` of every position estimate in the chunk, (n,) each; empty without an encoder.

    A reference that calls itself an estimate is none: it would be compared with itself.
    """
    channels = chunk.config.channels
    reference = reference_angle(channels)
    if not reference:
        return {}
    actual = chunk.physical(reference)
    return {
        channel.name: position_error(actual, chunk.physical(channel.name))
        for channel in channels
        if channel.flags & Flag.ESTIMATE and channel.unit == Unit.RAD and channel.name != reference
    }


def states(chunk: SampleChunk) -> NDArray[np.int64] | None:
    """The drive's state at each sample by the channel status, shape (n,); None where no whole numbers tell it."""
    words = _status(chunk)
    return None if words is None else words.astype(np.int64) & STATUS_STATE_MASK


def last_state(chunk: SampleChunk) -> int | None:
    """The state at the last sample; None as `states`."""
    words = _status(chunk)
    return None if words is None else int(words[-1]) & STATUS_STATE_MASK


def _status(chunk: SampleChunk) -> NDArray[Any] | None:
    words = chunk.raw["status"] if "status" in (chunk.raw.dtype.names or ()) else None
    return None if words is None or words.dtype.kind not in "iu" else words


def running(chunk: SampleChunk) -> NDArray[np.bool_]:
    """Where the drive is RUNNING, (n,); everywhere, where it does not tell."""
    told = states(chunk)
    return np.ones(len(chunk), bool) if told is None else told == DriveState.RUNNING


@dataclass(slots=True)
class Moments:
    """Count, mean, standard deviation and largest magnitude, merged chunk by chunk (Chan et al. 1979)."""

    n: int = 0
    mean: float = 0.0
    m2: float = 0.0
    peak: float = 0.0

    def add(self, values: NDArray[np.float64]) -> None:
        """Add `values`, shape (n,)."""
        if len(values):
            mean = float(values.mean())
            self.merge(Moments(len(values), mean, float(((values - mean) ** 2).sum()), float(np.abs(values).max())))

    def merge(self, other: Moments) -> None:
        """Add those of other values."""
        total = self.n + other.n
        if not other.n:
            return
        delta = other.mean - self.mean
        self.m2 += other.m2 + delta * delta * self.n * other.n / total
        self.mean += delta * other.n / total
        self.n = total
        self.peak = max(self.peak, other.peak)

    @property
    def std(self) -> float:
        """Standard deviation of the population; NaN before the first value."""
        return math.sqrt(self.m2 / self.n) if self.n else math.nan

    @property
    def rms(self) -> float:
        """Root of the mean square; NaN before the first value."""
        return math.hypot(self.std, self.mean)


@dataclass(slots=True)
class ErrorTable:
    """Position error moments, by segment of the run and by estimator."""

    segments: dict[str, dict[str, Moments]] = field(default_factory=dict)

    def add(self, segment: str, errors: dict[str, NDArray[np.float64]]) -> None:
        """Add position errors in rad to `segment`."""
        row = self.segments.setdefault(segment, {})
        for name, values in errors.items():
            row.setdefault(name, Moments()).add(values)

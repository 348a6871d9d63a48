"""What becomes of the rows that a device pushes: the records of a stream of samples, values as they are or their means.

A row is a full sample of the device, in bytes. This module knows no frames and no links.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.errors import Refused
from protocol.messages import ErrorCode
from protocol.signals import Flag, RawType, Signal, Unit

Run = slice
"""Bytes of neighbouring channels in a full sample."""
Rows = NDArray[np.uint8]
"""Full samples of consecutive PWM periods, shape (n, bytes of a sample)."""


class LateSamples:
    """Samples of `n` periods that are made when somebody needs them.

    `make(names)` returns samples of all channels, in which those of these names are right.
    """

    __slots__ = ("_made", "_make", "_n", "_names")

    def __init__(self, n: int, make: Callable[[frozenset[str]], NDArray[np.void]]) -> None:
        self._n = n
        self._make = make
        self._names: frozenset[str] = frozenset()  # that are right in what has been made
        self._made: NDArray[np.void] | None = None

    def __len__(self) -> int:
        return self._n

    def made(self, names: frozenset[str]) -> NDArray[np.void]:
        """Return samples in which the channels of these names are right."""
        if self._made is None or not names <= self._names:
            self._names, self._made = names, self._make(names)
        return self._made

    def kept(self, names: frozenset[str]) -> Samples:
        """Return what is best kept by somebody who may need these names later: themselves, once they are made."""
        return self if self._made is None or not names <= self._names else self._made


Samples = NDArray[np.void] | LateSamples
"""Samples of consecutive PWM periods, a field for each channel of a device; whoever gets them may keep them."""

MEAN_BYTES = 4  # of a channel in a record of means: an f32


def made(samples: Samples, names: frozenset[str]) -> NDArray[np.void]:
    """Return samples in which the channels of these names are right."""
    return samples.made(names) if isinstance(samples, LateSamples) else samples


def rows_of(raw: NDArray[np.void], dtype: np.dtype[np.void]) -> Rows:
    """Return samples of all channels as rows; TypeError if they are not of the channels' `dtype`."""
    if raw.dtype is not dtype and raw.dtype != dtype:
        raise TypeError(f"samples of {raw.dtype}, the channels make {dtype}")
    return np.ascontiguousarray(raw).view(np.uint8).reshape(len(raw), dtype.itemsize)


def runs_of(dtype: np.dtype[np.void], names: Iterable[str]) -> list[Run]:
    """Return where channels lie in a full sample of `dtype`, in the order of `names`, neighbours joined."""
    runs: list[Run] = []
    for name in names:
        each, start = dtype.fields[name][:2]  # type: ignore[index]
        end = start + each.itemsize
        if runs and runs[-1].stop == start:
            runs[-1] = slice(runs[-1].start, end)
        else:
            runs.append(slice(start, end))
    return runs


def packed(rows: Rows, runs: Sequence[Run]) -> Rows:
    """Return the channels in `runs` of some rows, without padding, shape (n, bytes of these)."""
    return np.concatenate([rows[:, run] for run in runs], axis=1)


class Records(Protocol):
    """Makes the records of one stream of samples."""

    @property
    def widths(self) -> Sequence[int]:
        """Bytes of each channel."""

    def take(self, index0: int, rows: Rows) -> tuple[int, Rows]:
        """Return the records that n more periods complete, shape (k, bytes of a record), and the index of the first.

        Records are `decimation` periods apart, at indices that it divides.
        """


class Values:
    """The channels' raw values in every `decimation`-th period."""

    def __init__(self, dtype: np.dtype[np.void], channels: Sequence[Signal], decimation: int) -> None:
        self.widths = [np.dtype(channel.raw.dtype).itemsize for channel in channels]
        self._runs = runs_of(dtype, (channel.name for channel in channels))
        self._decimation = decimation

    def take(self, index0: int, rows: Rows) -> tuple[int, Rows]:
        """See `Records`."""
        offset = -index0 % self._decimation
        return index0 + offset, packed(rows[offset :: self._decimation], self._runs)


@dataclass(slots=True)
class _Sum:
    """What is known of a channel in the periods of a record that is not complete yet."""

    channel: Signal
    span: float  # of an angle, in raw units; 0 for what does not wrap
    lowest: float
    first: Any = 0
    total: Any = 0


class Means:
    """The channels' means over the `decimation` periods that end with the record's: see 11.51 of SPEC.md."""

    def __init__(self, dtype: np.dtype[np.void], channels: Sequence[Signal], decimation: int) -> None:
        self.widths = [MEAN_BYTES] * len(channels)
        self._dtype = dtype
        self._decimation = decimation
        self._sums = [_Sum(channel, *_turn(channel)) for channel in channels]
        self._open = 0  # periods of the record that is not complete yet
        self._skip = 0  # periods until the first whole record begins
        self._next: int | None = None

    def take(self, index0: int, rows: Rows) -> tuple[int, Rows]:
        """See `Records`. A record of which periods are missing is left out."""
        n, decimation = len(rows), self._decimation
        if index0 != self._next:
            self._open, self._skip = 0, (1 - index0) % decimation
        skipped = min(n, self._skip)
        self._skip -= skipped
        self._next = index0 + n
        first = index0 + skipped - self._open + decimation - 1  # index of the first record that can be complete
        begins = np.arange(-self._open, n - skipped, decimation)
        begins[:1] = 0
        complete = (self._open + n - skipped) // decimation
        means = np.empty((complete, len(self._sums)), "<f4")
        if n > skipped:
            samples = rows[skipped:].view(self._dtype)[:, 0]
            for column, each in enumerate(self._sums):
                means[:, column] = self._means(each, samples[each.channel.name], begins, complete)
            self._open = (self._open + n - skipped) % decimation
        return first, means.view(np.uint8)

    def _means(self, each: _Sum, raw: NDArray[Any], begins: NDArray[np.intp], complete: int) -> NDArray[Any]:
        """Return a channel's means in the complete records; `begins`: where each record's periods begin in `raw`."""
        values: NDArray[Any] = raw.astype(np.float64 if each.channel.raw is RawType.F32 else np.int64)
        firsts = values[begins]
        if self._open:
            firsts[0] = each.first
        each.first = firsts[-1]
        if each.channel.unit is Unit.NONE:
            return values.take(np.append(begins[1:], len(values))[:complete] - 1)
        if each.span:
            values = values - np.repeat(firsts, np.diff(begins, append=len(values)))
            values = np.mod(values + each.span / 2, each.span) - each.span / 2
        totals = np.add.reduceat(values, begins)
        if self._open:
            totals[0] += each.total
        each.total = totals[-1]
        means = totals[:complete] / self._decimation
        if each.span:
            means = (np.mod(firsts[:complete] + means - each.lowest, each.span) + each.lowest).astype(np.float32)
            means[means >= each.lowest + each.span] -= each.span  # rounded up to it
        return means


def _turn(channel: Signal) -> tuple[float, float]:
    """Return what a turn is in raw units of a channel, 0 if it does not wrap, and the lowest raw value of the turn."""
    if not channel.flags & Flag.WRAPS:
        return 0.0, 0.0
    if channel.raw is RawType.F32:
        turn = math.tau / abs(float(np.float32(channel.scale)))
        return turn, -turn / 2
    limits = np.iinfo(channel.raw.dtype)
    return float(limits.max) - float(limits.min) + 1, float(limits.min)


def check_channels(ids: Sequence[int], known: Container[int]) -> None:
    """Refuse channels that the device has not or that come twice, the first of them, and none at all."""
    if not ids:
        raise Refused("no channels", ErrorCode.BAD_VALUE, 0)
    for position, number in enumerate(ids):
        if number not in known:
            raise Refused(f"no channel {number}", ErrorCode.UNKNOWN_ID, number)
        if number in ids[:position]:
            raise Refused(f"channel {number} comes twice", ErrorCode.BAD_VALUE, number)

"""When the shaft stands, starts, runs steadily, changes its speed or turns round, told from the encoder's angle alone.

The thresholds stand here once; docs/score.md says what they mean. Times are centred on the sample, so nothing here
lags. When the shaft starts and turns round depends on all that came before: that is told from where its direction
changes (`turns_of`). All else depends on what is within `CONTEXT` only, so a recording can be looked at in parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.signal.position import unwrapped
from bench.signal.units import RPM

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Flags = NDArray[np.bool_]

SPEED_WINDOW = 0.01  # s over which the speed is the difference of the angle
SLOPE_WINDOW = 0.04  # s over which the slope is the difference of the speed
MOVING_RPM = 10.0  # r/min above which the shaft moves
TRANSIENT_RPM_S = 500.0  # (r/min)/s above which the speed changes
AFTER = 0.1  # s after such a change that count as transient too
STAND = 0.1  # s without motion after which motion is a start
BEFORE_START, START_UP = 0.01, 0.3  # s before and after the start that count as start-up
REVERSAL = 0.1  # s before and after zero speed that count as reversal
CONTEXT = 0.2  # s on either side of a sample that are looked at, at most: the windows above, and AFTER
SPEED_EDGES = (0.0, 75.0, 150.0, 350.0, 750.0, 1500.0, 2500.0, 4000.0, 7500.0, 15000.0, 35000.0, 75000.0)
"""r/min; none at a round speed, so that one that is held falls into one bin."""


@dataclass(frozen=True)
class Phases:
    """Where, of n samples, the shaft does what: masks (n,). Those but `moving` exclude each other."""

    moving: Flags
    steady: Flags
    transient: Flags
    start_up: Flags
    reversal: Flags
    starts: int
    reversals: int


def speed_of(theta: F64, rate: float) -> F64:
    """Speed (n,), rad/s, of the angle `theta` (n,) rad, wrapped or not, at `rate` samples a second without a gap."""
    return _difference(unwrapped(theta), SPEED_WINDOW, rate)


@dataclass(frozen=True)
class Turns:
    """Samples at which the shaft starts, and at which it moves the other way: (k,) each, in order."""

    starts: I64
    reversals: I64

    def since(self, first: int) -> Turns:
        """The same, counted from sample `first` on."""
        return Turns(self.starts - first, self.reversals - first)


def phases_of(omega: F64, usable: Flags, rate: float, pole_pairs: int) -> Phases:
    """Phases of the electrical speed `omega` (n,) rad/s, `rate` a second without a gap, where `usable` (n,) is set."""
    direction = direction_of(omega, pole_pairs)
    begins = changes(direction)
    turns = turns_of(begins, direction[begins], usable[begins], len(omega), rate)
    return phases_with(turns, omega, usable, rate, pole_pairs)


def direction_of(omega: F64, pole_pairs: int) -> NDArray[np.int8]:
    """1 and -1 where the shaft moves, 0 where it stands, (n,)."""
    rpm = omega / (RPM * pole_pairs)
    return np.where(np.abs(rpm) > MOVING_RPM, np.sign(rpm), 0.0).astype(np.int8)


def changes(values: NDArray[np.integer[Any]]) -> I64:
    """The first sample, and all that differ from the one before; of none, none."""
    return np.flatnonzero(np.concatenate([np.ones(min(1, len(values)), bool), np.diff(values) != 0]))


def turns_of(begins: I64, direction: NDArray[np.int8], usable: Flags, n: int, rate: float) -> Turns:
    """Starts and reversals of n samples, `rate` a second, whose `direction` changes at `begins`, (k,) each.

    Those that begin where `usable` is not set do not count.
    """
    starts, reversals = [], []
    last = 0  # direction of the last motion; 0: it has stood since
    ends = [*begins[1:].tolist(), n]
    for k, (begin, end, now) in enumerate(zip(begins.tolist(), ends, direction.tolist(), strict=True)):
        if now == 0:
            if begin == 0 or end - begin >= STAND * rate:  # before the first sample it stood, for all that is known
                last = 0
                if end < n and usable[k + 1]:
                    starts.append(end)
            continue
        if last and now != last and usable[k]:
            reversals.append(begin)
        last = now
    return Turns(np.array(starts, np.int64), np.array(reversals, np.int64))


def phases_with(turns: Turns, omega: F64, usable: Flags, rate: float, pole_pairs: int) -> Phases:
    """Phases as `phases_of` has them, of a part of a recording: `turns` are those of all of it, by this part's samples.

    What is farther than `CONTEXT` from the part's ends is that of the whole; `starts`, `reversals`: those within.
    """
    n = len(omega)
    moving = (direction_of(omega, pole_pairs) != 0) & usable
    start_up = _spans(turns.starts, BEFORE_START * rate, START_UP * rate, n) & usable
    reversal = _spans(turns.reversals, REVERSAL * rate, REVERSAL * rate, n) & usable & ~start_up
    rpm = omega / (RPM * pole_pairs)
    changing = _held(np.abs(_difference(rpm, SLOPE_WINDOW, rate)) > TRANSIENT_RPM_S, AFTER * rate)
    free = moving & ~start_up & ~reversal
    within = [int(np.count_nonzero((at >= 0) & (at < n))) for at in (turns.starts, turns.reversals)]
    return Phases(moving, free & ~changing, free & changing, start_up, reversal, *within)


def speed_numbers(rpm: F64) -> I64:
    """The bin of each of the speeds `rpm` (n,), negative in reverse; 0: at rest."""
    numbers: I64 = np.sign(rpm).astype(np.int64) * np.digitize(np.abs(rpm), SPEED_EDGES)
    return numbers


def speed_bin(number: int) -> str:
    """Name of a bin of the speed, as "350_to_750" or "-750_to_-350"."""
    k = abs(number)
    lo, hi = (f"{SPEED_EDGES[j]:g}" if j < len(SPEED_EDGES) else "up" for j in (k - 1, k))
    return f"{lo}_to_{hi}" if number > 0 else f"-{hi}_to_-{lo}"


def _difference(values: F64, window: float, rate: float) -> F64:
    """Central difference quotient over `window` s; one-sided at the ends."""
    n = len(values)
    half = min(max(1, round(0.5 * window * rate)), n)
    quotient = np.empty(n)
    inner, ends = slice(half, n - half), np.concatenate([np.arange(half), np.arange(max(half, n - half), n)])
    if n > 2 * half:
        np.subtract(values[2 * half :], values[: n - 2 * half], out=quotient[inner])
        quotient[inner] *= rate
        quotient[inner] /= 2 * half
    after, before = np.minimum(ends + half, n - 1), np.maximum(ends - half, 0)
    quotient[ends] = (values[after] - values[before]) * rate / np.maximum(after - before, 1)
    return quotient


def _held(flags: Flags, samples: float) -> Flags:
    """Also set for `samples` after each that is set."""
    index = np.arange(len(flags))
    last = np.maximum.accumulate(np.where(flags, index, -len(flags) - round(samples)))
    held: Flags = index - last <= samples
    return held


def _spans(at: I64, before: float, after: float, n: int) -> Flags:
    """Set, of n samples, from `before` samples before each of `at` to `after` samples after it."""
    flags = np.zeros(n, bool)
    for k in at[(at > -after) & (at < n + before)].tolist():
        flags[max(0, k - round(before)) : max(0, min(n, k + round(after)))] = True
    return flags

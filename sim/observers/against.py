"""An estimate against a reference: sums, extremes and counts of its error by group of samples, in one pass.

A group has the samples of a sector, a range of speed, or a phase of the motion; a sample is in two of them at most.
What groups there are, and what is done with the sums, `bench.score.tally` knows. Angles are in electrical rad, errors
in electrical degrees, speeds in electrical rad/s.
"""

from __future__ import annotations

import math

import numpy as np

from sim.native import Pointer, native
from sim.numba_cache import kernel
from sim.observers.transforms import TWO_PI

NONE = 255  # no group
STEADY = 6  # groups below are of steady running, by sector
PORTION = 4096  # samples gone through twice at a time
BITS, OCTAVES = 8, 44  # of a magnitude: bits of its mantissa that tell bins apart, and powers of two from `LOW` up
LOW = 2.0**-24
BINS = OCTAVES << BITS
ANGLES = 240  # bins of the angle, in reverse the upper half
TAIL = 10  # what `found` has after its groups: how many are beyond, largest error and where, and of steady samples
# the number, mean of speed and of error, sum of speed by speed and by error about them, least and largest speed
_FIRST_BIN = int(np.array(LOW).view(np.int64)) >> (52 - BITS)
_DEGREES = 180.0 / math.pi
_RADIANS = math.pi / 180.0


@kernel
def _degrees(angle: float) -> float:
    """An angle in [-180, 180), to the last bit as numpy makes it of `bench.signal.position.wrap`."""
    turned = angle + math.pi
    if not 0.0 <= turned < TWO_PI:
        turned = turned % TWO_PI
    return (turned - math.pi) * _DEGREES


@kernel
def _bin(bits: int) -> int:
    """Of a magnitude, by the bits of its float: they rise with it."""
    return min(max((bits >> (52 - BITS)) - _FIRST_BIN, 0), BINS - 1)


@kernel
def _extremes(ends: Pointer[float], k: int, other: int, value: float) -> None:
    """Widen the range from ends[k] to ends[other]; NaN stays."""
    if not value >= ends[k] and ends[k] == ends[k]:
        ends[k] = value
    if not value <= ends[other] and ends[other] == ends[other]:
        ends[other] = value


@kernel
def _merged(into: Pointer[float], g: int, of: Pointer[float], h: int) -> None:
    """Add number, mean, sum of squares about it (Chan et al. 1979) and largest magnitude; none are left in h."""
    n, m = into[4 * g], of[4 * h]
    if m > 0.0:
        delta = of[4 * h + 1] - into[4 * g + 1]
        into[4 * g] = n + m
        into[4 * g + 1] += delta * m / (n + m)
        into[4 * g + 2] += of[4 * h + 2] + delta * delta * n * m / (n + m)
        into[4 * g + 3] = max(into[4 * g + 3], of[4 * h + 3])
    for k in range(4):
        of[4 * h + k] = 0.0


@native
def fold(
    theta: Pointer[float],
    omega: Pointer[float],
    first: Pointer[np.uint8],
    second: Pointer[np.uint8],
    angle: Pointer[np.uint8],
    point: Pointer[int],
    n: int,
    estimate: Pointer[float],
    speed: Pointer[float],
    stride: int,
    rpm_by: float,
    groups: int,
    scratch: Pointer[float],
    bits: Pointer[int],
    counts: Pointer[int],
    least: Pointer[float],
    beyond: Pointer[float],
    whose: Pointer[np.uint8],
    by_angle: Pointer[float],
    over: Pointer[float],
    points: int,
    found: Pointer[float],
) -> None:
    """n samples: angle and speed of the reference, and an estimate's, `stride` numbers apart.

    `first`, `second`: groups of each, the last one is that of the error of the speed, r/min. `angle`: bin. `point`: of
    `points` over time. `scratch`: for 2 `PORTION` + 4 `groups` numbers, `bits`: the same memory as whole numbers.
    Added to: `counts` (groups, BINS) by magnitude, `by_angle` (5, ANGLES): number, sum, sum of squares, least, largest,
    `over` (4, points): least and largest error, and speed in r/min. Set: `found` (groups, 4) as in `_merged`, and the
    `TAIL`; magnitudes `beyond` the `least` of the group `whose` they are, up to 3 n.
    """
    tail = 4 * groups
    part = 2 * PORTION
    slips = groups - 1
    for k in range(tail + TAIL):
        found[k] = 0.0
    for k in range(tail):
        scratch[part + k] = 0.0
    lo, hi = math.inf, -math.inf
    peak, at = 0.0, 0
    m = 0
    mean_speed, mean_error, total, square, product = 0.0, 0.0, 0.0, 0.0, 0.0
    begin = 0
    while begin < n:
        end = min(begin + PORTION, n)
        steady, sum_speed, sum_error = 0.0, 0.0, 0.0
        for k in range(begin, end):
            error = _degrees(theta[k] - estimate[k * stride])
            size = abs(error)
            scratch[k - begin] = error
            scratch[PORTION + k - begin] = size
            p = point[k]
            _extremes(over, p, points + p, error)
            _extremes(over, 2 * points + p, 3 * points + p, speed[k * stride] * rpm_by)
            if size > peak:
                peak, at = size, k
            g = int(first[k])
            if g == NONE:
                continue
            bin = _bin(bits[PORTION + k - begin])
            h = int(second[k])
            for j in range(2):
                if j == 1:
                    if h == NONE:
                        break
                    g, h = h, g
                scratch[part + 4 * g] += 1.0
                scratch[part + 4 * g + 1] += error
                scratch[part + 4 * g + 3] = max(scratch[part + 4 * g + 3], size)
                counts[g * BINS + bin] += 1
                if not size <= least[g]:
                    beyond[m], whose[m] = size, np.uint8(g)
                    m += 1
            if int(first[k]) < STEADY:
                steady += 1.0
                sum_speed += omega[k]
                sum_error += error * _RADIANS
                lo, hi = min(lo, omega[k]), max(hi, omega[k])
                if math.isfinite(error):
                    a = int(angle[k])
                    by_angle[a] += 1.0
                    by_angle[ANGLES + a] += error
                    by_angle[2 * ANGLES + a] += error * error
                    _extremes(by_angle, 3 * ANGLES + a, 4 * ANGLES + a, error)
                slip = (omega[k] - speed[k * stride]) * rpm_by
                if math.isfinite(slip):
                    size = abs(slip)
                    scratch[PORTION + k - begin] = size
                    scratch[part + 4 * slips] += 1.0
                    scratch[part + 4 * slips + 1] += slip
                    scratch[part + 4 * slips + 3] = max(scratch[part + 4 * slips + 3], size)
                    counts[slips * BINS + _bin(bits[PORTION + k - begin])] += 1
                    if not size <= least[slips]:
                        beyond[m], whose[m] = size, np.uint8(slips)
                        m += 1
        for g in range(groups):
            if scratch[part + 4 * g] > 0.0:
                scratch[part + 4 * g + 1] /= scratch[part + 4 * g]
        own_square, own_product = 0.0, 0.0
        if steady > 0.0:
            sum_speed /= steady
            sum_error /= steady
        for k in range(begin, end):
            g = int(first[k])
            if g == NONE:
                continue
            error = scratch[k - begin]
            off = error - scratch[part + 4 * g + 1]
            scratch[part + 4 * g + 2] += off * off
            h = int(second[k])
            if h != NONE:
                off = error - scratch[part + 4 * h + 1]
                scratch[part + 4 * h + 2] += off * off
            if g < STEADY:
                off = omega[k] - sum_speed
                own_square += off * off
                own_product += off * (error * _RADIANS - sum_error)
                off = (omega[k] - speed[k * stride]) * rpm_by - scratch[part + 4 * slips + 1]
                if math.isfinite(off):
                    scratch[part + 4 * slips + 2] += off * off
        for g in range(groups):
            _merged(found, g, scratch, part // 4 + g)
        if steady > 0.0:
            by_speed, by_error = sum_speed - mean_speed, sum_error - mean_error
            weight = total * steady / (total + steady)
            square += own_square + weight * by_speed * by_speed
            product += own_product + weight * by_speed * by_error
            total += steady
            mean_speed += by_speed * steady / total
            mean_error += by_error * steady / total
        begin = end
    found[tail], found[tail + 1], found[tail + 2] = float(m), peak, float(at)
    found[tail + 3], found[tail + 4], found[tail + 5] = total, mean_speed, mean_error
    found[tail + 6], found[tail + 7], found[tail + 8], found[tail + 9] = square, product, lo, hi

"""Behaviour in time: settling and step responses.

Nothing here knows what was commanded but what it is told. Values keep the unit of `y`, times are in s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bench.signal.waveforms.samples import Floats, checked, sample_period

TAIL = 0.2
"""Share of the time after a step, at its end, that counts as the steady state."""


class Settled(NamedTuple):
    """When a value came into its band for good."""

    time: float | None
    """s from the first sample; None: never, or not for long enough."""
    held: float
    """s from then to the last sample; 0 where `time` is None."""


class StepResponse(NamedTuple):
    """How a value followed a step from y0 to y1. Times are s after the step, None for what did not happen."""

    delay: float | None
    """Until 10 % of the step."""
    rise: float | None
    """From 10 % to 90 %."""
    settling: float | None
    """Until it stays within the band around y1 to the end."""
    overshoot: float
    """Past y1, as a share of y1 - y0; 0 where y1 was not passed."""
    peak: float
    """Farthest value in the direction of the step, in the unit of y."""
    steady_error: float
    """Mean of y - y1 over the last fifth of the time after the step, in the unit of y."""


def settled(t: ArrayLike, y: ArrayLike, target: float, band: float, hold: float = 0.0) -> Settled:
    """From when on |y - target| <= `band` until the end, and that for at least `hold` s.

    `t` (n,) s uniform, `y` (n,); `target` and `band` in the unit of y. Raises ValueError for unfit samples and for a
    negative band or hold.
    """
    if band < 0 or hold < 0:
        raise ValueError(f"band and hold must be >= 0, got {band:g} and {hold:g} s")
    t, y = checked(t=t, y=y)
    sample_period(t)
    outside = np.flatnonzero(np.abs(y - target) > band)
    first = int(outside[-1]) + 1 if len(outside) else 0
    if first == len(t) or t[-1] - t[first] < hold:
        return Settled(None, 0.0)
    return Settled(float(t[first] - t[0]), float(t[-1] - t[first]))


def step_response(
    t: ArrayLike, y: ArrayLike, t_step: float, y0: float, y1: float, band: float = 0.02, smooth: float = 0.0
) -> StepResponse:
    """Response to a step, rising or falling, that was commanded at `t_step` from `y0` to `y1`.

    `t` (n,) s uniform, `y` (n,) in the unit of y0 and y1, `band` as a share of |y1 - y0|. 10 % and 90 % are
    interpolated between samples and count where they are first reached: with noise on y take `smooth`, the length in s
    of a centred moving mean over y. It divides white noise by the root of the samples in it, but it starts a rise up to
    half of itself early, makes a sharp one up to 0.8 of itself long, and flattens peaks: keep it well below the rise.

    Raises ValueError for unfit samples, a `t_step` outside `t`, y0 = y1 and a negative band or smooth.
    """
    if band < 0 or smooth < 0:
        raise ValueError(f"band and smooth must be >= 0, got {band:g} and {smooth:g} s")
    if y0 == y1:
        raise ValueError(f"y0 and y1 are both {y0:g}: that is no step")
    t, y = checked(t=t, y=y)
    period = sample_period(t)
    if not t[0] <= t_step <= t[-2]:
        raise ValueError(f"t_step: {t_step:g} s is not among the samples, which go from {t[0]:g} to {t[-1]:g} s")
    height = y1 - y0
    after = t >= t_step
    time = t[after] - t_step
    progress = (_moving_mean(y, smooth / period)[after] - y0) / height  # 0 before the step, 1 when done
    low, high = _reached(time, progress, 0.1), _reached(time, progress, 0.9)
    settling = settled(time, progress, 1.0, band).time
    return StepResponse(
        delay=low,
        rise=None if low is None or high is None else high - low,
        settling=None if settling is None else float(time[0]) + settling,
        overshoot=max(0.0, float(progress.max()) - 1.0),
        peak=y0 + float(progress.max()) * height,
        steady_error=(float(progress[time >= (1.0 - TAIL) * time[-1]].mean()) - 1.0) * height,
    )


def _reached(time: Floats, progress: Floats, level: float) -> float | None:
    """When `progress` first reaches `level`, between samples by a straight line."""
    i = int(np.argmax(progress >= level))
    if progress[i] < level:
        return None
    if i == 0:
        return float(time[0])
    return float(np.interp(level, progress[i - 1 : i + 1], time[i - 1 : i + 1]))


def _moving_mean(y: Floats, samples: float) -> Floats:
    """Centred mean over an odd number of samples, `samples` of them to within one; over what there is at the ends."""
    half = round((samples - 1.0) / 2.0)
    if half <= 0:
        return y
    index = np.arange(len(y))
    begin, end = np.maximum(index - half, 0), np.minimum(index + half + 1, len(y))
    sums = np.concatenate([[0.0], np.cumsum(y - y[0])])
    means: Floats = y[0] + (sums[end] - sums[begin]) / (end - begin)
    return means

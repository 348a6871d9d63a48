"""Phase current measurement: gain, offset, noise, converter range and steps.

Never filters: the converter samples at the start of a PWM period, where the ripple passes its mean, or `delay` later.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sim.numba_cache import kernel


class Params(NamedTuple):
    """The sensors' constants."""

    gain_a: float
    gain_b: float
    gain_c: float
    offset_a: float  # A
    offset_b: float
    offset_c: float
    noise: float  # A rms
    step: float  # A a code
    steps_per_A: float
    code_max: float
    delay: float  # s


def make_params(
    noise_rms: float,
    offset: Sequence[float],
    gain_error: Sequence[float],
    range: float,
    bits: int,
    delay: float = 0.0,
) -> Params:
    """Constants from A, A, relative errors, A (plus and minus), the converter's bits over both signs, and s."""
    codes = float(2 ** (bits - 1))
    a, b, c = (1.0 + error for error in gain_error)
    offset_a, offset_b, offset_c = (float(each) for each in offset)
    steps = range / codes, codes / range, codes - 1.0
    return Params(a, b, c, offset_a, offset_b, offset_c, float(noise_rms), *steps, float(delay))


@kernel
def measure(params: Params, current: float, gain: float, offset: float, normal: float) -> float:
    """The measured current (A) for the true one and a standard normal number."""
    code = float(np.rint((gain * current + offset + params.noise * normal) * params.steps_per_A))
    return code

"""Phase current measurement: gain, offset, noise, converter range and steps.

Never filters: the converter samples at the start of a PWM period, where the ripple passes its mean, or `delay` later.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sim.hints import seldom
from sim.numba_cache import kernel

Three = tuple[float, float, float]
"""Phases a, b, c."""


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
def _converted(params: Params, current: float, gain: float, offset: float, normal: float) -> float:
    """The converter's code for a current (A), not held within its range."""
    return float(np.rint((gain * current + offset + params.noise * normal) * params.steps_per_A))


@kernel
def _held(params: Params, code: float) -> float:
    return min(max(code, -params.code_max - 1.0), params.code_max)


@kernel
def measure(params: Params, currents: Three, normal: Three) -> Three:
    """The measured currents (A) of phases a, b, c for the true ones and three standard normal numbers."""
    a = _converted(params, currents[0], params.gain_a, params.offset_a, normal[0])
    b = _converted(params, currents[1], params.gain_b, params.offset_b, normal[1])
    c = _converted(params, currents[2], params.gain_c, params.offset_c, normal[2])
    if seldom(max(abs(a), abs(b), abs(c)) > params.code_max):
        a, b, c = _held(params, a), _held(params, b), _held(params, c)
    return a * params.step, b * params.step, c * params.step

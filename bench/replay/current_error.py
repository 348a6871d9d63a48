"""What the integral of a drive's current loop took in, as (18) integrates it, from what the drive streams.

That is reference less q current, until the voltage is at its limit: what the loop's anti-windup takes back then is in
no channel. But in steady state the regulator's integral holds the resistance's voltage, R_s i_q, and its gain is R_s
alpha, alpha = 2 pi bw_current. So at the limit the sum is set to i_q / alpha, and what it was before does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from protocol.signals import MILLI
from protocol.streams import SampleChunk

F64 = NDArray[np.float64]

LINEAR = 1.0 / math.sqrt(3.0)
"""Longest voltage vector over the DC link's voltage, in the linear range of space-vector modulation."""
ROUNDED = 2.0 * MILLI  # V, by which the channels' rounding may shorten it


class CurrentError:
    """The current error over a drive's chunks, one PWM period a sample."""

    def __init__(self, parameters: Mapping[str, float], pwm_hz: float) -> None:
        self._pwm_hz = pwm_hz
        self.use(parameters)
        self._i_q = 0.0  # at the last sample, A
        self._sum = 0.0  # A, times samples

    def use(self, parameters: Mapping[str, float]) -> None:
        """The drive's parameters are these from now on."""
        bw_current = parameters.get("bw_current", 0.0)
        self._samples = self._pwm_hz / (2.0 * math.pi * bw_current) if bw_current > 0.0 else 0.0

    def of(self, chunk: SampleChunk, reset: NDArray[np.bool_]) -> F64:
        """The error at each sample, (n,) A, 0 where it is not known; `reset` (n,): where observers are initialised."""
        names = chunk.raw.dtype.names or ()
        if not {"i_q", "i_q_ref"} <= set(names):
            return np.zeros(len(chunk))
        i_q = np.r_[self._i_q, chunk.physical("i_q")]
        self._i_q = float(i_q[-1])
        error: F64 = chunk.physical("i_q_ref") - i_q[:-1]
        limited = np.zeros(len(error), bool)
        if "u_dc" in names and self._samples:
            voltage = np.hypot(chunk.physical("u_alpha"), chunk.physical("u_beta"))
            limited = (voltage > 0.0) & (voltage >= LINEAR * chunk.physical("u_dc") - ROUNDED)
        # the sum up to each sample: from the last one at which it is known, on
        known = np.where(reset, 0.0, self._samples * i_q[:-1])
        since = np.maximum.accumulate(np.where(limited | reset, np.arange(len(error)), -1))
        run = np.cumsum(error)
        total = run + np.where(since >= 0, known[since] - run[since], self._sum)
        error[limited] = (total - np.r_[self._sum, total[:-1]])[limited]
        self._sum = float(total[-1])
        return error

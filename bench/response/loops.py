"""The loops that can be measured, and how a test signal reaches each. Nothing here talks to a drive."""

from __future__ import annotations

import math
from dataclasses import dataclass

from bench.errors import BenchError
from bench.signal.waveforms import excitation
from bench.signal.waveforms.excitation import Waveform

LINES = 40
"""Frequencies that are measured at most."""
OVERSAMPLING = 4
"""Samples of the waveform in a cycle of the highest frequency, at least."""
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Turns of the shaft beyond whole ones in a cycle: no small multiple of it is nearly whole."""


@dataclass(frozen=True)
class Loop:
    """A loop of the firmware: what excites it, and the channels of its reference and its output."""

    name: str
    excited: str
    """What the test signal is added to."""
    reference: str
    late: int
    """PWM periods by which the reference is recorded later than the control used it (SPEC, chapter 14)."""
    output: str
    """Channel of what the loop controls; empty: the speed of the control's angle source."""


CURRENT = Loop("current", "i_d", "i_d_ref", 1, "i_d")
SPEED = Loop("speed", "speed", "omega_ref", 0, "")
LOOPS = {loop.name: loop for loop in (CURRENT, SPEED)}


def waveform(pwm_hz: float, room: int, lowest: float, highest: float, turns_hz: float = 0.0) -> Waveform:
    """A multisine from `lowest` to `highest` Hz that fits in `room` samples; BenchError if none does.

    What comes once a turn of the shaft, or several times, at multiples of `turns_hz`, meets each cycle in another
    phase: it becomes scatter, and is not taken for an answer.
    """
    if not 0.0 < lowest < highest:
        raise BenchError(f"frequencies from {lowest:g} to {highest:g} Hz: the first must be above 0 and below the last")
    if highest > pwm_hz / OVERSAMPLING:
        raise BenchError(f"{highest:g} Hz is above a quarter of the PWM rate, {pwm_hz / OVERSAMPLING:g} Hz")
    hold = max(1, math.floor(pwm_hz / (OVERSAMPLING * highest)))
    n = math.ceil(pwm_hz / (hold * lowest))
    if turns_hz:
        whole = math.floor(n * hold / pwm_hz * abs(turns_hz))
        fitting = (math.ceil((whole + k + GOLDEN) / abs(turns_hz) * pwm_hz / hold) for k in range(2))
        n = next(each for each in fitting if each >= n)
    if n > room:
        least = pwm_hz / (hold * room)
        raise BenchError(
            f"a test signal from {lowest:g} to {highest:g} Hz needs {n} samples; the drive has room for {room}: "
            f"begin at {least:.3g} Hz or above, or measure in two parts"
        )
    base = pwm_hz / (hold * n)
    last = max(1, math.floor(highest / base * (1 + 1e-9)))
    return excitation.multisine(n, excitation.spread(1, last, LINES), hold=hold)

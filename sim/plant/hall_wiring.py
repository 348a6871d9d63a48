"""The wires between the Hall sensors and the firmware: exchanged, inverted, broken, shorted, disturbed by false pulses.

In this order, as on a real harness: wires may be exchanged, and what comes on one inverted; a broken wire is pulled up
at the input, which reads 1, a shorted one reads 0; an EMI pulse inverts one input for 2 to 5 us, whatever is connected
to it. Pulses come one at a time, at random times
and on random inputs: the gaps between them are exponentially distributed, so that they are independent of everything
else.

It never moves an edge of a sensor, and draws no random number where the rate of pulses is zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from protocol.signals import HallSwap
from sim.numba_cache import kernel
from sim.plant import noise

PARAMETERS = ("hall_swap", "hall_invert", "hall_open", "hall_short", "hall_glitch")
PULSE_MIN, PULSE_SPREAD = 2e-6, 3e-6  # s
NEVER = 2**63 - 1
A_B, B_C, C_A = int(HallSwap.A_B), int(HallSwap.B_C), int(HallSwap.C_A)
A_ON_B, A_ON_C = int(HallSwap.A_ON_B), int(HallSwap.A_ON_C)


class Params(NamedTuple):
    """What is wrong with the wires."""

    swap: int  # HallSwap
    invert: int  # one bit each, by input
    open: int
    short: int
    gap: float  # ticks between the end of a pulse and the begin of the next, mean; 0: no pulses
    pulse_min: float  # ticks
    pulse_spread: float  # ticks


class State(NamedTuple):
    """What the inputs see."""

    pins: int  # code that the firmware's inputs read
    pulse: int  # bit of the input that a pulse inverts, 0: none does
    due: int  # tick at which a pulse begins or ends


def make_params(
    tick_hz: float, *, hall_swap: float, hall_invert: float, hall_open: float, hall_short: float, hall_glitch: float
) -> Params:
    """Constants from the load machine's parameters of the same names."""
    width = PULSE_MIN + 0.5 * PULSE_SPREAD
    gap = max(1.0 / hall_glitch - width, 0.0) * tick_hz if hall_glitch > 0.0 else 0.0
    wires = int(hall_swap), int(hall_invert), int(hall_open), int(hall_short)
    return Params(*wires, gap, PULSE_MIN * tick_hz, PULSE_SPREAD * tick_hz)


@kernel
def pins(params: Params, code: int, opened: int, pulse: int) -> int:
    """The code at the inputs where the sensors say `code`; `opened`: inputs that are broken besides, a bit each."""
    if params.swap == A_B:
        code = (code & 1) << 1 | (code & 2) >> 1 | code & 4
    elif params.swap == B_C:
        code = (code & 2) << 1 | (code & 4) >> 1 | code & 1
    elif params.swap == C_A:
        code = (code & 1) << 2 | (code & 4) >> 2 | code & 2
    elif params.swap == A_ON_B:
        code = (code & 3) << 1 | (code & 4) >> 2
    elif params.swap == A_ON_C:
        code = (code & 1) << 2 | (code & 6) >> 1
    return ((code ^ params.invert | params.open | opened) & ~params.short) ^ pulse


@kernel
def init(params: Params, code: int) -> State:
    """The state at boot."""
    return State(pins(params, code, 0, 0), 0, NEVER)


@kernel
def next_pulse(params: Params, state: State, tick: int, rng: np.uint64) -> State:
    """The state with the begin of the next pulse drawn anew, some time after `tick`; as it is within a pulse.

    An exponential wait has no memory, so drawing it anew in every period changes nothing, and a new rate is used at
    once.
    """
    if state.pulse != 0:
        return state
    if params.gap == 0.0:
        return State(state.pins, 0, NEVER)
    wait = -params.gap * math.log(1.0 - noise.uniform(rng))
    return State(state.pins, 0, tick + 1 + math.floor(wait))


@kernel
def toggled(params: Params, state: State, rng: np.uint64) -> State:
    """The state after a pulse began or ended at `state.due`; the edge is still to be captured."""
    if state.pulse != 0:
        return next_pulse(params, State(state.pins, 0, NEVER), state.due, rng)
    x = 3.0 * noise.uniform(rng)
    sensor = math.floor(x)
    width = params.pulse_min + (x - sensor) * params.pulse_spread
    return State(state.pins, 1 << sensor, state.due + max(1, round(width)))

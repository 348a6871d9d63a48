"""The firmware's protection: which faults have a cause at a sample.

Currents and DC link voltage: at once. Speed: at once by the encoder; without one by the Hall sensors, once it has
stood for a while, because one false edge makes any speed.

Hall sensors, by a level of doubt between 0 and 1 that trips when it is full:
- a sample with the code 000 or 111 adds T_s / `hall_fault_time`;
- an implausible edge, which is one to such a code or a sector skipped (by edges, or found by a sample), adds
  1 / `hall_fault_count`;
- any other sample takes away T_s / `hall_fault_leak`.
A broken or shorted wire makes one sector in six illegal and another one skipped, however the shaft turns. An EMI
pulse, over within microseconds, is one implausible edge at most.

Exchanged wires make a legal sequence that runs backwards. While the outputs are on the back-EMF (6) tells which way
the rotor turns: the angle by which it turns against the direction of the Hall sensors adds up, the angle with it takes
away, and `hall_turns` electrical turns trip. A rotor that reverses is seen by the Hall sensors within a third of a
turn. The back-EMF is smoothed, since currents that are differentiated bring noise, and not looked at below `hall_emf`.

It never switches anything off: `tick_firmware` latches the faults.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from protocol.messages import Fault
from sim.config.sections import Protection
from sim.numba_cache import kernel

OVERCURRENT, OVERSPEED = int(Fault.OVERCURRENT), int(Fault.OVERSPEED)
UNDERVOLTAGE, OVERVOLTAGE, HALL = int(Fault.UNDERVOLTAGE), int(Fault.OVERVOLTAGE), int(Fault.HALL)
FULL = 1.0 - 1e-9  # doubt that trips: parts add up to 1 but for rounding
SMOOTH = 16.0  # samples, the time constant of the back-EMF's mean


class Params(NamedTuple):
    """Limits."""

    i_trip: float  # A
    omega_trip: float  # electrical rad/s
    speed_periods: int  # periods that a speed must stand above it
    u_dc_min: float  # V
    u_dc_max: float  # V
    doubt_sample: float  # added by a sample with an illegal code
    doubt_edge: float  # added by an implausible edge
    doubt_leak: float  # taken away by any other sample
    opposed_max: float  # electrical rad
    e_min: float  # V


class Sensed(NamedTuple):
    """What the protection looks at, at a sample."""

    current: float  # the largest phase current's size, A
    omega: float  # electrical rad/s
    u_dc: float  # V
    hall: int  # code
    edges: int  # implausible edges since the last sample
    direction: int  # by the Hall sensors: +1, -1, 0: unknown
    e_alpha: float  # back-EMF (6), V
    e_beta: float


class State(NamedTuple):
    """What the protection remembers."""

    fast: int  # periods in a row above the largest speed
    doubt: float  # of the Hall sensors, 0..1
    opposed: float  # angle by which the back-EMF turned against the Hall sensors, electrical rad
    e_alpha: float  # of the back-EMF smoothed, V
    e_beta: float
    causes: int  # Fault bits whose cause is there now


def make_params(pwm_hz: float, drive: Mapping[str, float], encoder: bool, limits: Protection) -> Params:
    """Constants for control periods at `pwm_hz` Hz, thresholds by the parameters `drive`; `encoder`: there is one."""
    T_s = 1.0 / pwm_hz
    return Params(
        drive["i_trip"],
        drive["omega_m_trip"] * drive["n_p"],
        1 if encoder else max(1, round(limits.omega_trip_time * pwm_hz)),
        drive["u_dc_min"],
        drive["u_dc_max"],
        T_s / limits.hall_fault_time,
        1.0 / limits.hall_fault_count,
        T_s / limits.hall_fault_leak,
        2.0 * math.pi * limits.hall_turns,
        limits.hall_emf,
    )


@kernel
def init() -> State:
    """Nothing seen yet."""
    return State(0, 0.0, 0.0, 0.0, 0.0, 0)


def forgiven(state: State) -> State:
    """The state once a host has cleared the faults: the Hall sensors are believed anew."""
    return state._replace(doubt=0.0, opposed=0.0)


@kernel
def _doubt(params: Params, doubt: float, hall: int, edges: int) -> float:
    """The doubt of the Hall sensors after a sample."""
    if hall == 0 or hall == 7:
        doubt += params.doubt_sample
    elif edges == 0:
        return max(doubt - params.doubt_leak, 0.0)
    return min(doubt + edges * params.doubt_edge, 1.0)


@kernel
def _opposed(params: Params, state: State, sensed: Sensed, e_alpha: float, e_beta: float) -> float:
    """The angle against the Hall sensors after a sample with the outputs on."""
    before = state.e_alpha * state.e_alpha + state.e_beta * state.e_beta
    square = e_alpha * e_alpha + e_beta * e_beta
    if square < params.e_min * params.e_min:
        return state.opposed
    with_hall = sensed.direction * (state.e_alpha * e_beta - state.e_beta * e_alpha)
    if with_hall >= 0.0 and state.opposed == 0.0:
        return 0.0
    return max(state.opposed - with_hall / max(square, before), 0.0)  # a small angle is its sine


@kernel
def step(params: Params, state: State, sensed: Sensed, on: bool) -> State:
    """One control period; `on`: the outputs were on over it."""
    fast = state.fast + 1 if abs(sensed.omega) > params.omega_trip else 0
    doubt = _doubt(params, state.doubt, sensed.hall, sensed.edges)
    e_alpha = state.e_alpha + (sensed.e_alpha - state.e_alpha) / SMOOTH
    e_beta = state.e_beta + (sensed.e_beta - state.e_beta) / SMOOTH
    opposed = _opposed(params, state, sensed, e_alpha, e_beta) if on else 0.0
    causes = 0
    if sensed.current > params.i_trip:
        causes |= OVERCURRENT
    if fast >= params.speed_periods:
        causes |= OVERSPEED
    if sensed.u_dc < params.u_dc_min:
        causes |= UNDERVOLTAGE
    if sensed.u_dc > params.u_dc_max:
        causes |= OVERVOLTAGE
    if doubt >= FULL or opposed > params.opposed_max:
        causes |= HALL
    return State(fast, doubt, opposed, e_alpha, e_beta, causes)

"""The three wires between inverter and motor: exchanged, broken, or shorted at the motor.

Exchanged wires are as those of the Hall sensors (`HallSwap`): the leg a on the phase b, and so on. Sensors and duties
are the legs', everything else is the motor's phases'.

A short is a resistance and an inductance between two of the motor's terminals. What flows there comes from two legs and
passes their current sensors, but not the motor: as long as the legs hold its terminals, the motor does not feel it. It
is averaged over a PWM period like all else, so it is what a sensor sees in the middle of the low state; its ripple, and
what it does to switches that are not ideal, are left out. With the outputs off it ties two phases of the motor
together (`open_phase`).
"""

from __future__ import annotations

from typing import NamedTuple

from protocol.signals import HallSwap
from sim.hints import apart, seldom
from sim.numba_cache import kernel
from sim.plant import inverter, pmsm

Three = tuple[float, float, float]
"""A value for each leg, or for each phase."""

A_B, B_C, C_A = int(HallSwap.A_B), int(HallSwap.B_C), int(HallSwap.C_A)
A_ON_B, A_ON_C = int(HallSwap.A_ON_B), int(HallSwap.A_ON_C)
ROUNDS = 50  # of halving


class Params(NamedTuple):
    """What is wrong with the wires."""

    swap: int  # HallSwap
    short: int  # 0 none, 1 a to b, 2 b to c, 3 c to a, by the motor's phases
    R: float  # ohm, of the short
    L: float  # H


def make_params(swap: float, short: float, short_R: float, short_L: float) -> Params:
    """From HallSwap, the pair of phases, ohm and H."""
    return Params(int(swap), int(short), float(short_R), float(short_L))


def open_phase(bits: int, swap: int) -> int:
    """The motor's phase without a current, as `sim.plant.open_phase` has it, from the legs whose wires are broken.

    `bits`: bit 0 is the leg a.
    """
    broken = to_phases(swap, (float(bits & 1), float(bits >> 1 & 1), float(bits >> 2 & 1)))
    if sum(broken) > 1.0:
        return 4
    return 1 + broken.index(1.0) if any(broken) else 0


@kernel
def to_phases(swap: int, legs: Three) -> Three:
    """What the motor's phases get of the legs."""
    return _exchanged(swap, legs) if seldom(swap != 0) else legs


@kernel
def _exchanged(swap: int, legs: Three) -> Three:
    a, b, c = legs
    if swap == A_B:
        return b, a, c
    if swap == B_C:
        return a, c, b
    if swap == C_A:
        return c, b, a
    if swap == A_ON_B:
        return c, a, b
    if swap == A_ON_C:
        return b, c, a
    return legs


@kernel
def to_legs(swap: int, phases: Three) -> Three:
    """What the legs see of the motor's phases."""
    if swap == A_ON_B:
        return to_phases(A_ON_C, phases)
    if swap == A_ON_C:
        return to_phases(A_ON_B, phases)
    return to_phases(swap, phases)


@kernel
def with_short(params: Params, phases: Three, i: float) -> Three:
    """The phases' wires' currents (A) with what flows in the short, too."""
    a, b, c = phases
    if params.short == 1:
        return a + i, b - i, c
    if params.short == 2:
        return a, b + i, c - i
    if params.short == 3:
        return a - i, b, c + i
    return phases


@kernel
def _losses(params: Params, g: float, applied: inverter.Applied, phases: Three, i: float) -> Three:
    """What the legs lose, V, at these currents; of the leg that has no part in the short nothing."""
    a, b, c = with_short(params, phases, i)
    return (
        0.0 if params.short == 2 else applied.e_a * min(max(a * g, -1.0), 1.0),
        0.0 if params.short == 3 else applied.e_b * min(max(b * g, -1.0), 1.0),
        0.0 if params.short == 1 else applied.e_c * min(max(c * g, -1.0), 1.0),
    )


@kernel
def _across(params: Params, voltages: Three) -> float:
    """The voltage across the short, V."""
    if params.short == 1:
        return voltages[0] - voltages[1]
    if params.short == 2:
        return voltages[1] - voltages[2]
    return voltages[2] - voltages[0]


@kernel
def shorted(
    params: Params, legs: inverter.Params, applied: inverter.Applied, i_alpha: float, i_beta: float, i: float
) -> tuple[float, inverter.Applied]:
    """The short's current (A) a PWM period later, and what the inverter does to the motor meanwhile.

    `i_alpha`, `i_beta`, `i`: currents of the motor and of the short at the begin (A). With the outputs off nothing is
    left: their diodes end it within some microseconds.
    """
    apart()
    if not applied.on:
        return 0.0, applied
    phases = pmsm.phases(i_alpha, i_beta)
    ideal = _across(params, pmsm.phases(applied.u_alpha, applied.u_beta))
    per_A = params.L / legs.legs.T + params.R  # V/A, by the implicit Euler method: losses are stiff near zero current
    most = 2.0 * (applied.e_a + applied.e_b + applied.e_c) / per_A
    begin = params.L / legs.legs.T * i + ideal
    low = begin / per_A - most
    high = begin / per_A + most
    for _ in range(ROUNDS):
        i = 0.5 * (low + high)
        lost = _losses(params, legs.g_smooth, applied, phases, i)
        if per_A * i + _across(params, lost) > begin:
            high = i
        else:
            low = i
    lost = _losses(params, legs.g_smooth, applied, phases, i)
    lost_alpha, lost_beta = pmsm.vector(lost[0], lost[1], lost[2])
    return i, inverter.Applied(
        True,
        applied.u_alpha - lost_alpha,
        applied.u_beta - lost_beta,
        applied.e_a if params.short == 2 else 0.0,
        applied.e_b if params.short == 3 else 0.0,
        applied.e_c if params.short == 1 else 0.0,
    )


@kernel
def taken(params: Params, legs: inverter.Params, applied: inverter.Applied, i: float) -> float:
    """What the short takes from the DC link (A), at its mean current (A)."""
    return i * _across(params, pmsm.phases(applied.u_alpha, applied.u_beta)) / legs.u_dc

"""The DC link: a source behind a resistance, a capacitor, and a brake resistor that is switched on above a voltage.

    C du/dt = (u_source - u) / R_source - i - u / R_brake

`i` is what the inverter takes. A source that limits its current gives that, and no more, as its voltage falls: a
laboratory supply at its limit. A source that takes nothing back, such as a mains adapter, is cut off while the
capacitor stands above it: then a motor that brakes pumps the link up. Over a PWM period the inverter's current is
constant, so each stretch between cutting off and coming back is solved exactly. Without a resistance the link is stiff.

It trips nothing: the firmware's protection sees the voltage at each sample.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel

STRETCHES = 4  # in a period, at most: the source comes or goes once, seldom twice
BRAKE_HYSTERESIS = 0.5  # V between switching the brake on and off


class Params(NamedTuple):
    """The link's constants."""

    u_source: float  # V
    R_source: float  # ohm; 0: the link is stiff
    C: float  # F
    regenerates: int  # 1: the source takes current back
    u_brake: float  # V from which on the brake is on; 0: there is none
    g_brake: float  # 1/ohm
    T_s: float
    whole: float  # how much of a deviation is left after a period, fed and without the brake
    i_limit: float  # A, the most that the source gives
    u_limit: float  # V, of the link below which it gives that; minus infinity: it always gives what it takes


class State(NamedTuple):
    """The link at a sample."""

    u: float  # V
    braking: int  # 1: the brake resistor is on


def make_params(
    u_dc: float,
    R_source: float,
    C: float,
    regenerates: int,
    u_brake: float,
    R_brake: float,
    T_s: float,
    i_limit: float = 0.0,
) -> Params:
    """The link's constants from V, ohm, F, 0 or 1, V, ohm, the PWM period in s and the source's limit in A, 0: none."""
    u_limit = u_dc - R_source * i_limit if i_limit > 0.0 else -math.inf
    whole = math.exp(-T_s / (R_source * C)) if R_source else 0.0
    source = float(u_dc), float(R_source), float(C), int(regenerates)
    return Params(*source, float(u_brake), 1.0 / R_brake, T_s, whole, float(i_limit), u_limit)


@kernel
def init(params: Params) -> State:
    """Charged, without a load."""
    return State(params.u_source, 0)


@kernel
def _upto(u: float, end: float, tau: float, goal: float, left: float) -> float:
    """When, in s from now, a voltage that goes from `u` towards `end` with a time constant passes `goal`."""
    share = (end - goal) / (end - u) if end != u else 1.0
    if share <= 0.0 or share >= 1.0:
        return left
    return min(-tau * math.log(share), left)


@kernel
def step(params: Params, state: State, current: float) -> State:
    """The link a PWM period later, with `current` (A) taken by the inverter in the mean."""
    u = state.u
    braking = state.braking
    if params.u_brake > 0.0:
        if u > params.u_brake:
            braking = 1
        elif u < params.u_brake - BRAKE_HYSTERESIS:
            braking = 0
    end = params.u_source - params.R_source * current
    if braking == 0 and u < params.u_source and end <= params.u_source:  # as it mostly is
        after = end + (u - end) * params.whole
        if min(u, after) >= params.u_limit:
            return State(after, 0)
    g = params.g_brake if braking == 1 else 0.0
    left = params.T_s
    rises = current + g * u < 0.0  # while the source is cut off
    fed = u < params.u_source or (u == params.u_source and not rises) or params.regenerates == 1
    for _ in range(STRETCHES):
        falls = params.i_limit < current + g * u  # where the source gives its most
        limited = fed and (u < params.u_limit or (u == params.u_limit and falls))
        drive = params.u_source / params.R_source - current if fed else -current
        total = g + 1.0 / params.R_source if fed else g
        if limited:
            drive = params.i_limit - current
            total = g
        goal = params.u_source
        if limited or (fed and params.i_limit > 0.0 and drive < total * u):
            goal = params.u_limit
        h = left
        if total > 0.0:
            end = drive / total
            tau = params.C / total
            if u != goal and (goal == params.u_limit or params.regenerates == 0):
                h = _upto(u, end, tau, goal, left)
            after = end + (u - end) * math.exp(-h / tau)
        else:
            goes = drive / params.C
            if goes != 0.0 and (goal - u) / goes > 0.0:
                h = min((goal - u) / goes, left)
            after = u + goes * h
        left -= h
        if left <= 0.0:
            u = after
            break
        u = goal
        if goal == params.u_source:
            fed = not fed
    return State(u, braking)

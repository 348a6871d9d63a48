"""What of the winding depends on frequency: a resistance beside an inductance, both in series with the rest of a phase.

    u = R_s i + R_skin (i - i_L) + d psi / dt,    L_skin di_L/dt = R_skin (i - i_L),    L_skin = R_skin / (2 pi f_skin)

The current that flows around in the conductors and in the iron near them takes the resistance: slow currents see R_s
and all of the inductance, quick ones R_s + R_skin and L_skin less of it. At f_skin half of R_skin is there and half of
L_skin has gone. It is the first step of a ladder that any skin effect can be made of.

The flux in `pmsm` is that of the rest, whose resistance is R_s + R_skin, and R_skin i_L is a voltage beside the
inverter's. Over an integration step the current is a straight line between its ends, which are found by iteration.

Source: C.-S. Yen et al., "Time-domain skin-effect model for transient analysis of lossy transmission lines", Proc.
IEEE, 1982, for the ladder.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.hints import apart
from sim.numba_cache import kernel
from sim.plant import integrator, inverter, mechanics, pmsm

PASSES = 3  # each leaves some percent of what the one before was wrong


class Params(NamedTuple):
    """The constants of a step."""

    R: float  # ohm, R_skin; 0: nothing depends on frequency
    angle: float  # 2 pi f_skin h
    decay: float  # exp(-angle)
    share: float  # (1 - decay) / angle


class State(NamedTuple):
    """What flows in the inductance."""

    i_alpha: float  # A
    i_beta: float


def inductance(skin_R: float, skin_hz: float) -> float:
    """L_skin (H) from ohm and Hz."""
    return skin_R / (2.0 * math.pi * skin_hz)


def make_params(skin_R: float, skin_hz: float, h: float) -> Params:
    """The constants from ohm, Hz and the integration step in s."""
    angle = 2.0 * math.pi * skin_hz * h
    return Params(float(skin_R), angle, math.exp(-angle), -math.expm1(-angle) / angle)


@kernel
def init() -> State:
    """Without a current."""
    return State(0.0, 0.0)


@kernel
def _mean(params: Params, i_L: float, begin: float, end: float) -> float:
    """Mean of the inductance's current, A, over a step in which the phase's goes straight from `begin` to `end`."""
    lag = (end - begin) / params.angle
    return 0.5 * (begin + end) - lag + (i_L - begin + lag) * params.share


@kernel
def _end(params: Params, i_L: float, begin: float, end: float) -> float:
    """The same current after that step."""
    lag = (end - begin) / params.angle
    return end - lag + (i_L - begin + lag) * params.decay


@kernel
def step(
    params: Params,
    state: State,
    plant: integrator.Params,
    before: integrator.State,
    applied: inverter.Applied,
    load: mechanics.Load,
    h: float,
) -> tuple[State, integrator.State, float]:
    """`integrator.step` of a winding with skin effect: both states after `h` seconds, and the forced acceleration."""
    apart()
    motor = plant.motor
    begin_alpha, begin_beta = pmsm.currents(motor, before.psi_alpha, before.psi_beta, before.cos, before.sin)
    end_alpha, end_beta = begin_alpha, begin_beta
    after, alpha = before, 0.0
    for _ in range(PASSES):
        with_skin = applied._replace(
            u_alpha=applied.u_alpha + params.R * _mean(params, state.i_alpha, begin_alpha, end_alpha),
            u_beta=applied.u_beta + params.R * _mean(params, state.i_beta, begin_beta, end_beta),
        )
        after, alpha = integrator.step(plant, before, with_skin, load, h)
        end_alpha, end_beta = pmsm.currents(motor, after.psi_alpha, after.psi_beta, after.cos, after.sin)
    i_alpha = _end(params, state.i_alpha, begin_alpha, end_alpha)
    i_beta = _end(params, state.i_beta, begin_beta, end_beta)
    return State(i_alpha, i_beta), after, alpha

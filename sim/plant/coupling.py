"""The coupling between motor and load machine: two inertias, a stiffness with damping, and backlash.

    tau = k (phi -+ backlash / 2) + d (omega_m - omega_l),   0 within the backlash
    J_m domega_m/dt = tau_e - friction - tau,   J_l domega_l/dt = tau - tau_machine

`phi` is the angle by which the motor is ahead. A coupling pushes and never sticks: its damping takes effect in contact
only. The load machine beyond it takes time: a brake's torque follows its command with a time constant, and a forced
speed is held by a controller with as much torque as the machine has.

Over a step the coupling's torque is that of the middle, which is found with the speeds of the begin (Verlet's method:
second order, and it keeps the energy). Without a stiffness there is one rigid shaft, and nothing here is in use.

Nothing here knows the winding: the motor's side is `integrator`'s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.numba_cache import kernel
from sim.plant import integrator, mechanics


class Params(NamedTuple):
    """The constants of the coupling and of what is beyond it."""

    stiffness: float  # N m/rad; 0: one rigid shaft
    damping: float  # N m s/rad
    half_backlash: float  # mechanical rad
    J_load: float  # kg m2
    bandwidth: float  # of the load machine, rad/s
    tau_max: float  # that it has to force a speed, N m
    alpha_max: float  # slope of a forced speed, rad/s2; 0: none
    gain: float  # of its speed controller, N m s/rad


class State(NamedTuple):
    """The load's side."""

    omega: float  # rad/s, mechanical
    ahead: float  # angle by which the motor is ahead, rad
    tau: float  # of the coupling, over the last step, N m
    torque: float  # of the brake now, N m
    reference: float  # of the forced speed, on its ramp, rad/s
    integral: float  # N m, of the speed controller


def make_params(
    stiffness: float,
    damping: float,
    backlash_deg: float,
    load_share: float,
    bandwidth: float,
    J: float,
    tau_max: float,
    alpha_m_max: float,
) -> Params:
    """Constants from N m/rad, N m s/rad, degrees in all, the share of `J` (kg m2) beyond it, Hz, N m, rad/s2."""
    omega = 2.0 * math.pi * bandwidth
    return Params(
        float(stiffness),
        float(damping),
        0.5 * math.radians(backlash_deg),
        load_share * J,
        omega,
        float(tau_max),
        float(alpha_m_max),
        J * omega,
    )


@kernel
def init() -> State:
    """At rest, in the middle of the backlash."""
    return State(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@kernel
def torque(params: Params, ahead: float, faster: float) -> float:
    """Torque (N m) from the motor's side to the load's: `ahead` rad, `faster` rad/s."""
    if ahead > params.half_backlash:
        return max(params.stiffness * (ahead - params.half_backlash) + params.damping * faster, 0.0)
    if ahead < -params.half_backlash:
        return min(params.stiffness * (ahead + params.half_backlash) + params.damping * faster, 0.0)
    return 0.0


@kernel
def _forced(params: Params, state: State, goal: float, h: float) -> tuple[float, float, float]:
    """The controller's torque (N m) against the positive direction, its ramp (rad/s) and its integral (N m)."""
    reference = goal
    if params.alpha_max > 0.0:
        most = params.alpha_max * h
        reference = state.reference + min(max(goal - state.reference, -most), most)
    error = state.omega - reference
    wanted = params.gain * error + state.integral
    given = min(max(wanted, -params.tau_max), params.tau_max)
    integral = state.integral
    if given == wanted:  # no wind-up
        integral += h * 0.25 * params.bandwidth * params.gain * error
    return given, reference, integral


@kernel
def _braked(omega: float, tau: float, brake: float, J: float, h: float) -> float:
    """The load's speed (rad/s) after `h` s with `tau` from the coupling, braked by a torque of a passive machine."""
    against = brake if brake > 0.0 else 0.0  # of the positive direction
    behind = -brake if brake < 0.0 else 0.0
    if omega > 0.0 or (omega == 0.0 and tau > against):
        dry = against
    elif omega < 0.0 or tau < -behind:
        dry = -behind
    else:
        return 0.0
    after = omega + h * (tau - dry) / J
    return 0.0 if after * omega < 0.0 and abs(tau) <= abs(dry) else after


@kernel
def middle(params: Params, motor: integrator.State, state: State, h: float) -> tuple[State, mechanics.Load]:
    """The load's side half way through `h` seconds, and what acts on the motor's over all of them."""
    ahead = state.ahead + 0.5 * h * (motor.omega_m - state.omega)
    tau = torque(params, ahead, motor.omega_m - state.omega)
    return state._replace(ahead=ahead, tau=tau), mechanics.Load(mechanics.COUPLED, tau, 0.0)


@kernel
def end(params: Params, state: State, motor: integrator.State, load: mechanics.Load, h: float) -> State:
    """The load's side at the end, from the `middle` and the motor's side at the end."""
    brake = load.tau if load.mode == mechanics.TORQUE else 0.0
    brake += (state.torque - brake) * math.exp(-params.bandwidth * h)
    reference = state.omega
    integral = 0.0
    if load.mode == mechanics.SPEED:
        machine, reference, integral = _forced(params, state, load.omega_m, h)
        omega = state.omega + h * (state.tau - machine) / params.J_load
    else:
        omega = _braked(state.omega, state.tau, brake, params.J_load, h)
    ahead = state.ahead + 0.5 * h * (motor.omega_m - omega)
    return State(omega, ahead, state.tau, brake, reference, integral)

"""The shaft: inertia, friction with stiction, and the load machine on it.

    J d omega_m / dt = tau_e - b omega_m - tau_dry,    theta_e' = n_p omega_m

`tau_dry` is dry friction and the load machine's brake torque: it opposes motion, holds the shaft at rest up to its
size, and never drives it. Friction may be more at rest and fall as the shaft begins to turn (Stribeck), and the iron
takes torque where the flux goes round in it, by hysteresis and by eddy currents:

    tau_dry = tau_c + tau_s exp(-(omega_m / omega_s)^2) + tau_h psi^2 / psi_f^2,   b = b_v + b_eddy psi^2 / psi_f^2

with psi the flux linkage's size. In power that is a resistance of 3/2 n_p^2 psi_f^2 / b_eddy across the flux, as far as
the flux turns with the rotor; losses by ripple and by quick changes are not in it. Over an integration step all of it
is a straight line over the speed, the tangent at its begin. The dry torque keeps its direction over a step;
`integrator` ends one where the speed passes zero, so friction never chatters.

The load machine
- is off: no torque;
- brakes (TORQUE): a constant torque against one direction. It looks passive: it holds the shaft at rest, and adds
  nothing to a motion the other way, so that a drive that gives up is not driven backwards by its load;
- forces the speed (SPEED): a stiff servo, exactly on its ramp whatever the drive does;
- is beyond a coupling (COUPLED): see `coupling`.

A hand, or a machine that trembles, may rock the shaft at rest by a sine of its angle (ROCKED).

Source: B. Armstrong-Helouvry et al., "A survey of models, analysis tools and compensation methods for the control of
machines with friction", Automatica, 1994, for Stribeck's curve; G. Bertotti, "General properties of power losses in
soft ferromagnetic materials", IEEE Trans. Magn., 1988, for hysteresis that goes with frequency and eddy currents with
its square, both with the square of the flux here; its excess losses are left out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from sim.hints import seldom
from sim.numba_cache import kernel

OFF, SPEED, TORQUE = 0, 1, 3  # the load machine's modes, SPEED and TORQUE as on the wire
COUPLED = 16  # it is beyond a coupling: what acts on this shaft is the coupling's torque, either way
ROCKED = 17  # the speed is what `omega_m` says, at once


class Params(NamedTuple):
    """The shaft's constants."""

    J: float  # kg m2
    b: float  # N m s/rad
    tau_coulomb: float  # N m
    alpha_m_max: float  # slope of a forced speed, rad/s2; 0: none
    stribeck: float  # N m, by which dry friction is more at rest
    omega_stribeck: float  # rad/s, at which a share 1/e of that is left
    hysteresis: float  # N m by (V s)^2
    eddy: float  # N m s/rad by (V s)^2
    varies: int  # 1: any of these is there


class Load(NamedTuple):
    """What the load machine is told."""

    mode: int
    tau: float  # N m, TORQUE: positive brakes the positive direction; COUPLED: against the positive direction
    omega_m: float  # rad/s, SPEED: where the ramp ends


class Rock(NamedTuple):
    """How the shaft is rocked."""

    speed: float  # rad/s, amplitude; 0: it is not
    omega: float  # rad/s


class Push(NamedTuple):
    """What acts on the shaft over one integration step: omega_m' = gain (tau_e - b omega_m - tau_dry) + alpha."""

    gain: float  # 1/J, or 0: the shaft is held or its speed forced
    tau_dry: float  # N m, against the positive direction
    alpha: float  # rad/s2


def make_params(
    J: float,
    b: float,
    tau_coulomb: float,
    alpha_m_max: float,
    stribeck: float = 0.0,
    omega_stribeck: float = 1.0,
    iron: tuple[float, float] = (0.0, 0.0),
) -> Params:
    """The shaft's constants from kg m2, N m s/rad, N m, rad/s2, N m and rad/s.

    `iron`: its losses, N m by (V s)^2 and N m s/rad by (V s)^2.
    """
    hysteresis, eddy = iron
    varies = int(stribeck > 0.0 or hysteresis > 0.0 or eddy > 0.0)
    shaft = float(J), float(b), float(tau_coulomb), float(alpha_m_max)
    return Params(*shaft, float(stribeck), float(omega_stribeck), float(hysteresis), float(eddy), varies)


@kernel
def losing(params: Params, omega_m: float, square: float) -> Params:
    """The shaft with friction and iron losses as they are near a speed (rad/s) and a flux, squared ((V s)^2)."""
    return _losing(params, omega_m, square) if seldom(params.varies != 0) else params


@kernel
def _losing(params: Params, omega_m: float, square: float) -> Params:
    x = omega_m / params.omega_stribeck
    more = params.stribeck * math.exp(-x * x)
    fall = 2.0 * abs(x) / params.omega_stribeck * more  # N m s/rad
    dry = params.tau_coulomb + more + fall * abs(omega_m) + params.hysteresis * square
    return params._replace(b=params.b - fall + params.eddy * square, tau_coulomb=dry)


def make_rock(rock_deg: float, rock_hz: float, n_p: int) -> Rock:
    """From the amplitude in electrical degrees and Hz."""
    omega = math.tau * rock_hz
    return Rock(math.radians(rock_deg) * omega / n_p, omega)


@kernel
def rocks(rock: Rock, load: Load, on: int, omega_m: float) -> bool:
    """Whether the shaft is rocked now: nothing drives it, and it is no faster than that makes it."""
    return rock.speed > 0.0 and on == 0 and load.mode == OFF and abs(omega_m) <= 1.01 * rock.speed


@kernel
def rocked(rock: Rock, time: float) -> Load:
    """What rocks it up to a moment, s since boot."""
    return Load(ROCKED, 0.0, rock.speed * math.cos(rock.omega * time))


@kernel
def brakes(params: Params, load: Load) -> tuple[float, float]:
    """Dry torque (N m) against the positive direction, and that against the negative one."""
    forward = params.tau_coulomb
    backward = params.tau_coulomb
    if load.mode == TORQUE:
        if load.tau > 0.0:
            forward += load.tau
        else:
            backward -= load.tau
    return forward, backward


@kernel
def push(params: Params, load: Load, omega_m: float, tau_e: float, h: float) -> Push:
    """What acts on the shaft over the next `h` seconds, from its speed and the motor's torque at the start."""
    if load.mode == SPEED or load.mode == ROCKED:
        alpha = (load.omega_m - omega_m) / h
        if params.alpha_m_max > 0.0 and load.mode == SPEED:
            alpha = min(max(alpha, -params.alpha_m_max), params.alpha_m_max)
        return Push(0.0, 0.0, alpha)
    forward, backward = brakes(params, load)
    alpha = 0.0
    if load.mode == COUPLED:
        tau_e -= load.tau
        alpha = -load.tau / params.J
    if omega_m > 0.0 or (omega_m == 0.0 and tau_e > forward):
        return Push(1.0 / params.J, forward, alpha)
    if omega_m < 0.0 or tau_e < -backward:
        return Push(1.0 / params.J, -backward, alpha)
    return Push(0.0, 0.0, 0.0)


@kernel
def load_torque(params: Params, load: Load, omega_m: float, tau_e: float, alpha: float) -> float:
    """The load machine's torque on the shaft (N m), positive against the positive direction.

    `alpha`: the forced acceleration (rad/s2). At rest the dry friction takes up the motor's torque first.
    """
    if load.mode == SPEED:
        dry = params.tau_coulomb
        if omega_m < 0.0:
            dry = -dry
        elif omega_m == 0.0:
            dry = min(max(tau_e, -dry), dry)
        return tau_e - params.b * omega_m - dry - params.J * alpha
    if load.mode != TORQUE:
        return 0.0
    if omega_m != 0.0:
        return load.tau if (omega_m > 0.0) == (load.tau > 0.0) else 0.0
    rest = tau_e - min(max(tau_e, -params.tau_coulomb), params.tau_coulomb)
    return min(max(rest, min(load.tau, 0.0)), max(load.tau, 0.0))

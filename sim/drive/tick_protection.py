"""The firmware's protection: which faults have a cause at a sample.

Currents and DC link voltage: at once. Speed: at once by the encoder; without one by the Hall sensors, once it has
stood for a while, because one false edge makes any speed. Heat of the winding: once the excess of the squared current
vector over `i_cont` squared, added up and never below zero, is above `i2t_max`.

Hall sensors, by a level of doubt between 0 and 1 that trips when it is full:
- a sample with the code 000 or 111 adds T_s / `hall_fault_time`;
- an implausible edge, which is one to such a code or a sector skipped (by edges, or found by a sample), adds
  1 / `hall_fault_count`;
- any other sample takes away T_s / `hall_fault_leak`.
A broken or shorted wire makes one sector in six illegal and another one skipped, however the shaft turns. An EMI
pulse, over within microseconds, is one implausible edge at most.

Exchanged wires make a legal sequence that runs backwards. While the outputs are on the back-EMF (5) tells which way
the rotor turns. It is turned by the angle of the Hall sector and added up while the Hall sensors go once around. Of a
rotor that turns with them nothing is left, at any speed; of one that turns against them, 2 pi psi_f. Such a turn
counts if what is left is more than
- `hall_emf` over its time,
- `SHARE` of what psi_f_hat would leave: misplaced edges leave some, too, and
- what currents can have left in that direction, however they turn, if R_s_hat and L_s_hat are anything from half to
  twice the true values, and a dead time's `hall_emf` is left along them.
Any other turn takes one away. `hall_turns` trip.
All that counts is counted always, and trips only while the control uses the Hall sensors.

It never switches anything off: `tick_firmware` latches the faults.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from protocol.messages import Fault
from sim.config.sections import Protection
from sim.numba_cache import kernel
from sim.observers.hall_speed import SECTOR_WIDTH

OVERCURRENT, OVERSPEED = int(Fault.OVERCURRENT), int(Fault.OVERSPEED)
UNDERVOLTAGE, OVERVOLTAGE, HALL = int(Fault.UNDERVOLTAGE), int(Fault.OVERVOLTAGE), int(Fault.HALL)
OVERLOAD = int(Fault.OVERLOAD)
FULL = 1.0 - 1e-9  # doubt that trips: parts add up to 1 but for rounding
SHARE = 0.3  # of 2 pi psi_f_hat; exchanged wires leave 0.95 of 2 pi psi_f, edges that are 10 deg off 0.1
TURN = 6  # sectors
COS_OF_SECTOR = tuple(math.cos(sector * SECTOR_WIDTH) for sector in range(TURN))
SIN_OF_SECTOR = tuple(math.sin(sector * SECTOR_WIDTH) for sector in range(TURN))


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
    opposed_max: float  # electrical turns
    e_min: float  # V
    left_min: float  # V, added up over samples
    R_s: float  # ohm
    L_by_T: float  # L_s / T_s
    T_s: float
    i_cont_square: float  # A2
    i2t_max: float  # A2 s


class Sensed(NamedTuple):
    """What the protection looks at, at a sample."""

    current: float  # the largest phase current's size, A
    omega: float  # electrical rad/s
    u_dc: float  # V
    hall: int  # code
    edges: int  # implausible edges since the last sample
    sector: int  # by the Hall sensors: 0..5, -1: unknown
    u_alpha: float  # over the period that ends here, V
    u_beta: float
    i_alpha: float  # A
    i_beta: float


class Turn(NamedTuple):
    """What was added up since the Hall sensors were last once around, each sample turned by its sector's angle."""

    sectors: int  # passed, by direction
    n: int  # samples
    e_alpha: float  # back-EMF (5), V
    e_beta: float
    r_alpha: float  # V, along the current, by R_s_hat and a dead time
    r_beta: float
    l_alpha: float  # V, by L_s_hat
    l_beta: float


class State(NamedTuple):
    """What the protection remembers."""

    fast: int  # periods in a row above the largest speed
    doubt: float  # of the Hall sensors, 0..1
    opposed: float  # electrical turns of the back-EMF against the Hall sensors
    turn: Turn
    sector: int  # at the last sample
    i_alpha: float  # A, at the last sample
    i_beta: float
    excess: float  # of the squared current, added up, A2 s
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
        limits.hall_turns,
        limits.hall_emf,
        SHARE * 2.0 * math.pi * drive["psi_f_hat"] * pwm_hz,
        drive["R_s_hat"],
        drive["L_s_hat"] * pwm_hz,
        T_s,
        drive["i_cont"] ** 2,
        drive["i2t_max"] or math.inf,
    )


@kernel
def _begun() -> Turn:
    """A turn begins."""
    return Turn(0, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@kernel
def init() -> State:
    """Nothing seen yet."""
    return State(0, 0.0, 0.0, _begun(), -1, 0.0, 0.0, 0.0, 0)


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
def _added(params: Params, state: State, sensed: Sensed) -> Turn:
    """The turn with this sample."""
    turn = state.turn
    c = COS_OF_SECTOR[sensed.sector]
    s = SIN_OF_SECTOR[sensed.sector]
    i_alpha = 0.5 * (sensed.i_alpha + state.i_alpha)
    i_beta = 0.5 * (sensed.i_beta + state.i_beta)
    along = params.R_s + params.e_min / max(math.sqrt(i_alpha * i_alpha + i_beta * i_beta), 1e-6)
    l_alpha = params.L_by_T * (sensed.i_alpha - state.i_alpha)
    l_beta = params.L_by_T * (sensed.i_beta - state.i_beta)
    e_alpha = sensed.u_alpha - params.R_s * i_alpha - l_alpha
    e_beta = sensed.u_beta - params.R_s * i_beta - l_beta
    return Turn(
        turn.sectors + (sensed.sector - state.sector + 3) % TURN - 3,
        turn.n + 1,
        turn.e_alpha + c * e_alpha - s * e_beta,
        turn.e_beta + c * e_beta + s * e_alpha,
        turn.r_alpha + along * (c * i_alpha - s * i_beta),
        turn.r_beta + along * (c * i_beta + s * i_alpha),
        turn.l_alpha + c * l_alpha - s * l_beta,
        turn.l_beta + c * l_beta + s * l_alpha,
    )


@kernel
def _against(params: Params, turn: Turn) -> bool:
    """Whether the rotor certainly turned against the Hall sensors."""
    by_r = turn.e_alpha * turn.r_alpha + turn.e_beta * turn.r_beta
    by_l = turn.e_alpha * turn.l_alpha + turn.e_beta * turn.l_beta
    unsure = max(by_r, -0.5 * by_r) + max(by_l, -0.5 * by_l)
    size = math.sqrt(turn.e_alpha * turn.e_alpha + turn.e_beta * turn.e_beta)
    return size * (size - max(params.e_min * turn.n, params.left_min)) > unsure


@kernel
def step(params: Params, state: State, sensed: Sensed, on: bool, by_hall: bool) -> State:
    """One control period; `on`: the outputs were on over it; `by_hall`: the control uses the Hall sensors."""
    fast = state.fast + 1 if abs(sensed.omega) > params.omega_trip else 0
    doubt = _doubt(params, state.doubt, sensed.hall, sensed.edges)
    opposed = 0.0
    turn = _begun()
    if on:
        opposed = state.opposed
        if state.sector >= 0 and (sensed.sector - state.sector + 1) % TURN <= 2:  # else a sector was skipped
            turn = _added(params, state, sensed)
        if abs(turn.sectors) >= TURN:
            opposed = opposed + 1.0 if _against(params, turn) else max(opposed - 1.0, 0.0)
            turn = _begun()
    square = sensed.i_alpha * sensed.i_alpha + sensed.i_beta * sensed.i_beta
    excess = max(state.excess + params.T_s * (square - params.i_cont_square), 0.0)
    causes = 0
    if excess > params.i2t_max:
        causes |= OVERLOAD
    if sensed.current > params.i_trip:
        causes |= OVERCURRENT
    if fast >= params.speed_periods:
        causes |= OVERSPEED
    if sensed.u_dc < params.u_dc_min:
        causes |= UNDERVOLTAGE
    if sensed.u_dc > params.u_dc_max:
        causes |= OVERVOLTAGE
    if by_hall and (doubt >= FULL or opposed >= params.opposed_max):
        causes |= HALL
    return State(fast, doubt, opposed, turn, sensed.sector, sensed.i_alpha, sensed.i_beta, excess, causes)

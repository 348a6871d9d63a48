"""The drive's firmware: what it does at each sample, from measured values to duties.

Voltages and duties that are computed from the sample at k are in force from k + 1 to k + 2. All three angle
sources are followed all the time; the control uses one, and changes over without a bump.

It sees sensors only: rounded currents, Hall codes and edges, encoder counts, the DC link voltage. Never the
plant.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.messages import DriveState, SetpointMode
from protocol.signals import AngleSource
from sim.control import current_loop, dead_time, modulation, speed_loop
from sim.control.transforms import inverse_clarke, inverse_park, park
from sim.drive import tick_protection as protection
from sim.drive.tick_record import quantised
from sim.numba_cache import kernel
from sim.observers import bank, hall_speed
from sim.observers.transforms import clarke
from sim.plant import encoder
from sim.plant.integrator import turn

ARMED, RUNNING, FAULT = int(DriveState.ARMED), int(DriveState.RUNNING), int(DriveState.FAULT)
MODE_SPEED = int(SetpointMode.SPEED)
ENCODER, AVERAGE_SPEED = int(AngleSource.ENCODER), int(AngleSource.AVERAGE_SPEED)


class Params(NamedTuple):
    """The firmware's constants and parameters."""

    bank: bank.Params
    current: current_loop.Params
    speed: speed_loop.Params
    dead_time: dead_time.Params
    encoder: encoder.Params
    protection: protection.Params
    T_s: float
    n_p: float
    has_encoder: bool


class Command(NamedTuple):
    """What the host asked for last."""

    state: int  # DriveState
    mode: int  # SetpointMode, 0: none yet
    omega_m: float  # SPEED: mechanical rad/s
    i_d: float  # CURRENT, A
    i_q: float


class Sensed(NamedTuple):
    """What the sensors say at a sample, currents and voltage as telemetry carries them."""

    tick: int
    hall: int
    counter: int  # encoder
    i_a: float
    i_b: float
    i_c: float
    u_dc: float


class Output(NamedTuple):
    """What the inverter is told for one period."""

    on: bool
    u_alpha: float  # reference voltage, V, as telemetry carries it
    u_beta: float
    d_a: float  # duties with the dead time's compensation
    d_b: float
    d_c: float


class State(NamedTuple):
    """What the firmware remembers."""

    bank: bank.State
    encoder: encoder.State
    current: current_loop.State
    speed: speed_loop.State
    source: int  # of the last sample
    mode: int  # SetpointMode at the last sample, 0: none
    i_d_ref: float  # in force since the last sample, A
    i_q_ref: float
    i_q: float  # at the last sample, A, in the frame that the control uses, as telemetry carries it
    now: Output  # in force since the last sample
    next: Output  # in force from the coming sample on
    protection: protection.State
    faults: int  # latched Fault bits


class Result(NamedTuple):
    """One period's results, for the record."""

    estimate: bank.BankEstimate
    omega_enc: float
    i_d: float
    i_q: float
    omega_ref: float


@kernel
def output_off() -> Output:
    """Outputs off."""
    return Output(False, 0.0, 0.0, 0.5, 0.5, 0.5)


@kernel
def init(counter: int) -> State:
    """The state at boot, with the encoder at `counter`."""
    return State(
        bank.init(),
        encoder.init(counter),
        current_loop.init(),
        speed_loop.init(0.0, 0.0),
        ENCODER,
        0,
        0.0,
        0.0,
        0.0,
        output_off(),
        output_off(),
        protection.init(),
        0,
    )


@kernel
def _protect(
    params: Params,
    state: State,
    sensed: Sensed,
    hall: hall_speed.State,
    omega_enc: float,
    estimate: bank.BankEstimate,
) -> protection.State:
    """The protection after a sample; `hall`: the Hall front end's state after it."""
    before = state.bank.front.hall
    sampled = 1 if sensed.hall == 0 or sensed.hall == 7 else 0
    return protection.step(
        params.protection,
        state.protection,
        protection.Sensed(
            max(abs(sensed.i_a), abs(sensed.i_b), abs(sensed.i_c)),
            omega_enc if params.has_encoder else estimate.omega[AVERAGE_SPEED - 1],
            sensed.u_dc,
            sensed.hall,
            hall.illegal - before.illegal - sampled + hall.skipped - before.skipped,
            hall.now.direction,
            estimate.e_alpha,
            estimate.e_beta,
        ),
        state.now.on,
    )


@kernel
def _angle(
    params: Params, source: int, sensed: Sensed, omega_enc: float, estimate: bank.BankEstimate
) -> tuple[float, float]:
    """Angle and speed (electrical rad, rad/s) by an angle source."""
    if source == ENCODER:
        return encoder.angle(params.encoder, sensed.counter), omega_enc
    return estimate.theta[source - 1], estimate.omega[source - 1]


@kernel
def _change_over(
    params: Params,
    current: current_loop.State,
    speed: speed_loop.State,
    theta_old: float,
    omega_old: float,
    theta: float,
    omega: float,
) -> tuple[current_loop.State, speed_loop.State]:
    """The loops' states for another angle source: the voltage in the stator frame and the torque stay."""
    c = math.cos(theta_old - theta)
    s = math.sin(theta_old - theta)
    u_d, u_q = inverse_park(current.u_d_i, current.u_q_i, c, s)
    i_q_i = speed.i_q_i + params.speed.k_p * (omega - omega_old) / params.n_p
    return current_loop.State(u_d, u_q), speed_loop.State(speed.omega_m_ref, i_q_i)


@kernel
def _modulate(
    params: Params,
    u_dc: float,
    u_d: float,
    u_q: float,
    i_d: float,
    i_q: float,
    cos: float,
    sin: float,
) -> Output:
    """Rotor-frame voltage and currents, turned by the angle of the period in force, to duties."""
    u_alpha, u_beta = inverse_park(u_d, u_q, cos, sin)
    u_alpha = quantised(u_alpha)
    u_beta = quantised(u_beta)
    d_a, d_b, d_c = modulation.duties(u_alpha, u_beta, u_dc)
    i_alpha, i_beta = inverse_park(i_d, i_q, cos, sin)
    i_a, i_b, i_c = inverse_clarke(i_alpha, i_beta)
    d_a, d_b, d_c = dead_time.compensate(params.dead_time, d_a, d_b, d_c, i_a, i_b, i_c)
    return Output(True, u_alpha, u_beta, d_a, d_b, d_c)


@kernel
def step(
    params: Params,
    state: State,
    command: Command,
    source: int,
    sensed: Sensed,
    edge_ticks: NDArray[np.int64],
    edge_halls: NDArray[np.uint8],
    first: int,
    last: int,
) -> tuple[State, Result]:
    """One control period: observers with the edges [first, last) of the arrays, protection, loops,
    modulation. `source`: the AngleSource that the control uses.

    On return `state.now` is what is in force until the next sample.
    """
    estimator, estimate = bank.step(
        params.bank,
        state.bank,
        sensed.tick,
        sensed.hall,
        state.now.u_alpha,
        state.now.u_beta,
        sensed.i_a,
        sensed.i_b,
        sensed.i_c,
        state.i_q_ref - state.i_q,
        edge_ticks,
        edge_halls,
        first,
        last,
    )
    tracker, omega_enc = encoder.track(params.encoder, state.encoder, sensed.counter)
    theta, omega = _angle(params, source, sensed, omega_enc, estimate)

    protected = _protect(params, state, sensed, estimator.front.hall, omega_enc, estimate)
    faults = state.faults
    if command.state == ARMED or command.state == RUNNING:
        faults |= protected.causes

    i_alpha, i_beta = clarke(sensed.i_a, sensed.i_b, sensed.i_c)
    cos = math.cos(theta)
    sin = math.sin(theta)
    i_d, i_q = park(i_alpha, i_beta, cos, sin)

    current = state.current
    speed = state.speed
    mode = 0
    i_d_ref = 0.0
    i_q_ref = 0.0
    omega_ref = 0.0
    output = output_off()
    if command.state == RUNNING and faults == 0:
        mode = command.mode
        if state.source != source and state.next.on:
            theta_old, omega_old = _angle(params, state.source, sensed, omega_enc, estimate)
            current, speed = _change_over(params, current, speed, theta_old, omega_old, theta, omega)
        if mode == MODE_SPEED:
            if state.mode != MODE_SPEED:
                speed = speed_loop.init(omega / params.n_p, state.i_q_ref)
            speed, i_q_ref = speed_loop.step(params.speed, speed, command.omega_m, omega / params.n_p)
            omega_ref = speed.omega_m_ref * params.n_p
        else:
            i_d_ref = command.i_d
            i_q_ref = command.i_q
        i_d_ref = quantised(i_d_ref)
        i_q_ref = quantised(i_q_ref)
        current, u_d, u_q = current_loop.step(
            params.current, current, i_d_ref, i_q_ref, i_d, i_q, omega, modulation.linear_limit(sensed.u_dc)
        )
        cos, sin = turn(cos, sin, 1.5 * params.T_s * omega)
        output = _modulate(params, sensed.u_dc, u_d, u_q, i_d, i_q, cos, sin)
        now = state.next
    else:
        current = current_loop.init()
        speed = speed_loop.init(0.0, 0.0)
        now = output

    after = State(
        estimator,
        tracker,
        current,
        speed,
        source,
        mode,
        i_d_ref,
        i_q_ref,
        quantised(i_q),
        now,
        output,
        protected,
        faults,
    )
    return after, Result(estimate, omega_enc, i_d, i_q, omega_ref)

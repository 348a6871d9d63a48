"""The simulated bench in one compiled loop: plant, sensors, firmware and record, a PWM period at a time.

In the period that ends at the sample k
1. the plant moves from k-1 to k with the duties computed at k-2, and Hall edges are captured in timer ticks;
2. the sensors are sampled;
3. the firmware steps its observers, with the edges captured since k-1, and its control (`tick_firmware`);
4. the sample is recorded, with references and voltages that were in force over the period that ends at it.

An edge's tick is that of the first timer clock after it, so it lies in (tick_{k-1}, tick_k].

The loop draws no random numbers but those of the seed in its state, and it does the same in one call as in many.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.signals import OTHER_SOURCE, STATUS_SOURCE_SHIFT, Status
from sim.drive import tick_firmware
from sim.drive.tick_record import (
    PER_NM,
    PER_RAD_PER_S,
    PER_UNIT,
    angle,
    clipped,
    edge_codes,
    quantised,
    quantised_u16,
)
from sim.numba_cache import kernel
from sim.observers import bank
from sim.plant import current_sensor, encoder, hall_sensor, hall_wiring, integrator, inverter, mechanics, noise, pmsm

RESET, CORRECTION, SYNC = int(Status.OBSERVERS_RESET), int(Status.CORRECTION_ON), int(Status.INJECTION_SYNC)
FAULT = tick_firmware.FAULT
NEVER = hall_wiring.NEVER
REFRESH = 256  # samples after which the rotor's cosine and sine are computed anew

LOG_FIELDS = (
    "theta_avg",
    "omega_avg",
    "theta_vt",
    "omega_vt",
    "delta_hat",
    "e_alpha",
    "e_beta",
    "theta_e",  # the plant's, unwrapped
    "omega_e",
    "i_alpha",  # the plant's
    "i_beta",
)


class Params(NamedTuple):
    """Constants of the bench."""

    plant: integrator.Params
    hall: hall_sensor.Params
    wiring: hall_wiring.Params
    current_sensor: current_sensor.Params
    firmware: tick_firmware.Params
    source: int  # AngleSource of the control
    source_from: int  # the first sample at which it is used
    source_before: int  # what is used until then
    period_ticks: int
    substeps: int
    h: float  # integration step, s


class State(NamedTuple):
    """Everything that changes."""

    k: int  # samples taken
    tick: int  # of the next sample
    rng: np.uint64
    plant: integrator.State
    alpha_m: float  # acceleration that the load machine forces, rad/s2
    hall: hall_sensor.State
    wiring: hall_wiring.State
    firmware: tick_firmware.State


class Arrays(NamedTuple):
    """Where results go: n samples, and edges as far as there are places."""

    samples: NDArray[np.void]  # SAMPLE_DTYPE
    load_samples: NDArray[np.void]  # LOAD_DTYPE
    edges: NDArray[np.void]  # EDGE_RECORD
    edge_tick: NDArray[np.int64]  # the same edges for the observers
    edge_hall: NDArray[np.uint8]
    log: NDArray[np.float64]  # shape (n, len(LOG_FIELDS)), or (0, ...) for none


class Command(NamedTuple):
    """What the host asked for last."""

    drive: tick_firmware.Command
    load: mechanics.Load
    load_state: int  # DriveState of the load machine, for its record
    reset: bool  # initialise the observers at the first sample


@kernel
def init(params: Params, theta_e: float, start_tick: int, quantiles: NDArray[np.float64], rng: np.uint64) -> State:
    """The state at boot with the rotor at rest at `theta_e` (electrical rad)."""
    rng = noise.advance(rng)
    counter = encoder.count(params.firmware.encoder, theta_e)
    hall = hall_sensor.init(params.hall, theta_e, quantiles, rng)
    return State(
        0,
        start_tick,
        rng,
        integrator.init(params.plant, theta_e),
        0.0,
        hall,
        hall_wiring.init(params.wiring, hall_sensor.code(hall.number)),
        tick_firmware.init(counter),
    )


@kernel
def _captured(
    params: Params, wiring: hall_wiring.State, new: int, tick: int, theta: float, arrays: Arrays, m: int
) -> tuple[hall_wiring.State, int]:
    """Capture an edge at `tick`, at the angle `theta`, if the code `new` is another one than before."""
    old = wiring.pins
    if new == old:
        return wiring, m
    arrays.edge_tick[m] = tick
    arrays.edge_hall[m] = new
    row = arrays.edges[m]
    row["tick"] = tick & 0xFFFFFFFF
    row["codes"] = edge_codes(old, new)
    row["flags"] = 0
    row["encoder"] = encoder.count(params.firmware.encoder, theta) if params.firmware.has_encoder else 0
    return hall_wiring.State(new, wiring.pulse, wiring.due), m + 1


@kernel
def _edges(
    params: Params,
    hall: hall_sensor.State,
    wiring: hall_wiring.State,
    before: integrator.State,
    after: integrator.State,
    tick: int,
    offset: float,
    arrays: Arrays,
    m: int,
    quantiles: NDArray[np.float64],
    rng: np.uint64,
) -> tuple[hall_sensor.State, hall_wiring.State, int, np.uint64]:
    """Capture the edges between two plant states, those of the sensors and those of false pulses, in order.

    `tick`: of the sample at the period's end; `offset`: ticks from there back to `before`; `m`: edges so far.
    """
    n_p = params.plant.motor.n_p
    step_ticks = params.period_ticks / params.substeps
    while m < arrays.edge_tick.shape[0]:
        way = 0
        theta = after.theta_e
        late = math.floor(step_ticks - offset)
        if after.theta_e >= hall.above:
            way = 1
            theta = hall.above
        elif after.theta_e < hall.below:
            way = -1
            theta = hall.below
        if way != 0:
            x = hall_sensor.time_of(
                before.theta_e, n_p * before.omega_m, after.theta_e, n_p * after.omega_m, params.h, theta
            )
            late = math.floor(x * step_ticks - offset) + 1
        captured = tick + min(late, 0)
        if wiring.due <= captured:  # a false pulse begins or ends before
            x = (wiring.due - tick + offset) / step_ticks
            theta = before.theta_e + x * (after.theta_e - before.theta_e)
            rng = noise.advance(rng)
            due = wiring.due
            wiring = hall_wiring.toggled(params.wiring, wiring, rng)
            pins = hall_wiring.pins(params.wiring, hall_sensor.code(hall.number), wiring.pulse)
            wiring, m = _captured(params, wiring, pins, due, theta, arrays, m)
        elif way != 0:
            rng = noise.advance(rng)
            hall = hall_sensor.enter(params.hall, hall.number + way, theta, quantiles, rng)
            pins = hall_wiring.pins(params.wiring, hall_sensor.code(hall.number), wiring.pulse)
            wiring, m = _captured(params, wiring, pins, captured, theta, arrays, m)
        else:
            break
    return hall, wiring, m, rng


@kernel
def _rewired(params: Params, state: State, arrays: Arrays, m: int) -> tuple[State, int]:
    """The state with the wires as they are now: a code that changes with them is an edge as the period begins."""
    pins = hall_wiring.pins(params.wiring, hall_sensor.code(state.hall.number), state.wiring.pulse)
    tick = state.tick - params.period_ticks + 1
    wiring, m = _captured(params, state.wiring, pins, tick, state.plant.theta_e, arrays, m)
    return State(state.k, state.tick, state.rng, state.plant, state.alpha_m, state.hall, wiring, state.firmware), m


@kernel
def _move(
    params: Params,
    state: State,
    load: mechanics.Load,
    arrays: Arrays,
    m: int,
    quantiles: NDArray[np.float64],
) -> tuple[State, int]:
    """The plant over one period, with its edges; the sensors' random numbers are drawn at its end."""
    out = state.firmware.now
    if out.on:
        applied = inverter.apply(params.plant.inverter, out.d_a, out.d_b, out.d_c)
    else:
        applied = inverter.off()
    plant = state.plant
    hall = state.hall
    wiring = state.wiring
    rng = state.rng
    alpha = 0.0
    if params.wiring.gap > 0.0 or wiring.due != NEVER:
        rng = noise.advance(rng)
        wiring = hall_wiring.next_pulse(params.wiring, wiring, state.tick - params.period_ticks, rng)
    if state.k % REFRESH == 0:
        plant = integrator.refresh(plant)
    step_ticks = params.period_ticks / params.substeps
    for j in range(params.substeps):
        before = plant
        plant, alpha = integrator.step(params.plant, before, applied, load, params.h)
        if plant.theta_e >= hall.above or plant.theta_e < hall.below or wiring.due <= state.tick:
            offset = (params.substeps - j) * step_ticks
            hall, wiring, m, rng = _edges(
                params, hall, wiring, before, plant, state.tick, offset, arrays, m, quantiles, rng
            )
    return State(state.k, state.tick, rng, plant, alpha, hall, wiring, state.firmware), m


@kernel
def _sense(
    params: Params, state: State, i_alpha: float, i_beta: float, quantiles: NDArray[np.float64]
) -> tuple[np.uint64, tick_firmware.Sensed]:
    """Sample the sensors; also the generator's next state."""
    rng = noise.advance(state.rng)
    sensor = params.current_sensor
    i_a, i_b, i_c = pmsm.phases(i_alpha, i_beta)
    i_a = current_sensor.measure(sensor, i_a, sensor.gain_a, sensor.offset_a, noise.first(quantiles, rng))
    i_b = current_sensor.measure(sensor, i_b, sensor.gain_b, sensor.offset_b, noise.second(quantiles, rng))
    i_c = current_sensor.measure(sensor, i_c, sensor.gain_c, sensor.offset_c, noise.third(quantiles, rng))
    return rng, tick_firmware.Sensed(
        state.tick,
        state.wiring.pins,
        encoder.count(params.firmware.encoder, state.plant.theta_e),
        quantised(i_a),
        quantised(i_b),
        quantised(i_c),
        quantised_u16(params.plant.inverter.u_dc),
    )


@kernel
def _silenced(firmware: tick_firmware.State) -> tick_firmware.State:
    """The firmware's state with the outputs off at once."""
    off = tick_firmware.output_off()
    return tick_firmware.State(
        firmware.bank,
        firmware.encoder,
        firmware.current,
        firmware.speed,
        firmware.source,
        0,
        0.0,
        0.0,
        0.0,
        off,
        off,
        firmware.protection,
        firmware.faults,
    )


@kernel
def _with_bank(firmware: tick_firmware.State) -> tick_firmware.State:
    """The firmware's state with its observers initialised."""
    return tick_firmware.State(
        bank.init(),
        firmware.encoder,
        firmware.current,
        firmware.speed,
        firmware.source,
        firmware.mode,
        firmware.i_d_ref,
        firmware.i_q_ref,
        firmware.i_q,
        firmware.now,
        firmware.next,
        firmware.protection,
        firmware.faults,
    )


@kernel
def advance(
    params: Params,
    state: State,
    command: Command,
    n: int,
    quantiles: NDArray[np.float64],
    arrays: Arrays,
) -> tuple[State, int]:
    """Run `n` periods into `arrays`; returns the state after them and the number of edges captured.

    The first period of all only takes a sample: nothing has moved yet.
    """
    motor = params.plant.motor
    n_p = motor.n_p
    m = int(np.int64(0))  # numba would compile a version of everything for the literal 0 too
    if command.drive.state != tick_firmware.RUNNING or state.firmware.faults != 0:
        silenced = _silenced(state.firmware)
        state = State(state.k, state.tick, state.rng, state.plant, state.alpha_m, state.hall, state.wiring, silenced)
    for j in range(n):
        first = m
        if state.k > 0:
            if j == 0 or state.k == 1:
                state, m = _rewired(params, state, arrays, m)
            state, m = _move(params, state, command.load, arrays, m, quantiles)

        plant = state.plant
        i_alpha, i_beta = pmsm.currents(motor, plant.psi_alpha, plant.psi_beta, plant.cos, plant.sin)
        rng, sensed = _sense(params, state, i_alpha, i_beta, quantiles)
        before = state.firmware
        reset = state.k == 0 or (j == 0 and command.reset)
        if reset:
            before = _with_bank(before)
        source = params.source if state.k >= params.source_from else params.source_before
        firmware, result = tick_firmware.step(
            params.firmware, before, command.drive, source, sensed, arrays.edge_tick, arrays.edge_hall, first, m
        )

        estimate = result.estimate
        drive_state = FAULT if firmware.faults != 0 else command.drive.state
        status = drive_state | (min(firmware.source, OTHER_SOURCE) << STATUS_SOURCE_SHIFT)
        if reset:
            status |= RESET
        if estimate.correction_on == 1:
            status |= CORRECTION
        if estimate.injection_sync == 1:
            status |= SYNC
        tau_e = pmsm.torque(motor, plant.psi_alpha, plant.psi_beta, i_alpha, i_beta)
        tau_load = mechanics.load_torque(params.plant.shaft, command.load, plant.omega_m, tau_e, state.alpha_m)
        row = arrays.samples[j]
        row["hall"] = sensed.hall
        row["status"] = status
        row["theta_enc"] = angle(encoder.angle(params.firmware.encoder, sensed.counter))
        row["omega_enc"] = clipped(result.omega_enc * PER_RAD_PER_S)
        row["i_a"] = clipped(sensed.i_a * PER_UNIT)
        row["i_b"] = clipped(sensed.i_b * PER_UNIT)
        row["i_c"] = clipped(sensed.i_c * PER_UNIT)
        row["u_alpha"] = clipped(before.now.u_alpha * PER_UNIT)
        row["u_beta"] = clipped(before.now.u_beta * PER_UNIT)
        row["u_dc"] = np.uint16(sensed.u_dc * PER_UNIT)
        row["i_d"] = clipped(result.i_d * PER_UNIT)
        row["i_q"] = clipped(result.i_q * PER_UNIT)
        row["i_d_ref"] = clipped(before.i_d_ref * PER_UNIT)
        row["i_q_ref"] = clipped(before.i_q_ref * PER_UNIT)
        row["omega_ref"] = clipped(result.omega_ref * PER_RAD_PER_S)
        row["theta_avg"] = angle(estimate.theta[0])
        row["omega_avg"] = clipped(estimate.omega[0] * PER_RAD_PER_S)
        row["theta_vt"] = angle(estimate.theta[1])
        row["omega_vt"] = clipped(estimate.omega[1] * PER_RAD_PER_S)
        row["theta_la"] = angle(estimate.theta[2])
        row["omega_la"] = clipped(estimate.omega[2] * PER_RAD_PER_S)
        row["theta_zero"] = angle(estimate.theta[3])
        row["omega_zero"] = clipped(estimate.omega[3] * PER_RAD_PER_S)
        row["theta_lut"] = angle(estimate.theta[4])
        row["omega_lut"] = clipped(estimate.omega[4] * PER_RAD_PER_S)
        row["theta_hv"] = angle(estimate.theta[5])
        row["omega_hv"] = clipped(estimate.omega[5] * PER_RAD_PER_S)
        row["theta_hvd"] = angle(estimate.theta[6])
        row["omega_hvd"] = clipped(estimate.omega[6] * PER_RAD_PER_S)
        row["theta_plf"] = angle(estimate.theta[7])
        row["omega_plf"] = clipped(estimate.omega[7] * PER_RAD_PER_S)
        row["theta_q15"] = angle(estimate.theta[8])
        row["omega_q15"] = clipped(estimate.omega[8] * PER_RAD_PER_S)
        row["theta_le"] = angle(estimate.theta[9])
        row["omega_le"] = clipped(estimate.omega[9] * PER_RAD_PER_S)
        row["sensors_le"] = estimate.sensors
        row["delta_hat"] = angle(estimate.delta_hat)
        row["e_alpha"] = clipped(estimate.e_alpha * PER_UNIT)
        row["e_beta"] = clipped(estimate.e_beta * PER_UNIT)
        row["theta_true"] = angle(plant.theta_e)
        row["omega_true"] = clipped(n_p * plant.omega_m * PER_RAD_PER_S)
        row["tau_e_true"] = clipped(tau_e * PER_NM)
        row["tau_load_true"] = clipped(tau_load * PER_NM)

        load_row = arrays.load_samples[j]
        load_row["omega_m"] = plant.omega_m
        load_row["tau_load"] = tau_load
        load_row["status"] = command.load_state

        if j < arrays.log.shape[0]:
            log = arrays.log[j]
            log[0] = estimate.theta[0]
            log[1] = estimate.omega[0]
            log[2] = estimate.theta[1]
            log[3] = estimate.omega[1]
            log[4] = estimate.delta_hat
            log[5] = estimate.e_alpha
            log[6] = estimate.e_beta
            log[7] = plant.theta_e
            log[8] = n_p * plant.omega_m
            log[9] = i_alpha
            log[10] = i_beta

        state = State(
            state.k + 1,
            state.tick + params.period_ticks,
            rng,
            plant,
            state.alpha_m,
            state.hall,
            state.wiring,
            firmware,
        )
    return state, m

"""The simulated bench in one compiled loop: plant, sensors, firmware and record, a PWM period at a time.

In the period that ends at the sample k
1. the plant moves from k-1 to k with the duties computed at k-2, and Hall edges are captured in timer ticks;
2. the sensors are sampled;
3. the observers' front end is stepped, with the edges captured since k-1, and the observer that the control uses: no
   other has a say in what happens next, so the others run over the samples after the loop;
4. the firmware steps its control (`tick_firmware`);
5. the sample is recorded, with references and voltages that were in force over the period that ends at it.

An edge's tick is that of the first timer clock after it, so it lies in (tick_{k-1}, tick_k].

The loop draws no random numbers but those of the seed in its state, and it does the same in one call as in many.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from protocol.signals import OTHER_SOURCE, STATUS_SOURCE_SHIFT, AngleSource, Eight, Status
from sim.drive import tick_firmware
from sim.drive import tick_protection as protection
from sim.drive.tick_record import edge_codes, quantised_three, quantised_u16
from sim.hints import ahead, seldom
from sim.native import Native, Pointer, invoke, native, specialised
from sim.numba_cache import kernel
from sim.observers import hall_speed, sample
from sim.observers.hall_speed import Edge
from sim.observers.sample import Measured, Sample
from sim.plant import (
    coupling,
    current_sensor,
    dc_link,
    encoder,
    hall_input,
    hall_sensor,
    hall_wiring,
    integrator,
    inverter,
    mechanics,
    motor_wires,
    noise,
    pmsm,
    skin_effect,
)

ENCODER, AVERAGE_SPEED = int(AngleSource.ENCODER), int(AngleSource.AVERAGE_SPEED)
RESET = int(Status.OBSERVERS_RESET)
FAULT = tick_firmware.FAULT
NEVER = hall_wiring.NEVER
REFRESH = 256  # samples after which the rotor's cosine and sine are computed anew
NOT_BOOTED = -1
AHEAD = 8  # records that are fetched before they are written


class Params(NamedTuple):
    """Constants of the bench."""

    plant: integrator.Params
    skin: skin_effect.Params
    motor_wires: motor_wires.Params
    link: dc_link.Params
    link_gain: float  # of the measurement of the link's voltage
    coupling: coupling.Params
    hall: hall_sensor.Params
    input: hall_input.Params
    wiring: hall_wiring.Params
    rock: mechanics.Rock
    hall_map: Eight  # Hall code that the firmware takes its inputs for
    current_sensor: current_sensor.Params
    front: sample.Params
    encoder: encoder.Params
    has_encoder: int  # 1: there is one
    index_search: int  # 1: it begins at zero, wherever the rotor is
    firmware: tick_firmware.Params
    period_ticks: int
    substeps: int
    h: float  # integration step, s


class Electric(NamedTuple):
    """What follows from the plant's state at a sample."""

    i_alpha: float  # A
    i_beta: float
    tau: float  # N m


class World(NamedTuple):
    """What the firmware sees by sensors only: motor, shaft, DC link, Hall sensors and their wires."""

    rng: np.uint64
    plant: integrator.State
    skin: skin_effect.State
    short: float  # A, between two of the motor's terminals
    electric: Electric
    link: dc_link.State
    beyond: coupling.State  # the load's side of the shaft
    alpha_m: float  # acceleration that the load machine forces, rad/s2
    hall: hall_sensor.State
    due: int  # tick of the next thing that happens to an input, but for the sensors' edges and the wires' pulses
    wiring: hall_wiring.State


class State(NamedTuple):
    """Everything that changes, but what observers remember. To boot: `NOT_BOOTED`, tick, rng and the plant's angle."""

    k: int  # samples taken
    tick: int  # of the next sample
    world: World
    front: sample.State
    encoder: encoder.State
    counter: encoder.Index
    disc: encoder.Disc
    firmware: tick_firmware.State


class Sensed(NamedTuple):
    """What the sensors say at a sample, currents as telemetry carries them."""

    absolute: int  # encoder's count
    i_a: float
    i_b: float
    i_c: float


class Moved(NamedTuple):
    """What a period records of the plant, by the channels' names where there is one; SI units, angles not wrapped."""

    theta_true: float
    omega_true: float
    tau_e_true: float
    tau_load_true: float
    omega_m: float
    i_alpha_true: float
    i_beta_true: float
    u_dc: float


class Sampled(NamedTuple):
    """The same of sensors and front end, and of what was in force until the sample."""

    hall: int
    theta_enc: float
    omega_enc: float
    i_a: float
    i_b: float
    i_c: float
    u_alpha: float
    u_beta: float
    i_d_ref: float
    i_q_ref: float
    theta_avg: float
    omega_avg: float


class Steered(NamedTuple):
    """The same of the firmware."""

    status: int
    i_d: float
    i_q: float
    omega_ref: float
    dead_time_left: float
    dead_time_near: float
    theta_ctrl: float


RECORDS = Moved, Sampled, Steered
"""Each written as soon as all of it is known: whatever waits takes a register from what is computed meanwhile."""


class WireEdge(NamedTuple):
    """An edge as `protocol.streams.EDGE_RECORD` lays it out."""

    tick: np.uint32
    codes: np.uint8
    flags: np.uint8
    encoder: np.uint16


class Command(NamedTuple):
    """What the host asked for last."""

    drive: tick_firmware.Command
    load: mechanics.Load
    source: int  # AngleSource of the control


class EdgeLog(NamedTuple):
    """Where captured edges go, those of a call one after the other."""

    edges: Pointer[Edge]
    wire: Pointer[WireEdge]
    room: int  # most of them


@kernel
def _booted(params: Params, state: State, quantiles: Pointer[float]) -> State:
    """The state at boot, with the rotor at rest."""
    rng = noise.advance(state.world.rng)
    theta_e = state.world.plant.theta_e
    hall = hall_sensor.init(params.hall, theta_e, quantiles, rng)
    wiring = hall_wiring.init(params.wiring, hall_sensor.code(hall.number))
    plant = integrator.init(params.plant, theta_e)
    link = dc_link.init(params.link)
    electric = Electric(0.0, 0.0, 0.0)
    world = World(rng, plant, skin_effect.init(), 0.0, electric, link, coupling.init(), 0.0, hall, NEVER, wiring)
    count = encoder.count(params.encoder, theta_e, 0.0)
    index = encoder.booted(params.encoder, count, params.index_search)
    tracker = encoder.init(encoder.counted(params.encoder, index, count))
    return State(0, state.tick, world, sample.init(), tracker, index, encoder.Disc(0.0, 0.0), tick_firmware.init())


@kernel
def _pins(params: Params, hall: hall_sensor.State, inputs: Pointer[hall_input.State], wiring: hall_wiring.State) -> int:
    """The code that the firmware's inputs read."""
    if params.input.on == 0:
        return hall_wiring.pins(params.wiring, hall_sensor.code(hall.number), 0, wiring.pulse)
    seen = inputs[0]
    return hall_wiring.pins(params.wiring, seen.code, seen.open, wiring.pulse ^ seen.pulse)


@kernel
def _captured(
    params: Params,
    wiring: hall_wiring.State,
    index: encoder.Index,
    new: int,
    tick: int,
    theta: float,
    omega: float,
    log: EdgeLog,
    m: int,
) -> tuple[hall_wiring.State, int]:
    """Capture an edge at `tick`, at this angle and speed, if the inputs read `new` and not what they did before."""
    if new == wiring.pins:
        return wiring, m
    old = params.hall_map[wiring.pins]
    code = params.hall_map[new]
    log.edges[m] = Edge(tick, code)
    count = 0
    if params.has_encoder == 1:
        count = encoder.counted(params.encoder, index, encoder.count(params.encoder, theta, omega))
        count = encoder.shown(params.encoder, index, count)
    log.wire[m] = WireEdge(
        np.uint32(tick & 0xFFFFFFFF), np.uint8(edge_codes(old, code)), np.uint8(0), np.uint16(count & 0xFFFF)
    )
    return wiring._replace(pins=new), m + 1


@kernel
def _edges(
    params: Params,
    world: World,
    index: encoder.Index,
    before: integrator.State,
    after: integrator.State,
    tick: int,
    offset: float,
    log: EdgeLog,
    m: int,
    inputs: Pointer[hall_input.State],
    quantiles: Pointer[float],
) -> tuple[World, int]:
    """Capture the edges between two plant states, those of the sensors and those that come otherwise, in order.

    `tick`: of the sample at the period's end; `offset`: ticks from there back to `before`; `m`: edges so far, of
    at most `room`.
    """
    rng, hall, happens, wiring = world.rng, world.hall, world.due, world.wiring
    omega_0 = params.plant.motor.n_p * before.omega_m
    omega_1 = params.plant.motor.n_p * after.omega_m
    theta_0 = hall_sensor.seen(params.hall, before.theta_e, omega_0)
    theta_1 = hall_sensor.seen(params.hall, after.theta_e, omega_1)
    step_ticks = params.period_ticks / params.substeps
    while m < log.room:
        way = 0
        theta = theta_1
        late = math.floor(step_ticks - offset)
        if theta_1 >= hall.above:
            way = 1
            theta = hall.above
        elif theta_1 < hall.below:
            way = -1
            theta = hall.below
        x = 1.0
        if way != 0:
            x = hall_sensor.time_of(theta_0, omega_0, theta_1, omega_1, params.h, theta)
            late = math.floor(x * step_ticks - offset) + 1
        captured = tick + min(late, 0)
        due = min(wiring.due, happens)
        if due <= captured:  # a false pulse begins or ends before, or something else happens to an input
            x = (due - tick + offset) / step_ticks
            theta = before.theta_e + x * (after.theta_e - before.theta_e)
            if due == wiring.due:
                rng = noise.advance(rng)
                wiring = hall_wiring.toggled(params.wiring, wiring, rng)
            else:
                inputs[0] = hall_input.happened(params.input, inputs[0])
                happens = hall_input.next_due(inputs[0])
            pins = _pins(params, hall, inputs, wiring)
            omega = omega_0 + x * (omega_1 - omega_0)
            wiring, m = _captured(params, wiring, index, pins, due, theta, omega, log, m)
        elif way != 0:
            rng = noise.advance(rng)
            hall = hall_sensor.enter(params.hall, hall.number + way, theta, quantiles, rng)
            omega = omega_0 + x * (omega_1 - omega_0)
            theta += params.hall.latency * omega
            if params.input.on == 1:
                code = hall_sensor.code(hall.number)
                inputs[0] = hall_input.sensed(params.input, inputs[0], code, captured)
                happens = hall_input.next_due(inputs[0])
            pins = _pins(params, hall, inputs, wiring)
            wiring, m = _captured(params, wiring, index, pins, captured, theta, omega, log, m)
        else:
            break
    return world._replace(rng=rng, hall=hall, due=happens, wiring=wiring), m


@kernel
def _move(
    params: Params,
    state: State,
    world: World,
    out: tick_firmware.Output,
    load: mechanics.Load,
    log: EdgeLog,
    m: int,
    inputs: Pointer[hall_input.State],
    quantiles: Pointer[float],
) -> tuple[World, int]:
    """The world after one period, with its edges; the sensors' random numbers are drawn at its end."""
    plant, first, link, beyond = world.plant, world.electric, world.link, world.beyond
    skin, short, in_short = world.skin, world.short, 0.0
    constants = params.plant
    if params.link.R_source > 0.0:
        constants = integrator.fed(constants, link.u)
    if out.on == 1:
        d_a, d_b, d_c = motor_wires.to_phases(params.motor_wires.swap, (out.d_a, out.d_b, out.d_c))
        applied = integrator.apply(constants, plant, first.i_alpha, first.i_beta, d_a, d_b, d_c)
    else:
        applied = inverter.off()
    by_duties = applied
    if seldom(params.motor_wires.short != 0):
        short, applied = motor_wires.shorted(
            params.motor_wires, constants.inverter, by_duties, first.i_alpha, first.i_beta, world.short
        )
        in_short = motor_wires.taken(params.motor_wires, constants.inverter, by_duties, 0.5 * (world.short + short))
    alpha = 0.0
    begin = state.tick - params.period_ticks
    if params.wiring.gap > 0.0 or world.wiring.due != NEVER:
        rng = noise.advance(world.rng)
        world = world._replace(rng=rng, wiring=hall_wiring.next_pulse(params.wiring, world.wiring, begin, rng))
    if params.input.on == 1:
        size = math.sqrt(first.i_alpha * first.i_alpha + first.i_beta * first.i_beta)
        duties = (out.d_a, out.d_b, out.d_c)
        inputs[0] = hall_input.begun(params.input, inputs[0], begin, params.period_ticks, size, out.on, duties)
        world = world._replace(due=hall_input.next_due(inputs[0]))
    rocks = mechanics.rocks(params.rock, load, out.on, plant.omega_m)
    if state.k % REFRESH == 0:
        plant = integrator.refresh(plant)
    step_ticks = params.period_ticks / params.substeps
    for j in range(params.substeps):
        before = plant
        if rocks:
            load = mechanics.rocked(params.rock, params.h * ((state.k - 1) * params.substeps + j + 1))
            beyond = beyond._replace(omega=load.omega_m, tau=0.0)
        coupled = params.coupling.stiffness > 0.0 and not rocks
        acts = load
        if coupled:
            beyond, acts = coupling.middle(params.coupling, before, beyond, params.h)
        if seldom(params.skin.R > 0.0):
            skin, plant, alpha = skin_effect.step(params.skin, skin, constants, before, applied, acts, params.h)
        else:
            plant, alpha = integrator.step(constants, before, applied, acts, params.h)
        if coupled:
            beyond = coupling.end(params.coupling, beyond, plant, load, params.h)
            alpha = 0.0
        theta = hall_sensor.seen(params.hall, plant.theta_e, params.plant.motor.n_p * plant.omega_m)
        due = min(world.wiring.due, world.due)
        if theta >= world.hall.above or theta < world.hall.below or due <= state.tick:
            offset = (params.substeps - j) * step_ticks
            world, m = _edges(
                params, world, state.counter, before, plant, state.tick, offset, log, m, inputs, quantiles
            )
    last = _electric(constants.motor, plant)
    if params.link.R_source > 0.0:
        i_alpha = 0.5 * (first.i_alpha + last.i_alpha)
        i_beta = 0.5 * (first.i_beta + last.i_beta)
        taken = inverter.taken(constants.inverter, by_duties, i_alpha, i_beta) + in_short
        link = dc_link.step(params.link, link, taken)
    world = world._replace(plant=plant, skin=skin, short=short, electric=last, link=link, beyond=beyond, alpha_m=alpha)
    return world._replace(rng=noise.advance(world.rng)), m


@kernel
def _electric(motor: pmsm.Params, plant: integrator.State) -> Electric:
    """What follows from the plant's state."""
    i_alpha, i_beta, tau = pmsm.currents_and_torque(motor, plant.psi_alpha, plant.psi_beta, plant.cos, plant.sin)
    return Electric(i_alpha, i_beta, tau)


@kernel
def _sense(params: Params, world: World, on: int, quantiles: Pointer[float]) -> Sensed:
    """Sample the sensors. A converter that is late sees how the current falls while all legs are low."""
    plant, electric, rng = world.plant, world.electric, world.rng
    sensor = params.current_sensor
    i_alpha = electric.i_alpha
    i_beta = electric.i_beta
    if on == 1 and sensor.delay > 0.0:
        motor = params.plant.motor
        emf = motor.n_p * plant.omega_m * motor.psi_f
        u_alpha = motor.R_s * i_alpha
        u_beta = motor.R_s * i_beta
        if seldom(params.skin.R > 0.0):
            u_alpha -= params.skin.R * world.skin.i_alpha
            u_beta -= params.skin.R * world.skin.i_beta
        i_alpha -= sensor.delay * motor.g_mean * (u_alpha - emf * plant.sin)
        i_beta -= sensor.delay * motor.g_mean * (u_beta + emf * plant.cos)
    normal = noise.first(quantiles, rng), noise.second(quantiles, rng), noise.third(quantiles, rng)
    currents = pmsm.phases(i_alpha, i_beta)
    if seldom(params.motor_wires.short != 0):
        currents = motor_wires.with_short(params.motor_wires, currents, world.short)
    measured = current_sensor.measure(sensor, motor_wires.to_legs(params.motor_wires.swap, currents), normal)
    i_a, i_b, i_c = quantised_three(measured, params.firmware.ampere, params.firmware.per_ampere)
    count = encoder.count(params.encoder, plant.theta_e, params.plant.motor.n_p * plant.omega_m)
    return Sensed(count, i_a, i_b, i_c)


@kernel
def _implausible(after: hall_speed.State, before: hall_speed.State, code: int) -> int:
    """Implausible edges between two samples, by the front end's counts of illegal codes and skipped sectors."""
    sampled = 1 if code == 0 or code == 7 else 0
    return after.illegal - before.illegal - sampled + after.skipped - before.skipped


@kernel
def given(params: Params) -> Params:
    """The constants as they are."""
    return params


@kernel
def usual(params: Params) -> Params:
    """The constants without what most benches do not have: compiled code then has nothing of it."""
    plant = params.plant
    legs = plant.inverter.legs._replace(dead=0.0)
    firmware = params.firmware
    return params._replace(
        plant=plant._replace(
            motor=plant.motor._replace(g_diff=0.0, cross=0.0, uneven=0),
            inverter=plant.inverter._replace(legs=legs),
            shaft=plant.shaft._replace(varies=0),
            open=0,
            tied=0,
        ),
        skin=params.skin._replace(R=0.0),
        motor_wires=params.motor_wires._replace(swap=0, short=0),
        link=params.link._replace(R_source=0.0),
        link_gain=1.0,
        coupling=params.coupling._replace(stiffness=0.0),
        hall=params.hall._replace(spread=0.0, latency=0.0, pole_pair_off=0.0, eccentric=0.0),
        input=params.input._replace(on=0),
        wiring=params.wiring._replace(swap=0, gap=0.0),
        rock=params.rock._replace(speed=0.0),
        current_sensor=params.current_sensor._replace(delay=0.0),
        encoder=params.encoder._replace(eccentric=0.0, within=0.0, latency=0.0, lost=0.0, grip=0.0),
        firmware=firmware._replace(
            dead_time=firmware.dead_time._replace(learn=0), commission=firmware.commission._replace(on=0)
        ),
        substeps=1,
    )


@kernel
def _advance(
    params_: Pointer[Params],
    state_: Pointer[State],
    inputs: Pointer[hall_input.State],
    command_: Pointer[Command],
    quantiles: Pointer[float],
    waveform: Pointer[float],
    n: int,
    reset: Pointer[np.uint8],
    moved: Pointer[Moved],
    sampled: Pointer[Sampled],
    steered: Pointer[Steered],
    samples: Pointer[Sample],
    edges: Pointer[Edge],
    wire: Pointer[WireEdge],
    room: int,
    count: Pointer[int],
    observer: int,
    observer_params: int,
    observer_state: int,
    found: Pointer[float],
    found_size: int,
) -> None:
    """Run `n` periods into records and `samples`; `reset`: before which samples the observers are initialised.

    Edges go to `edges` and `wire` from count[0] on, which is set to how many there are; at most `room`. `observer`: the
    address of the function of the observer that the control uses, 0: none; `found`: its estimates, of `found_size`
    bytes each.

    The first period of all only takes a sample: nothing has moved yet.
    """
    constants = known(params_[0])
    params = constants
    state = state_[0]
    command = command_[0]
    motor = params.plant.motor
    if state.k == NOT_BOOTED:
        state = _booted(params, state, quantiles)
    firmware = state.firmware
    if command.drive.state != tick_firmware.RUNNING or firmware.faults != 0:
        firmware = tick_firmware.silenced(firmware)
    u_dc = quantised_u16(params.link_gain * params.plant.inverter.u_dc)
    m = count[0]
    log = EdgeLog(edges, wire, room)
    for j in range(n):
        first = m
        k = state.k
        ahead(moved, j + AHEAD)
        ahead(sampled, j + AHEAD)
        ahead(steered, j + AHEAD)
        ahead(samples, j + AHEAD)
        world = state.world
        params = constants._replace(encoder=encoder.slipped(constants.encoder, state.disc, motor.n_p))
        disc = state.disc
        if k > 0:
            if j == 0 or k == 1:  # a code that changes with the wires is an edge as the period begins
                plant, wiring = world.plant, world.wiring
                code = hall_sensor.code(world.hall.number)
                inputs[0] = hall_input.switched(params.input, inputs[0], code, world.rng)
                if params.input.on == 0:
                    world = world._replace(due=NEVER)
                pins = _pins(params, world.hall, inputs, wiring)
                begin = state.tick - params.period_ticks + 1
                omega = motor.n_p * plant.omega_m
                wiring, m = _captured(params, wiring, state.counter, pins, begin, plant.theta_e, omega, log, m)
                world = world._replace(wiring=wiring)
            world, m = _move(params, state, world, firmware.driving.now, command.load, log, m, inputs, quantiles)
            disc = encoder.dragged(params.encoder, disc, state.world.plant.omega_m, world.plant.omega_m)
            params = constants._replace(encoder=encoder.slipped(constants.encoder, disc, motor.n_p))
            if params.link.R_source > 0.0:
                u_dc = quantised_u16(params.link_gain * world.link.u)
        else:
            world = world._replace(rng=noise.advance(world.rng))

        plant, electric, code = world.plant, world.electric, params.hall_map[world.wiring.pins]
        tau = world.beyond.tau
        if params.coupling.stiffness == 0.0:
            shaft = integrator.losing_shaft(params.plant.shaft, plant)
            tau = mechanics.load_torque(shaft, command.load, plant.omega_m, electric.tau, world.alpha_m)
        omega_e = motor.n_p * plant.omega_m
        moved[j] = Moved(
            plant.theta_e, omega_e, electric.tau, tau, plant.omega_m, electric.i_alpha, electric.i_beta, u_dc
        )
        sensed = _sense(params, world, firmware.driving.now.on, quantiles)
        driving = firmware.driving
        front = state.front
        if reset[j] != 0:
            front = sample.init()
        hall_before = front.hall
        measured = Measured(
            state.tick,
            code,
            driving.now.u_alpha,
            driving.now.u_beta,
            sensed.i_a,
            sensed.i_b,
            sensed.i_c,
            driving.i_q_ref - driving.i_q - driving.i_q_back,
        )
        front, seen = sample.step(params.front, front, measured, edges, first, m)
        samples[j] = seen
        index = encoder.sought(params.encoder, state.counter, sensed.absolute, world.rng)
        counter = encoder.counted(params.encoder, index, sensed.absolute)
        tracker, omega_enc = encoder.track(params.encoder, state.encoder, counter)
        theta_enc = encoder.angle(params.encoder, encoder.shown(params.encoder, index, counter))
        sampled[j] = Sampled(
            code,
            theta_enc,
            omega_enc,
            sensed.i_a,
            sensed.i_b,
            sensed.i_c,
            driving.now.u_alpha,
            driving.now.u_beta,
            driving.i_d_ref,
            driving.i_q_ref,
            seen.theta_avg,
            seen.hall.omega,
        )
        angle = tick_firmware.Angle(command.source, theta_enc, omega_enc)
        if observer != 0:
            ahead(found, (j + AHEAD) * (found_size // 8))
            invoke(observer, observer_params, observer_state, samples, reset, found, found_size, j)
            at = j * (found_size // 8)
            angle = tick_firmware.Angle(command.source, found[at], found[at + 1])
        elif command.source == AVERAGE_SPEED:
            angle = tick_firmware.Angle(command.source, seen.theta_avg, seen.hall.omega)
        seen_by_protection = protection.Sensed(
            max(abs(sensed.i_a), abs(sensed.i_b), abs(sensed.i_c)),
            omega_enc if params.has_encoder == 1 else seen.hall.omega,
            u_dc,
            code,
            _implausible(front.hall, hall_before, code),
            seen.hall.sector,
            seen.u_alpha,
            seen.u_beta,
            seen.i_alpha,
            seen.i_beta,
        )
        firmware, result = tick_firmware.step(
            params.firmware, firmware, command.drive, seen_by_protection, seen, angle, waveform
        )

        drive_state = FAULT if firmware.faults != 0 else command.drive.state
        status = drive_state | (min(command.source, OTHER_SOURCE) << STATUS_SOURCE_SHIFT) | result.status
        if reset[j] != 0:
            status |= RESET
        left = firmware.dead_time.left
        steered[j] = Steered(status, result.i_d, result.i_q, result.omega_ref, left.full, left.near, result.theta)
        tick = state.tick + params.period_ticks
        state = State(k + 1, tick, world, front, tracker, index, disc, firmware)
    state_[0] = state
    count[0] = m


def _loop(name: str, known: Callable[[Params], Params]) -> Native:
    return native(specialised(_advance, name, _advance.__annotations__, known=known))


known = given  # what `_advance` calls by this name: in each loop its own
advance = _loop("advance", given)
advance_usual = _loop("advance_usual", usual)


def loop(params: Params) -> Native:
    """`_advance` for a bench with these constants: `advance_usual` where they are `usual`."""
    return advance_usual if usual(params) == params else advance

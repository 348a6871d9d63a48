"""The drive's firmware: what it does at each sample, from measured values to duties.

Voltages and duties that are computed from the sample at k are in force from k + 1 to k + 2. The control uses the angle
of one source, and changes over to another without a bump.

What commissioning needs, an angle that is made and a voltage that is given, is in `tick_commission`.

It sees sensors only: rounded currents, Hall codes and edges, encoder counts, the DC link voltage. Never the
plant. It runs no observer (`tick` does): it is told angle and speed by the source.

The average speed comes as omega_h of (1), which steps at every edge. To the current loop it goes through the low-pass
that the other estimates have on their speed (Fig. 4), because there its ripple is multiplied by the flux. The speed
loop takes it as it is: (1) is a mean over a sector already, and a filter's lag on top of that makes the shaft swing at
50 r/min, where an edge comes every 33 ms.
"""

from __future__ import annotations

from typing import NamedTuple

from protocol.messages import DriveState, SetpointMode
from protocol.signals import MILLI, AngleSource, Status
from sim.circle import cos_sin
from sim.control import current_loop, dead_time, modulation, speed_loop
from sim.control.transforms import inverse_clarke, inverse_park, park
from sim.drive import tick_commission as commission
from sim.drive import tick_protection as protection
from sim.drive.tick_record import PER_UNIT, quantised
from sim.native import Pointer
from sim.numba_cache import kernel
from sim.observers.sample import Sample
from sim.plant.integrator import turn

ARMED, RUNNING, FAULT = int(DriveState.ARMED), int(DriveState.RUNNING), int(DriveState.FAULT)
MODE_SPEED, MODE_VOLTAGE = int(SetpointMode.SPEED), int(SetpointMode.VOLTAGE)
ENCODER, AVERAGE_SPEED = int(AngleSource.ENCODER), int(AngleSource.AVERAGE_SPEED)
FORCED = -1  # the source of an angle that is made
CYCLE = int(Status.INJECTION_SYNC)


Two = tuple[float, float]


class Params(NamedTuple):
    """The firmware's constants and parameters."""

    current: current_loop.Params
    speed: speed_loop.Params
    dead_time: dead_time.Params
    protection: protection.Params
    commission: commission.Params
    T_s: float
    n_p: float
    ampere: float  # A a count of telemetry
    per_ampere: float
    a_omega: float  # gain of the filter on omega_h


class Command(NamedTuple):
    """What the host asked for last."""

    state: int  # DriveState
    mode: int  # SetpointMode, 0: none yet
    omega_m: float  # SPEED: mechanical rad/s
    i_d: float  # CURRENT, and beside a speed, A
    i_q: float
    u_d: float  # VOLTAGE, V
    u_q: float


class Output(NamedTuple):
    """What the inverter is told for one period."""

    on: int  # 1: the outputs are on
    u_alpha: float  # reference voltage, V, as telemetry carries it
    u_beta: float
    d_a: float  # duties with the dead time's compensation
    d_b: float
    d_c: float


class Driving(NamedTuple):
    """What the control does to the motor."""

    mode: int  # SetpointMode at the last sample, 0: none
    i_d_ref: float  # in force since the last sample, A
    i_q_ref: float
    i_q: float  # at the last sample, A, in the frame that the control uses, as telemetry carries it
    i_q_back: float  # what the current loop's integral has not taken in of the difference of the two, A
    now: Output  # in force since the last sample
    next: Output  # in force from the coming sample on


class Angle(NamedTuple):
    """What the control works with at a sample, and where it is from."""

    source: int  # AngleSource, or FORCED
    theta: float  # electrical rad
    omega: float  # rad/s


class State(NamedTuple):
    """What the firmware remembers."""

    angle: Angle
    omega_h: float  # electrical rad/s, low-pass filtered
    current: current_loop.State
    speed: speed_loop.State
    dead_time: dead_time.State
    driving: Driving
    protection: protection.State
    commission: commission.State
    faults: int  # latched Fault bits


class Result(NamedTuple):
    """One period's results, for the record."""

    i_d: float
    i_q: float
    omega_ref: float
    theta: float  # electrical rad, that the control used
    status: int  # bits beside state and source


@kernel
def output_off() -> Output:
    """Outputs off."""
    return Output(0, 0.0, 0.0, 0.5, 0.5, 0.5)


@kernel
def at_rest() -> Driving:
    """Nothing is done."""
    return Driving(0, 0.0, 0.0, 0.0, 0.0, output_off(), output_off())


@kernel
def init() -> State:
    """The state at boot."""
    nothing = current_loop.init(), speed_loop.init(0.0, 0.0), dead_time.init()
    return State(Angle(ENCODER, 0.0, 0.0), 0.0, *nothing, at_rest(), protection.init(), commission.init(), 0)


@kernel
def silenced(state: State) -> State:
    """The state with the outputs off at once."""
    return state._replace(driving=at_rest())


@kernel
def _change_over(
    params: Params, current: current_loop.State, speed: speed_loop.State, old: Angle, new: Angle
) -> tuple[current_loop.State, speed_loop.State]:
    """The loops' states for another angle source: the voltage in the stator frame and the torque stay.

    `old` is of a period ago, and is now where it was, a period further.
    """
    expected = old.theta + params.T_s * old.omega
    c, s = cos_sin(expected - new.theta)
    u_d, u_q = inverse_park(current.u_d_i, current.u_q_i, c, s)
    i_q_i = speed.i_q_i + params.speed.k_p * (new.omega - old.omega) / params.n_p
    return current_loop.State(u_d, u_q), speed._replace(i_q_i=i_q_i)


@kernel
def _modulate(params: Params, left: dead_time.Left, u_dc: float, u: Two, i: Two, cos: float, sin: float) -> Output:
    """Rotor-frame voltage (V) and currents (A), turned by the angle of the period in force, to duties."""
    u_alpha, u_beta = inverse_park(u[0], u[1], cos, sin)
    u_alpha = quantised(u_alpha, MILLI, PER_UNIT)
    u_beta = quantised(u_beta, MILLI, PER_UNIT)
    ideal = modulation.duties(u_alpha, u_beta, u_dc)
    i_alpha, i_beta = inverse_park(i[0], i[1], cos, sin)
    d_a, d_b, d_c = dead_time.compensate(
        params.dead_time, left, (u_alpha, u_beta), ideal, inverse_clarke(i_alpha, i_beta)
    )
    return Output(1, u_alpha, u_beta, d_a, d_b, d_c)


@kernel
def _learnt(
    params: dead_time.Params, learned: dead_time.State, u_dc: float, now: Output, seen: Sample, omega: float
) -> dead_time.State:
    """What the period that ends at this sample, with `now` in force, taught of the dead time's error."""
    if now.on == 0 or abs(omega) < dead_time.FROM * params.omega_on:
        return dead_time.begun(learned, seen.i_alpha, seen.i_beta)
    return dead_time.learnt(params, learned, u_dc, now.u_alpha, now.u_beta, seen.i_alpha, seen.i_beta, omega)


@kernel
def _voltage(
    params: Params,
    state: State,
    command: Command,
    angle: Angle,
    loop: current_loop.State,
    u: Two,
    refs: Two,
    i: Two,
    smooth: float,
    cos: float,
    sin: float,
) -> tuple[current_loop.State, Two]:
    """What becomes of the loop and its voltage `u` (d, q), in the frame of cos and sin: a given one, one that goes on.

    `refs`, `i`, `smooth`: what the loop was stepped with.
    """
    before = state.driving
    turned = params.T_s * state.angle.omega
    old = commission.going_on(state.commission, before.next.u_alpha, before.next.u_beta, turned, cos, sin)
    other_frame = (state.angle.source == FORCED) != (angle.source == FORCED)
    if command.mode == MODE_VOLTAGE:
        return current_loop.init(), commission.given(params.commission, old, command.u_d, command.u_q)
    if before.next.on == 1 and (before.mode == MODE_VOLTAGE or other_frame):
        return current_loop.at_voltage(params.current, *old, *refs, *i, smooth), old
    return loop, u


@kernel
def step(
    params: Params,
    state: State,
    command: Command,
    sensed: protection.Sensed,
    seen: Sample,
    angle: Angle,
    waveform: Pointer[float],
) -> tuple[State, Result]:
    """One control period: protection, loops, modulation. `seen`: the sample as the observers see it.

    On return `state.driving.now` is what is in force until the next sample.
    """
    before = state.driving
    special = state.commission
    if params.commission.on == 1:
        on = command.state == RUNNING and state.faults == 0
        special = commission.forced(params.commission, special, angle.theta, on)
        if special.forced == 1:
            angle = Angle(FORCED, special.theta, special.omega)
    by_hall = angle.source != ENCODER and angle.source != FORCED
    protected = protection.step(params.protection, state.protection, sensed, before.now.on == 1, by_hall)
    faults = state.faults
    if command.state == ARMED or command.state == RUNNING:
        faults |= protected.causes

    theta = angle.theta
    omega = angle.omega
    omega_h = state.omega_h + params.a_omega * (seen.hall.omega - state.omega_h)
    smooth = omega_h if angle.source == AVERAGE_SPEED else omega
    cos, sin = cos_sin(theta)
    i_d, i_q = park(seen.i_alpha, seen.i_beta, cos, sin)

    learned = state.dead_time
    if params.dead_time.learn != 0:
        learned = _learnt(params.dead_time, learned, sensed.u_dc, before.now, seen, omega)
    current = state.current
    speed = state.speed
    mode = 0
    i_d_ref = 0.0
    i_q_ref = 0.0
    i_q_back = 0.0
    omega_ref = 0.0
    output = output_off()
    tested = 0.0
    added = 0.0
    status = 0
    if params.commission.on == 1:
        on = command.state == RUNNING and faults == 0
        special, tested, cycle = commission.tested(params.commission, special, waveform, on)
        status = CYCLE * cycle
    if command.state == RUNNING and faults == 0:
        mode = command.mode
        if state.angle.source != angle.source and before.next.on == 1:
            current, speed = _change_over(params, current, speed, state.angle, angle)
        if mode == MODE_SPEED:
            if before.mode != MODE_SPEED:
                speed = speed_loop.init(omega / params.n_p, before.i_q_ref)
            limits = params.speed
            if params.commission.on == 1:
                i_d_ref = command.i_d
                limits = commission.speed_limits(params.commission, limits, i_d_ref)
                ref = speed_loop.ramped(limits, speed, command.omega_m)
                added = commission.added_speed(params.commission, tested, ref)
            speed, i_q_ref = speed_loop.step(limits, speed, command.omega_m, omega / params.n_p - added)
            omega_ref = speed.omega_m_ref * params.n_p
            if params.commission.on == 1:
                omega_ref += added * params.n_p
        else:
            i_d_ref = command.i_d
            i_q_ref = command.i_q
        if params.commission.on == 1:
            if mode == MODE_VOLTAGE:  # nothing is asked of the currents, and nothing is wrong with them
                i_d_ref, i_q_ref = i_d, i_q
            else:
                i_d_ref, i_q_ref = commission.currents(params.commission, tested, i_d_ref, i_q_ref)
        i_d_ref = quantised(i_d_ref, params.ampere, params.per_ampere)
        i_q_ref = quantised(i_q_ref, params.ampere, params.per_ampere)
        u_max = modulation.linear_limit(sensed.u_dc)
        current, u_d, u_q, i_q_back = current_loop.step(
            params.current, current, i_d_ref, i_q_ref, i_d, i_q, smooth, u_max
        )
        cos, sin = turn(cos, sin, 1.5 * params.T_s * smooth)
        if params.commission.on == 1:
            refs = i_d_ref, i_q_ref
            current, u = _voltage(
                params, state, command, angle, current, (u_d, u_q), refs, (i_d, i_q), smooth, cos, sin
            )
            special, (u_d, u_q) = commission.with_test(params.commission, special, tested, u, u_max, cos, sin)
            i_q_back = 0.0 if mode == MODE_VOLTAGE else i_q_back
        output = _modulate(params, learned.left, sensed.u_dc, (u_d, u_q), (i_d, i_q), cos, sin)
        now = before.next
    else:
        current = current_loop.init()
        speed = speed_loop.init(0.0, 0.0)
        now = output
    driving = Driving(mode, i_d_ref, i_q_ref, quantised(i_q, params.ampere, params.per_ampere), i_q_back, now, output)
    state = State(angle, omega_h, current, speed, learned, driving, protected, special, faults)
    return state, Result(i_d, i_q, omega_ref, theta, status)

"""An observer past the paper's: back-EMF and learned Hall edges, each where it is the better one.

A phase-locked loop on the back-EMF, without the Hall speed's ripple that the paper's feed-forward lets through, and
Hall edges that set the angle right, at places learned on line (`edge_learning`). The stronger the back-EMF, the faster
its loop and the less an edge's own word: weight = omega² / (omega² + OMEGA_HALF²).

- Loop: e_d, the back-EMF across the estimate at the middle of the period, is -psi_f omega sin(theta - theta_hat); so
  epsilon = -e_d / (psi_f omega) - c i_q, theta += 2 w epsilon T_s, omega += w² epsilon T_s, w = BANDWIDTH * weight.
  A wrong R_s or psi_f turns no angle, because what it adds lies along the q axis; a wrong L_s does, and c, learned
  with the edges, takes that out. `voltage_learning` learns the dead time's error, which distorts e_d at low speed.
- Edges: one counts once the next sample still shows it, so that a pulse shorter than a period is none. Sensor and
  level leave two boundaries, 180 deg apart; at speed omega's sign chooses, at low speed the nearer one. It moves the
  angle by (1 - weight)² of the difference, and omega accordingly. An edge far off is not used; after `LOST` such in a
  row the observer starts anew at one.
- Learning: where the back-EMF counts, speed is steady and two edges running went the same way.
- Low speed (weight below `LEAD`): the angle stays between the last edge and the next. omega keeps within what the
  back-EMF's size allows, give or take an error of R_s and of the dead time; an edge overdue bounds it; below
  `omega_off` the angle returns to the middle of the sector, the least that it can be wrong.
- Between the first edge and the second omega is the back-EMF's size by psi_f, as soon as it is past `omega_on`.
- A back-EMF much too small along the estimate, or outputs that are off, is not believed: edges lead.

Edges must be at least two periods apart to be used, as they are up to three times the speed of Table II's motor. Works
on the sensors' raw levels, and so with two sensors, or one. Never uses the front end's sector or speed, an encoder, or
a model of the shaft.

Source of the back-EMF and its alignment: (5) of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367, and `vector_tracking`;
of the dead time's shape: the paper's [20], see `sim.control.dead_time`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, cast

from sim.numba_cache import kernel
from sim.observers import edge_learning, voltage_learning
from sim.observers.average_speed import FASTEST, HALF_SECTOR, centre
from sim.observers.edge_learning import BY_CODES, BY_SPEED, DEG, NEARER, Edges, Twelve
from sim.observers.hall_edges import HallEdges
from sim.observers.hall_speed import SECTOR_OF_CODE, SECTOR_WIDTH
from sim.observers.sample import Sample
from sim.observers.transforms import clip, wrap
from sim.observers.voltage_learning import Voltage

BANDWIDTH = 1000.0  # rad/s, of the loop where the back-EMF is strong
OMEGA_HALF = 150.0  # rad/s, where the weight is a half: 240 r/min of Table II's motor
LEAD = 0.1  # weight under which the edges lead: 80 r/min
CREDIBLE = 0.3  # of psi_f omega, the least back-EMF along the estimate that is believed
EPSILON_MAX = 0.5  # rad
STEADY = 0.02  # largest relative difference of omega and its filtered value while edges are learned
GATE = 25.0 * DEG  # largest difference of an edge that is used where the back-EMF counts
GATE_LOW = 75.0 * DEG  # and where it does not
LOST = 4
SEEN = 2.0  # periods after which an edge is seen at the latest
R_WEIGHT = 0.7  # weight up to which R_s is learned: psi_f matters more above
BAND_R = 0.1  # of R_s, its error once learned; three times that before the second edge
BAND_V = 0.04  # V, other errors of the back-EMF's size
TAU_E_Q = 0.5e-3  # s, filters
TAU_I_Q = 1e-3
TAU_OPPOSED = 10e-3  # s, in which omega gives way to a back-EMF of the other sign
TINY = 1e-9  # V s, least psi_f
SENSOR_OF_BIT = (-1, 0, 1, -1, 2, -1, -1, -1)  # that changed; -1: none, or more than one


@dataclass(frozen=True, kw_only=True)
class Settings(HallEdges):
    """The drive's parameters that it takes; an edge of 0 is not known."""

    n_p: float
    omega_m_max: float  # mechanical rad/s
    hall_timeout: float  # s
    R_s_hat: float  # ohm
    L_s_hat: float  # H
    psi_f_hat: float  # V s
    omega_on: float  # electrical rad/s
    omega_off: float
    bw_omega_lpf: float  # Hz
    learn_edges: float = 1.0  # 0 holds everything that is learned


class Params(NamedTuple):
    """Constants: SI units, electrical angles and speeds."""

    T_s: float
    R_s: float
    L_by_T: float  # L_s / T_s
    psi_f: float
    omega_on: float
    omega_off: float
    omega_max: float
    timeout: float  # s without an edge after which the rotor counts as standing
    a_e_q: float  # gains of filters
    a_i_q: float
    a_omega: float
    learn: int
    given: Twelve  # places at the start, as the residuals of `edge_learning`; 0: not known


class State(NamedTuple):
    """What the observer remembers."""

    primed: int  # 1: the fields below hold a past sample
    i_alpha: float
    i_beta: float
    theta: float
    omega: float
    omega_lpf: float
    e_q: float  # V, filtered
    i_q: float  # A, filtered
    code: int  # levels that two samples running have shown
    pending: int  # levels that the last sample showed, where they differ; -1: they do not
    pending_age: float  # s
    passed: int  # edges in a row that went one way: 0, 1, 2 and more
    way: int  # of the last, +1 or -1
    age: float  # s since the last
    e_q_sum: float  # V, over the samples since
    middle: float  # of the stretch that the last leads into, rad
    half: float  # of its width
    off: int  # edges in a row that were too far off
    unused: int  # edges that were not used so far; one that is pending counts
    voltage: Voltage
    edges: Edges


class Estimate(NamedTuple):
    """One period's result."""

    theta: float  # electrical rad in [-pi, pi), at the sample
    omega: float  # electrical rad/s, low-pass filtered
    sensors: int  # bits 0-2: sensor a, b, c is not believed; bits 3-5: it has moved since the start
    learned: int  # places learned, 0..12
    unused: int  # edges not used so far: pulses, edges far off or of a sensor that is not believed


def make_params(pwm_hz: float, drive: Settings) -> Params:
    """Constants for control periods at `pwm_hz` Hz."""
    T_s = 1.0 / float(pwm_hz)
    return Params(
        T_s=T_s,
        R_s=float(drive.R_s_hat),
        L_by_T=float(drive.L_s_hat) / T_s,
        psi_f=max(float(drive.psi_f_hat), TINY),
        omega_on=float(drive.omega_on),
        omega_off=max(float(drive.omega_off), 1.0),
        omega_max=FASTEST * float(drive.n_p) * float(drive.omega_m_max),
        timeout=float(drive.hall_timeout),
        a_e_q=1.0 - math.exp(-T_s / TAU_E_Q),
        a_i_q=1.0 - math.exp(-T_s / TAU_I_Q),
        a_omega=1.0 - math.exp(-2.0 * math.pi * float(drive.bw_omega_lpf) * T_s),
        learn=int(drive.learn_edges),
        given=cast("Twelve", tuple(-place for place in drive.places())),
    )


@kernel
def _at(sector: int, code: int, i_alpha: float, i_beta: float, primed: int, given: Twelve) -> State:
    """The state at rest in the middle of `sector`."""
    theta = wrap(centre(sector))
    return State(
        primed,
        i_alpha,
        i_beta,
        theta,
        0.0,
        0.0,
        0.0,
        0.0,
        code,
        -1,
        0.0,
        0,
        0,
        0.0,
        0.0,
        theta,
        HALF_SECTOR,
        0,
        0,
        voltage_learning.init(),
        edge_learning.start(given),
    )


@kernel
def init() -> State:
    """Nothing known: the next sample gives the first currents and the sector."""
    return _at(0, 0, 0.0, 0.0, 0, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))


@kernel
def _between_edges(
    params: Params, state: State, theta: float, omega: float, e_q: float, i_q: float, age: float, driven: bool
) -> tuple[float, float]:
    """Angle and speed a period later where the edges lead."""
    if driven:
        band_r = BAND_R if state.passed == 2 else 3.0 * BAND_R
        band = (band_r * params.R_s * abs(i_q) + BAND_V) / params.psi_f
        omega = min(max(omega, e_q / params.psi_f - band), e_q / params.psi_f + band)
        if e_q * omega < 0.0:
            omega *= 1.0 - params.T_s / TAU_OPPOSED
    since = max(age - SEEN * params.T_s, params.T_s)
    overdue = state.passed == 2 and abs(omega) * since >= 2.0 * state.half
    if overdue:
        omega = math.copysign(2.0 * state.half / since, omega)
    x = wrap(theta - state.middle)
    if abs(omega) < params.omega_off:
        x += params.T_s * (omega - 4.0 * x / params.timeout)
    elif overdue:
        x -= x * params.T_s / since
    else:
        x += params.T_s * omega
    return state.middle + clip(x, state.half + SEEN * params.T_s * abs(omega)), omega


@kernel
def _levels(params: Params, state: State, sample: Sample) -> tuple[int, int, float, int]:
    """`code`, `pending`, `pending_age`, `unused` after a sample: a level counts once the next sample still shows it."""
    unused = state.unused + sample.edges
    if sample.code == state.pending:
        return sample.code, -1, 0.0, unused
    if sample.code == state.code:
        return state.code, -1, 0.0, unused
    age = 0.5 * params.T_s  # an edge that was not captured
    if sample.edges == 0:
        unused += 1
    elif sample.edge_to == sample.code:
        age = min(sample.edge_age, params.T_s)
    return state.code, sample.code, age, unused


@kernel
def step(params: Params, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One control period."""
    if state.primed == 0:
        sector = max(SECTOR_OF_CODE[sample.code], 0)
        state = _at(sector, sample.code, sample.i_alpha, sample.i_beta, 1, params.given)
        return state, Estimate(state.theta, 0.0, 0, state.edges.learned, 0)
    T_s = params.T_s
    theta = state.theta
    omega = state.omega
    passed = state.passed
    way = state.way
    voltage = state.voltage
    edges = state.edges
    learn = params.learn != 0

    # the back-EMF along (q) and across (d) the estimate at the middle of the period
    e = voltage_learning.back_emf(voltage, params.R_s, params.L_by_T, sample, state.i_alpha, state.i_beta)
    theta_mid = theta + 0.5 * T_s * omega
    cos = math.cos(theta_mid)
    sin = math.sin(theta_mid)
    e_d = e.e_alpha * cos + e.e_beta * sin
    e_q_now = e.e_beta * cos - e.e_alpha * sin
    e_q = state.e_q + params.a_e_q * (e_q_now - state.e_q)
    i_q = state.i_q + params.a_i_q * (e.i_beta * cos - e.i_alpha * sin - state.i_q)
    driven = sample.u_alpha != 0.0 or sample.u_beta != 0.0

    # the back-EMF's part
    age = state.age + T_s
    e_q_sum = state.e_q_sum + e_q_now
    if passed == 1:
        omega = e_q / params.psi_f
        if not driven or omega * way < params.omega_on:
            omega = 0.0
    weight = 0.0
    if driven and abs(omega) >= params.omega_off and e_q * omega > CREDIBLE * params.psi_f * omega * omega:
        weight = omega * omega / (omega * omega + OMEGA_HALF * OMEGA_HALF)
        size = params.psi_f * omega
        epsilon = clip(-e_d / size, EPSILON_MAX) - edges.c * i_q
        w = BANDWIDTH * weight
        omega += w * w * T_s * epsilon
        theta += 2.0 * w * T_s * epsilon
        if learn and passed == 2:
            s_d = e.s_alpha * cos + e.s_beta * sin
            matters = 1.0 - weight * weight * weight * weight
            voltage = voltage_learning.learn_dead_time(voltage, matters * T_s, -epsilon * size, s_d)
    if weight >= LEAD:
        theta += T_s * omega
    else:
        if age > params.timeout and passed > 0:
            omega = 0.0
            passed = 0
        theta, omega = _between_edges(params, state, theta, omega, e_q, i_q, age, driven)
    theta = wrap(theta)

    # the edges' part
    code, pending, pending_age, unused = _levels(params, state, sample)
    sensor = SENSOR_OF_BIT[state.code ^ code]
    middle = state.middle
    half = state.half
    off = state.off
    if sensor >= 0 and edge_learning.believed(edges, sensor):
        ago = state.pending_age + T_s
        then = theta - omega * ago
        if off >= LOST:
            passed = 0
        how = BY_CODES if passed == 0 else BY_SPEED if weight >= LEAD else NEARER
        boundary, now = edge_learning.met(edges, sensor, state.code, code, then, omega, how)
        if learn and passed == 2 and weight >= LEAD and abs(omega - state.omega_lpf) < STEADY * abs(omega):
            r = wrap(then + edges.c * i_q - boundary * SECTOR_WIDTH)
            edges = edge_learning.learn(edges, boundary, now, r, i_q, weight * weight)
        d = wrap(edge_learning.place(edges, boundary, now) - then)
        if passed == 0 or abs(d) < (GATE if weight >= LEAD else GATE_LOW):
            off = 0
            unused -= 1
            share = (1.0 - weight) * (1.0 - weight)
            if passed == 0:
                theta += d
                omega = 0.0
                passed = 1
            elif now != way:
                theta += share * d
                if weight < LEAD:
                    omega = now * abs(omega)
            else:
                theta += share * d
                omega += share * d / (age - ago)
                if learn and passed == 2 and weight < R_WEIGHT:
                    excess = e_q_sum * T_s / (age - ago) - params.psi_f * omega
                    voltage = voltage_learning.learn_resistance(voltage, params.R_s, excess, i_q)
                passed = 2
            theta = wrap(theta)
            way = now
            age = ago
            e_q_sum = 0.0
            edges, astray = edge_learning.judge(edges, code, boundary, now)
            if astray:
                passed = 0
            middle, half = edge_learning.ahead(edges, boundary, now)
        else:
            off += 1

    omega = clip(omega, params.omega_max)
    omega_lpf = state.omega_lpf + params.a_omega * (omega - state.omega_lpf)
    state = State(
        1,
        sample.i_alpha,
        sample.i_beta,
        theta,
        omega,
        omega_lpf,
        e_q,
        i_q,
        code,
        pending,
        pending_age,
        passed,
        way,
        age,
        e_q_sum,
        middle,
        half,
        off,
        unused,
        voltage,
        edges,
    )
    waiting = 1 if pending >= 0 else 0
    return state, Estimate(theta, omega_lpf, edges.sensors, edges.learned, unused - waiting)

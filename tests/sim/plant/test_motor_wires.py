"""Broken, exchanged and shorted wires of the motor: against solve_ivp, closed forms and the balance of energy."""

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from sim.config.params import ConfigError, load_params
from sim.plant import hall_wiring, integrator, inverter, mechanics, motor_wires, pmsm
from tests.sim.plant.test_integrator import NO_LOAD, T_S, applied, make, state_at

R, L_D, PSI, N_P = 0.158, 176e-6, 6.55e-3, 6
AXIS = {1: 0.5 * math.pi, 2: math.pi / 6.0, 3: -math.pi / 6.0}  # of the current where a, b or c has none
PHASES = np.exp(2j * np.pi / 3 * np.arange(3))


def currents(params, state):
    return complex(*pmsm.currents(params.motor, state.psi_alpha, state.psi_beta, state.cos, state.sin))


def series(phase, L_q, shaft, R_more=0.0):
    """Two phases in series: x = (current, speed, angle), by L(theta) i + psi_f cos and the co-energy."""
    mean, diff = 0.5 * (L_D + L_q), 0.5 * (L_D - L_q)

    def rates(t, x, u):
        i, omega, angle = x[0], x[1], x[2] - AXIS[phase]
        L, L_rises = mean + diff * math.cos(2.0 * angle), -2.0 * diff * math.sin(2.0 * angle)
        e = N_P * omega * (L_rises * i - PSI * math.sin(angle))
        tau = 1.5 * N_P * (0.5 * L_rises * i * i - PSI * math.sin(angle) * i)
        u_e = (u * np.exp(-1j * AXIS[phase])).real
        lost = shaft["b"] * omega + shaft["tau_coulomb"] * np.sign(omega)
        return [(u_e - (R + R_more) * i - e) / L, (tau - lost) / shaft["J"], N_P * omega]

    return rates


@pytest.mark.parametrize("phase", [1, 2, 3])
@pytest.mark.parametrize("L_q", [176e-6, 300e-6])
def test_a_motor_with_one_broken_wire_agrees_with_solve_ivp(phase, L_q):
    params, reference = make(L_q)
    params, rates = params._replace(open=phase), series(phase, L_q, reference.shaft)
    state, x = state_at(params, 0.7, 60.0), np.array([0.0, 60.0, 0.7])
    for k in range(240):
        u = (0.4 + 1j * (3.0 if k < 120 else 1.0)) * np.exp(1j * (x[2] + 0.01))
        state, _ = integrator.step(params, state, applied(u.real, u.imag), NO_LOAD, T_S)
        x = solve_ivp(rates, (0.0, T_S), x, "DOP853", args=(u,), rtol=1e-10, atol=1e-12).y[:, -1]
        i = currents(params, state)
        assert abs((i * np.conj(PHASES[phase - 1])).real) < 1e-12  # of the broken wire
        assert abs(i - x[0] * np.exp(1j * AXIS[phase])) < 1e-5
    assert state.omega_m == pytest.approx(x[1], abs=1e-4)
    assert state.theta_e == pytest.approx(x[2], abs=1e-5)
    assert abs(x[0]) > 1.0


@pytest.mark.parametrize("pair", [1, 2, 3])
def test_a_shorted_motor_brakes_whoever_turns_it_with_the_outputs_off(pair):
    """Two phases and the short in a ring: half of its resistance belongs to each."""
    params, reference = make(300e-6)
    phase = (pair + 1) % 3 + 1
    params, rates = params._replace(tied=phase, tied_R=0.05), series(phase, 300e-6, reference.shaft, 0.025)
    state, x = state_at(params, 0.7, 200.0), np.array([0.0, 200.0, 0.7])
    for _ in range(320):
        state, _ = integrator.step(params, state, inverter.off(), NO_LOAD, T_S)
        x = solve_ivp(rates, (0.0, T_S), x, "DOP853", args=(0.0,), rtol=1e-9, atol=1e-11).y[:, -1]
        assert abs(currents(params, state) - x[0] * np.exp(1j * AXIS[phase])) < 1e-4
    assert state.omega_m == pytest.approx(x[1], abs=1e-3)
    assert x[1] < 190.0


@pytest.mark.parametrize("phase", [1, 2, 3])
def test_energy_is_kept_by_a_saturating_motor_with_a_broken_wire(phase):
    """What comes in is in the field, in the copper, or was work on a shaft that is turned at a steady speed."""
    params, reference = make(300e-6, emf=(0.05, -0.03, 0.01, 0.008), i_sat=12.0, i_cross=40.0)
    params = params._replace(open=phase)
    turned, omega, h = mechanics.Load(mechanics.SPEED, 0.0, 80.0), 80.0, T_S / 8
    decay, half_decay = integrator.decays(params.motor, h)
    params = params._replace(decay=decay, half_decay=half_decay)
    state = state_at(params, 0.3, omega)
    u, e = 2.0 * np.exp(1j * (AXIS[phase] + 0.4)), np.exp(1j * AXIS[phase])
    begin = reference.energy(complex(state.psi_alpha, state.psi_beta), state.theta_e)
    rows = []
    for _ in range(500):
        i = (currents(params, state) * np.conj(e)).real
        rows.append((1.5 * (u * np.conj(e)).real * i, 1.5 * R * i * i, integrator.torque(params, state) * omega))
        state, _ = integrator.step(params, state, applied(u.real, u.imag), turned, h)
    i = (currents(params, state) * np.conj(e)).real
    rows.append((1.5 * (u * np.conj(e)).real * i, 1.5 * R * i * i, integrator.torque(params, state) * omega))
    given, copper, work = np.trapezoid(np.array(rows), dx=h, axis=0)
    field = 1.5 * (reference.energy(complex(state.psi_alpha, state.psi_beta), state.theta_e) - begin)
    assert given == pytest.approx(copper + work + field, abs=1e-4 * abs(given))
    assert given > 0.02


@pytest.mark.parametrize("open_", [motor_wires.open_phase(bits, 0) for bits in (3, 5, 6, 7)])
def test_where_two_wires_are_broken_nothing_flows(open_):
    params, _ = make()
    params = params._replace(open=open_)
    state = state_at(params, 0.2, 50.0, i_q=5.0)
    for k in range(40):
        state, _ = integrator.step(params, state, applied(6.0, -3.0), NO_LOAD, T_S)
        assert k < 4 or abs(currents(params, state)) < 1e-9
    assert state.omega_m < 50.0


@pytest.mark.parametrize("swap", range(6))
def test_exchanged_wires_are_exchanged_as_those_of_hall_sensors_are(swap):
    wires = hall_wiring.Params(swap, 0, 0, 0, 0.0, 1.0, 1.0)
    for legs in itertools.product((0.0, 1.0), repeat=3):
        phases = motor_wires.to_phases(swap, legs)
        code = sum(int(one) << k for k, one in enumerate(legs))
        assert hall_wiring.pins(wires, code, 0, 0) == sum(int(one) << k for k, one in enumerate(phases))
        assert motor_wires.to_legs(swap, phases) == legs
    for bit in range(3):
        broken = motor_wires.open_phase(1 << bit, swap)
        assert motor_wires.to_legs(swap, tuple(float(k == broken - 1) for k in range(3)))[bit] == 1.0


LEGS = inverter.make_params(24.0, 1e-6, 0.0, 0.3, 0.8, T_S)


@pytest.mark.parametrize("short", [1, 2, 3])
@pytest.mark.parametrize("volts", [0.2, 0.9, 5.0, -5.0])
def test_a_short_settles_at_what_its_resistance_and_the_legs_let_flow(short, volts):
    """R i is u less what both legs lose, each at the sum of its currents; the motor gets what is left."""
    wires = motor_wires.make_params(0, short, 0.05, 2e-6)
    x, y = short - 1, short % 3
    motor = 1.5 * np.exp(0.6j)
    phases = (motor * np.conj(PHASES)).real
    d = np.full(3, 0.5)
    d[x] += volts / 24.0
    ideal = inverter.apply(LEGS, *d)
    i = 0.0
    for _ in range(60):
        i, left = motor_wires.shorted(wires, LEGS, ideal, motor.real, motor.imag, i)

    def lost(leg, current):
        return (ideal.e_a, ideal.e_b, ideal.e_c)[leg] * max(-1.0, min(1.0, current / 0.3))

    expected = brentq(
        lambda i: volts - lost(x, phases[x] + i) + lost(y, phases[y] - i) - 0.05 * i, -500.0, 500.0, xtol=1e-12
    )
    assert i == pytest.approx(expected, abs=1e-6)
    across = np.array(pmsm.phases(left.u_alpha, left.u_beta))
    assert across[x] - across[y] == pytest.approx(0.05 * i, abs=1e-6)
    assert motor_wires.shorted(wires, LEGS, inverter.off(), motor.real, motor.imag, i) == (0.0, inverter.off())
    sensed = np.array(motor_wires.with_short(wires, tuple(phases), i)) - phases
    assert (sensed[x], sensed[y], sensed.sum()) == pytest.approx((i, -i, 0.0))


def test_a_short_beside_a_broken_wire_is_refused():
    with pytest.raises(ConfigError, match=r"^open must be 0 where short = 1, got 2 \(faults.motor in overrides\)"):
        load_params(None, {"faults.motor.short": 1, "faults.motor.open": 2})

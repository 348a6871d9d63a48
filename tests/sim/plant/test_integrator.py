"""The plant against scipy's solve_ivp at rtol 1e-10, and its friction, load machine and floating phases."""

import math
from itertools import product

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim.config.params import load_params
from sim.plant import integrator, inverter, mechanics, pmsm
from tests.choice import sampled

T_S = 1.0 / 16000.0
NO_LOAD = mechanics.Load(mechanics.OFF, 0.0, 0.0)


class Reference:
    """Motor and shaft once more, in the rotor frame, for scipy: an oracle that shares no code.

    Ideal voltages, viscous and dry friction, and a constant torque against positive speed.
    """

    def __init__(self, R_s, L_d, L_q, psi_f, n_p, J, b, tau_dry):
        self.R_s, self.L_d, self.L_q, self.psi_f, self.n_p = R_s, L_d, L_q, psi_f, n_p
        self.J, self.b, self.tau_dry = J, b, tau_dry

    def torque(self, i_d, i_q):
        return 1.5 * self.n_p * (self.psi_f * i_q + (self.L_d - self.L_q) * i_d * i_q)

    def rates(self, t, x, u_alpha, u_beta):
        i_d, i_q, omega_m, theta = x
        omega_e = self.n_p * omega_m
        u_d = u_alpha * np.cos(theta) + u_beta * np.sin(theta)
        u_q = u_beta * np.cos(theta) - u_alpha * np.sin(theta)
        return [
            (u_d - self.R_s * i_d + omega_e * self.L_q * i_q) / self.L_d,
            (u_q - self.R_s * i_q - omega_e * (self.L_d * i_d + self.psi_f)) / self.L_q,
            (self.torque(i_d, i_q) - self.b * omega_m - self.tau_dry * np.sign(omega_m)) / self.J,
            omega_e,
        ]

    def solve(self, x, span, u_alpha=0.0, u_beta=0.0, t_eval=None, events=None):
        return solve_ivp(
            self.rates, (0.0, span), x, "DOP853", t_eval, args=(u_alpha, u_beta), rtol=1e-10, atol=1e-12,
            events=events,
        )  # fmt: skip


def make(L_q=None, **changes):
    """Plant parameters with an ideal inverter, and the reference of the same figures."""
    p = load_params(None, {"motor.L_q": L_q} if L_q else None)
    m = p.motor
    shaft = {"J": p.mechanics.J, "b": p.mechanics.b, "tau_coulomb": p.mechanics.tau_coulomb, **changes}
    motor = pmsm.make_params(m.R_s, m.L_d, m.L_q, m.psi_f, m.n_p)
    params = integrator.Params(
        motor,
        inverter.make_params(24.0, 0.0, 0.0, 0.3, 0.8, T_S),
        mechanics.make_params(**shaft, alpha_m_max=1000.0),
        integrator.make_decay(motor, T_S),
    )
    reference = Reference(m.R_s, m.L_d, m.L_q, m.psi_f, m.n_p, shaft["J"], shaft["b"], shaft["tau_coulomb"])
    return params, reference


def state_at(params, theta_e, omega_m, i_d=0.0, i_q=0.0):
    cos, sin = math.cos(theta_e), math.sin(theta_e)
    psi = pmsm.flux(params.motor, cos * i_d - sin * i_q, sin * i_d + cos * i_q, cos, sin)
    return integrator.State(*psi, omega_m, theta_e, cos, sin)


def currents_dq(params, state):
    """i_d, i_q by numpy from the flux linkage."""
    psi = (state.psi_alpha + 1j * state.psi_beta) * np.exp(-1j * state.theta_e)
    L_d = 1.0 / (params.motor.g_mean + params.motor.g_diff)
    L_q = 1.0 / (params.motor.g_mean - params.motor.g_diff)
    return np.array([(psi.real - params.motor.psi_f) / L_d, psi.imag / L_q])


def applied(u_alpha, u_beta):
    return inverter.Applied(True, float(u_alpha), float(u_beta), 0.0, 0.0, 0.0)


def voltage_steps(substeps, L_q):
    """dq voltage steps with a load beside solve_ivp: end states, largest differences in A and rad."""
    params, reference = make(L_q)
    load = mechanics.Load(mechanics.TORQUE, 0.2, 0.0)
    reference.tau_dry += 0.2
    state = state_at(params, 0.7, 150.0)
    x = np.array([0.0, 0.0, 150.0, 0.7])
    worst_current = worst_angle = 0.0
    for k in range(320):
        u_dq = 0.5 + 7.0j if k < 160 else -1.5 + 9.5j
        u = u_dq * np.exp(1j * x[3])
        for _ in range(substeps):
            state, _ = integrator.step(params, state, applied(u.real, u.imag), load, T_S / substeps)
        x = reference.solve(x, T_S, u.real, u.imag).y[:, -1]
        worst_current = max(worst_current, np.abs(currents_dq(params, state) - x[:2]).max())
        worst_angle = max(worst_angle, abs(state.theta_e - x[3]))
    return state, x, worst_current, worst_angle


@pytest.mark.parametrize("L_q", [176e-6, 300e-6])
@pytest.mark.parametrize("substeps", [1, 2])
def test_voltage_steps_with_a_load_agree_with_solve_ivp(substeps, L_q):
    state, x, worst_current, worst_angle = voltage_steps(substeps, L_q)
    assert np.abs(x[:2]).max() > 3.0
    assert worst_current < 1e-6
    assert worst_angle < 1e-7
    assert abs(state.omega_m - x[2]) < 1e-5
    assert (state.cos, state.sin) == pytest.approx((math.cos(state.theta_e), math.sin(state.theta_e)), abs=1e-12)


class Uneven:
    """A motor with harmonics, cogging, saturation and L_d != L_q, for scipy: by its energy, in the stator frame."""

    def __init__(self, m, shaft, emf, cogging, i_sat):
        self.m, self.shaft, self.cogging = m, shaft, cogging
        L = 2.0 / (1.0 / m.L_d + 1.0 / m.L_q)
        self.soft = 1.0 / (L * i_sat**2) if i_sat else 0.0
        self.orders = np.array([1, -5, 7, -11, 13])
        self.flux = m.psi_f * np.array([1.0, *emf]) / np.abs(self.orders)

    def magnet(self, theta):
        waves = self.flux * np.exp(1j * self.orders * theta)
        return waves.sum(), (1j * self.orders * waves).sum()

    def energy(self, psi, theta):
        """Of the windings' own flux, J over 3/2: half of v . i_0, and what saturation adds."""
        own = (psi - self.magnet(theta)[0]) * np.exp(-1j * theta)
        twice = own.real**2 / self.m.L_d + own.imag**2 / self.m.L_q
        return 0.5 * twice + 0.25 * self.soft * twice**2

    def current(self, psi, theta):
        """Its gradient."""
        own = (psi - self.magnet(theta)[0]) * np.exp(-1j * theta)
        i_0 = own.real / self.m.L_d + 1j * own.imag / self.m.L_q
        return i_0 * (1.0 + self.soft * (own * np.conj(i_0)).real) * np.exp(1j * theta)

    def torque(self, psi, theta):
        """How it falls with the angle, by a complex step's kin: central differences, good to 1e-9 here."""
        d = 1e-5
        six, twelve = self.cogging
        fall = (self.energy(psi, theta - d) - self.energy(psi, theta + d)) / (2.0 * d)
        return 1.5 * self.m.n_p * fall + six * np.sin(6 * theta) + twelve * np.sin(12 * theta)

    def rates(self, t, x, u, load):
        psi, omega, theta = x[0] + 1j * x[1], x[2], x[3]
        flux = u - self.m.R_s * self.current(psi, theta)
        tau = self.torque(psi, theta) - self.shaft.b * omega - self.shaft.tau_coulomb * np.sign(omega) - load
        return [flux.real, flux.imag, tau / self.shaft.J, self.m.n_p * omega]


UNEVEN = product((10.0, 150.0, 300.0), (176e-6, 300e-6), (0.0, 8.0))


@pytest.mark.parametrize(("omega_m", "L_q", "i_sat"), sampled("uneven", UNEVEN, 4, campaign="oracles"))
def test_harmonics_cogging_and_saturation_agree_with_solve_ivp(omega_m, L_q, i_sat):
    p = load_params(None, {"motor.L_q": L_q})
    m, shaft, emf, cogging = p.motor, p.mechanics, (0.05, -0.03, 0.01, 0.008), (0.004, -0.002)
    motor = pmsm.make_params(m.R_s, m.L_d, m.L_q, m.psi_f, m.n_p, emf, cogging, i_sat)
    params = integrator.Params(
        motor,
        inverter.make_params(24.0, 0.0, 0.0, 0.3, 0.8, T_S),
        mechanics.make_params(shaft.J, shaft.b, shaft.tau_coulomb, 1000.0),
        integrator.make_decay(motor, T_S),
    )
    reference = Uneven(m, shaft, emf, cogging, i_sat)
    state = state_at(params, 0.7, omega_m, i_d=-1.0, i_q=3.0)
    x = np.array([state.psi_alpha, state.psi_beta, omega_m, 0.7])
    assert abs(reference.current(x[0] + 1j * x[1], 0.7) - (-1.0 + 3.0j) * np.exp(0.7j)) < 1e-12
    load = mechanics.Load(mechanics.TORQUE, 0.1, 0.0)
    ripple = []
    for _ in range(200):
        u = (0.3 + 1j * (m.n_p * x[2] * m.psi_f + 0.5)) * np.exp(1j * x[3])
        state, _ = integrator.step(params, state, applied(u.real, u.imag), load, T_S)
        x = solve_ivp(reference.rates, (0.0, T_S), x, "DOP853", args=(u, 0.1), rtol=1e-10, atol=1e-13).y[:, -1]
        i = reference.current(x[0] + 1j * x[1], x[3])
        found = pmsm.currents(motor, state.psi_alpha, state.psi_beta, state.cos, state.sin)
        assert abs(complex(*found) - i) < 3e-4
        assert abs(state.theta_e - x[3]) < 1e-6
        ripple.append(integrator.torque(params, state))
        assert ripple[-1] == pytest.approx(reference.torque(x[0] + 1j * x[1], x[3]), abs=1e-5)
    assert np.ptp(ripple) > 0.005


def test_shorted_coast_down_agrees_with_solve_ivp_and_ends_at_rest():
    params, reference = make()
    state = state_at(params, -1.0, 300.0)

    def stop(t, x, *_):
        return x[2]

    stop.terminal = True
    n = 3200
    solution = reference.solve([0.0, 0.0, 300.0, -1.0], n * T_S, t_eval=np.arange(n + 1) * T_S, events=stop)
    stopped = solution.t_events[0][0]
    assert 0.02 < stopped < n * T_S
    still = None
    for k in range(1, n + 1):
        for _ in range(2):
            state, _ = integrator.step(params, state, applied(0.0, 0.0), NO_LOAD, T_S / 2)
        if k < solution.t.size:
            assert np.abs(currents_dq(params, state) - solution.y[:2, k]).max() < 1e-5
            assert abs(state.theta_e - solution.y[3, k]) < 1e-6
        elif k * T_S > stopped + T_S:
            still = state.theta_e if still is None else still
            assert state.omega_m == 0.0
            assert state.theta_e == still
    assert state.theta_e == pytest.approx(solution.y_events[0][0][3], abs=1e-6)
    assert np.abs(currents_dq(params, state)).max() < 1e-3


def test_dry_friction_holds_then_lets_go():
    params, _ = make(tau_coulomb=0.01)
    k_tau = 1.5 * 6 * 6.55e-3
    for i_q, moves in ((0.99 * 0.01 / k_tau, False), (-0.99 * 0.01 / k_tau, False), (1.01 * 0.01 / k_tau, True)):
        state = state_at(params, 0.0, 0.0, i_q=i_q)
        u = applied(0.0, 0.158 * i_q)  # keeps the current
        for _ in range(100):
            state, _ = integrator.step(params, state, u, NO_LOAD, T_S)
        assert (state.omega_m != 0.0) == moves


def test_friction_does_not_chatter_where_speed_passes_zero():
    params, _ = make(tau_coulomb=0.02)
    state = state_at(params, 0.0, 2.0)
    speeds = []
    for _ in range(800):
        state, _ = integrator.step(params, state, inverter.off(), NO_LOAD, T_S)
        speeds.append(state.omega_m)
    first = speeds.index(0.0)
    # from 2 rad/s by 0.02 N m on 2e-4 kg m2: 20 ms
    assert first * T_S == pytest.approx(0.02, abs=3e-4)
    assert all(s > 0.0 for s in speeds[:first])
    assert set(speeds[first:]) == {0.0}


def test_reversal_passes_through_zero_once():
    params, _ = make()
    state = state_at(params, 0.0, 3.0)
    signs = []
    for _ in range(400):
        u = 1.5j * np.exp(1j * state.theta_e) * -1.0
        state, _ = integrator.step(params, state, applied(u.real, u.imag), NO_LOAD, T_S)
        signs.append(np.sign(state.omega_m))
    assert signs[0] == 1.0
    assert signs[-1] == -1.0
    assert np.count_nonzero(np.diff(signs)) <= 2


def test_brake_looks_passive():
    params, _ = make()
    brake = mechanics.Load(mechanics.TORQUE, 0.3, 0.0)
    state = state_at(params, 0.0, 0.0)
    for _ in range(200):
        state, _ = integrator.step(params, state, inverter.off(), brake, T_S)
    assert state.omega_m == 0.0
    backwards = free = state_at(params, 0.0, -50.0)
    forwards = state_at(params, 0.0, 50.0)
    for _ in range(100):
        backwards, _ = integrator.step(params, backwards, inverter.off(), brake, T_S)
        free, _ = integrator.step(params, free, inverter.off(), NO_LOAD, T_S)
        forwards, _ = integrator.step(params, forwards, inverter.off(), brake, T_S)
    assert backwards.omega_m == free.omega_m
    assert forwards.omega_m == pytest.approx(50.0 - (0.305 + 0.005) / 2e-4 * 100 * T_S, rel=1e-2)
    assert mechanics.load_torque(params.shaft, brake, 50.0, 0.1, 0.0) == 0.3
    assert mechanics.load_torque(params.shaft, brake, -50.0, 0.1, 0.0) == 0.0
    assert mechanics.load_torque(params.shaft, brake, 0.0, 0.1, 0.0) == pytest.approx(0.1 - 0.005)
    assert mechanics.load_torque(params.shaft, brake, 0.0, -0.1, 0.0) == 0.0
    assert mechanics.load_torque(params.shaft, NO_LOAD, 0.0, 0.1, 0.0) == 0.0


def test_forced_speed_ramps_and_reports_the_torque_it_takes():
    params, _ = make()
    forced = mechanics.Load(mechanics.SPEED, 0.0, 40.0)
    state = state_at(params, 0.0, 0.0)
    for k in range(1, 800):
        state, alpha = integrator.step(params, state, inverter.off(), forced, T_S)
        assert state.omega_m == pytest.approx(min(1000.0 * k * T_S, 40.0), abs=1e-9)
        if k == 100:
            taken = mechanics.load_torque(params.shaft, forced, state.omega_m, 0.0, alpha)
            assert taken == pytest.approx(-(0.005 + 1e-4 * state.omega_m + 2e-4 * 1000.0))
    assert state.omega_m == 40.0
    assert state.theta_e == pytest.approx(6 * (40.0 * 799 * T_S - 40.0 * 0.04 / 2), abs=1e-6)


def test_outputs_off_ends_current_and_torque_at_once():
    params, _ = make()
    state = state_at(params, 0.3, 100.0, i_d=-3.0, i_q=7.0)
    steps = 0
    while integrator.torque(params, state) != 0.0:
        state, _ = integrator.step(params, state, inverter.off(), NO_LOAD, T_S / 2)
        steps += 1
    assert steps * T_S / 2 < 0.2e-3
    omega, t = state.omega_m, 0.0
    for _ in range(1000):
        state, _ = integrator.step(params, state, inverter.off(), NO_LOAD, T_S)
        t += T_S
    rest = 0.005 / 1e-4  # friction alone: omega + tau_c / b decays with b / J
    assert state.omega_m == pytest.approx((omega + rest) * math.exp(-1e-4 / 2e-4 * t) - rest, abs=1e-9)
    assert np.abs(currents_dq(params, state)).max() < 1e-9

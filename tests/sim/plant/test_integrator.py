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
    """The motor by its energy and the shaft, in the stator frame, for scipy: an oracle that shares no code.

    Ideal voltages, harmonics, cogging and saturation, also of one axis by the other, friction, viscous, dry, Stribeck's
    and the iron's, a torque `load` against positive speed.
    """

    def __init__(self, m, shaft, emf, cogging, i_sat, i_cross=0.0):
        self.m, self.shaft, self.cogging, self.load = m, shaft, cogging, 0.0
        self.soft = 0.5 * (1.0 / m.L_d + 1.0 / m.L_q) / i_sat**2 if i_sat else 0.0
        self.cross = 1.0 / (m.L_d * m.L_q * m.psi_f * i_cross) if i_cross else 0.0
        self.orders = np.array([1, -5, 7, -11, 13])
        self.flux = m.psi_f * np.array([1.0, *emf]) / np.abs(self.orders)

    def own(self, psi, theta):
        """The windings' own flux in the rotor's frame, and the current that it takes without saturation."""
        own = psi * np.exp(-1j * theta) - (self.flux * np.exp(1j * (self.orders - 1) * theta)).sum()
        return own, complex(own.real / self.m.L_d, own.imag / self.m.L_q)

    def current(self, psi, theta):
        """The gradient of the energy, in the rotor's frame."""
        own, i_0 = self.own(psi, theta)
        whole = own.real + self.m.psi_f
        crossed = complex(whole * own.imag**2, (whole**2 - self.m.psi_f**2) * own.imag)
        return i_0 * (1.0 + self.soft * (own * np.conj(i_0)).real) + 0.5 * self.cross * crossed

    def energy(self, psi, theta):
        """Of the windings' own flux, J over 3/2: half of own . i_0, and what saturation adds."""
        own, i_0 = self.own(psi, theta)
        twice = (own * np.conj(i_0)).real
        crossed = ((own.real + self.m.psi_f) ** 2 - self.m.psi_f**2) * own.imag**2
        return 0.5 * twice + 0.25 * self.soft * twice**2 + 0.25 * self.cross * crossed

    def torque(self, psi, theta):
        """How the energy falls with the angle, by central differences: good to 1e-9 here."""
        d = 1e-5
        six, twelve = self.cogging
        fall = (self.energy(psi, theta - d) - self.energy(psi, theta + d)) / (2.0 * d)
        return 1.5 * self.m.n_p * fall + six * np.sin(6 * theta) + twelve * np.sin(12 * theta)

    def friction(self, psi, omega):
        """All that the shaft loses, N m."""
        s = {"stribeck": 0.0, "omega_stribeck": 1.0, "iron": (0.0, 0.0)} | self.shaft
        dry = s["tau_coulomb"] + s["stribeck"] * np.exp(-((omega / s["omega_stribeck"]) ** 2))
        hysteresis, eddy = np.array(s["iron"]) * abs(psi) ** 2
        return (s["b"] + eddy) * omega + (dry + hysteresis) * np.sign(omega)

    def rates(self, t, x, u):
        psi, omega, theta = x[0] + 1j * x[1], x[2], x[3]
        flux = u - self.m.R_s * self.current(psi, theta) * np.exp(1j * theta)
        tau = self.torque(psi, theta) - self.friction(psi, omega) - self.load
        return [flux.real, flux.imag, tau / self.shaft["J"], self.m.n_p * omega]

    def solve(self, x, span, u=0.0, **how):
        return solve_ivp(self.rates, (0.0, span), x, "DOP853", args=(u,), rtol=1e-10, atol=1e-12, **how)


def make(L_q=None, emf=(0.0,) * 4, cogging=(0.0, 0.0), i_sat=0.0, i_cross=0.0, **changes):
    """Plant parameters with an ideal inverter, and the reference of the same figures."""
    p = load_params(None, {"motor.L_q": L_q} if L_q else None)
    m = p.motor
    shaft = {"J": p.mechanics.J, "b": p.mechanics.b, "tau_coulomb": p.mechanics.tau_coulomb, **changes}
    motor = pmsm.make_params(m.R_s, m.L_d, m.L_q, m.psi_f, m.n_p, emf, cogging, i_sat)
    motor = pmsm.with_crossing(motor, i_cross)
    params = integrator.Params(
        motor,
        inverter.make_params(24.0, 0.0, 0.0, 0.3, 0.8, T_S),
        mechanics.make_params(**shaft, alpha_m_max=1000.0),
        *integrator.decays(motor, T_S),
    )
    return params, Reference(m, shaft, emf, cogging, i_sat, i_cross)


LOST = dict.fromkeys(("e_a", "e_b", "e_c"), 0.4)


def state_at(params, theta_e, omega_m, i_d=0.0, i_q=0.0):
    cos, sin = math.cos(theta_e), math.sin(theta_e)
    psi = pmsm.flux(params.motor, cos * i_d - sin * i_q, sin * i_d + cos * i_q, cos, sin)
    return integrator.State(*psi, omega_m, theta_e, cos, sin)


def applied(u_alpha, u_beta):
    return inverter.Applied(True, float(u_alpha), float(u_beta), 0.0, 0.0, 0.0)


def voltage_steps(substeps, L_q=None, omega_m=150.0, n=320, **motor):
    """Steps of the voltage, and a load, beside solve_ivp.

    Returns:
        End states, largest differences of current (A), angle (rad) and torque (N m), and how much that was rippled.
    """
    params, reference = make(L_q, **motor)
    reference.load = 0.2
    load = mechanics.Load(mechanics.TORQUE, reference.load, 0.0)
    state = state_at(params, 0.7, omega_m, i_d=-1.0, i_q=3.0)
    x = np.array([state.psi_alpha, state.psi_beta, omega_m, 0.7])
    assert abs(reference.current(complex(*x[:2]), 0.7) - (-1.0 + 3.0j)) < 1e-12 or params.motor.uneven
    worst, torques = np.zeros(3), []
    for k in range(n):
        u = (0.3 + 1j * (6.0 * x[2] * 6.55e-3 + (2.0 if k < n // 2 else 0.5))) * np.exp(1j * x[3])
        for _ in range(substeps):
            state, _ = integrator.step(params, state, applied(u.real, u.imag), load, T_S / substeps)
        x = reference.solve(x, T_S, u).y[:, -1]
        psi, found = complex(*x[:2]), pmsm.currents(params.motor, state.psi_alpha, state.psi_beta, state.cos, state.sin)
        torques.append(integrator.torque(params, state))
        wrong = (
            abs(complex(*found) - reference.current(psi, x[3]) * np.exp(1j * x[3])),
            abs(state.theta_e - x[3]),
            abs(torques[-1] - reference.torque(psi, x[3])),
        )
        worst = np.maximum(worst, wrong)
    return state, x, *worst, float(np.ptp(torques))


@pytest.mark.parametrize("L_q", [176e-6, 300e-6])
@pytest.mark.parametrize("substeps", [1, 2])
def test_voltage_steps_with_a_load_agree_with_solve_ivp(substeps, L_q):
    state, x, current, angle, torque, _ = voltage_steps(substeps, L_q)
    assert current < 1e-6
    assert angle < 1e-7
    assert torque < 1e-7
    assert abs(state.omega_m - x[2]) < 1e-5
    assert (state.cos, state.sin) == pytest.approx((math.cos(state.theta_e), math.sin(state.theta_e)), abs=1e-12)


class Losing(Reference):
    """The same with an inverter that takes `e` V of a leg against its current, in proportion below `i_smooth` A."""

    e, i_smooth = 0.4, 0.3

    def rates(self, t, x, u):
        psi, axes = x[0] + 1j * x[1], np.exp(2j * np.pi / 3 * np.arange(3))
        i = self.current(psi, x[3]) * np.exp(1j * x[3])
        lost = self.e * np.clip((i * np.conj(axes)).real / self.i_smooth, -1.0, 1.0)
        return super().rates(t, x, u - 2 / 3 * np.dot(lost, axes))


@pytest.mark.parametrize(
    ("omega_m", "i_q", "most"), [(15.0, 0.5, 3e-4), (52.0, 4.0, 6e-4), (150.0, 4.0, 1e-3), (150.0, 0.5, 1e-3)]
)
def test_an_inverters_loss_near_zero_current_agrees_with_solve_ivp(omega_m, i_q, most):
    """Six times a turn a phase passes zero within a step or some."""
    params, even = make()
    reference = Losing(even.m, even.shaft, (0.0,) * 4, (0.0, 0.0), 0.0)
    params = params._replace(inverter=params.inverter._replace(g_smooth=1.0 / reference.i_smooth))
    state = state_at(params, 0.7, omega_m, i_q=i_q)
    x = np.array([state.psi_alpha, state.psi_beta, omega_m, 0.7])
    worst = 0.0
    for _ in range(round(2.0 * math.pi / 6.0 / (6.0 * omega_m * T_S))):
        middle = x[3] + 3.0 * x[2] * T_S
        u = (0.158 * 1j * i_q + 6j * x[2] * (6.55e-3 + 176e-6j * i_q) + 0.4j) * np.exp(1j * middle)
        state, _ = integrator.step(params, state, applied(u.real, u.imag)._replace(**LOST), NO_LOAD, T_S)
        x = reference.solve(x, T_S, u, max_step=T_S / 8).y[:, -1]
        found = complex(*pmsm.currents(params.motor, state.psi_alpha, state.psi_beta, state.cos, state.sin))
        worst = max(worst, abs(found - reference.current(complex(*x[:2]), x[3]) * np.exp(1j * x[3])))
    assert worst < most
    assert abs(state.omega_m - x[2]) < 1e-4 * omega_m
    assert abs(state.theta_e - x[3]) < 1e-4


UNEVEN = product((20.0, 150.0, 300.0), (176e-6, 300e-6), (0.0, 8.0), (0.0, 25.0))


@pytest.mark.parametrize(("omega_m", "L_q", "i_sat", "i_cross"), sampled("uneven", UNEVEN, 3, campaign="oracles"))
def test_harmonics_cogging_and_saturation_agree_with_solve_ivp(omega_m, L_q, i_sat, i_cross):
    uneven = {"emf": (0.05, -0.03, 0.01, 0.008), "cogging": (0.004, -0.002), "i_sat": i_sat, "i_cross": i_cross}
    _, _, current, angle, torque, ripple = voltage_steps(1, L_q, omega_m, 160, **uneven)
    assert current < 3e-4
    assert angle < 3e-6
    assert torque < 1e-5
    assert ripple > 0.005


def test_shorted_coast_down_agrees_with_solve_ivp_and_ends_at_rest():
    params, reference = make()
    state = state_at(params, -1.0, 300.0)

    def stop(t, x, *_):
        return x[2]

    stop.terminal = True
    n = 3200
    begin = [state.psi_alpha, state.psi_beta, 300.0, -1.0]
    solution = reference.solve(begin, n * T_S, t_eval=np.arange(n + 1) * T_S, events=stop)
    stopped = solution.t_events[0][0]
    assert 0.02 < stopped < n * T_S
    for k in range(1, n + 1):
        for _ in range(2):
            state, _ = integrator.step(params, state, applied(0.0, 0.0), NO_LOAD, T_S / 2)
        if k < solution.t.size:
            assert state[:4] == pytest.approx(solution.y[:, k], abs=2e-6)
        elif k * T_S > stopped + T_S:
            assert (state.omega_m, state.theta_e) == (0.0, pytest.approx(solution.y_events[0][0][3], abs=1e-6))


@pytest.mark.parametrize(("share", "moves"), [(0.99, False), (-0.99, False), (1.01, True), (-1.01, True)])
def test_dry_friction_holds_then_lets_go(share, moves):
    params, _ = make(tau_coulomb=0.01)
    i_q = share * 0.01 / (1.5 * 6 * 6.55e-3)
    state = state_at(params, 0.0, 0.0, i_q=i_q)
    for _ in range(100):  # the voltage keeps the current
        state, _ = integrator.step(params, state, applied(0.0, 0.158 * i_q), NO_LOAD, T_S)
    assert np.sign(state.omega_m) == moves * np.sign(share)


def test_friction_stops_a_shaft_in_its_time_and_a_motor_turns_it_back_through_zero_once():
    params, _ = make(tau_coulomb=0.02)
    for torque, seconds in ((0.0, 0.02), (-0.03, 0.008)):  # from 2 rad/s, 2e-4 kg m2
        state, speeds = state_at(params, 0.0, 2.0), []
        for _ in range(800):
            i = 1j * torque / (1.5 * 6 * 6.55e-3) * np.exp(1j * state.theta_e)
            u = 0.158 * i + 1j * 6 * state.omega_m * (6.55e-3 * np.exp(1j * state.theta_e) + 176e-6 * i)
            state = state_at(params, state.theta_e, state.omega_m, i_q=torque / (1.5 * 6 * 6.55e-3))
            state, _ = integrator.step(params, state, applied(u.real, u.imag), NO_LOAD, T_S)
            speeds.append(state.omega_m)
        first = int(np.argmax(np.array(speeds) <= 0.0))
        assert first * T_S == pytest.approx(seconds, abs=3e-4)
        assert (np.sign(speeds[first + 2 :]) == np.sign(torque)).all()


@pytest.mark.parametrize(
    ("omega_m", "tau_e", "dry", "brakes"),
    [(50.0, 0.1, 0.305, 0.3), (-50.0, 0.1, -0.005, 0.0), (0.0, 0.4, 0.305, 0.3), (0.0, -0.1, -0.005, 0.0),
     (0.0, 0.1, None, 0.095), (0.0, 0.003, None, 0.0)],
)  # fmt: skip
def test_brake_looks_passive(omega_m, tau_e, dry, brakes):
    """It takes what a motor gives beyond the dry friction of 5 mN m, and never drives; None: the shaft is held."""
    shaft, brake = make()[0].shaft, mechanics.Load(mechanics.TORQUE, 0.3, 0.0)
    held, turns = mechanics.Push(0.0, 0.0, 0.0), mechanics.Push(1.0 / 2e-4, dry, 0.0)
    assert mechanics.push(shaft, brake, omega_m, tau_e, T_S) == (held if dry is None else pytest.approx(turns))
    assert mechanics.load_torque(shaft, brake, omega_m, tau_e, 0.0) == pytest.approx(brakes)
    assert mechanics.load_torque(shaft, NO_LOAD, omega_m, tau_e, 0.0) == 0.0


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
    assert pmsm.currents(params.motor, *state[:2], state.cos, state.sin) == pytest.approx((0.0, 0.0), abs=1e-9)

"""A winding with skin effect: its two equations by the matrix exponential, its impedance, and the motor that turns."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from protocol.messages import SetpointMode
from sim.config.params import ConfigError, load_params
from sim.drive import constants
from sim.plant import integrator, mechanics, pmsm, skin_effect
from tests.sim.drive.rig import Rig
from tests.sim.plant.test_integrator import NO_LOAD, T_S, Reference, applied, make, state_at

R, L, R_SKIN, F_SKIN = 0.158, 176e-6, 0.08, 1500.0
L_SKIN = R_SKIN / (2.0 * math.pi * F_SKIN)
HELD = mechanics.Load(mechanics.SPEED, 0.0, 0.0)


def winding(**changes):
    """The plant whose flux is that of what is in series with the ladder, the ladder, and the reference."""
    params, reference = make(**changes)
    m = reference.m
    motor = pmsm.make_params(m.R_s + R_SKIN, m.L_d - L_SKIN, m.L_q - L_SKIN, m.psi_f, m.n_p)
    decay, half_decay = integrator.decays(motor, T_S)
    params = params._replace(motor=motor, decay=decay, half_decay=half_decay)
    return params, skin_effect.make_params(R_SKIN, F_SKIN, T_S), reference


def held(voltages):
    """Current (A) at each step's end of a rotor that is held with its magnet across: u (V) along one axis."""
    params, skin, _ = winding()
    state, inside, found = state_at(params, 0.0, 0.0), skin_effect.init(), []
    for u in voltages:
        inside, state, _ = skin_effect.step(skin, inside, params, state, applied(u, 0.0), HELD, T_S)
        found.append(pmsm.currents(params.motor, state.psi_alpha, state.psi_beta, state.cos, state.sin)[0])
    return np.array(found)


def exact(voltages):
    """The same by the matrix exponential of (L - L_skin) di/dt = u - R i - R_skin (i - j), L_skin dj/dt = ..."""
    a = np.array([[-(R + R_SKIN), R_SKIN, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) / (L - L_SKIN)
    a[1, :2] = R_SKIN / L_SKIN, -R_SKIN / L_SKIN
    step, x, found = expm(a * T_S), np.zeros(3), []
    for u in voltages:
        x = step @ [x[0], x[1], u]
        found.append(x[0])
    return np.array(found)


@pytest.mark.parametrize("periods", [1, 4, 10, 1000])
def test_a_square_wave_of_voltage_makes_the_current_of_the_two_equations(periods):
    voltages = np.where(np.arange(1500) // periods % 2 == 0, 1.0, -1.0)
    found = held(voltages)
    np.testing.assert_allclose(found, exact(voltages), atol=5e-4 * np.abs(found).max())


def impedance(w):
    """Of a phase at w rad/s, ohm."""
    return R + 1j * w * (L - L_SKIN) + R_SKIN * 1j * w * L_SKIN / (R_SKIN + 1j * w * L_SKIN)


def test_slow_currents_see_the_resistance_and_quick_ones_more_of_it_and_less_inductance():
    """Impedance at a frequency by the first harmonic of a sine that is held from step to step."""
    n = 1600
    for cycles, part in ((1, 0.001), (150, 0.5), (700, 0.95)):
        f = cycles / (n * T_S)
        k = np.arange(3 * n)
        u = np.sin(2.0 * math.pi * cycles * k / n)
        i = held(u)[2 * n :]
        at = np.exp(-2j * math.pi * cycles * np.arange(n) / n)
        harmonic, given = np.dot(i, at), np.dot(u[2 * n :], at)
        x = f / F_SKIN
        z_skin = R_SKIN * (x * x + 1j * x) / (1.0 + x * x)
        assert (x * x / (1.0 + x * x)) == pytest.approx(part, abs=0.06)
        # what a sampled current answers to a held voltage: all aliases of the frequency
        w = 2.0 * math.pi * (f + np.arange(-400, 401) / T_S)
        hold = (1.0 - np.exp(-1j * w * T_S)) / (1j * w * T_S) * np.exp(1j * 2.0 * math.pi * f * T_S)
        assert harmonic / given == pytest.approx(np.sum(hold / impedance(w)), rel=6e-3)
        assert impedance(2.0 * math.pi * f).real == pytest.approx(R + z_skin.real)


class WithSkin(Reference):
    """The motor whose flux is that of the rest, with the inductance's current as two more states."""

    def rates(self, t, x, u):
        theta, j = x[3], x[4] + 1j * x[5]
        i = self.current(x[0] + 1j * x[1], theta) * np.exp(1j * theta)
        across = R_SKIN * (i - j)
        rates = super().rates(t, x[:4], u - across)
        return [*rates, across.real / L_SKIN, across.imag / L_SKIN]


def test_a_motor_that_turns_agrees_with_solve_ivp():
    params, skin, even = winding()
    rest = even.m.replace(L_d=L - L_SKIN, L_q=L - L_SKIN)
    reference = WithSkin(rest, even.shaft, (0.0,) * 4, (0.0, 0.0), 0.0)
    state, inside = state_at(params, 0.7, 150.0, i_q=3.0), skin_effect.init()
    x = np.array([state.psi_alpha, state.psi_beta, 150.0, 0.7, 0.0, 0.0])
    worst = 0.0
    for k in range(240):
        u = (0.3 + 1j * (6.0 * x[2] * 6.55e-3 + (2.0 if k < 120 else 0.5))) * np.exp(1j * x[3])
        inside, state, _ = skin_effect.step(skin, inside, params, state, applied(u.real, u.imag), NO_LOAD, T_S)
        x = reference.solve(x, T_S, u).y[:, -1]
        i = complex(*pmsm.currents(params.motor, state.psi_alpha, state.psi_beta, state.cos, state.sin))
        worst = max(worst, abs(i - reference.current(complex(*x[:2]), x[3]) * np.exp(1j * x[3])))
        assert abs(complex(*inside) - complex(*x[4:])) < 0.02
    assert worst < 0.01  # of 10 A: the current is not quite straight within a step
    assert abs(state.omega_m - x[2]) < 5e-3


def test_in_the_drive_a_constant_current_takes_the_resistance_alone():
    """And the winding warms up by that."""
    ideal = {"inverter.dead_time": 0.0, "firmware.dead_time.dead_time_hat": 0.0, "current_sensor.noise_rms": 0.0}
    rig = Rig(0, **ideal, **{"motor.skin_R": 0.1, "motor.skin_hz": 2000.0, "mechanics.theta_0_deg": 0.0})
    rig.set_param("observer", 0.0)
    rig.start()
    rig.load_setpoint(SetpointMode.SPEED, 0.0)
    rig.setpoint(SetpointMode.CURRENT, 0.0, 5.0)
    rig.run(0.2)
    run = rig.run(0.1)
    assert run["u_alpha"].mean() / run["i_alpha_true"].mean() == pytest.approx(rig.params.motor.R_s, rel=2e-3)
    motor = constants.of_motor(rig.params)
    assert 1.0 / motor.g_mean == pytest.approx(rig.params.motor.L_d - 0.1 / (2.0 * math.pi * 2000.0))


def test_more_than_half_of_the_inductance_is_refused():
    with pytest.raises(ConfigError, match=r"^skin_R must be <= 1.11 ohm at skin_hz = 2000 Hz, .*, got 2 \(motor"):
        load_params(None, {"motor.skin_R": 2})

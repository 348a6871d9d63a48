"""Friction of Stribeck's shape and the iron's losses: against solve_ivp, closed forms and the balance of power."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from protocol.messages import SetpointMode
from sim.config.params import ConfigError, load_params
from sim.plant import integrator, inverter, mechanics
from tests.sim.drive.rig import Rig
from tests.sim.plant.test_integrator import NO_LOAD, T_S, applied, make, state_at, voltage_steps

PSI, K_TAU = 6.55e-3, 1.5 * 6 * 6.55e-3
IRON = 4e-3 / PSI**2, 2e-4 / PSI**2
LOSING = {"stribeck": 6e-3, "omega_stribeck": 3.0, "iron": IRON}


@pytest.mark.parametrize(
    "shaft", [{"stribeck": 6e-3, "omega_stribeck": 3.0}, {"iron": IRON}, LOSING], ids=["stribeck", "iron", "both"]
)
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_coasting_to_rest_agrees_with_solve_ivp(shaft, way):
    """The speed all the way down, and where the shaft stops."""
    params, reference = make(**shaft)
    state = state_at(params, 0.4, way * 12.0)

    def rates(t, x):  # without a current the flux is the magnet's
        return [-reference.friction(PSI, x[0]) / reference.shaft["J"], 6.0 * x[0]]

    def at_rest(t, x):
        return way * x[0]

    at_rest.terminal = True
    begin = [way * 12.0, 0.4]
    found = solve_ivp(rates, (0.0, 1.0), begin, rtol=1e-9, atol=1e-11, dense_output=True, events=at_rest, max_step=1e-3)
    stopped = found.t_events[0][0]
    for k in range(1, round(stopped / T_S) + 20):
        state, _ = integrator.step(params, state, inverter.off(), NO_LOAD, T_S)
        if k * T_S < stopped - 2.0 * T_S and k % 50 == 0:
            assert state.omega_m == pytest.approx(found.sol(k * T_S)[0], abs=2e-4)
    assert state.omega_m == 0.0
    assert state.theta_e == pytest.approx(found.y_events[0][0][1], abs=2e-4)


def test_voltage_steps_agree_with_solve_ivp():
    """The flux that the iron sees is that of each step's begin, so what it takes lags by half a step."""
    state, x, current, angle, torque, _ = voltage_steps(1, 300e-6, 150.0, 160, **LOSING)
    assert current < 1e-3
    assert angle < 1e-4
    assert torque < 1e-4
    assert abs(state.omega_m - x[2]) < 3e-3
    without = voltage_steps(1, 300e-6, 150.0, 160)[0]
    assert without.omega_m - state.omega_m > 1.0


@pytest.mark.parametrize(("share", "moves"), [(0.99, 0.0), (-0.99, 0.0), (1.01, 1.0), (-1.01, -1.0)])
def test_a_shaft_at_rest_is_held_by_all_that_is_dry(share, moves):
    params, _ = make(tau_coulomb=5e-3, stribeck=6e-3, iron=(2e-3 / PSI**2, 0.0))
    i_q = share * 13e-3 / K_TAU
    i_q = share * (11e-3 + 2e-3 * (1.0 + (176e-6 * i_q / PSI) ** 2)) / K_TAU
    state = state_at(params, 0.0, 0.0, i_q=i_q)
    for _ in range(200):
        state, _ = integrator.step(params, state, applied(0.0, 0.158 * i_q), NO_LOAD, T_S)
    assert np.sign(state.omega_m) == moves


@pytest.mark.parametrize("rpm", [60.0, 1500.0, -1500.0])
@pytest.mark.parametrize("i_d", [0.0, -6.0])
def test_the_load_machine_sees_what_friction_and_iron_take(rpm, i_d):
    """At a steady speed its torque is the motor's less that, and less iron loss where i_d weakens the flux."""
    h, eddy, stribeck, omega_s = 4e-3, 5e-5, 6e-3, 8.0
    rig = Rig(0, **{"motor.iron_hysteresis": h, "motor.iron_eddy": eddy, "mechanics.stribeck": stribeck,
                    "mechanics.omega_stribeck": omega_s, "current_sensor.noise_rms": 0.0})  # fmt: skip
    rig.set_param("observer", 0.0)
    rig.start()
    rig.load_setpoint(SetpointMode.SPEED, rpm * math.tau / 60.0)
    rig.setpoint(SetpointMode.CURRENT, 2.0, i_d)
    rig.run(0.4)
    run = rig.run(0.2)
    p, omega = rig.params, run["omega_m"].mean()
    true = (run["i_alpha_true"] + 1j * run["i_beta_true"]) * np.exp(-1j * run["theta_true"])
    square = np.mean((PSI + p.motor.L_d * true.real) ** 2 + (p.motor.L_q * true.imag) ** 2) / PSI**2
    dry = p.mechanics.tau_coulomb + stribeck * math.exp(-((omega / omega_s) ** 2)) + h * square
    lost = (p.mechanics.b + eddy * square) * omega + math.copysign(dry, omega)
    assert run["tau_load_true"].mean() == pytest.approx(run["tau_e_true"].mean() - lost, abs=2e-6)
    assert square == pytest.approx(1.0 if i_d == 0.0 else 0.70, abs=0.03)


def test_power_from_the_link_is_copper_iron_friction_and_what_the_load_gets():
    rig = Rig(0, **{"motor.iron_hysteresis": 6e-3, "motor.iron_eddy": 1e-4, "dc_link.R_source": 0.2,
                    "inverter.dead_time": 0.0, "firmware.dead_time.dead_time_hat": 0.0})  # fmt: skip
    rig.start()
    run = rig.spin(2000.0, 1.5, 0.1)
    tail, m, p = slice(-3200, None), rig.params.motor, rig.params
    mean = {name: run[name][tail].mean() for name in ("u_dc", "omega_m", "tau_load_true", "tau_e_true")}
    i_square = np.mean(run["i_alpha_true"][tail] ** 2 + run["i_beta_true"][tail] ** 2)
    omega = mean["omega_m"]
    square = 1.0 + m.L_q**2 * i_square / PSI**2
    iron = (6e-3 + 1e-4 * omega) * omega * square
    friction = (p.mechanics.tau_coulomb + p.mechanics.b * omega) * omega
    supplied = np.mean(run["u_dc"][tail] * (24.0 - run["u_dc"][tail])) / 0.2
    spent = 1.5 * m.R_s * i_square + iron + friction + 0.1 * omega
    assert iron > 5.0
    assert supplied == pytest.approx(spent, rel=0.01)


def test_friction_that_falls_too_steeply_for_a_step_is_refused():
    with pytest.raises(ConfigError, match=r"^mechanics.J must be >= \S+ kg m2 for integration steps"):
        load_params(None, {"mechanics.stribeck": 0.05, "mechanics.omega_stribeck": 0.01})
    assert mechanics.make_params(1e-4, 1e-4, 0.0, 0.0).varies == 0

"""Two inertias on a coupling: against solve_ivp and closed forms, and in the closed loop."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim.config.params import ConfigError, load_params
from sim.plant import coupling, integrator, inverter, mechanics
from tests.sim.drive.rig import RPM, Rig
from tests.sim.plant.test_integrator import T_S, make

J_M, J_L, K, D = 1.2e-4, 0.8e-4, 25.0, 3e-3


def step_through(n, *, load, omega=(0.0, 0.0), ahead=0.0, damping=D, backlash_deg=0.0, **shaft):
    """Speeds and twist after each of `n` steps of a motor without current; (n, 3)."""
    plant, _ = make(J=J_M, **{"b": 0.0, "tau_coulomb": 0.0, **shaft})
    params = coupling.make_params(K, damping, backlash_deg, J_L / (J_M + J_L), 50.0, J_M + J_L, 1.0, 5000.0)
    motor = integrator.init(plant, 0.3)._replace(omega_m=omega[0])
    beyond = coupling.init()._replace(omega=omega[1], ahead=ahead)
    found = []
    for _ in range(n):
        beyond, acts = coupling.middle(params, motor, beyond, T_S)
        motor, _ = integrator.step(plant, motor, inverter.off(), acts, T_S)
        beyond = coupling.end(params, beyond, motor, load, T_S)
        found.append((motor.omega_m, beyond.omega, beyond.ahead))
    return np.array(found)


@pytest.mark.parametrize("backlash_deg", [0.0, 1.0])
def test_agrees_with_solve_ivp(backlash_deg):
    half = math.radians(backlash_deg) / 2.0

    def rates(t, x):
        over = x[2] - np.clip(x[2], -half, half)
        tau = K * over + D * (x[0] - x[1]) if over else 0.0
        tau = tau if tau * over > 0.0 else 0.0
        return [(-0.001 * x[0] - tau) / J_M, tau / J_L, x[0] - x[1]]

    n = 800
    found = step_through(
        n, load=mechanics.Load(mechanics.OFF, 0, 0), omega=(60.0, 50.0), backlash_deg=backlash_deg, b=0.001
    )
    span = np.arange(1, n + 1) * T_S
    exact = solve_ivp(rates, (0.0, span[-1]), [60.0, 50.0, 0.0], t_eval=span, rtol=1e-9, atol=1e-11, max_step=1e-5).y.T
    np.testing.assert_allclose(found[:200, :2], exact[:200, :2], atol=0.12)
    np.testing.assert_allclose(found[:, :2], exact[:, :2], atol=0.5 if backlash_deg else 0.15)
    assert np.ptp(exact[:, 0] - exact[:, 1]) > 10.0


def test_a_brake_holds_the_load_and_never_drives_it():
    brake = mechanics.Load(mechanics.TORQUE, 0.2, 0.0)
    found = step_through(3200, load=brake, omega=(30.0, 30.0), tau_coulomb=2e-3)
    assert abs(found[-1, 1]) == 0.0
    assert found[:, 1].min() > -4.0  # it swings back on its spring, no more
    assert np.abs(found[-100:, 0]).max() < 0.05


def test_a_brakes_torque_comes_with_its_time_constant():
    n, tau = 320, 1.0 / (2.0 * math.pi * 50.0)
    found = step_through(n, load=mechanics.Load(mechanics.TORQUE, 0.2, 0.0), omega=(300.0, 300.0))
    t = np.arange(1, n + 1) * T_S
    lost = 0.2 * (t - tau * (1.0 - np.exp(-t / tau)))  # of the momentum
    momentum = J_M * found[:, 0] + J_L * found[:, 1]
    np.testing.assert_allclose((J_M + J_L) * 300.0 - momentum, lost, atol=0.2 * T_S)


def test_in_the_loop_the_load_machine_takes_its_time_and_the_shaft_winds_up():
    settings = {"coupling.stiffness": 20.0, "coupling.damping": 2e-3, "coupling.bandwidth": 30.0}
    rig, rigid = Rig(0, **settings), Rig(0)
    for each in (rig, rigid):
        each.start()
        each.spin(500.0, 1.0)
    soft, stiff = rig.spin(500.0, 0.8, 0.2), rigid.spin(500.0, 0.8, 0.2)
    torque = soft["tau_load_true"]
    assert stiff["tau_load_true"][1] == pytest.approx(0.2)
    assert np.ptp(torque) > 0.05
    assert torque[-1600:].mean() == pytest.approx(0.2, abs=0.004)
    forced = rig.forced(800.0, 2.0, 1.0)
    assert forced["omega_m"][-1600:].mean() == pytest.approx(800.0 * RPM, rel=0.002)
    assert forced["omega_m"][100] < 0.9 * 800.0 * RPM


def test_a_coupling_too_stiff_for_the_steps_is_refused():
    with pytest.raises(ConfigError, match=r"coupling.stiffness must be <= .* take more clock.substeps"):
        load_params(None, {"coupling.stiffness": 1e5})

"""The DC link against scipy's solve_ivp, and its trips in the closed loop."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from protocol.messages import Fault
from sim.config.params import ConfigError, load_params
from sim.plant import dc_link
from tests.sim.drive.rig import Rig

T_S = 1.0 / 16000.0
U, R, C, R_BRAKE = 24.0, 0.15, 470e-6, 3.3


def reference(u, currents, *, regenerates, braking, i_limit=0.0):
    """The voltage after each period, V: integrated, with the diode as it conducts."""
    found = []

    def rate(t, x, i):
        source = (U - x[0]) / R
        if not regenerates:
            source = max(source, 0.0)
        if i_limit:
            source = min(source, i_limit)
        return [(source - i - (x[0] / R_BRAKE if braking else 0.0)) / C]

    for i in currents:
        u = solve_ivp(rate, (0.0, T_S), [u], "RK45", args=(i,), rtol=1e-9, atol=1e-9, max_step=T_S / 20).y[0, -1]
        found.append(u)
    return np.array(found)


@pytest.mark.parametrize("regenerates", [0, 1])
@pytest.mark.parametrize("braking", [0, 1])
@pytest.mark.parametrize("u", [22.0, 24.0, 31.0])
def test_agrees_with_solve_ivp(regenerates, braking, u):
    params = dc_link.make_params(U, R, C, regenerates, 20.0 if braking else 0.0, R_BRAKE, T_S)
    currents = np.concatenate([np.full(20, 12.0), np.full(20, -6.0), [0.0] * 10, np.linspace(-20.0, 20.0, 60)])
    state, found = dc_link.State(u, braking), []
    for i in currents:
        state = dc_link.step(params, state, float(i))
        found.append(state.u)
    np.testing.assert_allclose(found, reference(u, currents, regenerates=regenerates, braking=braking), atol=2e-5)
    assert min(found) < U - 0.5
    assert regenerates or braking or max(found) > U + 5.0  # cut off: what is fed back stays


@pytest.mark.parametrize("regenerates", [0, 1])
@pytest.mark.parametrize("braking", [0, 1])
@pytest.mark.parametrize("u", [20.0, 23.8, 31.0])
def test_a_source_that_limits_its_current_agrees_with_solve_ivp(regenerates, braking, u):
    """It folds, comes back over the line of its resistance, and is cut off while the link stands above it."""
    limit = 5.0
    params = dc_link.make_params(U, R, C, regenerates, 1e-3 if braking else 0.0, R_BRAKE, T_S, limit)
    currents = np.concatenate([np.full(8, 12.0), np.full(25, -9.0), [0.0] * 10, np.linspace(-8.0, 9.0, 36)])
    state, found = dc_link.State(u, braking), []
    for i in currents:
        state = dc_link.step(params, state, float(i))
        found.append(state.u)
    expected = reference(u, currents, regenerates=regenerates, braking=braking, i_limit=limit)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert min(found) < U - R * limit - 1.0


def test_a_limit_of_a_stiff_link_is_refused():
    with pytest.raises(ConfigError, match=r"^dc_link.i_limit must be 0 where dc_link.R_source = 0, got 3"):
        load_params(None, {"dc_link.i_limit": 3})


def test_the_brake_comes_above_its_voltage_and_goes_half_a_volt_below():
    params = dc_link.make_params(U, R, C, 0, 28.0, R_BRAKE, T_S)
    state = dc_link.State(U, 0)
    came = []
    for _ in range(400):
        before = state
        state = dc_link.step(params, state, -3.0)
        if state.braking != before.braking:
            came.append((before.u, state.braking))
    assert {on for _, on in came} == {0, 1}
    assert all(u > 28.0 if on else u < 27.5 for u, on in came)


STOPPED = {"dc_link.R_source": 0.1, "dc_link.C": 470e-6, "firmware.alpha_m_max": 1e4}


@pytest.mark.parametrize(
    ("more", "trips"),
    [
        ({}, Fault.OVERVOLTAGE),
        ({"dc_link.regenerates": 1}, Fault(0)),
        ({"dc_link.u_brake": 27.0}, Fault(0)),
        ({"dc_link.C": 1.0}, Fault(0)),
    ],
)
def test_a_braking_motor_pumps_the_link_up_until_it_trips_unless_something_takes_it(more, trips):
    rig = Rig(0, **STOPPED | more)
    rig.start()
    rig.spin(2500.0, 1.0)
    assert rig.faults == Fault(0)
    stopping = rig.spin(0.0, 0.3)
    assert rig.faults == trips
    assert (stopping["u_dc"].max() > rig.params.firmware.protection.u_dc_max) == bool(trips)


def test_a_supply_at_its_limit_lets_the_link_fall_until_the_drive_trips():
    """It gives 2 A at 24 V, and the shaft alone takes more as soon as it is fast enough."""
    rig = Rig(0, **{"dc_link.R_source": 0.05, "dc_link.i_limit": 2.0})
    rig.start()
    run = rig.spin(2500.0, 1.0, 0.3)
    assert rig.faults == Fault.UNDERVOLTAGE
    sagging = run["u_dc"] < U - 0.05 * 2.0 - 1.0
    taken = run["tau_e_true"] * run["omega_m"] / run["u_dc"]
    assert taken[sagging][: len(taken[sagging]) // 2].max() > 2.0
    assert taken[run["u_dc"] > U - 0.05].max() < 2.0 * 1.1


def test_a_weak_source_sags_under_load_by_its_resistance():
    rig = Rig(0, **{"dc_link.R_source": 0.5})
    rig.start()
    run = rig.spin(2000.0, 1.5, 0.25)
    tail = slice(-1600, None)
    motor = rig.params.motor
    shaft = np.mean(run["tau_e_true"][tail] * run["omega_m"][tail])
    copper = 1.5 * motor.R_s * np.mean(run["i_alpha_true"][tail] ** 2 + run["i_beta_true"][tail] ** 2)
    u = np.mean(run["u_dc"][tail])
    supplied = u * (24.0 - u) / 0.5
    assert supplied == pytest.approx(shaft + copper, rel=0.02)

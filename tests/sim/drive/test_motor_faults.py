"""A motor whose wires are broken, exchanged or shorted, and a link that is measured wrongly, as the drive sees them."""

import math

import numpy as np
import pytest
from rig import PWM_HZ, Rig, physical
from test_forced_angle import IDEAL, PSI, L, R, force

from protocol.messages import Fault, SetpointMode

PHASES = np.exp(2j * np.pi / 3 * np.arange(3))
LEGS = ("i_a", "i_b", "i_c")


def rotor(held=True, **settings):
    """A drive that gives voltages, on its encoder; its rotor held by the load machine, or free."""
    rig = Rig(3, **IDEAL | {"mechanics.theta_0_deg": 20.0} | settings)
    rig.start()
    if held:
        rig.load_setpoint(SetpointMode.SPEED, 0.0)
    return rig


def measured(run):
    return np.array([physical(run, leg) for leg in LEGS])


# -- the measured link ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gain_error", [-0.03, 0.02])
def test_volts_of_the_drive_are_too_many_by_the_gain_of_its_link(gain_error):
    """It reads u (1 + g), makes duties by that, and a winding of R takes R (1 + g) of its volts for an ampere."""
    rig = rotor(**{"link_sensor.gain_error": gain_error, "current_sensor.bits": 20})
    rig.setpoint(SetpointMode.CURRENT, 0.0, 5.0)
    rig.run(0.2)
    run = rig.run(0.1)
    assert physical(run, "u_dc") == pytest.approx(24.0 * (1.0 + gain_error), abs=6e-4)
    u = np.hypot(physical(run, "u_alpha").mean(), physical(run, "u_beta").mean())
    i = np.hypot(run["i_alpha_true"].mean(), run["i_beta_true"].mean())
    assert u / i == pytest.approx(R * (1.0 + gain_error), rel=1.5e-3)


@pytest.mark.parametrize(
    ("gain_error", "faults"),
    [(0.3, Fault(0)), (0.35, Fault.OVERVOLTAGE), (-0.49, Fault(0)), (-0.5, Fault.UNDERVOLTAGE)],
)
def test_the_drive_trips_by_what_it_measures(gain_error, faults):
    """Limits of 12.1 and 32 V, on a link that has 24 V whatever is measured."""
    limits = {"firmware.protection.u_dc_min": 12.1, "firmware.protection.u_dc_max": 32.0}
    rig = Rig(0, **{"link_sensor.gain_error": gain_error}, **limits)
    rig.enable()
    rig.run(0.01)
    assert rig.faults == faults


# -- broken wires ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("leg", range(3))
def test_a_broken_wire_leaves_two_phases_in_series(leg):
    """Ohm's law with the part of the voltage that is between the two others; nothing where the voltage is along it."""
    rig = rotor(**{"faults.motor.open": 1 << leg, "current_sensor.bits": 20})
    for way in np.arange(6) * math.pi / 3.0:
        theta = 20.0 / 180.0 * math.pi
        u = 1.0 * np.exp(1j * way)
        in_frame = u * np.exp(-1j * theta)
        rig.setpoint(SetpointMode.VOLTAGE, in_frame.imag, in_frame.real)
        rig.run(0.05)
        found = measured(rig.run(0.02)).mean(axis=1)
        across = u - (u * np.conj(PHASES[leg])).real * PHASES[leg]
        expected = (across * np.conj(PHASES)).real / R
        expected[leg] = 0.0
        assert found == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("open_", [3, 5, 6, 7])
def test_with_nothing_connected_nothing_flows(open_):
    rig = rotor(**{"faults.motor.open": open_})
    rig.setpoint(SetpointMode.VOLTAGE, 0.5, 1.5)
    assert np.abs(measured(rig.run(0.1))).max() == 0.0
    assert rig.outputs_on


def test_a_wire_breaks_and_is_mended_while_the_motor_turns():
    rig = Rig(3, **{"firmware.observer": 0, "faults.motor.open": 2, "faults.begin": 0.6, "faults.end": 0.8})
    rig.start()
    whole = rig.spin(600.0, 0.6, 0.05)
    broken = rig.run(0.2)
    mended = rig.run(0.6)
    noise = 5.0 * rig.params.current_sensor.noise_rms
    assert np.abs(physical(whole, "i_b")).max() > 1.0
    assert np.abs(physical(broken, "i_b")[10:-10]).max() < noise
    assert mended["omega_m"][-1600:].mean() == pytest.approx(600.0 * math.tau / 60.0, rel=0.01)
    healthy = Rig(3, **{"firmware.observer": 0})
    healthy.start()
    assert np.array_equal(healthy.spin(600.0, 0.6, 0.05)["i_a"][:-2], whole["i_a"][:-2])


# -- exchanged wires ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("swap", "way", "turned_deg"), [(0, 1, 0), (1, -1, 120), (2, -1, 0), (3, -1, -120),
                                                         (4, 1, 120), (5, 1, -120)])  # fmt: skip
def test_a_dragged_rotor_goes_the_way_that_the_wires_say(swap, way, turned_deg):
    """A leg's axis is the phase's that it is on: the angle is turned by a third of a turn, or mirrored, or both."""
    rig = rotor(held=False, **{"faults.motor.swap": swap, "mechanics.tau_coulomb": 1e-4,
                                "mechanics.b": 1e-3, "mechanics.J": 2e-5})  # fmt: skip
    force(rig, speed=0.0, slope=200.0)
    rig.setpoint(SetpointMode.CURRENT, 0.0, 5.0)
    rig.run(0.5)
    rig.set_param("forced_speed", 60.0)
    run = rig.run(0.8)
    last = slice(-int(0.2 * PWM_HZ), None)
    turned = np.exp(1j * (run["theta_true"] - way * run["theta_ctrl"]))[last]
    assert np.degrees(np.angle(turned.mean())) == pytest.approx(turned_deg, abs=3.0)
    assert run["omega_true"][last].mean() == pytest.approx(way * 60.0, rel=0.02)


def test_sensors_belong_to_the_legs():
    rig = rotor(**{"faults.motor.swap": 4, "current_sensor.gain_error": [0.2, 0.0, 0.0], "current_sensor.bits": 20})
    rig.setpoint(SetpointMode.VOLTAGE, 0.4, 0.6)
    rig.run(0.05)
    run = rig.run(0.02)
    true = np.array([((run["i_alpha_true"] + 1j * run["i_beta_true"]) * np.conj(axis)).real for axis in PHASES])
    a, b, c = measured(run)
    np.testing.assert_allclose([a, b, c], [1.2 * true[1], true[2], true[0]], atol=2e-3)


# -- a short --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("short", [1, 2, 3])
def test_a_short_takes_current_from_two_legs_and_none_from_the_motor(short):
    rig = rotor(**{"faults.motor.short": short, "faults.motor.short_R": 0.2, "current_sensor.bits": 20})
    rig.setpoint(SetpointMode.VOLTAGE, 0.2, 0.3)
    rig.run(0.05)
    run = rig.run(0.02)
    u = physical(run, "u_alpha").mean() + 1j * physical(run, "u_beta").mean()
    legs = (u * np.conj(PHASES)).real
    i = (legs[short - 1] - legs[short % 3]) / 0.2
    more = np.zeros(3)
    more[short - 1], more[short % 3] = i, -i
    assert measured(run).mean(axis=1) == pytest.approx(legs / R + more, abs=0.03)
    assert run["i_alpha_true"].mean() + 1j * run["i_beta_true"].mean() == pytest.approx(u / R, rel=5e-3)


def test_a_hard_short_trips_at_once_and_brakes_the_shaft_when_the_outputs_are_off():
    """Turned by hand it takes torque: 3/2 of the mean of the induced voltage squared over the ring's resistance."""
    rig = rotor(**{"faults.motor.short": 2, "faults.motor.short_R": 0.02})
    rig.setpoint(SetpointMode.VOLTAGE, 1.0, 1.0)
    rig.run(0.02)
    assert rig.faults & Fault.OVERCURRENT
    assert not rig.outputs_on
    omega_m = 20.0
    rig.load_setpoint(SetpointMode.SPEED, omega_m)
    rig.run(0.3)
    turn = rig.run(math.tau / (6 * omega_m))
    R_ring, w = R + 0.01, 6 * omega_m
    expected = -1.5 * 6 * PSI**2 * w * 0.5 * R_ring / (R_ring**2 + (w * L) ** 2)
    assert turn["tau_e_true"].mean() == pytest.approx(expected, rel=0.02)
    rig.set_load_param("faults", 0.0)
    assert np.abs(rig.run(0.1)["tau_e_true"][-160:]).max() < 1e-9

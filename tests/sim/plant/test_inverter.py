"""Phase voltages by duties, and what dead time takes from them."""

import numpy as np
import pytest

from sim.plant import inverter, pmsm

U_DC, T_D, T_S = 24.0, 1e-6, 1.0 / 16000.0
LOST = U_DC * T_D / T_S
PARAMS = inverter.make_params(U_DC, T_D, 0.1, 0.3, 0.8, T_S)
AXES = np.exp(2j * np.pi / 3 * np.arange(3))


def space_vector(phases):
    """Amplitude-invariant vector of three phase quantities."""
    return 2 / 3 * np.dot(phases, AXES)


def test_ideal_voltage_is_the_duties_vector():
    duties = np.array([0.7, 0.4, 0.2])
    out = inverter.apply(PARAMS, *duties)
    assert complex(out.u_alpha, out.u_beta) == pytest.approx(space_vector(duties * U_DC))


def test_dead_time_and_device_oppose_each_phase_current():
    currents = np.array([3.0, -1.0, -2.0])
    i = space_vector(currents)
    out = inverter.apply(PARAMS, 0.5, 0.5, 0.5)
    lost = complex(*inverter.loss(PARAMS, out, i.real, i.imag))
    assert lost == pytest.approx((LOST + 0.1) * space_vector(np.sign(currents)))
    assert pytest.approx(0.384) == LOST


def test_loss_fades_in_proportion_near_zero_current():
    i = space_vector(np.array([0.03, -0.015, -0.015]))
    lost = complex(*inverter.loss(PARAMS, inverter.apply(PARAMS, 0.5, 0.5, 0.5), i.real, i.imag))
    assert lost == pytest.approx((LOST + 0.1) * i / 0.3)
    assert inverter.loss(PARAMS, inverter.apply(PARAMS, 0.5, 0.5, 0.5), 0.0, 0.0) == (0.0, 0.0)


def test_leg_that_does_not_switch_loses_no_dead_time():
    out = inverter.apply(PARAMS, 1.2, 0.5, -0.1)
    assert (out.e_a, out.e_b, out.e_c) == pytest.approx((0.1, LOST + 0.1, 0.1))
    assert complex(out.u_alpha, out.u_beta) == pytest.approx(space_vector(np.array([24.0, 12.0, 0.0])))


def test_freewheeling_current_runs_down_and_stays_zero():
    motor = pmsm.make_params(0.158, 176e-6, 176e-6, 6.55e-3, 6)
    i = inverter.freewheel(PARAMS, motor, 3.0, -4.0, 20e-6)
    assert np.hypot(*i) == pytest.approx(5.0 - 20e-6 * 12.8 / 176e-6)
    assert i[1] / i[0] == pytest.approx(-4.0 / 3.0)
    assert inverter.freewheel(PARAMS, motor, 3.0, -4.0, 1e-3) == (0.0, 0.0)
    assert inverter.freewheel(PARAMS, motor, 0.0, 0.0, 1e-3) == (0.0, 0.0)

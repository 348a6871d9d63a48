"""The loop around a winding that is discretised exactly, with the drive's one period of delay."""

import math

import numpy as np
import pytest

from sim.control import current_loop

T_S = 1 / 16_000
R_S, L_S, PSI_F = 0.158, 0.176e-3, 6.55e-3
FIRMWARE = {"bw_current": 800.0, "R_s_hat": R_S, "L_s_hat": L_S, "psi_f_hat": PSI_F}


def winding(u, i, omega):
    """One period of L di/dt = u - (R + j omega L) i - j omega psi with u constant in the rotor frame, exactly."""
    pole = R_S / L_S + 1j * omega
    settled = (u - 1j * omega * PSI_F) / (R_S + 1j * omega * L_S)
    return settled + (i - settled) * np.exp(-pole * T_S)


def close(reference, periods, *, omega=0.0, u_max=13.8, delay=1, firmware=FIRMWARE):
    """Currents at each sample (complex d + j q) and voltages; `reference(k)` complex."""
    params = current_loop.make_params(16_000, **firmware)
    state = current_loop.init()
    i = 0j
    queue = [1j * omega * PSI_F] * delay
    currents, voltages = [], []
    for k in range(periods):
        ref = reference(k)
        state, u_d, u_q, _ = current_loop.step(params, state, ref.real, ref.imag, i.real, i.imag, omega, u_max)
        currents.append(i)
        voltages.append(complex(u_d, u_q))
        queue.append(complex(u_d, u_q))
        i = winding(queue.pop(0), i, omega)
    return np.array(currents), np.array(voltages)


def test_without_delay_it_is_the_first_order_low_pass_of_internal_model_control():
    slow = {**FIRMWARE, "bw_current": 80.0}  # slow against the sampling: the continuous answer
    i, _ = close(lambda k: 2j, 400, delay=0, firmware=slow)
    t = np.arange(400) * T_S
    np.testing.assert_allclose(i.imag, 2 * (1 - np.exp(-2 * math.pi * 80 * t)), atol=0.04)


@pytest.mark.parametrize("omega", [0.0, 314.0, -1885.0, 1885.0])
def test_axes_are_decoupled_and_the_error_vanishes(omega):
    i, _ = close(lambda k: 4j, 400, omega=omega)
    assert np.abs(i.real[40:]).max() < 0.06 * 4
    assert abs(i[-1] - 4j) < 0.01


def test_wrong_parameters_leave_no_lasting_error():
    wrong = {**FIRMWARE, "R_s_hat": 1.3 * R_S, "L_s_hat": 0.8 * L_S, "psi_f_hat": 0.9 * PSI_F}
    i, _ = close(lambda k: 1 + 4j, 1600, omega=628.0, firmware=wrong)
    assert abs(i[-1] - (1 + 4j)) < 0.01


def test_the_voltage_keeps_to_its_limit_and_the_integral_does_not_wind_up():
    u_max = 3.0
    # far out of reach for 50 ms, then a reference that is not
    i, u = close(lambda k: 60j if k < 800 else 2j, 1200, u_max=u_max)
    assert np.abs(u).max() <= u_max * (1 + 1e-12)
    assert abs(u[700]) == pytest.approx(u_max)
    assert i.imag[700] == pytest.approx(u_max / R_S, rel=0.02)
    after = i.imag[800:]
    assert after.min() > 2 - 0.08 * 17  # the overshoot of any step, here of 17 A, and no more
    assert np.abs(after[120:] - 2).max() < 0.05


def test_the_limited_voltage_keeps_its_direction():
    _, free = close(lambda k: 30 + 40j, 1, u_max=1e3)
    _, held = close(lambda k: 30 + 40j, 1, u_max=1.0)
    assert held[0] / abs(held[0]) == pytest.approx(free[0] / abs(free[0]))
    assert abs(held[0]) == pytest.approx(1.0)


def test_no_voltage_at_all_is_allowed():
    _, u = close(lambda k: 1j, 3, u_max=0.0)
    assert np.abs(u).max() == 0


@pytest.mark.parametrize(("u_max", "limited"), [(100.0, False), (3.0, True)])
def test_what_anti_windup_takes_back_is_told_in_amperes(u_max, limited):
    """The integral is that of the errors less what is told, by its gain, at the limit too."""
    params = current_loop.make_params(16_000, **FIRMWARE)
    state, took_in, told = current_loop.init(), 0.0, 0.0
    rng = np.random.default_rng(1)
    for _ in range(400):
        i_d, i_q = rng.normal(0.0, 0.5), 2.0 + rng.normal(0.0, 0.5)
        state, u_d, u_q, back = current_loop.step(params, state, 0.0, 4.0, i_d, i_q, 700.0, u_max)
        assert (back != 0.0) == (math.hypot(u_d, u_q) > u_max - 1e-9)
        took_in += 4.0 - i_q - back
        told += abs(back)
    assert (told > 100.0) == limited
    assert state.u_q_i == pytest.approx(2.0 * math.pi * 800.0 * R_S / 16_000 * took_in, rel=1e-9)

import numpy as np
import pytest

from sim.control import speed_loop

T_S = 1 / 16_000
GAINS = {"k_p_speed": 0.3, "k_i_speed": 4.0, "i_max": 8.0, "alpha_m_max": 1000.0}
J, K_T = 2e-4, 0.05895


def params(**changes):
    return speed_loop.make_params(16_000, **{**GAINS, **changes})


def shaft(p, target, seconds, tau_load=0.0, omega=0.0):
    """Closed loop around an ideal shaft; target and load functions of time or numbers."""
    state = speed_loop.init(omega, 0.0)
    n = round(seconds / T_S)
    record = np.empty((n, 3))
    for k in range(n):
        t = k * T_S
        state, i_q = speed_loop.step(p, state, target(t) if callable(target) else target, omega)
        record[k] = omega, i_q, state.omega_m_ref
        load = tau_load(t) if callable(tau_load) else tau_load
        omega += T_S * (K_T * i_q - load) / J
    return record


def test_the_reference_moves_at_its_largest_slope_and_no_faster():
    record = shaft(params(), 50.0, 0.1)
    slope = np.diff(record[:, 2]) / T_S
    np.testing.assert_allclose(slope[:700], 1000.0)
    assert record[-1, 2] == 50.0


def test_a_ramp_is_followed_without_a_lasting_error():
    record = shaft(params(), 50.0, 1.0, tau_load=0.1)
    assert record[-1, 0] == pytest.approx(50.0, abs=0.1)
    assert record[-1, 1] == pytest.approx(0.1 / K_T, rel=0.01)
    assert record[:, 0].max() < 1.15 * 50


def test_a_small_step_answers_as_the_characteristic_polynomial_says():
    """J s² + K_T k_p s + K_T k_i: the error to a step of load torque, in closed form."""
    record = shaft(params(), 0.0, 0.6, tau_load=lambda t: 0.1 if t >= 0.01 else 0.0)
    p1, p2 = np.roots([J, K_T * GAINS["k_p_speed"], K_T * GAINS["k_i_speed"]])
    t = np.maximum(np.arange(record.shape[0]) * T_S - 0.01, 0)
    expected = -0.1 / J * (np.exp(p1 * t) - np.exp(p2 * t)) / (p1 - p2)
    np.testing.assert_allclose(record[:, 0], expected.real, atol=0.03 * np.abs(expected).max())


def test_the_output_keeps_to_the_largest_current_and_does_not_wind_up():
    fast = params(alpha_m_max=1e5)
    record = shaft(fast, 100.0, 1.0)
    assert np.abs(record[:, 1]).max() == 8.0
    assert (np.abs(record[:, 1]) == 8.0).mean() > 0.03  # it did saturate
    assert record[:, 0].max() < 110
    stalled = speed_loop.init(0.0, 0.0)
    for _ in range(16_000):  # a second against a locked shaft
        stalled, i_q = speed_loop.step(fast, stalled, 100.0, 0.0)
    assert i_q == 8.0
    stalled, i_q = speed_loop.step(fast, stalled, 100.0, 130.0)
    assert i_q < 8.0  # released at once


def test_it_takes_over_without_a_bump():
    _, i_q = speed_loop.step(params(), speed_loop.init(52.0, 3.0), 52.0, 52.0)
    assert i_q == pytest.approx(3.0)

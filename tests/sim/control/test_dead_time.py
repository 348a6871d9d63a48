import numpy as np
import pytest

from sim.control import dead_time

PARAMS = dead_time.make_params(16_000, dead_time_hat=1e-6, dead_time_comp=1.0, L_s_hat=0.176e-3)


def added(current, params=PARAMS):
    return dead_time.compensate(params, 0.5, 0.5, 0.5, current, -current, 0.0)


def test_full_current_gets_back_what_the_dead_time_takes():
    """1 us in 62.5 us of 24 V is 0.384 V, against the current's sign."""
    d_a, d_b, d_c = added(4.0)
    assert (d_a - 0.5) * 24 == pytest.approx(0.384)
    assert (d_b - 0.5) * 24 == pytest.approx(-0.384)
    assert d_c == 0.5


def test_it_fades_smoothly_through_zero_current():
    currents = np.linspace(-1, 1, 401)
    gain = np.array([added(i)[0] - 0.5 for i in currents])
    assert np.all(np.diff(gain) >= 0)
    np.testing.assert_allclose(gain, -gain[::-1], atol=1e-15)
    assert np.diff(gain).max() <= 0.016 * (currents[1] - currents[0]) / 0.3 * 1.001


def test_the_share_scales_and_zero_switches_it_off():
    part = dead_time.make_params(16_000, dead_time_hat=1e-6, dead_time_comp=0.9, L_s_hat=0.176e-3)
    none = dead_time.make_params(16_000, dead_time_hat=1e-6, dead_time_comp=0.0, L_s_hat=0.176e-3)
    assert added(4.0, part)[0] - 0.5 == pytest.approx(0.9 * (added(4.0)[0] - 0.5))
    assert added(4.0, none) == (0.5, 0.5, 0.5)


def test_duties_stay_within_0_and_1():
    assert dead_time.compensate(PARAMS, 0.999, 0.001, 0.5, 5.0, -5.0, 0.0) == (1.0, 0.0, 0.5)


def test_it_fades_where_the_ripple_does():
    """Twice the inductance, half the ripple, half the current."""
    smooth = dead_time.make_params(16_000, dead_time_hat=1e-6, dead_time_comp=1.0, L_s_hat=0.352e-3)
    assert added(0.05, smooth)[0] == pytest.approx(added(0.1)[0])
    assert added(0.15, smooth)[0] == pytest.approx(added(4.0)[0])
    assert added(0.15)[0] < added(4.0)[0]

import numpy as np
import pytest
from ideal_motor import PAPER_EDGES, PWM_HZ, TICK_HZ, constant, error_deg, rpm, samples, signals, track

from sim.observers import sector_centre

PARAMS = sector_centre.make_params(PWM_HZ, sector_centre.Settings())


def expected_error(edges_deg):
    """Mean, std and largest error over a turn at constant speed, of sectors held at 60 s + 30 deg: exact (deg)."""
    begin = np.asarray(edges_deg) - (60.0 * np.arange(6) + 30.0)
    end = np.r_[edges_deg[1:], 360.0 + edges_deg[0]] - (60.0 * np.arange(6) + 30.0)
    mean = np.sum(end**2 - begin**2) / 2 / 360
    square = np.sum(end**3 - begin**3) / 3 / 360
    return mean, np.sqrt(square - mean**2), max(np.abs(begin).max(), np.abs(end).max())


@pytest.mark.parametrize("speed", [50.0, 500.0, 3000.0, -50.0, -500.0, -3000.0])
@pytest.mark.parametrize("edges_deg", [np.arange(6) * 60.0, PAPER_EDGES], ids=["ideal", "table I"])
def test_a_sawtooth_over_each_sector(speed, edges_deg):
    omega = rpm(speed)
    turn = 2 * np.pi / abs(omega)
    s = signals(constant(omega), 41.7 * turn, edges_deg=edges_deg)
    out = track(sector_centre, PARAMS, s)
    whole = s.tick < 40 * turn * TICK_HZ
    error = error_deg(s.theta, out.theta)[whole]
    mean, std, largest = expected_error(edges_deg)
    a_period = np.degrees(abs(omega)) / PWM_HZ
    assert error.mean() == pytest.approx(mean, abs=0.02 + 0.2 * a_period)
    assert error.std() == pytest.approx(std, abs=0.02 + 0.05 * a_period)
    assert largest - 1.01 * a_period < np.abs(error).max() < largest + 1e-6
    assert np.array_equal(out.omega, samples(s).hall.omega)


def test_no_angle_before_a_legal_code_and_none_lost_by_a_gap():
    s = signals(constant(rpm(50), np.radians(70)), 0.02)
    hall = s.hall.copy()
    hall[:3] = 7
    reset = np.zeros(hall.size, bool)
    reset[100] = True
    out = track(sector_centre, PARAMS, s._replace(hall=hall), reset)
    assert set(out.theta[:3]) == {0.0}
    np.testing.assert_allclose(out.theta[3:], np.pi / 2, rtol=1e-12)

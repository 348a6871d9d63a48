import numpy as np
import pytest
from ideal_motor import PAPER_EDGES, TICK_HZ, constant, error_deg, rpm, samples, signals


@pytest.mark.parametrize("speed", [50.0, 500.0, 3000.0, -50.0, -500.0, -3000.0])
def test_exact_at_constant_speed_with_well_placed_sensors(speed):
    omega = rpm(speed)
    s = signals(constant(omega), 2.5 * 2 * np.pi / abs(omega))
    settled = s.tick >= s.edge_tick[1]
    tick_deg = np.degrees(abs(omega)) / TICK_HZ
    assert np.abs(error_deg(s.theta, samples(s).theta_avg))[settled].max() < 3 * tick_deg


def expected_error(edges_deg, points=600):
    """Error of (1)-(2) over a turn at constant speed, by sector arithmetic alone (deg)."""
    opened = np.asarray(edges_deg)
    width = np.diff(np.r_[opened, 360 + opened[0]])
    error = []
    for s in range(6):
        passed = np.arange(points) / points * width[s]
        travel = np.minimum(passed * 60 / width[s - 1], 60)
        error.append((opened[s] + passed) - (60 * s + travel))
    weight = np.repeat(width / points, points)
    error = np.concatenate(error)
    mean = np.average(error, weights=weight)
    return mean, np.sqrt(np.average((error - mean) ** 2, weights=weight)), np.abs(error).max()


@pytest.mark.parametrize("speed", [50.0, 500.0, 1000.0])
def test_error_with_the_sensors_of_table_i(speed):
    omega = rpm(speed)
    s = signals(constant(omega), max(1.0, 5 * 2 * np.pi / omega), edges_deg=PAPER_EDGES)
    turns = int(s.theta[-1] / (2 * np.pi)) - 1
    whole = (s.theta >= 2 * np.pi) & (s.theta < 2 * np.pi * turns)
    error = error_deg(s.theta, samples(s).theta_avg)[whole]
    mean, std, largest = expected_error(PAPER_EDGES)
    assert std == pytest.approx(7.3, abs=0.1)
    assert largest == pytest.approx(17.4, abs=0.1)
    assert error.mean() == pytest.approx(mean, abs=0.1)
    assert error.std() == pytest.approx(std, abs=0.1)
    assert np.abs(error).max() == pytest.approx(largest, abs=0.3)

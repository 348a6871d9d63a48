import numpy as np
import pytest
from ideal_motor import T_S, constant, error_deg, estimate, rpm, signals
from test_hall_vector import component, loop

from sim.observers import hall_vector, hall_vector_decoupled


def settled(s, out):
    return error_deg(s.theta, out.theta)[s.tick.size // 2 :]


@pytest.mark.parametrize("speed", [200.0, 500.0, 1000.0, -500.0])
def test_the_ripple_of_ideal_sensors_is_gone(speed):
    """The sixth and twelfth harmonics altogether; what is left begins with the eighteenth, as computed."""
    s = signals(constant(rpm(speed)), 2.0)
    plain, out = estimate(hall_vector, s), estimate(hall_vector_decoupled, s)
    assert abs(component(s, out, 6, 1.0)) < 0.04 * abs(component(s, plain, 6, 1.0))
    assert abs(component(s, out, 12, 1.0)) < 0.1 * abs(component(s, plain, 12, 1.0))
    # of the ripple at 18 theta the loop makes this, and the swing of the decoupled loop's gain does not reach it
    expected = np.degrees((1 / 17 + 1 / 19) * abs(loop(18 * rpm(speed))))
    assert abs(component(s, out, 18, 1.0)) == pytest.approx(expected, rel=0.1)
    a_period = np.degrees(abs(rpm(speed))) * T_S
    assert abs(settled(s, out).mean()) < 0.02 + 0.2 * a_period
    assert 4 < settled(s, plain).std() / settled(s, out).std() < 10

"""Why sgn() of (9) must not see the corrected speed, which reaches +-k_p = +-1268 rad/s: 2018 r/min.

Where the correction outweighs the speed the sign flips with it, and what should brake the estimate drives it on. The
estimate can then stand still against the rotor where the two cancel, |sin(error)| = omega / k_p, on the far side.
"""

import numpy as np
import pytest
from ideal_motor import DRIVE, PWM_HZ, T_S, error_deg, rpm
from test_vector_tracking import locked


def errors(speed, ahead_deg, literal):
    """Two seconds at constant speed from an estimate `ahead_deg` too far."""
    t = np.arange(2 * PWM_HZ) * T_S
    omega = rpm(speed)
    sign = int(np.sign(speed))
    start = np.radians(ahead_deg) * sign
    out = locked(omega, omega * t, start=start, direction=sign, literal_sgn=float(literal))
    return error_deg((omega * t)[1:], out.theta)


@pytest.mark.parametrize("speed", [200.0, 500.0, -500.0, 1000.0, 1500.0, 1900.0])
def test_the_printed_form_locks_falsely_for_good_below_2000_rpm(speed):
    literal = errors(speed, 120.0, True)[-PWM_HZ:]
    lock = 180 - np.degrees(np.arcsin(abs(rpm(speed)) / DRIVE["k_p_vt"]))
    assert literal.mean() == pytest.approx(-np.sign(speed) * lock, abs=5.0)
    assert literal.std() < 4
    assert np.abs(errors(speed, 120.0, False)[-PWM_HZ:]).max() < 0.1


def test_above_that_speed_the_printed_form_finds_back():
    assert np.abs(errors(2100.0, 120.0, True)[-PWM_HZ:]).max() < 0.1

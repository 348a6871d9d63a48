import math

import numpy as np
import pytest
from ideal_motor import (
    N_P,
    PWM_HZ,
    T_S,
    constant,
    error_deg,
    estimate,
    rpm,
    signals,
)

from sim.observers import hall_vector

J = 2e-4
BW = 10.0
W = 2 * math.pi * BW


def loop(omega, w=W):
    """Angle of the estimate by angle of the Hall vector at the frequency `omega`: three poles at `w`."""
    s = 1j * np.asarray(omega)
    return (3 * w * s**2 + 3 * w**2 * s + w**3) / (s + w) ** 3


def component(s, out, harmonic, seconds):
    """Complex amplitude (deg) of a harmonic of the rotor's angle in the error, over the last whole turns."""
    speed = (s.theta[-1] - s.theta[0]) / (s.tick.size - 1)
    n = round(int(seconds * PWM_HZ * abs(speed) / (2 * np.pi)) * 2 * np.pi / abs(speed))
    return 2 * np.mean(error_deg(out.theta, s.theta)[-n:] * np.exp(-1j * harmonic * s.theta[-n:]))


@pytest.mark.parametrize(
    ("speed", "bw"), [(500.0, BW), (1000.0, BW), (3000.0, BW), (-500.0, BW), (-3000.0, BW), (500.0, 5.0)]
)
def test_ripple_at_constant_speed(speed, bw):
    """With ideal sensors: no mean, and the sixth harmonic of the Hall vector through the loop."""
    omega = rpm(speed)
    s = signals(constant(omega), 1.0)
    out = estimate(hall_vector, s, bw_hall_vector=bw)
    error = error_deg(s.theta, out.theta)[PWM_HZ // 2 :]
    a_period = np.degrees(abs(omega)) * T_S
    assert abs(error.mean()) < 0.02 + 0.2 * a_period  # codes are sampled: the sectors' edges are that coarse
    expected = np.degrees(12 / 35 * abs(loop(6 * omega, 2 * math.pi * bw)))
    assert abs(component(s, out, 6, 0.5)) == pytest.approx(expected, rel=0.04)
    assert out.omega[-PWM_HZ // 2 :].mean() == pytest.approx(omega, rel=1e-3)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_step_of_the_load_is_found(sign):
    """The rotor is accelerated by 0.15 N m and no current: the peak of the error, its end, the torque with its sign."""
    a = sign * 0.15 * N_P / J
    start = 0.5
    s = signals(lambda t: 0.3 + rpm(2000) * t + a / 2 * np.maximum(t - start, 0) ** 2, 0.65, i_q=0.0)
    out = estimate(hall_vector, s)
    later = slice(round(start * PWM_HZ), None)
    error = sign * error_deg(s.theta, out.theta)[later]
    assert error.max() == pytest.approx(np.degrees(abs(a) * 2 * math.exp(-2) / W**2), rel=0.15)
    assert np.argmax(error) == pytest.approx(2 / W * PWM_HZ, rel=0.3)
    assert np.abs(error[-PWM_HZ // 50 :]).max() < 2.0
    assert out.tau_load[-PWM_HZ // 50 :].mean() == pytest.approx(-sign * 0.15, rel=0.05)

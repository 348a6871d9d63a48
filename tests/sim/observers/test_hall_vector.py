import math

import numpy as np
import pytest
from ideal_motor import (
    N_P,
    PSI_F,
    PWM_HZ,
    T_S,
    constant,
    error_deg,
    estimate,
    ramp,
    rpm,
    sectors,
    signals,
)

from sim.observers import hall_vector

J = 2e-4
BW = 10.0
W = 2 * math.pi * BW
PER_AMPERE = 1.5 * N_P**2 * PSI_F / J  # rad/s2 of electrical acceleration


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
def test_no_lag_while_the_current_accelerates_the_rotor(sign):
    """4 A from 500 r/min on: what the model knows it follows, with half the inertia it lags as computed."""
    a = sign * 4 * PER_AMPERE
    omega = sign * rpm(500)
    start = 0.5
    angle = ramp((0, omega), (start, omega), (0.6, omega + 0.1 * a))
    t = np.arange(round(0.6 * PWM_HZ)) * T_S
    s = signals(angle, 0.6, i_q=np.where(t >= start, sign * 4.0, 0.0))
    later = slice(round(start * PWM_HZ), None)
    ripple = np.degrees(12 / 35 * abs(loop(6 * omega)))
    out = estimate(hall_vector, s)
    assert np.abs(error_deg(s.theta, out.theta))[later].max() < 1.7 * ripple
    assert abs(out.tau_load[-1]) < 0.03
    for wrong, share in ((2.0, 0.5), (0.8, -0.25)):
        error = sign * error_deg(s.theta, estimate(hall_vector, s, J_hat=wrong * J).theta)[later]
        peak = np.degrees(share * abs(a) * 2 * math.exp(-2) / W**2)
        assert error[np.argmax(np.abs(error))] == pytest.approx(peak, abs=2.0 + 0.1 * abs(peak))


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


def test_a_load_too_big_for_the_loop_is_caught_up_with():
    """0.8 N m at once throw the estimate to the clamp; it comes back by itself."""
    a = 0.8 * N_P / J
    s = signals(
        lambda t: 0.3 + rpm(2000) * t - a / 2 * np.clip(t - 0.3, 0, 0.03) ** 2 - a * 0.03 * np.maximum(t - 0.33, 0),
        1.3,
        i_q=0.0,
        fine=10,
    )
    assert s.theta[-1] - s.theta[-2] > rpm(200) * T_S
    out = estimate(hall_vector, s)
    centre = np.radians(60 * sectors(s.theta) + 30)
    away = np.abs(error_deg(centre, out.theta))
    beyond = away > 60 + 1e-9  # more than 30 deg outside the sector
    assert beyond.any()
    assert not (beyond[1:] & beyond[:-1]).any()
    assert np.abs(error_deg(s.theta, out.theta))[-1600:].max() < 4.0

"""What dead time takes, by the currents at the legs' edges, beside a switched inverter in the same current loop."""

import itertools
import math

import numba
import numpy as np
import pytest

from sim.plant import dead_time, pmsm
from tests.sim.plant.switched import advance, harmonics, run, switching

T = 1.0 / 16000.0
U_DC, U_DIODE = 24.0, 0.8
MOTORS = {  # ohm, H, V s, pole pairs
    "paper": ((0.158, 176e-6, 6.55e-3), 6),
    "four pole pairs": ((0.35, 600e-6, 10.5e-3), 4),
    "seven pole pairs": ((0.12, 90e-6, 4.2e-3), 7),
}


@numba.njit(error_model="numpy")
def modelled(i, t, period, duty, w, R, L, psi, u_dc, dead, u_diode, mean):
    """A period by the model: its mean voltages, and the currents after it."""
    motor = pmsm.Params(R, 1.0 / L, 0.0, psi, 1.0, 1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
    legs = dead_time.Params(period, dead, u_dc, u_diode)
    beta = (i[1] - i[2]) / math.sqrt(3.0)
    u_alpha, u_beta = dead_time.mean_voltage(
        legs, motor, duty[0], duty[1], duty[2], i[0], beta, math.cos(w * t), math.sin(w * t), w
    )
    mean[0], mean[1], mean[2] = pmsm.phases(u_alpha, u_beta)
    advance(i, mean, t, period, w, R, L, psi)


def lost(model, motor, dead, rpm, i_q, u_diode=U_DIODE):
    """Fundamental and 5th harmonic (V) of phase a's lost voltage in steady state; fundamental of its current (A)."""
    constants, n_p = MOTORS[motor]
    w = rpm * math.tau / 60.0 * n_p
    settled = round(0.1 / T)
    n = settled + round((1 if rpm < 100 else 6) * math.tau / w / T)
    errors, where, currents = np.empty((n, 3)), np.empty(n), np.empty((n, 3))
    run(model, n, constants, (U_DC, dead, u_diode, T), w, i_q, errors, where, currents)
    volts = harmonics(errors[settled:, 0], where[settled:], (1, 5, 7, 11, 13))
    amperes = harmonics(currents[settled:, 0], where[settled:] - 0.5 * w * T, (1, 5, 7))
    return volts[1], volts[5], amperes[1]


def test_agrees_with_a_switched_inverter():
    """Three motors, three dead times, all in one test: the oracle takes its time to compile."""
    for motor, dead in itertools.product(MOTORS, (0.5e-6, 1e-6, 2e-6)):
        textbook = 4.0 / math.pi * U_DC * dead / T
        seen = 0
        for rpm, i_q in itertools.product((20, 100, 500, 1000, 2000, 3000), (0.5, 1.0, 4.0, 8.0)):
            first, fifth, current = lost(switching, motor, dead, rpm, i_q)
            if abs(abs(current) - i_q) > 0.02 * i_q:
                continue  # the link's voltage does not do
            model_first, model_fifth, _ = lost(modelled, motor, dead, rpm, i_q)
            assert abs(model_first - first) <= 0.012 * textbook, (motor, dead, rpm, i_q)
            assert abs(model_fifth - fifth) <= 0.006 * textbook, (motor, dead, rpm, i_q)  # 3 mV with 1 us
            seen += 1
        assert seen >= 20


def test_the_switched_inverter_has_the_textbook_error_far_from_zero_current():
    first, fifth, current = lost(switching, "paper", 1e-6, 100, 20.0, u_diode=0.0)
    textbook = 4.0 / math.pi * U_DC * 1e-6 / T
    assert -first / abs(first) == pytest.approx(current / abs(current), abs=0.01)
    assert abs(first) == pytest.approx(textbook, rel=3e-4)
    assert abs(fifth) == pytest.approx(textbook / 5.0, rel=5e-3)


@pytest.mark.parametrize("i_0", [(0.05, -0.02, -0.03), (-0.3, 0.1, 0.2), (2.0, -1.5, -0.5), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("duty", [(0.5, 0.5, 0.5), (0.52, 0.5, 0.48), (0.9, 0.4, 0.1)])
def test_the_switched_inverter_beside_small_steps(i_0, duty):
    """The oracle's own oracle: a leg's gates by the clock, its diodes by its current, 2 ns at a time."""
    (R, L, psi), w, dead = MOTORS["paper"][0], 600.0, 1e-6
    i, mean = np.array(i_0), np.zeros(3)
    switching(i, 0.0, T, np.array(duty), w, R, L, psi, U_DC, dead, U_DIODE, mean)
    stepped, volts = in_small_steps(np.array(i_0), np.array(duty), w, R, L, psi, dead, 2e-9)
    np.testing.assert_allclose(i, stepped, atol=3e-3)
    np.testing.assert_allclose(mean - mean.mean(), volts - volts.mean(), atol=8e-3)


@numba.njit
def in_small_steps(i, duty, w, R, L, psi, dead, h):
    """Currents (A) after a period, and the legs' mean voltages (V)."""
    total = np.zeros(3)
    n = round(T / h)
    v, e, on = np.zeros(3), np.zeros(3), np.zeros(3)
    for m in range(n):
        t = (m + 0.5) * h
        for k in range(3):
            rise, fall = 0.5 * T * (1.0 - duty[k]), 0.5 * T * (1.0 + duty[k])
            e[k] = -w * psi * math.sin(w * t - k * math.tau / 3.0) + R * i[k]
            on[k] = 1.0
            if rise + dead <= t < fall:
                v[k] = U_DC
            elif t < rise or t >= fall + dead:
                v[k] = 0.0
            elif abs(i[k]) > 1.5 * U_DC / L * h:
                v[k] = -U_DIODE if i[k] > 0.0 else U_DC + U_DIODE
            else:
                i[k], on[k] = 0.0, 0.0
        star = np.sum(on * (v - e)) / max(1.0, np.sum(on)) if np.sum(on) else 0.5 * U_DC
        for k in range(3):
            if on[k] == 0.0:
                v[k] = min(max(star + e[k], -U_DIODE), U_DC + U_DIODE)
        star = np.sum(on * (v - e)) / max(1.0, np.sum(on))
        for k in range(3):
            if on[k] == 1.0:
                i[k] += h / L * (v[k] - e[k] - star)
        i -= on * np.sum(i) / max(1.0, np.sum(on))
        total += v * h / T
    return i, total

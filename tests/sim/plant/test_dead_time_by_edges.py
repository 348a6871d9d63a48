"""What dead time takes, by the currents at the legs' edges, beside a switched inverter."""

import math

import numba
import numpy as np
import pytest

from sim.plant import dead_time, pmsm
from tests.sim.plant import switched
from tests.sim.plant.switched import MOTORS, U_DC, U_DIODE, harmonics, switching
from tests.sim.plant.switched import PERIOD as T

ORDERS = (1, -5, 7, -11)


def modelled(motor, dead, w, theta, i, duties):
    """The voltages (V) that phases a and b lose in a period, by the model."""
    (R, L, psi), _ = motor
    params = pmsm.Params(R, 1.0 / L, 0.0, psi, 1.0, 1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
    beta, begin = (i[0] + 2.0 * i[1]) / math.sqrt(3.0), theta - 0.5 * w * T
    legs = dead_time.Params(T, dead, U_DC, U_DIODE)
    currents = pmsm.phases(i[0], beta)
    u = dead_time.mean_voltage(legs, params, tuple(duties), currents, math.cos(begin), math.sin(begin), w)
    return np.array(pmsm.phases(*u)[:2]) - U_DC * (np.array(duties) - np.mean(duties))[:2]


def test_agrees_with_a_switched_inverter():
    """Fundamental and 5th harmonic of the lost voltage, in the periods that the oracle went through."""
    periods = np.load(switched.FILE)["periods"].astype(float).reshape(-1, switched.KEPT, 12)
    seen = np.zeros(len(MOTORS), int)
    for turn in periods:
        number, dead, rpm, _ = turn[0, :4]
        motor = MOTORS[int(number)]
        w = rpm * math.tau / 60.0 * motor[1]
        losses = [modelled(motor, float(dead), w, row[4], row[5:7], row[7:10].tolist()) for row in turn]
        wrong = np.array(losses) - turn[:, 10:]
        vector = wrong[:, 0] + 1j / math.sqrt(3.0) * (wrong[:, 0] + 2.0 * wrong[:, 1])
        waves = np.exp(1j * np.outer(turn[:, 4], ORDERS))
        first, fifth, *_ = np.abs(np.linalg.lstsq(waves, vector, rcond=None)[0]) / (4.0 / math.pi * U_DC * dead / T)
        assert first <= 0.012, turn[0, :4]
        assert fifth <= 0.01, turn[0, :4]  # 5 mV with 1 us
        seen[int(number)] += 1
    assert seen.min() >= 60


@pytest.mark.campaign("oracles")
def test_the_file_holds_what_the_switched_inverter_makes():
    np.testing.assert_allclose(np.load(switched.FILE)["periods"], switched.kept(), rtol=1e-5, atol=1e-5)


@pytest.mark.campaign("oracles")
def test_the_switched_inverter_has_the_textbook_error_far_from_zero_current():
    lost, where, currents, _ = switched.steady(MOTORS[0], 1e-6, 100, 20.0, u_diode=0.0)
    volts = harmonics(lost[:, 0], where, (1, 5, 7, 11, 13))
    current = harmonics(currents[:, 0], where - 0.5 * 100 * math.tau / 60.0 * 6 * T, (1, 5, 7))[1]
    textbook = 4.0 / math.pi * U_DC * 1e-6 / T
    assert -volts[1] / abs(volts[1]) == pytest.approx(current / abs(current), abs=0.01)
    assert abs(volts[1]) == pytest.approx(textbook, rel=3e-4)
    assert abs(volts[5]) == pytest.approx(textbook / 5.0, rel=5e-3)


@pytest.mark.campaign("oracles")
@pytest.mark.parametrize("i_0", [(0.05, -0.02, -0.03), (-0.3, 0.1, 0.2), (2.0, -1.5, -0.5), (0.0, 0.0, 0.0)])
@pytest.mark.parametrize("duty", [(0.5, 0.5, 0.5), (0.52, 0.5, 0.48), (0.9, 0.4, 0.1)])
def test_the_switched_inverter_beside_small_steps(i_0, duty):
    """The oracle's own oracle: a leg's gates by the clock, its diodes by its current, 2 ns at a time."""
    (R, L, psi), w, dead = MOTORS[0][0], 600.0, 1e-6
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

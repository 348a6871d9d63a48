"""What dead time takes, by the currents at the legs' edges, beside the legs in small steps, diode by diode."""

import math
from itertools import product

import numpy as np
import pytest

from sim.plant import dead_time, pmsm
from tests.choice import sampled

T, U_DC, U_DIODE = 1.0 / 16000.0, 24.0, 0.8  # s, V
MOTORS = ((0.158, 176e-6, 6.55e-3), (0.35, 600e-6, 10.5e-3), (0.12, 90e-6, 4.2e-3))  # R_s, L_s, psi_f; ohm, H, V s
POINTS = product(MOTORS, (0.5e-6, 1e-6, 2e-6), (0.005, 0.02, 0.1, 0.2, 0.4, 0.65), (0.5, 1.0, 4.0, 8.0))
"""Motor, dead time (s), back-EMF as a share of the largest voltage, current (A)."""
ORDERS = (1, -5, 7, -11)
STEPS = 40  # from one switching to the next
AXES = np.exp(2j * np.pi / 3 * np.arange(3))


def phases(vector):
    """Of complex vectors (n,), shape (n, 3)."""
    return (vector[:, None] * AXES.conj()).real


def in_small_steps(motor, dead, w, theta, i, duties):
    """The legs' mean voltages (V), what they have in common taken off, (n, 3), in periods that begin so.

    A leg in its dead time follows its current through a diode; without one it floats until its voltage reaches a rail.
    """
    R, L, psi = motor
    rise, fall = 0.5 * T * (1.0 - duties), 0.5 * T * (1.0 + duties)
    ends = (rise, np.minimum(rise + dead, fall), fall, np.minimum(fall + dead, T))
    times = np.sort(np.concatenate([np.zeros((len(i), 1)), *ends, np.full((len(i), 1), T)], axis=1))
    total = np.zeros_like(i)
    for begin, end in zip(times.T[:-1], times.T[1:], strict=True):
        h = ((end - begin) / STEPS)[:, None]
        for step in range(STEPS):
            t = begin[:, None] + (step + 0.5) * h
            behind = phases(1j * w * psi * np.exp(1j * (theta + w * t[:, 0]))) + R * i
            high, low = (t >= ends[1]) & (t < ends[2]), (t < ends[0]) | (t >= ends[3])
            diode = ~high & ~low
            v = np.where(high, U_DC, np.where(low, 0.0, np.where(i > 0.0, -U_DIODE, U_DC + U_DIODE)))
            on = ~diode | (i != 0.0)
            n = on.sum(axis=1, keepdims=True)
            star = np.where(n > 0, (on * (v - behind)).sum(axis=1, keepdims=True) / np.maximum(n, 1), 0.5 * U_DC)
            floating = np.clip(star + behind, -U_DIODE, U_DC + U_DIODE)
            v = np.where(on, v, floating)
            on |= floating != star + behind  # its diode takes up a current
            star = (on * (v - behind)).sum(axis=1, keepdims=True) / np.maximum(on.sum(axis=1, keepdims=True), 1)
            after = i + on * h / L * (v - behind - star)
            i = np.where(diode & (i * after < 0.0), 0.0, after)
            total += v * h / T
    return total - total.mean(axis=1, keepdims=True)


def modelled(motor, dead, w, theta, i, duties):
    """The same by the model."""
    R, L, psi = motor
    params = pmsm.make_params(R, L, L, psi, 1)
    legs = dead_time.Params(T, dead, U_DC, U_DIODE)
    return np.array(
        [
            pmsm.phases(*dead_time.mean_voltage(legs, params, tuple(d), tuple(now), math.cos(at), math.sin(at), w))
            for at, now, d in zip(theta, i.tolist(), duties.tolist(), strict=True)
        ]
    )


@pytest.mark.parametrize(("motor", "dead", "emf", "i_q"), sampled("dead time", POINTS, 24, campaign="oracles"))
def test_agrees_with_small_steps_in_fundamental_and_fifth_harmonic(motor, dead, emf, i_q):
    R, L, psi = motor
    w = emf * U_DC / math.sqrt(3.0) / psi
    theta = 0.1 + np.arange(41) * math.tau / 41  # where a period begins
    i = 1j * i_q * np.exp(1j * theta)
    wanted = phases(((R + 1j * w * L) * i + 1j * w * psi * np.exp(1j * theta)) * np.exp(0.5j * w * T))
    duties = 0.5 + (wanted - 0.5 * (wanted.max(axis=1) + wanted.min(axis=1))[:, None]) / U_DC
    found = modelled(motor, dead, w, theta, phases(i), duties)
    textbook = 4.0 / math.pi * U_DC * dead / T
    wrong = 2.0 / 3.0 * (found - in_small_steps(motor, dead, w, theta, phases(i), duties)) @ AXES / textbook
    waves = np.exp(1j * np.outer(theta, ORDERS))
    first, fifth, *_ = np.abs(np.linalg.lstsq(waves, wrong, rcond=None)[0])
    assert first <= 0.008
    assert fifth <= 0.008  # 4 mV with 1 us
    assert np.abs(wrong).max() <= 0.15

"""Harmonics of the back-EMF in the rotor's frame, and the torque that currents make with them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.commission.analysis.harmonics import NONE, ORDERS, Harmonics, harmonics
from bench.commission.analysis.mechanics import mechanics
from bench.commission.quantity import Quantity
from tests.bench.commission.turning_motor import Bench, Drive, along_d, drawn, known_flux
from tests.choice import commit

SWING = 8e-3
"""Share of the flux that swings six times a turn: d its cosine, q half of its sine."""


def turned(seed: int) -> tuple[Bench, float, float]:
    rng = np.random.default_rng([seed, int(commit(), 36) % 2**32])
    motor, i_max, top = drawn(rng, harmonic=SWING)
    drive = Drive(1.0 / 12000.0, noise=0.003 * i_max, ahead=0.01, encoder_delay=1e-6)
    return Bench(motor, drive, rng), i_max, top


def test_harmonics_are_the_derivative_of_the_flux_that_swings() -> None:
    """psi h (cos 6 x + j/2 sin 6 x) has j h (21/4 e^6jx - 5/4 e^-6jx) as its derivative in the frame that turns."""
    bench, i_max, top = turned(0)
    windows = along_d(bench, 0.5 * i_max, top)
    told = harmonics(windows, known_flux(bench), bench.motor.R, bench.motor.L_q)
    want = {6: 5.25j * SWING, -6: -1.25j * SWING}
    for order, share in zip(ORDERS, told.share, strict=True):
        assert share == pytest.approx(want.get(int(order), 0.0), abs=0.35 * SWING), order
    blind = [replace(window, theta=None) for window in windows]
    assert harmonics(blind, known_flux(bench), bench.motor.R, bench.motor.L_q) is NONE


def test_a_torque_is_the_power_of_three_phases_over_the_speed() -> None:
    theta = np.linspace(0.0, math.tau, 700)
    of = Harmonics(np.array([0.003j, 0.04 - 0.01j, -0.02j, 0.002]))
    i = (0.3 + 0.1 * np.cos(6.0 * theta)) + 1j * (2.0 - 0.2 * np.sin(6.0 * theta))
    e = 1j + sum(share * np.exp(1j * order * theta) for share, order in zip(of.share, ORDERS, strict=True))
    phase = np.exp(-1j * math.tau / 3.0 * np.arange(3))[:, None]
    of_phases = [np.real(vector * np.exp(1j * theta) * phase) for vector in (e, i)]
    assert of.torque_current(theta, i) == pytest.approx((of_phases[0] * of_phases[1]).sum(axis=0) / 1.5)
    assert NONE.torque_current(theta, i) == pytest.approx(i.imag)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_inertia_is_not_taken_for_less_by_currents_of_harmonics(seed: int) -> None:
    bench, i_max, top = turned(seed)
    m = bench.motor
    windows = along_d(bench, 0.5 * i_max, top)
    for way in (1.0, -1.0):
        bench.w = way * 0.02 * top
        windows += [bench.turned_by(0.35j * way * i_max, 4.0, top), bench.coast(0.8, 0.15 * top)]
    R, L_q = Quantity("R_s", "ohm", m.R, {"noise": 1e-3 * m.R}), Quantity("L_q", "H", m.L_q, {"noise": 3e-3 * m.L_q})
    found = mechanics(windows, known_flux(bench), R, L_q, m.n_p)
    assert found.J.value == pytest.approx(m.J, rel=2e-3)
    assert found.J.covers(m.J)

"""Flux, inductances, zero and delay at speed, against motors solved by scipy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.commission.analysis.back_emf import flux_by_back_emf
from bench.commission.analysis.flux import compensated, flux, rows
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Window
from tests.bench.commission.stated_intervals import inside, relative_errors, scores
from tests.bench.commission.turning_motor import Bench, Drive, Motor, along_d, drawn, noisy
from tests.choice import commit

DRAWS = 40
EXACT = 1e-6


def known(motor: Motor, error: float = 0.0, rng: np.random.Generator | None = None) -> tuple[Quantity, Quantity]:
    """R and L_q as a step at rest would have them, wrong by `error` rms of themselves."""
    wrong = np.zeros(2) if rng is None else error * rng.standard_normal(2)
    return (
        Quantity("R_s", "ohm", motor.R * (1.0 + wrong[0]), {"noise": max(error, EXACT) * motor.R}),
        Quantity("L_q", "H", motor.L_q * (1.0 + wrong[1]), {"noise": max(error, EXACT) * motor.L_q}),
    )


def draw(seed: int, **more: float) -> tuple[Bench, list[Window], float]:
    rng = np.random.default_rng([seed, int(commit(), 36) % 2**32])
    motor, i_max, top = drawn(rng)
    drive = Drive(
        1.0 / 8000.0, noise=0.004 * i_max, U=float(rng.uniform(0.0, 0.3)),
        ahead=float(rng.normal(0.0, 0.03)), encoder_delay=float(rng.uniform(0.0, 3e-6)),
    )  # fmt: skip
    bench = Bench(motor, replace(drive, **more), rng, theta=float(rng.uniform(0.0, 50.0)))
    return bench, along_d(bench, 0.5 * i_max, top), i_max


@pytest.fixture(scope="module")
def draws() -> list[tuple[Bench, list[Window], float]]:
    return [draw(seed) for seed in range(DRAWS)]


def test_the_stated_intervals_hold_over_motors(draws: list[tuple[Bench, list[Window], float]]) -> None:
    found, truth = [], []
    for bench, windows, _ in draws:
        R, L_q = known(bench.motor, 2e-3, bench.rng)
        found.append(flux(windows, R, L_q, encoder_zero=0.3))
        truth.append((bench.motor, bench.drive))
    motors, drives = zip(*truth, strict=True)
    psi, L_d = [each.psi for each in found], [each.L_d for each in found]
    inside(psi, [motor.psi for motor in motors])
    inside(L_d, [motor.L_d for motor in motors])
    inside([each.zero for each in found], [0.3 - drive.ahead for drive in drives])
    inside([each.delay for each in found], [drive.encoder_delay for drive in drives])
    off = np.abs(relative_errors(psi, [motor.psi for motor in motors]))
    assert np.median(off) < 3e-4
    assert off.max() < 4e-3
    assert np.median(np.abs(relative_errors(L_d, [motor.L_d for motor in motors]))) < 1e-2
    zero = np.array([each.ahead - drive.ahead for each, drive in zip(found, drives, strict=True)])
    assert np.abs(zero).max() < math.radians(0.05)


def test_what_is_stated_as_noise_is_the_scatter_that_noise_makes() -> None:
    """The same bench, with other noise each time, and no other error."""
    rng = np.random.default_rng(3)
    motor, i_max, top = drawn(np.random.default_rng(5))
    bench = Bench(motor, Drive(1 / 8000, counts=2_000_000, ahead=0.02), rng)
    windows = along_d(bench, 0.5 * i_max, top)
    found = [flux(noisy(windows, 0.05 * i_max, rng), *known(motor)) for _ in range(60)]
    for name, truth in (("psi", motor.psi), ("L_d", motor.L_d)):
        z = scores([getattr(each, name) for each in found], [truth] * len(found), "noise")
        assert 0.5 < math.sqrt(float(np.mean(z**2))) < 1.6, name


@pytest.mark.parametrize("degrees", [-8.0, -2.0, 0.0, 3.0, 8.0])
def test_psi_does_not_depend_on_how_far_the_rough_zero_is_off(degrees: float) -> None:
    bench, windows, _ = draw(1, ahead=math.radians(degrees))
    found = flux(windows, *known(bench.motor))
    assert found.psi.value == pytest.approx(bench.motor.psi, rel=1e-3)
    assert math.degrees(found.ahead) == pytest.approx(degrees, abs=0.03)


def test_the_encoder_zero_is_told_as_the_parameter_that_puts_it_right() -> None:
    bench, windows, _ = draw(2, ahead=0.05)
    found = flux(windows, *known(bench.motor), encoder_zero=-3.13)
    assert found.zero.value == pytest.approx(-3.13 - 0.05 + math.tau, abs=1e-3)


def test_dead_time_is_along_the_current_and_not_in_psi() -> None:
    told = []
    for U in (0.0, 0.4):
        bench, windows, i_max = draw(3, U=U)
        told.append(flux(windows, *known(bench.motor)))
    assert told[1].psi.value == pytest.approx(told[0].psi.value, rel=3e-4)
    assert told[1].along - told[0].along == pytest.approx(4.0 / math.pi * 0.4 / (0.5 * i_max), rel=0.03)


def test_late_currents_are_in_psi_by_the_formula_and_are_put_right() -> None:
    late = 2e-6
    bench, windows, _ = draw(4, late=late, U=0.0, encoder_delay=2e-6)
    motor, (R, L_q) = bench.motor, known(bench.motor)
    found = flux(windows, R, L_q)
    assert found.psi.value / motor.psi - 1.0 == pytest.approx(motor.R * late / motor.L_q, abs=2e-4)
    right = compensated(found, R, L_q, Quantity("current_delay", "s", late, {"noise": 1e-7}))
    assert right.psi.value == pytest.approx(motor.psi, rel=5e-4)
    assert right.psi.sd > found.psi.sd * right.psi.value / found.psi.value
    assert right.delay.value == pytest.approx(2e-6, abs=4e-7)


def test_L_q_under_torque(draws: list[tuple[Bench, list[Window], float]]) -> None:
    found, truth = [], []
    for bench, before, i_max in draws[:5]:
        windows = list(before)
        top = abs(2.0 * float(np.diff(np.unwrap(windows[0].theta)).mean()) / bench.drive.T) / 2.0
        for way in (1.0, -1.0):
            bench.w = way * 0.8 * top
            windows += [bench.hold("q", 0.5j * way * i_max, 0.05)]
        told = flux(windows, *known(bench.motor)).L_q
        assert told is not None
        found.append(told)
        truth.append(bench.motor.L_q)
    assert all(each.covers(value) for each, value in zip(found, truth, strict=True))
    assert np.abs(relative_errors(found, truth)).max() < 0.03


def lost(window: Window, U: float) -> np.ndarray:
    """V, that a dead time takes along the current in the mean of a turn, and that a drive which knows it puts back."""
    return 4.0 / math.pi * U * window.current / np.abs(window.current)


def test_without_an_encoder_psi_is_the_same(draws: list[tuple[Bench, list[Window], float]]) -> None:
    found, truth = [], []
    for bench, windows, _ in draws:
        blind = [replace(window, theta=None, u=window.u - lost(window, bench.drive.U)) for window in windows]
        R, L_q = known(bench.motor, 2e-3, bench.rng)
        given = Quantity("current_delay", "s", 0.0, {"noise": 1e-7})
        found.append(flux_by_back_emf(blind, R, L_q, given))
        truth.append(bench.motor.psi)
    inside(found, truth)
    assert np.median(np.abs(relative_errors(found, truth))) < 1e-3


def test_without_an_encoder_a_lateness_that_nobody_knows_widens_the_interval() -> None:
    bench, windows, _ = draw(7, U=0.0, late=1e-6)
    R, L_q = known(bench.motor)
    unknown = flux_by_back_emf(windows, R, L_q)
    assert unknown.covers(bench.motor.psi)
    assert unknown.parts["late currents"] > 0.3e-6 * R.value / L_q.value * unknown.value


def test_one_way_alone_is_refused_and_so_is_a_rotor_that_stands() -> None:
    bench, windows, _ = draw(8)
    R, L_q = known(bench.motor)
    half = windows[: len(windows) // 2]
    with pytest.raises(Refused, match="one way only"):
        flux(half, R, L_q)
    with pytest.raises(Refused, match="0 steady parts"):
        flux([], R, L_q)
    with pytest.raises(Refused, match=r"\d+ steady parts with a current along .* and 0 against"):
        flux([window for window in windows if window.kind == "d+"], R, L_q)
    still = [replace(w, i=np.repeat(w.i[:, :1], len(w), 1), u=np.full(len(w), R.value * w.current[0])) for w in windows]
    with pytest.raises(Refused, match="turns with the rotor"):
        flux_by_back_emf(still, R, L_q)


def test_parts_in_which_the_current_changes_do_not_count() -> None:
    """A step of the current within a window, as of a loop that saturates, is left out, and psi is right without it."""
    bench, windows, i_max = draw(9)
    spoilt = []
    for k, window in enumerate(windows):
        if k % 4 == 0:
            n = len(window)
            wrong = np.where(np.arange(n) > 0.7 * n, 0.3 * i_max, 0.0) * np.exp(1j * window.control)
            phases = np.real(wrong[None, :] * np.exp(-1j * math.tau / 3.0 * np.arange(3)[:, None]))
            window = replace(window, i=window.i + phases)
        spoilt.append(window)
    assert flux(spoilt, *known(bench.motor)).psi.value == pytest.approx(bench.motor.psi, rel=1e-3)


def test_sensors_offsets_do_not_make_a_steady_current_unsteady() -> None:
    """A loop keeps what its sensors show: what they are off by turns in the frame of the rotor. A jump is a jump."""
    rng = np.random.default_rng(5)
    _, windows, i_max = draw(5, noise=0.0)
    turn = math.tau / float(np.abs(rows(windows, 0.1, ("d+", "d-")).w).max())
    steady = lambda of: len(rows(of, 0.1, ("d+", "d-"), seconds=turn).w)  # noqa: E731
    usual = steady(windows)
    assert usual > 5
    for size in (0.01, 0.03, 0.06):
        off = size * i_max * np.array([0.67, -1.0, 0.33])[rng.permutation(3), None]
        assert steady([replace(w, i=w.i + off) for w in windows]) == usual, size
    jumping = [replace(w, i=w.i * np.where(np.arange(len(w)) // 200 % 2, 0.9, 1.1)) for w in windows]
    assert steady(jumping) < usual

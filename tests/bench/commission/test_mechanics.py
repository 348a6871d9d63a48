"""Inertia and friction by driven and coasting runs, against motors solved by scipy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bench.commission.analysis.mechanics import Mechanics, mechanics
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Window
from tests.bench.commission.stated_intervals import inside, relative_errors, scores
from tests.bench.commission.turning_motor import Bench, Drive, Motor, drawn, known_flux
from tests.choice import commit

DRAWS = 40
Change = Callable[[Motor, float, float], Motor]


def as_it_is(motor: Motor, i_max: float, top: float) -> Motor:
    return motor


def draw(seed: int, change: Change = as_it_is, laps: int = 1, **more: float) -> tuple[Bench, list[Window]]:
    """A bench driven up by a q current and coasting, both ways."""
    rng = np.random.default_rng([seed, int(commit(), 36) % 2**32])
    motor, i_max, top = drawn(rng)
    motor = change(motor, i_max, top)
    drive = Drive(
        1.0 / 8000.0, noise=0.004 * i_max, U=0.1, ahead=float(rng.normal(0.0, 0.01)),
        encoder_delay=float(rng.uniform(0.0, 2e-6)),
    )  # fmt: skip
    bench = Bench(motor, replace(drive, **more), rng, theta=float(rng.uniform(0.0, 50.0)))
    windows = []
    for way in (1.0, -1.0):
        for _ in range(laps):
            bench.w = way * 0.02 * top
            windows.append(bench.turned_by(0.35j * way * i_max, 4.0, top))
            windows.append(bench.coast(0.8, 0.15 * top))
    return bench, windows


def seen(bench: Bench, windows: list[Window], psi_wrong: float = 0.0) -> Mechanics:
    """With flux, angle and winding as they are; psi wrong by a share, as late currents make it."""
    m = bench.motor
    found = known_flux(bench, psi_wrong)
    R = Quantity("R_s", "ohm", m.R, {"noise": 1e-3 * m.R})
    L_q = Quantity("L_q", "H", m.L_q, {"noise": 3e-3 * m.L_q})
    return mechanics(windows, found, R, L_q, m.n_p)


def friction(found: Mechanics) -> Quantity:
    assert found.friction is not None, found.refused
    return found.friction


def test_the_stated_intervals_hold_over_motors() -> None:
    found, motors = [], []
    for seed in range(DRAWS):
        bench, windows = draw(seed)
        found.append(seen(bench, windows))
        motors.append(bench.motor)
    J, b, dry = [each.J for each in found], [each.b for each in found], [friction(each) for each in found]
    inside(J, [motor.J for motor in motors])
    inside(b, [motor.b for motor in motors])
    inside(dry, [motor.up for motor in motors])
    inside([each.late for each in found], [0.0] * DRAWS)
    assert np.abs(relative_errors(J, [motor.J for motor in motors])).max() < 5e-3
    assert np.median(np.abs(relative_errors(b, [motor.b for motor in motors]))) < 0.02
    assert np.median(np.abs(relative_errors(dry, [motor.up for motor in motors]))) < 0.01
    z = scores(b, [motor.b for motor in motors], "noise")
    assert 0.3 < math.sqrt(float(np.mean(z**2))) < 2.0
    assert np.median([each.half_width / motor.J for each, motor in zip(J, motors, strict=True)]) < 0.012


def unkind(motor: Motor, i_max: float, top: float) -> Motor:
    torque = 1.5 * motor.n_p * motor.psi * i_max
    return replace(motor, cogging=0.02 * torque, cogging_order=2 * motor.n_p)


def bent(motor: Motor, i_max: float, top: float) -> Motor:
    return replace(motor, stribeck=0.5)


def light(motor: Motor, i_max: float, top: float) -> Motor:
    return replace(unkind(motor, i_max, top), J=0.4 * motor.J, up=0.4 * motor.up, down=0.4 * motor.down)


@pytest.mark.parametrize("change", [unkind, bent, light])
def test_intervals_hold_for_motors_that_are_not_as_the_equations_have_them(change: Change) -> None:
    found, motors = [], []
    for seed in range(3):
        bench, windows = draw(100 + seed, change)
        found.append(seen(bench, windows))
        motors.append(bench.motor)
    inside([each.J for each in found], [motor.J for motor in motors])
    inside([each.b for each in found], [motor.b for motor in motors])
    inside([friction(each) for each in found], [motor.up for motor in motors])


def test_iron_loss_is_friction_that_goes_with_the_speed() -> None:
    def lossy(motor: Motor, i_max: float, top: float) -> Motor:
        return replace(motor, R_fe=motor.psi * top / (0.02 * i_max))

    found, truth = [], []
    for seed in range(6):
        bench, windows = draw(200 + seed, lossy)
        found.append(seen(bench, windows).b)
        m = bench.motor
        truth.append(m.b + 1.5 * m.n_p**2 * m.psi**2 / m.R_fe)
    inside(found, truth)
    assert np.abs(relative_errors(found, truth)).max() < 0.06


def test_late_currents_are_told_from_friction_by_coasting() -> None:
    found, truth, psi = [], [], []
    for seed, late in enumerate((0.0, 0.5e-6, 1e-6, 1.5e-6, 2e-6, 3e-6)):
        bench, windows = draw(300 + seed, late=late)
        m = bench.motor
        by = m.R * late / m.L_q
        told = seen(bench, windows, psi_wrong=by)
        found.append(told.late)
        truth.append(late)
        psi.append(told.flux.psi.value / m.psi - 1.0)
        assert told.b.covers(m.b)
    inside(found, truth)
    assert np.abs([each.value - late for each, late in zip(found, truth, strict=True)]).max() < 2.5e-6
    assert np.abs(psi).max() < 4e-3


def test_what_takes_more_with_the_outputs_on_widens_b() -> None:
    """Losses that are there only while the drive switches look like currents that are sampled early."""
    bench, windows = draw(400)
    m = bench.motor
    k_t = 1.5 * m.n_p * m.psi
    spoilt = []
    for window in windows:
        if window.kind == "up":
            w = np.gradient(np.unwrap(window.theta)) / window.T
            w = np.convolve(w, np.ones(400) / 400.0, "same")
            more = 1j * (2.0 * m.b * w / m.n_p / k_t) * np.exp(1j * (window.theta - bench.drive.ahead))
            phases = np.real(more[None, :] * np.exp(-1j * math.tau / 3.0 * np.arange(3)[:, None]))
            window = replace(window, i=window.i + phases)
        spoilt.append(window)
    told, before = seen(bench, spoilt), seen(bench, windows)
    assert told.b.parts["iron loss"] == pytest.approx(2.0 * m.b, rel=0.3)
    assert told.late.value == 0.0
    assert before.b.parts["iron loss"] < 0.5 * m.b
    assert told.J.value == pytest.approx(m.J, rel=0.01)


def test_a_load_that_acts_one_way_does_not_become_inertia_and_friction_is_refused() -> None:
    def hanging(motor: Motor, i_max: float, top: float) -> Motor:
        return replace(motor, up=2.6 * motor.up, down=0.4 * motor.down)

    found, truth = [], []
    for seed in range(4):
        bench, windows = draw(500 + seed, hanging)
        told = seen(bench, windows)
        assert told.friction is None
        assert "something acts one way" in str(told.refused[0])
        assert told.J.covers(bench.motor.J)
        found += told.each_way
        truth += [bench.motor.up, bench.motor.down]
    inside(found, truth)
    off = np.array([each.value - value for each, value in zip(found, truth, strict=True)])
    assert np.all(np.abs(off) < 0.1 * np.repeat(np.mean(np.reshape(truth, (-1, 2)), axis=1), 2))


def test_a_run_that_is_too_short_is_refused_with_what_to_do() -> None:
    bench, windows = draw(600)
    with pytest.raises(Refused, match=r"coasting; 4 are needed: accelerate with less torque, and let it coast longer"):
        seen(bench, [window for window in windows if window.kind != "off"])
    short = [
        replace(w, theta=w.theta[:100], i=w.i[:, :100], u=w.u[:100], control=w.control[:100], index=w.index[:100])
        for w in windows
    ]
    with pytest.raises(Refused, match="0 and 0 moments driven"):
        seen(bench, short)


def test_windows_with_a_d_current_do_not_enter() -> None:
    bench, windows = draw(700)
    before = seen(bench, windows)
    bench.w = 400.0
    with_d = [*windows, bench.hold("d+", 2.0 + 0j, 0.1)]
    assert seen(bench, with_d).J.value == pytest.approx(before.J.value, rel=1e-4)  # but for harmonics that noise makes

"""The shaft's angle and speed through its Hall edges, against a rotor solved by scipy; what else is known of a fit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.commission.analysis import by_edges
from bench.commission.analysis.dragged import rough_flux
from bench.commission.analysis.edges import HallEdges, quantities
from bench.commission.least_squares import fit
from bench.commission.quantity import Quantity
from bench.commission.window import Edges, Window
from bench.signal.position import wrap
from tests.bench.commission.test_commission_edges import draw
from tests.bench.commission.turning_motor import Bench

SIXTH = math.pi / 3.0


def known(bench: Bench) -> HallEdges:
    """The edges as the bench has them, the mean of the pole pairs."""
    drive = bench.drive
    ideal, mean = drive.ring + SIXTH * np.arange(6), drive.places.mean(axis=1)
    half = 0.5 * drive.hysteresis
    places = {"up": (ideal + mean + half).tolist(), "down": (ideal + mean - half).tolist()}
    up, down = quantities(places, drive.ring, [{"noise": 1e-4}] * 12)
    delay = Quantity("hall_delay", "s", drive.hall_delay, {"noise": 1e-7})
    return HallEdges(Quantity("hall_offset", "rad", drive.ring, {"noise": 1e-4}), up, down, delay)


@pytest.mark.parametrize("seed", range(4))
def test_the_angle_through_the_edges_is_that_of_the_shaft(seed: int) -> None:
    """Pole pairs that differ by half a degree, jitter and hysteresis included; between edges and beyond the outer ones.

    The encoder of this bench is ahead, and its angle late.
    """
    bench, windows, _ = draw(60 + seed, encoder_delay=0.0)
    places = known(bench)
    for window in windows:
        found = by_edges.with_angle(replace(window, theta=None), places)
        assert found.theta is not None
        assert window.theta is not None
        off = np.degrees(wrap(found.theta - window.theta + bench.drive.ahead))
        first, last = np.searchsorted(window.index, window.edges.index[[6, -7]])
        assert np.sqrt(np.mean(off[first:last] ** 2)) < 1.5
        assert np.abs(off).max() < 45.0  # a line for an acceleration, in the first sector and the last
        assert abs(off[first:last].mean()) < 0.3


@pytest.mark.parametrize("seed", range(4))
def test_the_speed_is_told_within_a_turn_and_falls_when_edges_stop(seed: int) -> None:
    bench, windows, _ = draw(70 + seed)
    places = known(bench)
    for window in windows:
        edges, T = window.edges, window.T
        for at in np.linspace(12, len(edges) - 2, 10).astype(int):
            seen = edges.index <= edges.index[at]
            recent = Edges(edges.old[seen], edges.new[seen], edges.index[seen] - edges.index[at], edges.count[seen])
            w, gone = by_edges.speed(recent, places, T)
            since = edges.index[at - 6]
            span = (window.index >= since) & (window.index <= edges.index[at])
            angle = np.unwrap(np.asarray(window.theta))[span]
            true = (angle[-1] - angle[0]) / (T * (len(angle) - 1))
            assert w == pytest.approx(true, rel=0.03)
            assert gone < 0.1
            later = replace(recent, index=recent.index - 0.3 / T)
            slow, gone = by_edges.speed(later, places, T)
            assert abs(slow) <= 1.51 * SIXTH / 0.3
            assert slow * w > 0.0
            assert gone == pytest.approx(abs(w) * 0.3, rel=0.5)
    few = Edges(*(each[:1] for each in (edges.old, edges.new, edges.index, edges.count)))
    assert by_edges.speed(few, places, T) == (0.0, 0.0)


def test_edges_that_come_in_no_order_are_left_out() -> None:
    bench, windows, _ = draw(80)
    window = windows[0]
    new = window.edges.new.copy()
    new[20] = 0
    broken = replace(window, edges=replace(window.edges, new=new))
    with_all, with_fewer = (by_edges.with_angle(replace(w, theta=None), known(bench)) for w in (window, broken))
    off = wrap(np.asarray(with_fewer.theta) - np.asarray(with_all.theta))
    assert 0.0 < np.abs(off).max() < 0.2
    none = replace(window, theta=None, edges=Edges(*(each[:1] for each in vars(window.edges).values())))
    assert by_edges.with_angle(none, known(bench)).theta is None


@pytest.mark.parametrize("w", [10.0, -25.0])
def test_the_flux_is_roughly_told_by_what_turns_with_a_dragged_rotor(w: float) -> None:
    T, n, current, R, L, psi, dead = 1e-4, 20_000, 3.0, 0.4, 3e-4, 6e-3, 0.3
    angle = w * T * np.arange(n)
    turn = np.exp(1j * angle)
    u = (R * current + dead + 1j * w * (psi + L * current)) * turn
    zeros = np.zeros(n)
    window = Window(
        T, np.zeros((3, n)), u, zeros, None, wrap(angle), np.arange(n), zeros.astype(bool), kind="forced",
        i_ref=complex(current),
    )  # fmt: skip
    assert rough_flux([window], L, current) == pytest.approx(psi, rel=1e-3)
    assert rough_flux([replace(window, u=0.0 * u)], L, current) == 0.0


def test_what_else_is_known_of_a_coefficient_counts_as_an_equation_of_its_own() -> None:
    rng = np.random.default_rng(3)
    A = rng.standard_normal((40, 3))
    y = A @ [1.0, -2.0, 0.5] + 0.1 * rng.standard_normal(40)
    told = fit(A, y)
    scatter = math.sqrt(float(told.residuals @ told.residuals) / 37)
    value, sd = 0.7, 0.02
    more = np.linalg.lstsq(
        np.vstack([A, [0.0, 0.0, scatter / sd]]), np.append(y, value * scatter / sd), rcond=None
    )[0]  # fmt: skip
    assert told.inflation() == 1.0
    found = told.informed(2, value, sd)
    assert found.x == pytest.approx(more, rel=1e-9)
    assert found.sd[2] == pytest.approx(1.0 / math.hypot(1.0 / told.sd[2], 1.0 / sd), rel=1e-9)
    assert np.all(found.sd <= told.sd)

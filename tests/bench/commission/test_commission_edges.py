"""Hall edges at speed by an encoder and by the back-EMF, against edges that were put there."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.commission.analysis.edges import HallEdges, edges_by_back_emf, hall_edges
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Window
from bench.signal.position import wrapped
from tests.bench.commission.stated_intervals import inside
from tests.bench.commission.turning_motor import Bench, Drive, along_d, drawn, known_flux
from tests.choice import commit

COUNTS = 14400


def draw(seed: int, gaps: bool = False, **more: float) -> tuple[Bench, list[Window], float]:
    """Driven up and coasting, both ways, with edges of each pole pair at places of their own."""
    rng = np.random.default_rng([seed, int(commit(), 36) % 2**32])
    motor, i_max, top = drawn(rng)
    places = np.radians(rng.uniform(-8.0, 8.0, (6, 1)) + rng.normal(0.0, 0.5, (6, motor.n_p)))
    drive = Drive(
        1.0 / 8000.0, ahead=float(rng.normal(0.0, 0.02)), encoder_delay=float(rng.uniform(0.0, 2e-6)), places=places,
        ring=float(rng.uniform(-math.pi, math.pi)), hysteresis=math.radians(float(rng.uniform(0.3, 2.0))),
        hall_delay=float(rng.uniform(0.0, 2e-5)), jitter=math.radians(0.1),
    )  # fmt: skip
    bench = Bench(motor, replace(drive, **more), rng, theta=float(rng.uniform(0.0, 50.0)))
    windows = []
    for way in (1.0, -1.0):
        bench.w = way * 0.05 * top
        windows += [bench.turned_by(0.35j * way * i_max, 4.0, top), bench.coast(0.4, 0.2 * top)]
        if gaps:
            bench.period += 1234
            bench.theta += math.tau * float(rng.integers(0, 20))
    return bench, windows, i_max


def truth(bench: Bench) -> tuple[list[float], list[float]]:
    """Ideal minus actual angle of each edge, forward and in reverse, the mean of the pole pairs, from the ring on."""
    mean, half = bench.drive.places.mean(axis=1), 0.5 * bench.drive.hysteresis
    return (-mean - half).tolist(), (-mean + half).tolist()


def both(found: HallEdges, ring: float) -> list[Quantity]:
    """The edges, from that ring on."""
    moved = ring - found.ring.value
    return [replace(each, value=wrapped(each.value + moved)) for each in (*found.up, *found.down)]


def test_the_stated_intervals_hold_over_benches() -> None:
    found, want, delays, late = [], [], [], []
    for seed in range(10):
        bench, windows, _ = draw(seed)
        told = hall_edges(windows, known_flux(bench), bench.motor.n_p, COUNTS)
        edges = both(told, bench.drive.ring)
        assert [each.name for each in edges] == [f"edge_{way}_{k}" for way in ("up", "down") for k in range(1, 7)]
        found += edges
        want += [value for way in truth(bench) for value in way]
        assert told.delay is not None
        delays.append(told.delay)
        late.append(bench.drive.hall_delay)
    inside(found, want, alike=12)
    inside(delays, late)
    off = np.degrees([each.value - value for each, value in zip(found, want, strict=True)])
    assert np.abs(off).max() < 0.15
    assert np.median([math.degrees(each.half_width) for each in found]) < 0.15
    z = np.array([each.value - value for each, value in zip(found, want, strict=True)])
    z /= [each.parts["noise"] for each in found]
    assert 0.3 < math.sqrt(float(np.mean(z**2))) < 3.0


def test_pole_pairs_are_told_apart_across_gaps_by_the_encoders_count() -> None:
    bench, windows, _ = draw(20, gaps=True)
    told = hall_edges(windows, known_flux(bench), bench.motor.n_p, COUNTS)
    up, down = truth(bench)
    edges = both(told, bench.drive.ring)
    assert [each.value for each in edges] == pytest.approx([*up, *down], abs=math.radians(0.1))
    assert told.up[0].parts["pole pairs"] == 0.0


def test_the_ring_is_told_and_is_where_edges_are_told_from() -> None:
    bench, windows, _ = draw(21)
    told = hall_edges(windows, known_flux(bench), bench.motor.n_p, COUNTS)
    up, down = truth(bench)
    mean = float(np.mean([*up, *down]))
    assert wrapped(told.ring.value - bench.drive.ring + mean) == pytest.approx(0.0, abs=math.radians(0.1))
    assert [each.value for each in (*told.up, *told.down)] == pytest.approx(
        [x - mean for x in (*up, *down)], abs=math.radians(0.15)
    )


def test_an_error_of_the_zero_is_in_every_edge_and_in_its_interval() -> None:
    bench, windows, _ = draw(22)
    exact = known_flux(bench)
    wrong = replace(exact, ahead=exact.ahead + 0.01, zero=replace(exact.zero, parts={"noise": 0.006}))
    before, after = (
        both(hall_edges(windows, each, bench.motor.n_p, COUNTS), bench.drive.ring) for each in (exact, wrong)
    )
    moved = [b.value - a.value for a, b in zip(before, after, strict=True)]
    assert moved == pytest.approx([0.01] * 12, abs=1e-4)
    assert all(each.parts["zero"] == 0.006 and each.dominated_by == "zero" for each in after)


def test_what_edges_cannot_show_is_refused() -> None:
    bench, windows, _ = draw(23)
    known, n_p = known_flux(bench), bench.motor.n_p
    with pytest.raises(Refused, match="one way only"):
        hall_edges(windows[:2], known, n_p, COUNTS)
    steady, m = [], bench.motor
    for way in (1.0, -1.0):
        bench.w = way * 500.0
        holds = (m.up + m.b * 500.0 / n_p) / (1.5 * n_p * m.psi)
        steady.append(bench.turned_by(1j * way * holds, 0.2, 0.1))
        bench.period += 1000
    with pytest.raises(Refused, match=r"at about (499|500|501) rad/s: turn slower too"):
        hall_edges(steady, known, n_p, COUNTS)
    with pytest.raises(Refused, match="no window has an encoder's angle"):
        hall_edges([replace(w, theta=None) for w in windows], known, n_p)
    none = replace(windows[0].edges, old=windows[0].edges.old[:0], new=windows[0].edges.new[:0],
                   index=windows[0].edges.index[:0], count=windows[0].edges.count[:0])  # fmt: skip
    with pytest.raises(Refused, match="0 Hall edges came"):
        hall_edges([replace(w, edges=none) for w in windows], known, n_p)
    backwards = {1: 1, 3: 5, 2: 4, 6: 6, 4: 2, 5: 3}
    swapped = [
        replace(w, edges=replace(w.edges, old=np.vectorize(backwards.get)(w.edges.old),
                                 new=np.vectorize(backwards.get)(w.edges.new)))
        for w in windows
    ]  # fmt: skip
    with pytest.raises(Refused, match="reverse order"):
        hall_edges(swapped, known, n_p, COUNTS)


def test_without_an_encoder_edges_are_where_the_back_emf_has_them_and_two_speeds_tell_their_delay() -> None:
    found, want, delays, late = [], [], [], []
    for seed in range(5):
        bench, _, i_max = draw(50 + seed, U=0.1, noise=0.02)
        motor = bench.motor
        top = min(0.5 * 13.8 / motor.psi, 2000.0)
        windows = [
            replace(w, theta=None) for part in (1.0, 0.4) for w in along_d(bench, 0.5 * i_max, part * top, held=0.1)
        ]
        R = Quantity("R_s", "ohm", motor.R, {"noise": 1e-3 * motor.R})
        L_q = Quantity("L_q", "H", motor.L_q, {"noise": 3e-3 * motor.L_q})
        told = edges_by_back_emf(windows, R, L_q)
        found += both(told, bench.drive.ring)
        want += [value for way in truth(bench) for value in way]
        assert told.delay is not None
        delays.append(told.delay)
        late.append(bench.drive.hall_delay)
    inside(found, want, alike=12)
    inside(delays, late)
    off = np.degrees([each.value - value for each, value in zip(found, want, strict=True)])
    assert np.median(np.abs(off)) < 0.2
    with pytest.raises(Refused, match="in reverse in fewer than 3 parts"):
        edges_by_back_emf(windows[:2], R, L_q)
    with pytest.raises(Refused, match="turn slower too, to tell their delay"):
        edges_by_back_emf(windows[:4], R, L_q)

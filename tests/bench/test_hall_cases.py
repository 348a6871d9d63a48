"""What the recordings by formula hold, checked against plain arithmetic: places, counts, times, encoder angles."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from bench.hall.trace import Recorded, pieces_of
from bench.record.reader import Run
from protocol.streams import EdgeChunk
from tests.bench.hall_cases.drives import MOTORS, drawn, healthy
from tests.bench.hall_cases.faults import FAULTS, PLACES, Case, by_name, cases
from tests.bench.hall_cases.recording import (
    Bounce,
    Contact,
    Encoder,
    Pulses,
    Recording,
    Sensors,
    Wires,
    pieces,
    write_run,
)
from tests.bench.hall_cases.shaft import Way, check, hand, rest
from tests.choice import chosen

FORWARD = Way(((0.0, 240.0), (4.0, 240.0)), ((0.0, 4.0),))
"""Four turns a second, 24 electrical ones of six pole pairs: 8640 deg/s."""
EXACT = Sensors(jitter=(0.0, 0.0, 0.0), hysteresis=(0.0, 0.0, 0.0))
PLAIN = Recording(way=FORWARD, sensors=EXACT)
OMEGA = 8640.0


def places(recording: Recording, number: int, level: int) -> np.ndarray:
    """Electrical deg, unwrapped, of the shaft where this input changes to that level."""
    line = recording.lines[number]
    times = line.times[(np.arange(len(line.times)) + line.first) % 2 == 1 - level]
    return np.degrees(np.interp(times, recording.t, recording.shaft)) * recording.motor.n_p


def off(angles: np.ndarray, place: float) -> np.ndarray:
    return (angles - place + 180.0) % 360.0 - 180.0


def test_ideal_sensors_are_those_of_spec_12() -> None:
    tick, codes = PLAIN.edges()
    assert Counter(np.diff(np.sort(tick)) // 1000) == {138: len(tick) - 1}  # 60 deg of 8640 deg/s in ticks of 50 ns
    assert set(pairwise(codes.tolist())) == {(1, 3), (3, 2), (2, 6), (6, 4), (4, 5), (5, 1)}
    assert len(tick) == pytest.approx(4.0 * OMEGA / 60.0, abs=1)
    for number, rise in enumerate((-60.0, 60.0, 180.0)):
        assert np.abs(off(places(PLAIN, number, 1), rise)).max() < 1e-6
        assert np.abs(off(places(PLAIN, number, 0), rise + 180.0)).max() < 1e-6


def test_sensors_stand_where_they_are_put() -> None:
    magnets = tuple(np.linspace(-5.0, 5.0, 12).tolist())
    it = PLAIN.sensing(ring=33.0, displaced=(4.0, 0.0, -2.0), apart=(0.0, 3.0, 0.0), magnets=magnets)
    assert np.mean(off(places(it, 0, 1), -60.0)) == pytest.approx(37.0 + np.mean(magnets[::2]), abs=0.02)
    assert np.mean(off(places(it, 1, 0), 240.0)) == pytest.approx(36.0 + np.mean(magnets[1::2]), abs=0.02)
    assert np.mean(off(places(it, 1, 1), 60.0)) == pytest.approx(30.0 + np.mean(magnets[::2]), abs=0.02)
    by_turn = off(places(it, 2, 1)[:24], 180.0).reshape(4, 6)
    assert np.ptp(by_turn, axis=0).max() < 1e-6  # each turn of the shaft alike
    assert np.ptp(by_turn, axis=1) == pytest.approx(np.ptp(magnets[::2]), abs=1e-6)


def test_hysteresis_delays_and_jitter() -> None:
    both = PLAIN.but(way=check(240.0, 6))
    late = both.sensing(hysteresis=(2.0, 2.0, 2.0), rise_late=(0.0, 1e-3, 0.0))
    way = np.sign(np.interp(late.lines[0].times, late.t, np.gradient(late.shaft, late.t)))
    angles = np.degrees(np.interp(late.lines[0].times, late.t, late.shaft)) * 6.0
    found = (angles + 60.0 + 90.0) % 180.0 - 90.0
    assert (found[way > 0].mean(), found[way < 0].mean()) == pytest.approx((1.0, -1.0), abs=0.05)
    moved = PLAIN.sensing(rise_late=(0.0, 1e-3, 0.0)).lines[1].times - PLAIN.lines[1].times
    assert Counter(np.round(moved, 9)) == {0.0: len(moved) // 2, 1e-3: len(moved) // 2}
    shaken = PLAIN.sensing(jitter=(0.0, 0.0, 2.0))
    assert off(places(shaken, 2, 1), 180.0).std() == pytest.approx(2.0, rel=0.25)


def test_a_shaft_that_rocks_within_the_hysteresis_changes_nothing() -> None:
    there = PLAIN.but(way=Way(rest().knots, rocking=(math.radians(1.0) / 6.0, 5.0)), start=0.0).sensing(
        hysteresis=(3.0,) * 3
    )
    assert not len(there.edges()[0])
    beyond = there.sensing(hysteresis=(1.0,) * 3)  # the edge at 0 deg is that of sensor c's fall: 25 times each way
    tick, codes = beyond.edges()
    assert len(tick) in (49, 50)
    assert len({int(a) ^ int(b) for a, b in pairwise(codes)}) == 1


@pytest.mark.parametrize(("share", "returns"), [(1.0, 1), (1.0, 3), (0.25, 2)])
def test_bounces_are_as_many_as_asked(share: float, returns: int) -> None:
    it = PLAIN.with_effect(Bounce((1,), share, returns, 50e-6))
    more = len(it.lines[1].times) - len(PLAIN.lines[1].times)
    assert more == pytest.approx(2 * returns * share * len(PLAIN.lines[1].times), rel=0.25 if share < 1.0 else 0.01)
    assert it.lines[0] is not it.lines[1]
    assert len(it.edges()[0]) == len(PLAIN.edges()[0]) + more
    gaps = np.diff(it.lines[1].times)
    assert np.all((gaps > 40e-6) & (gaps < 60e-6) | (gaps > 1e-3))


def test_pulses_contacts_and_dead_inputs() -> None:
    pulsed = PLAIN.with_effect(Pulses((0, 1, 2), 300.0, (5e-6, 10e-6)))
    assert len(pulsed.edges()[0]) - len(PLAIN.edges()[0]) == pytest.approx(2 * 300 * 4, rel=0.1)
    hall = PLAIN.with_effect(Contact((2,), 0.3, 0.005)).but(decimation=1).capture().samples.raw["hall"]
    assert np.mean(hall >> 2 & 1) == pytest.approx(0.3 + 0.7 * 0.5, abs=0.06)
    dead = PLAIN.with_effect(Contact((0,), 1.0, 0.0, 0, since=2.0)).lines[0]
    assert dead.times.max() <= 2.0
    for together in (True, False):
        _, codes = PLAIN.with_effect(Contact((0, 1), 0.2, 0.01, together=together)).edges()
        assert (sum(a ^ b == 3 for a, b in pairwise(codes.tolist())) > 10) == together


def test_pulses_that_come_with_current() -> None:
    it = PLAIN.but(loads=10.0).with_effect(Pulses((0,), 500.0, (1e-6, 2e-6), with_current=True))
    times = it.lines[0].times
    short = np.diff(times) < 3e-6
    loaded = np.floor(times[:-1][short] / 0.3) % 2 == 1
    assert loaded.mean() > 0.85


def test_wires_and_sensors_60_deg_apart() -> None:
    swapped = PLAIN.but(wires=Wires((1, 0, 2), 4))
    assert swapped.lines[0].times.tolist() == PLAIN.lines[1].times.tolist()
    assert swapped.lines[2].first == 1 - PLAIN.lines[2].first
    close = PLAIN.sensing(spacing=60.0).edges()[1]
    assert len(set(close.tolist())) == 6
    assert {0, 7} <= set(close.tolist())
    turned_round = PLAIN.sensing(spacing=-60.0).but(wires=Wires(inverted=2)).edges()
    assert turned_round[0].tolist() == PLAIN.edges()[0].tolist()
    assert turned_round[1].tolist() == PLAIN.edges()[1].tolist()


def test_what_is_sampled_is_what_the_edges_say() -> None:
    for seed in chosen("hall cases", range(20), 3):
        capture = healthy(seed).capture()
        behind = np.searchsorted(capture.edges.tick, capture.samples.tick, side="right")
        told = np.concatenate([capture.edges.hall_old[:1], capture.edges.hall_new])[behind]
        assert np.array_equal(told, capture.samples.raw["hall"])
        assert np.array_equal(capture.edges.hall_new[:-1], capture.edges.hall_old[1:])
        assert np.all(np.diff(capture.edges.tick) > 0)


def test_codes_that_are_sampled_change_at_samples() -> None:
    tick, _ = PLAIN.but(resolution=1 / 5000).edges()
    assert not np.any(tick % 4000)
    exact, _ = PLAIN.edges()
    assert np.mean(tick - exact[: len(tick)]) == pytest.approx(2000, abs=400)


ENCODERS = {
    "zero": (Encoder(zero=5.0), lambda turns: 5.0 + 0.0 * turns),
    "ratio": (Encoder(ratio=4.0), lambda turns: 3.0 * turns * 2160.0),
    "reversed": (Encoder(way=-1.0), lambda turns: -2.0 * turns * 2160.0),
    "late": (Encoder(late=1e-3), lambda turns: np.where(turns > 0.11, -OMEGA * 1e-3, np.nan)),
    "slip": (Encoder(slips=((2.0, 12.0),)), lambda turns: np.where(turns >= 8.1, 12.0, 0.0)),
    "lost": (Encoder(lost=2.0), lambda turns: -2.0 * np.floor(turns - 0.37)),
    "gained": (Encoder(gained=2.0), lambda turns: 2.0 * np.floor(turns - 0.1 + 0.3)),
    "index": (Encoder(indexed=False), lambda turns: np.where(turns < 1.0, -0.1 * 2160.0, 0.0)),
    "eccentric": (Encoder(eccentric=7.0), lambda turns: 7.0 * np.sin(math.tau * turns + 1.0)),
}


@pytest.mark.parametrize(("encoder", "expected"), ENCODERS.values(), ids=ENCODERS)
def test_the_encoder_shows_what_it_is_made_to(encoder: Encoder, expected: object) -> None:
    it = PLAIN.but(encoder=encoder)
    turns = it.shaft / math.tau
    found = np.degrees(it.encoder_angle()) - 2160.0 * turns
    wanted = expected(turns)  # type: ignore[operator]
    away = np.abs(found - wanted)
    assert np.nanpercentile(away, 99.5) < 1.0 * max(1.0, encoder.ratio)  # half a count is 0.26 deg


def test_the_back_emf_is_that_of_the_motor() -> None:
    it = PLAIN.but(decimation=1)
    capture = it.capture()
    u = capture["u_alpha"] + 1j * capture["u_beta"]
    i = capture["i_a"] + 1j * (capture["i_a"] + 2.0 * capture["i_b"]) / math.sqrt(3.0)
    omega = math.radians(OMEGA)
    half = np.exp(-1j * (it.shaft * 6.0 - 0.5 * omega / it.pwm_hz))
    e = u * half - (it.motor.r + 1j * omega * it.motor.l) * i * np.exp(-1j * it.shaft * 6.0)
    assert e.mean() == pytest.approx(1j * omega * it.motor.psi, abs=2e-3)


def test_drawn_sensors_are_as_those_of_real_motors() -> None:
    rng = np.random.default_rng(5)
    many = [drawn(rng, 6, 8640.0) for _ in range(400)]
    off_place = np.array([s.displaced for s in many])
    edges = np.concatenate(
        [off_place + np.array([s.apart for s in many]), off_place - np.array([s.apart for s in many])]
    )
    assert np.sqrt(np.mean(off_place**2)) == pytest.approx(3.0, abs=0.35)
    assert np.sqrt(np.mean(edges**2)) == pytest.approx(3.3, abs=0.4)
    assert np.abs(edges).max() <= 8.4 + 1e-9
    assert np.median(np.abs(off_place).max(axis=1)) == pytest.approx(2.4, abs=0.4)
    assert np.abs(off_place.mean(axis=1)).max() < 1e-9
    assert 0.85 < np.std([s.magnets for s in many]) < 1.36
    fast = [drawn(rng, 6, 43200.0).most_late * 43200.0 for _ in range(50)]
    assert max(fast) <= 2.0


def test_every_fault_has_a_case_that_can_be_made_again_by_its_name() -> None:
    every = list(cases(quick=True))
    assert len(FAULTS) >= 40
    assert {case.place for case in every} == set(PLACES)
    for fault in chosen("faults made", FAULTS.values(), 8):
        case = Case(fault, fault.sizes[-1], "slow", "unkind", True, 3)
        again = by_name(case.name)
        assert np.array_equal(again.recording.edges()[0], case.recording.edges()[0])
        assert again.expected == case.expected


def test_a_verdict_on_a_case() -> None:
    case = by_name("bounce_one/50/slow/kind/none/0")
    letter = case.expected.inputs
    other = "abc".replace(letter, "")[0]
    assert case.judged("INVALID", []) == "cannot tell"
    assert case.judged("PASS", []) == "missed"
    assert case.judged("FAIL", [("bounce", f"sensor {letter} bounces")]) == "right"
    assert case.judged("FAIL", [("bounce", f"sensor {other} bounces")]) == "wrong"
    assert case.judged("FAIL", [("bounce", f"sensor {letter} bounces"), ("pole_pairs", "")]) == "wrong"
    assert by_name("bounce_one/3/slow/kind/none/0").judged("PASS", []) == "right"
    assert by_name("ring_anywhere/1/slow/kind/none/0").judged("FAIL", [("ring", "")]) == "wrong"


def test_pieces_and_a_run_have_all_of_it(tmp_path: Path) -> None:
    capture = PLAIN.but(way=hand(60.0, 1.0)).capture()
    found = list(pieces(capture, 0.05))
    edges = np.concatenate([piece.tick for piece in found if isinstance(piece, EdgeChunk)])
    samples = np.concatenate([piece.tick for piece in found if not isinstance(piece, EdgeChunk)])
    assert np.array_equal(edges, capture.edges.tick)
    assert np.array_equal(samples, capture.samples.tick)
    recorded = Recorded(Run(write_run(tmp_path / "x.run", capture)))
    read = list(pieces_of(recorded, ("hall",)))
    assert np.array_equal(np.concatenate([part.edges.tick for part in read]), capture.edges.tick)
    assert np.array_equal(
        np.concatenate([part.samples.raw["theta_enc"] for part in read]), capture.samples.raw["theta_enc"]
    )
    assert {motor.n_p for motor in MOTORS} >= {1, 23}

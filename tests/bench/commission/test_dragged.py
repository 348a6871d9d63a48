"""Dragged turns: pole pairs, direction, zero, lag, and how Hall sensors are wired, against a rotor solved by scipy."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from bench.commission.analysis.dragged import dragged, jump
from bench.commission.analysis.hall_order import (
    BACKWARD,
    FORWARD,
    NEITHER,
    HallOrder,
    hall_order,
    heavy,
    orientation,
    verdicts,
)
from bench.commission.refusal import Refused
from bench.commission.window import Edges, Window
from bench.findings.wiring import hats
from bench.signal.position import wrapped
from tests.bench.commission.turning_motor import CODES, Bench, Drive, Motor, drawn
from tests.choice import commit

Ways = tuple[list[Window], list[Window]]
ROWS = ((0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0), (2, 0, 1))
"""SPEC, chapter 12: by `hall_swap_hat`, the input that sensors a, b, c are on."""


def draw(
    seed: int, turns: float = 1.1, change: Callable[[Motor], Motor] = lambda m: m, **more: float
) -> tuple[Bench, Ways, float]:
    """Dragged at half the rated current by 2 Hz, both ways; the bench, the windows, the current."""
    rng = np.random.default_rng([seed, int(commit(), 36) % 2**32])
    motor, i_max, _ = drawn(rng)
    motor = change(motor)
    places = np.radians(rng.uniform(-8.0, 8.0, (6, 1)) + rng.normal(0.0, 0.3, (6, motor.n_p)))
    drive = Drive(
        1.0 / 1000.0, noise=0.004 * i_max, ahead=float(rng.uniform(-math.pi, math.pi)), places=places,
        hysteresis=math.radians(1.0),
    )  # fmt: skip
    bench = Bench(motor, replace(drive, **more), rng, theta=float(rng.uniform(0.0, 50.0)))
    up, down = ([bench.drag(0.5 * i_max, way * 2.0, turns)] for way in (1.0, -1.0))
    return bench, (up, down), 0.5 * i_max


def lag_of(motor: Motor, current: float) -> float:
    """By the torque that holds: k_t I sin(lag), without saliency."""
    w = math.tau * 2.0 / motor.n_p
    return math.asin((motor.up + motor.b * w) / (1.5 * motor.n_p * motor.psi * current))


def test_pole_pairs_direction_zero_and_lag_of_drawn_motors() -> None:
    for seed in range(8):
        bench, (up, down), current = draw(seed, change=lambda m: replace(m, L_d=m.L_q, cogging=0.15 * m.up))
        told = dragged(up, down, n_p=bench.motor.n_p)
        assert told.n_p == bench.motor.n_p
        assert told.direction == 1
        assert abs(wrapped(told.zero.value + bench.drive.ahead)) < 2.0 * told.zero.sd
        assert abs(wrapped(told.zero.value + bench.drive.ahead)) < math.radians(1.0)
        assert told.lag.value == pytest.approx(lag_of(bench.motor, current), rel=0.1)
        assert told.ratio.covers(bench.motor.n_p)


def test_the_drives_own_pole_pairs_and_zero_are_taken_out() -> None:
    bench, ways, _ = draw(20)
    n_p = bench.motor.n_p
    one = [
        [replace(w, theta=(np.unwrap(w.theta) / n_p + 0.4 + math.pi) % math.tau - math.pi) for w in way] for way in ways
    ]
    told, before = dragged(*one, n_p=1, encoder_zero=0.4), dragged(*ways, n_p=n_p)
    assert told.n_p == n_p
    # the shaft's angle was unwrapped from another of the electrical turns, which are alike
    assert wrapped(told.zero.value - before.zero.value) == pytest.approx(0.0, abs=1e-6)


def test_a_counter_that_its_index_sets_right_jumps_and_one_that_counts_does_not() -> None:
    """By half a degree of the shaft and more, at any place, also across the wrap of the angle."""
    rng = np.random.default_rng(24)
    for seed in range(6):
        bench, ways, _ = draw(seed)
        shafts = [replace(w, theta=np.unwrap(w.theta) / bench.motor.n_p) for way in ways for w in way]
        lines = 3600
        assert jump([replace(w, theta=_counted(w.theta, lines)) for w in shafts], lines) == 0.0
        for by in rng.uniform(math.radians(0.5), math.pi, 5) * rng.choice([-1.0, 1.0], 5):
            at = int(rng.integers(1, len(shafts[0])))
            jumped = shafts[0].theta + by * (np.arange(len(shafts[0])) >= at)
            told = jump([replace(shafts[0], theta=_counted(jumped, lines)), shafts[1]], lines)
            assert told == pytest.approx(abs(by), abs=0.015 + math.tau / lines)


def _counted(shaft: np.ndarray, lines: int) -> np.ndarray:
    """As an encoder has it, and wrapped."""
    return (np.floor(shaft / math.tau * 4 * lines) / (4 * lines) * math.tau + math.pi) % math.tau - math.pi


def test_an_encoder_that_counts_backwards_is_told() -> None:
    bench, ways, _ = draw(21)
    told = dragged(*([replace(w, theta=-w.theta) for w in way] for way in ways), n_p=bench.motor.n_p)
    assert told.direction == -1
    assert told.n_p == bench.motor.n_p
    assert abs(wrapped(told.zero.value + bench.drive.ahead)) < math.radians(1.0)


@pytest.mark.parametrize("lines", [2500 / 3600, 1.04, 0.5 / 0.95])
def test_lines_that_are_not_the_encoders_are_refused(lines: float) -> None:
    _, ways, _ = draw(22, change=lambda m: replace(m, n_p=3))
    wrong = [
        [replace(w, theta=(np.unwrap(w.theta) * lines + math.pi) % math.tau - math.pi) for w in way] for way in ways
    ]
    with pytest.raises(Refused, match=r"\d\.\d\d electrical turns in one of the shaft .* lines are not 3600"):
        dragged(*wrong, n_p=3, lines=3600)


def test_a_blocked_shaft_and_one_without_an_encoder_are_refused() -> None:
    bench, ways, _ = draw(23)
    still = [[replace(w, theta=0.0 * w.theta) for w in way] for way in ways]
    with pytest.raises(Refused, match=r"the shaft does not follow: the flux turned by .* electrical turns"):
        dragged(*still, n_p=bench.motor.n_p)
    with pytest.raises(Refused, match="there is no encoder's angle"):
        dragged(*([replace(w, theta=None) for w in way] for way in ways))


def test_a_shaft_that_is_hard_to_turn_is_named_with_the_share_of_the_current() -> None:
    bench, ways, current = draw(24, change=lambda m: replace(m, up=8.0 * m.up, down=8.0 * m.down))
    share = dragged(*ways, n_p=bench.motor.n_p).share
    assert share == pytest.approx(math.sin(lag_of(bench.motor, current)), rel=0.2)
    found = heavy(0.3, 4.0, 8.0)
    assert found is not None
    assert found.cause.startswith("it takes 15 % of i_max to turn the shaft")
    assert heavy(0.2, 4.0, 8.0) is None


# -- Hall sensors ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def turned() -> tuple[Bench, Ways]:
    bench, ways, _ = draw(30)
    return bench, ways


def rewired(ways: Ways, wire: Callable[[int], int]) -> Ways:
    """The same turns, with inputs that read another word for each code of the sensors."""
    table = np.array([wire(code) for code in range(8)])

    def one(window: Window) -> Window:
        old, new = table[window.edges.old], table[window.edges.new]
        keep = old != new
        return replace(window, edges=Edges(old[keep], new[keep], window.edges.index[keep], window.edges.count[keep]))

    up, down = ([one(window) for window in way] for way in ways)
    return up, down


def put_right(found: HallOrder, word: int) -> int:
    """What a drive makes of an input word with the parameters that were found: SPEC 12.5."""
    assert found.wired is not None
    swap, inverted = hats(found.wired)
    pins = word ^ int(inverted)
    return sum((pins >> at & 1) << sensor for sensor, at in enumerate(ROWS[int(swap)]))


@pytest.mark.parametrize("inverted", range(8))
def test_every_wiring_is_put_right_by_what_was_found(turned: tuple[Bench, Ways], inverted: int) -> None:
    """All 48 ways to wire three sensors: codes come in the order of SPEC afterwards, and the ring is where they are."""
    bench, ways = turned
    for inputs in permutations(range(3)):  # inputs[k]: the sensor on input k

        def wire(code: int, inputs: tuple[int, ...] = inputs) -> int:
            return sum((code >> sensor & 1) << at for at, sensor in enumerate(inputs)) ^ inverted

        found = hall_order(*rewired(ways, wire))
        assert found.wired is not None
        assert found.order == (FORWARD if inputs in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else BACKWARD)
        seen = [put_right(found, wire(code)) for code in CODES]
        first = seen.index(1)
        assert tuple(seen[first:] + seen[:first]) == CODES
        # code 1 comes at 0 deg of the ring: the sector that the true rotor is in then is `first`
        mean = float(np.mean(bench.drive.places))
        assert abs(wrapped(found.wired.ring - first * math.pi / 3.0 - mean)) < math.radians(2.0)


@pytest.mark.parametrize("ring_deg", [-150.0, -90.0, -30.0, 0.0, 30.0, 60.0, 90.0, 120.0, 180.0])
def test_a_ring_that_sits_elsewhere_is_an_orientation_and_no_fault(ring_deg: float) -> None:
    bench, ways, _ = draw(31, turns=0.6, ring=math.radians(ring_deg))
    found = hall_order(*ways)
    assert list(verdicts(found, 1)) == []
    assert found.wired is not None
    assert found.wired.changes == 0
    mean = float(np.mean(bench.drive.places))
    assert abs(wrapped(found.wired.ring - bench.drive.ring - mean)) < math.radians(2.0)
    note = orientation(found)
    assert note is not None
    assert note.code == "ring"


def test_edges_by_the_angle_of_the_phases_are_rough_but_right() -> None:
    for seed in range(4):
        bench, ways, _ = draw(40 + seed, change=lambda m: replace(m, L_d=m.L_q))
        blind = [[replace(w, theta=None) for w in way] for way in ways]
        found = hall_order(*blind)
        assert found.edges is not None
        want = -bench.drive.places.mean(axis=1)
        for each, value in zip(found.edges.up, want, strict=True):
            off = wrapped(each.value - found.edges.ring.value - value)
            assert abs(off) < min(math.radians(2.0), each.half_width)


FAULTS: dict[str, tuple[Callable[[int], int], str, str]] = {
    "a never": (lambda code: code & ~1, "dead", "sensor a shorted (always 0)"),
    "b always": (lambda code: code | 2, "dead", "sensor b open (always 1)"),
    "b and c exchanged": (lambda c: c & 1 | (c & 2) << 1 | (c & 4) >> 1, "wiring", "two Hall wires are exchanged"),
    "c inverted": (lambda code: code ^ 4, "wiring", "sensor c inverted"),
}


@pytest.mark.parametrize(("wire", "code", "cause"), FAULTS.values(), ids=FAULTS)
def test_faults_of_the_wires_are_named(
    turned: tuple[Bench, Ways], wire: Callable[[int], int], code: str, cause: str
) -> None:
    _, ways = turned
    found = list(verdicts(hall_order(*rewired(ways, wire)), 1))
    assert [each.code for each in found] == [code]
    assert found[0].cause == cause


def test_two_phases_of_the_motor_exchanged_turn_encoder_and_sensors_round(turned: tuple[Bench, Ways]) -> None:
    """The rotor then turns against the angle: everything that is on it runs backwards."""
    _, (up, down) = turned
    mirrored = [[replace(w, control=-w.control) for w in way] for way in (down, up)]
    found = hall_order(*mirrored)
    direction = dragged(*mirrored, n_p=turned[0].motor.n_p).direction
    assert direction == -1
    told = list(verdicts(found, direction))
    assert [each.code for each in told] == ["motor_phases"]
    assert "two motor phases are exchanged" in told[0].cause
    without = list(verdicts(found, None))
    assert without[0].cause == "two Hall wires are exchanged, or two motor phases"


def test_an_encoder_that_counts_backwards_alone_is_named(turned: tuple[Bench, Ways]) -> None:
    told = list(verdicts(hall_order(*turned[1]), -1))
    assert [each.code for each in told] == ["encoder_reversed"]


def test_codes_in_no_order_and_no_edges_are_told(turned: tuple[Bench, Ways]) -> None:
    _, ways = turned
    rng = np.random.default_rng(3)
    mixed = []
    for way in ways:
        codes = rng.permutation(np.array(CODES * 40))[: len(way[0].edges)]
        mixed.append([replace(way[0], edges=replace(way[0].edges, old=np.roll(codes, 1), new=codes))])
    found = hall_order(*mixed)
    assert found.order == NEITHER
    assert [each.code for each in verdicts(found, 1)] == ["hall_codes"]
    assert orientation(found) is None
    assert found.wired is None
    none = rewired(ways, lambda code: 5)
    with pytest.raises(Refused, match="no Hall edge came"):
        hall_order(*none)

"""What eight captures of two real motors hold: counts, and numbers that two methods found which `bench` does not have.

Method one: phase as a spline in time with a knot each two electrical turns and the six edges' places, by least squares
in blocks of whole shaft turns; then, over blocks of all speeds, places = places at rest + speed x (rising later than
falling) + a swing once an electrical turn that falls with the square of the speed. Method two: `shares_deg`. They
agree within 0.05 deg on steady stretches. Captures of one motor differ by 0.04 deg (standard deviation) in a sensor's
displacement and 0.15 deg in a sector's width; standard errors over a capture's shaft turns are 0.01 to 0.06.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from functools import cache
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from moteus_captures import NAMES, NEIGHBOURS, displacements_deg, needs_captures, read, shares_deg, unpacked, write

from bench.cli import main
from bench.findings.health import examine
from bench.hall.report import WIDTH, as_json
from bench.hall.trace import trace
from bench.hall.turning import Turned
from bench.record.reader import Run

pytestmark = needs_captures

Three = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Motor:
    """Of both captures or all six: n_p, and within which limits in deg a single capture agrees."""

    n_p: int
    displaced_deg: dict[int, Three]
    """Sensors a, b, c by direction of travel, their mean taken out; each within `displaced_limit`."""
    widths_deg: dict[int, Six]
    """Sectors I to VI without delays, by direction; within `widths_limit`. Unknown where the speed does not change."""
    high_deg: float
    """Of a sensor, mean of the three, without delays; within 0.3."""
    displaced_limit: float = 0.15
    widths_limit: float = 0.4


SPINDLE = Motor(
    2,
    {1: (-0.03, 0.80, -0.77), -1: (-0.49, 0.81, -0.32)},
    {1: (60.1, 60.3, 58.2, 63.0, 58.1, 60.3), -1: (59.9, 59.7, 58.9, 62.4, 57.8, 61.3)},
    181.15,
)
WHEEL = Motor(
    15,
    dict.fromkeys((1, -1), (0.45, -0.74, 0.29)),
    dict.fromkeys((1, -1), (59.6, 60.8, 60.3, 58.3, 61.6, 59.4)),
    179.55,
)


@dataclass(frozen=True)
class Known:
    """Of one capture. A step is a sector that was left; a reversal is a step against the one before."""

    motor: Motor
    samples: int
    forward: int
    """Steps."""
    reverse: int
    reversals: int
    rise_late_us: tuple[float, float] | None
    """How much later rising edges come than falling ones, and within which limit; None: its speed does not tell."""
    steady: tuple[tuple[float, float, int], ...]
    """Device time in s from and to, direction: where the speed is steady enough for shares."""


KNOWN = {
    "20250615-new-slow": Known(SPINDLE, 930992, 31, 1295, 62, None, ((5.5, 9.4, -1),)),
    "20250616-back-and-forth": Known(
        SPINDLE, 222704, 331, 667, 2, None, ((1.4, 2.2, -1), (3.3, 3.9, 1), (5.3, 6.1, -1))
    ),
    "20250616-bnforth-highaccel": Known(
        SPINDLE, 213776, 430, 788, 2, None, ((1.0, 2.05, -1), (2.4, 3.95, 1), (4.4, 5.9, -1))
    ),
    "20250616-hboard-cycle": Known(WHEEL, 622976, 0, 2843, 0, (276, 12), ((4.0, 6.5, -1), (8.8, 11.2, -1))),
    "20250616-hboard-manual": Known(
        WHEEL, 752762, 908, 292, 5, (249, 45), ((6.0, 10.0, 1), (10.0, 13.5, 1), (19.0, 22.0, -1))
    ),
    "20250616-speed-cycle": Known(
        SPINDLE, 723333, 8, 10613, 16, (0, 4), ((2.0, 3.5, -1), (7.1, 9.0, -1), (9.0, 10.4, -1))
    ),
    "20260618-spindle-hw": Known(SPINDLE, 896272, 1, 28698, 2, (136, 6), ((2.6, 6.0, -1), (12.0, 14.8, -1))),
    "20260618-spindle-sweep": Known(SPINDLE, 1611008, 1, 23465, 2, (275, 15), ((17.0, 20.0, -1), (34.5, 38.3, -1))),
}
"""No illegal code, no step of two sectors, no pulse and no bounce in any. What turns back for one step (31, 8, 1, 1 and
1 times) is the shaft, all but stopped: the step begins 10 to 330 ms after the edge before and lasts 5 to 140 ms. That
is 0.02 to 9 of the interval before, and 0.19 at least of the shorter one of its two neighbours."""


@pytest.mark.parametrize("name", NAMES)
def test_a_capture_has_the_codes_and_edges_of_its_file(name: str) -> None:
    """Counted over the file's text: the byte after each 0x5a, no code being one."""
    known, capture = KNOWN[name], read(name)
    runs = [
        (code, len(list(same))) for code, same in groupby(part[0] for part in unpacked(name).split(b"\x5a")[1:] if part)
    ]
    assert {code for code, _ in runs} == {1, 2, 3, 4, 5, 6}
    assert sum(n for _, n in runs) == len(capture) == known.samples
    steps = Counter(pair in NEIGHBOURS for pair in pairwise(code for code, _ in runs))
    assert steps == Counter({True: known.forward, False: known.reverse})
    assert not capture.edges.illegal.any()
    np.testing.assert_array_equal(capture.edges.hall_old, [code for code, _ in runs[:-1]])
    np.testing.assert_array_equal(capture.edges.hall_new, [code for code, _ in runs[1:]])
    np.testing.assert_allclose(capture.edge_t * 30_000, np.cumsum([n for _, n in runs])[:-1])
    forward = [pair in NEIGHBOURS for pair in pairwise(code for code, _ in runs)]
    assert sum(a != b for a, b in pairwise(forward)) == known.reversals


def test_a_capture_goes_into_a_recording_and_every_sixth_sample_with_all_edges(tmp_path: Path) -> None:
    name = "20250616-bnforth-highaccel"
    whole, kept = read(name), Run(write(tmp_path / "real.run", name, decimation=6))
    np.testing.assert_array_equal(kept.samples.raw["hall"], whole.samples.raw["hall"][::6])
    np.testing.assert_array_equal(kept.samples.tick, whole.samples.tick[::6])
    np.testing.assert_array_equal(kept.edges.tick, whole.edges.tick)
    np.testing.assert_array_equal(kept.edges.hall_new, whole.edges.hall_new)


@pytest.mark.parametrize("name", NAMES)
def test_steady_stretches_show_the_motor_by_shares_of_electrical_turns(name: str) -> None:
    """The table above comes from the other method."""
    known, capture = KNOWN[name], read(name)
    for first, last, direction in known.steady:
        widths = shares_deg(capture, first, last)
        found, expected = displacements_deg(widths), known.motor.displaced_deg[direction]
        np.testing.assert_allclose(found, expected, atol=known.motor.displaced_limit, err_msg=f"{name}, {first} s")


@pytest.mark.parametrize("name", [name for name in NAMES if KNOWN[name].rise_late_us and "manual" not in name])
def test_rising_edges_come_late_by_what_two_speeds_tell(name: str) -> None:
    """A code with one high input lasts less by delay x speed, one with two lasts more; in reverse the same."""
    known, capture = KNOWN[name], read(name)
    assert known.rise_late_us
    late, limit = known.rise_late_us
    rows = []
    for first, last, _ in known.steady[:2]:
        widths = shares_deg(capture, first, last)
        t = capture.edge_t[(capture.edge_t > first) & (capture.edge_t < last)]
        speed = 60 * (len(t) - 1) / (t[-1] - t[0])  # deg/s
        rows.append((speed, 180 - (widths[::2].mean() - widths[1::2].mean()) / 2, widths))
    (slow, high, _), (fast, less, widths) = sorted(rows, key=lambda row: row[0])
    assert 1e6 * (high - less) / (fast - slow) == pytest.approx(late, abs=limit)
    assert high + slow * late * 1e-6 == pytest.approx(known.motor.high_deg, abs=0.3)
    without = widths - np.array([1, -1] * 3) * fast * late * 1e-6
    np.testing.assert_allclose(without, known.motor.widths_deg[-1], atol=known.motor.widths_limit)


@pytest.mark.parametrize("name", NAMES)
def test_passages_repeat_with_the_turn_of_the_shaft(name: str) -> None:
    """What one pole pair's magnets add to a sector's share comes again after n_p electrical turns, and not before."""
    known, capture = KNOWN[name], read(name)
    first, last, _ = known.steady[0]
    t = capture.edge_t[(capture.edge_t > first) & (capture.edge_t < last)]
    passage = np.diff(t)
    turns = (t[6:-1] - t[:-7] + t[7:] - t[1:-6]) / 2
    shares = 360 * passage[3:-3] / turns
    sector = np.arange(len(shares)) % 6
    rest = shares - np.array([shares[sector == k].mean() for k in range(6)])[sector]
    alike = [float(np.corrcoef(rest[: -6 * n], rest[6 * n :])[0, 1]) for n in range(1, known.motor.n_p + 1)]
    assert alike[-1] > max(0.6, max(alike[:-1]) + 0.3), alike  # the wheel's neighbouring pole pairs: 0.5


# -- what `bench hall check` says of them ---------------------------------------------------------------------------

WAYS = {1: "up", -1: "down"}
UNEVEN = "20250615-new-slow"
"""20 turns a second and no other speed: it swings by a degree or two within each turn, as nothing can tell."""


@cache
def told(name: str) -> dict[str, Any]:
    """The JSON of a check."""
    capture = read(name)
    looked_at = trace(capture)
    return as_json(examine(looked_at), looked_at, Turned(capture, "recorded"), name)


def of_way(data: dict[str, Any], way: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Displacements (3,) and their standard errors, widths (6,) and theirs, in one direction; NaN where not passed."""
    sensors = data["sensors"].values()
    places = [edge[WAYS[way]]["angle_deg"] for edge in data["edges"]]
    known = [
        [one[f"displaced_{WAYS[way]}_deg"] for one in sensors],
        [one["displaced_each_way_half_width_95_deg"] for one in sensors],
        np.diff([*places, places[0] + 360.0]) if None not in places else [None] * 6,
        data["sector_widths_half_width_95_deg"],
    ]
    values = [np.array(row, float) for row in known]
    return values[0], values[1] / 1.96, values[2], values[3] / 1.96


def assert_it_meets_what_is_known(name: str, data: dict[str, Any]) -> None:
    """Every figure from both sides, and errors that are neither too small nor too large."""
    known, motor = KNOWN[name], KNOWN[name].motor
    code = read(name).edges
    forward = np.array(
        [pair in NEIGHBOURS for pair in zip(code.hall_old.tolist(), code.hall_new.tolist(), strict=True)]
    )
    back = (forward[1:-1] != forward[:-2]) & (forward[1:-1] != forward[2:])  # one step back, and on again
    assert data["steps"] == {"up": known.forward, "down": known.reverse, "reversals": known.reversals}
    assert data["turns_net"] == pytest.approx((known.forward - known.reverse) / 6)
    assert data["turns_up"] == pytest.approx((known.forward - back.sum()) / 6, abs=0.51)
    assert data["turns_down"] == pytest.approx((known.reverse - back.sum()) / 6, abs=0.51)
    assert (data["bounces"]["n"], data["false_pulses"]["n"], data["codes"]["illegal_edges"]) == (0, 0, 0)
    assert data["n_p_by_edges"] == motor.n_p
    assert data["ring_deg"] is None
    assert 360 * np.mean(list(data["duty"].values())) == pytest.approx(motor.high_deg, abs=0.3)
    within = 1.0 if name == UNEVEN else motor.widths_limit
    for way in WAYS:
        displaced, displaced_se, widths, widths_se = of_way(data, way)
        if (known.forward if way > 0 else known.reverse) < 100:
            assert np.isnan(displaced).all()
            continue
        assert 0.01 < displaced_se.min() <= displaced_se.max() < 0.2
        assert 0.05 < widths_se.min() <= widths_se.max() < (1.2 if name == UNEVEN else 0.35)
        np.testing.assert_allclose(displaced, motor.displaced_deg[way], atol=motor.displaced_limit)
        np.testing.assert_allclose(widths, motor.widths_deg[way], atol=within)
        assert np.abs((displaced - motor.displaced_deg[way]) / displaced_se).max() < 3
        assert np.abs((widths - motor.widths_deg[way]) / widths_se).max() < 3
    for sensor in data["sensors"].values():
        assert sensor["rising_late_s"] is sensor["falling_late_s"] is None
        if known.rise_late_us is None:
            assert sensor["rising_after_falling_s"] is None
        else:
            late, limit = known.rise_late_us
            found, error = 1e6 * sensor["rising_after_falling_s"], 1e6 * sensor["late_half_width_95_s"] / 1.96
            assert found == pytest.approx(late, abs=min(limit, max(3 * error, 2)))
            assert 0.1 < error < 10


@pytest.mark.parametrize("name", NAMES)
def test_a_check_without_an_encoder_tells_what_a_capture_holds(name: str) -> None:
    assert_it_meets_what_is_known(name, told(name))


@pytest.mark.parametrize("name", NAMES)
def test_nothing_of_motors_that_work_is_accused_but_pull_ups_that_are_late(name: str) -> None:
    data, late = told(name), KNOWN[name].rise_late_us
    said = [finding["code"] for finding in (*data["findings"], *data["notes"])]
    assert said == ([] if late is None or late[0] < 40 else said[:1])
    assert set(said) <= {"late_edges", "delays"}
    assert len(said) == (late is not None and late[0] > 100)
    assert data["outcome"] == ("fault" if "late_edges" in said else "cannot_tell")


@pytest.mark.parametrize(("motor", "way"), [(SPINDLE, 1), (SPINDLE, -1), (WHEEL, -1)], ids=["both", "six", "wheel"])
def test_captures_of_one_motor_agree_within_their_errors(motor: Motor, way: int) -> None:
    """Six of them show that the errors are not much too large, either; two may agree by chance."""
    found = [of_way(told(name), way) for name in NAMES if KNOWN[name].motor is motor]
    found = [one for one in found if not np.isnan(one[0]).any()]
    for k in (0, 2):
        values, errors = np.array([one[k] for one in found]), np.array([one[k + 1] for one in found])
        mean = (values / errors**2).sum(axis=0) / (1 / errors**2).sum(axis=0)
        per_freedom = (((values - mean) / errors) ** 2).sum() / (values.size - len(mean))
        assert per_freedom < 1.5, k
        assert len(found) == 2 or (len(found) == 6 and per_freedom > 0.1), (k, per_freedom)


@pytest.mark.slow
def test_the_table_in_the_docs_is_what_the_check_says() -> None:
    from docs import make_real_halls

    old = make_real_halls.PAGE.read_text()
    assert make_real_halls.page(old, make_real_halls.table()) == old


def test_the_command_tells_the_same_of_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "20250616-hboard-manual"
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "real.run", name)
    with pytest.raises(SystemExit) as ended:
        main(["hall", "check", "real.run", "--json", "x.json"])
    assert ended.value.code == 2
    assert_it_meets_what_is_known(name, json.loads((tmp_path / "x.json").read_text()))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= WIDTH
    text = " ".join(" ".join(lines).split())
    for words in (
        "sectors 908 forward, 292 reverse, +616 net",
        "pole pairs 15, by edges that repeat with the shaft",
        "their mean is set to 0, 60 … 300; at standstill",
        "exchanged wires, the angle of the ring and a delay that all edges share are not known",
    ):
        assert words in text

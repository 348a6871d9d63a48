"""Other tools' tables of Hall sensors: what is said of them is what sensors at known angles have.

The oracle turns three sensors by small steps and takes, as each tool's firmware does, the mean direction of a code
(VESC, mcpwm_foc_hall_detect), or the angles at which codes change (ODrive, moteus). Real tables are public ones.
"""

from __future__ import annotations

import itertools
import json
import math
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from against import said as bench
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.errors import BenchError
from bench.hall.table_reading import compared, configuration, examined
from bench.hall.tables import parsed
from bench.signal.verdict import Verdict
from protocol.messages import DriveState, SetpointMode
from protocol.signals import ANGLE
from sim.config.params import load_params
from sim.drive.machine import SimulatedBench
from sim.ports.device import SimulatedDevice

STEP = 0.05  # deg
TURN = np.arange(0.0, 360.0, STEP)
CODES = (1, 3, 2, 6, 4, 5)  # of a shaft that turns forward, SPEC 12
ORDERS = list(itertools.permutations(range(3)))
PLACES = np.array([30.0, 150.0, 270.0])  # middle of what a, b, c are 1 over, of a ring at 0

REAL = {
    "vedderb/bldc, applications/finn/app_finn_az_conf.h": (255, 142, 8, 174, 74, 108, 42, 255),
    "vedderb/bldc, applications/er/app_erockit_conf_v2.h": (255, 189, 122, 156, 56, 22, 88, 255),
    "a fork of vedderb/bldc, header with a motor limit of 100 C": (255, 168, 34, 198, 97, 134, 66, 255),
    "a fork of vedderb/bldc, header with 1200 ERPM in open loop": (255, 134, 197, 166, 68, 98, 34, 255),
    "a fork of vedderb/bldc, header with a flux linkage of 0.005073": (255, 45, 111, 78, 179, 12, 145, 255),
    "a fork of vedderb/bldc, header with ten poles and a gear of 7.6": (255, 49, 117, 83, 184, 17, 150, 255),
    "a fork of vedderb/bldc, header that weakens the field by sl_d_current_factor": (255, 0, 67, 33, 133, 168, 99, 255),
    "an example in a user's question": (255, 166, 34, 0, 101, 134, 67, 255),
}
"""Tables of motors that run, by where they are published; each is a motor's own detection."""
WINCH = (255, 65, 118, 103, 199, 34, 173, 255)
"""Manual of a winch (its 260930_motor_config.xml): the motor jumped while it was detected."""
EMULATED = (255, 22, 90, 186, 162, 123, 43, 255)
"""VESC Tool's detection of an AS5600 with an ESP8266 that imitates Hall sensors."""
ODRIVE = "0.5972, 0.7208, 0.9467, 0.0562, 0.2848, 0.3776"
"""hall_encoder0.config.edge0 … edge5 of a robot's published configuration (ODrive 0.6)."""


def text(table: object) -> str:
    return ",".join(map(str, table))  # type: ignore[call-overload]


def codes(places: np.ndarray, duty: np.ndarray, order: tuple[int, ...] = (0, 1, 2), inverted: int = 0, way: int = 1):
    """The code at each angle of TURN: sensors in the middle of `places`, deg, on inputs in this order."""
    off = (way * TURN[:, None] - places + 180.0) % 360.0 - 180.0
    high = np.abs(off) < 180.0 * duty
    return ((high[:, list(order)] * [1, 2, 4]).sum(axis=1)) ^ inverted


def vesc(turn: np.ndarray) -> tuple[int, ...]:
    table = []
    for code in range(8):
        at = np.radians(TURN[turn == code])
        angle = math.degrees(math.atan2(np.sin(at).sum(), np.cos(at).sum())) % 360.0
        table.append(int(angle * 200.0 / 360.0) if len(at) > 30 / STEP * 0.17 else 255)
    return tuple(table)


def by_input(displaced: tuple[float, ...], order: tuple[int, ...], way: int) -> np.ndarray:
    """deg against the mean of three, as the angle rises."""
    off = np.array(displaced)[list(order)]
    return way * (off - off.mean())


angles = st.floats(-8.0, 8.0)
motors = st.tuples(
    st.floats(0.0, 360.0), st.tuples(angles, angles, angles), st.tuples(angles, angles, angles),
    st.sampled_from(ORDERS), st.integers(0, 7), st.sampled_from([1, -1]),
)  # fmt: skip


@given(motors)
@settings(max_examples=150, deadline=None)
def test_places_and_widths_are_those_of_sensors_at_known_angles(motor) -> None:
    ring, displaced, duties, order, inverted, way = motor
    places = ring + PLACES + displaced
    duty = 0.5 + (np.array(duties) - np.mean(duties)) / 180.0  # 50 % in the mean: more is not told
    turn = codes(places, duty, order, inverted, way)
    table = vesc(turn)
    reading = examined(parsed(text(table)))
    # three entries make a place, each rounded by 0.9 deg at most
    assert np.degrees(reading.displaced) == pytest.approx(by_input(displaced, order, way), abs=3.0)
    widths = {code: np.count_nonzero(turn == code) * STEP for code in reading.table.codes}
    assert np.degrees(reading.widths) == pytest.approx(list(widths.values()), abs=7.5)
    assert sum(np.degrees(reading.widths)) == pytest.approx(360.0)
    assert reading.verdict is not Verdict.FAIL  # of real motors the worst is 8.4 deg off


@given(motors, st.floats(-12.0, 12.0))
@settings(max_examples=40, deadline=None)
def test_a_duty_that_all_sensors_share_leaves_the_table_as_it_is(motor, shared: float) -> None:
    ring, displaced, _, order, inverted, way = motor
    places = ring + PLACES + displaced
    tables = [vesc(codes(places, np.full(3, 0.5 + off / 180.0), order, inverted, way)) for off in (0.0, shared)]
    assert all((b - a + 100) % 200 - 100 in (-1, 0, 1) for a, b in zip(*tables, strict=True) if a != 255)


@given(motors, st.integers(0, 2))
@settings(max_examples=60, deadline=None)
def test_a_sensor_that_is_far_off_is_named_and_no_other(motor, number: int) -> None:
    ring, _, _, order, inverted, way = motor
    places = ring + PLACES
    places[number] += 39.0  # 26 deg against the mean of three
    reading = examined(parsed(text(vesc(codes(places, np.full(3, 0.5), order, inverted, way)))))
    assert [finding.code for finding in reading.findings] == ["displaced"]
    assert reading.findings[0].cause.startswith(f"sensor {'abc'[order.index(number)]} is displaced by")
    assert math.degrees(reading.displaced[order.index(number)]) == pytest.approx(way * 26.0, abs=3.0)


def test_the_scatter_of_a_bad_detection_is_no_fault() -> None:
    """Entries that scatter by 5.4 deg: a rotor that lags unevenly moves edges, as sensors do."""
    rng = np.random.default_rng(5)
    verdicts = []
    for _ in range(1200):
        ring, off = rng.uniform(0.0, 360.0), rng.normal(0.0, 3.0, 3).clip(-8.4, 8.4)  # of sensors c, b, a, as they pass
        edges = ring + 60.0 * np.arange(6) + np.tile(off, 2) + rng.normal(0.0, 5.4 * math.sqrt(2.0), 6)
        middles = 0.5 * (edges + np.append(edges[1:], edges[0] + 360.0)) % 360.0
        table = [255] * 8
        for code, middle in zip(CODES, middles, strict=True):
            table[code] = int(middle / 1.8)
        verdicts.append(examined(parsed(text(table))).verdict)
    assert verdicts.count(Verdict.FAIL) < 2
    assert verdicts.count(Verdict.PASS) > 600


@pytest.mark.parametrize("table", REAL.values(), ids=list(REAL))
def test_motors_that_run_have_no_fault(table: tuple[int, ...]) -> None:
    reading = examined(parsed(text(table)))
    assert reading.verdict is Verdict.PASS
    assert np.degrees(np.abs(reading.displaced)).max() < 8.4
    assert abs(math.degrees(reading.missing)) < 5.4  # of whole counts, 100 less than half a turn


def test_rings_stand_where_the_mean_of_the_middles_does_half_of_them_at_30() -> None:
    rings = []
    for table in REAL.values():
        sixth = np.exp(1j * np.radians(6.0 * 1.8 * (np.array(table[1:7]) + 0.5)))
        rings.append((math.degrees(np.angle(sixth.mean())) / 6.0 - 30.0) % 60.0)
        off = math.degrees(examined(parsed(text(table))).wired.ring) - rings[-1]
        assert abs((off + 30.0) % 60.0 - 30.0) < 0.2
    assert sum(abs(ring - 30.0) < 5.0 for ring in rings) == 4


def test_a_detection_that_jumped_is_told_to_be_repeated_and_makes_no_configuration() -> None:
    reading = examined(parsed(text(WINCH)))
    assert reading.verdict is Verdict.INVALID
    assert "contradicts itself" in reading.unknown[0]
    assert "detect again" in reading.unknown[0]
    with pytest.raises(BenchError, match="contradicts itself"):
        configuration(reading)


def test_codes_that_no_three_sensors_give_are_no_table() -> None:
    with pytest.raises(BenchError, match="two sensors at once"):
        parsed(text(EMULATED))


def test_edges_of_an_odrive_are_what_it_stores() -> None:
    reading = examined(parsed(ODRIVE))
    edges = np.array([float(word) for word in ODRIVE.split(",")])
    widths = dict(zip(CODES, 360.0 * ((np.roll(edges, -1) - edges) % 1.0), strict=True))
    assert np.degrees(reading.widths) == pytest.approx([widths[code] for code in reading.table.codes])
    assert not reading.table.absolute
    # sensor a rises where count 0 begins and falls where count 3 does
    assert reading.duty[0] == pytest.approx((edges[2] - edges[5]) % 1.0, abs=0.51)
    assert reading.verdict is Verdict.INVALID  # 12 deg: a pull-up, or a detection


# -- files ----------------------------------------------------------------------------------------------------------


@given(motors)
@settings(max_examples=40, deadline=None)
def test_an_odrive_that_was_calibrated_either_way_has_the_places_of_its_sensors(motor) -> None:
    ring, displaced, _, _, _, way = motor
    places = ring + PLACES + displaced
    turn = codes(places, np.full(3, 0.5), way=way)
    begins = [TURN[(turn == code) & (np.roll(turn, way) != code)][0] for code in CODES]  # as codes go up
    for edges in (np.array(begins) / 360.0, (np.array(begins) - begins[0]) % 360.0 / 60.0):
        reading = examined(parsed(text(np.round(edges, 6))))
        assert np.degrees(reading.displaced) == pytest.approx(by_input(displaced, (0, 1, 2), way), abs=0.1)


def moteus(turn: np.ndarray, poles: int, zero: int, sign: int) -> dict[str, object]:
    """By mjbots/moteus: the table of what edges lack to their ideal places, and its other settings."""
    count = {code: ((CODES.index(code) + zero) * sign) % 6 for code in CODES}
    counts = np.array([count[code] for code in turn])
    delta = []
    for k in range(6):
        begins = TURN[(counts == k) & (np.roll(counts, 1) != k)][0]
        delta.append((begins - 60.0 * k + 180.0) % 360.0 - 180.0)
    mod = (np.arange(64) + 0.5) / 64.0 * 3.0 * poles % 6.0
    table = np.radians(np.interp(mod, range(7), [*delta, delta[0]]))
    return {
        "motor.poles": poles, "motor_position.sources.0.type": 4, "motor_position.sources.0.aux_number": 2,
        "motor_position.sources.0.offset": zero, "motor_position.sources.0.sign": sign, "motor.phase_invert": 0,
        "aux2.hall.polarity": 0, **{f"motor.offset.{k}": f"{value:.6f}" for k, value in enumerate(table)},
    }  # fmt: skip


@given(motors, st.sampled_from([4, 14, 22, 30]), st.integers(-5, 0))
@settings(max_examples=40, deadline=None)
def test_a_moteus_that_was_calibrated_has_edges_and_ring(tmp_path_factory, motor, poles: int, zero: int) -> None:
    ring, displaced, duties, _, _, way = motor
    places, duty = ring + PLACES + displaced, 0.5 + np.array(duties) / 180.0
    turn = codes(places, duty, way=way)
    file = tmp_path_factory.mktemp("moteus") / "dump.txt"
    file.write_text("".join(f"{name} {value}\n" for name, value in moteus(turn, poles, zero, way).items()))
    reading = examined(parsed(str(file)))
    for code, edge, width in zip(
        reading.table.codes, np.degrees(reading.edges), np.degrees(reading.widths), strict=True
    ):
        begins = TURN[(turn == code) & (np.roll(turn, 1) != code)][0]
        assert abs((edge - begins + 180.0) % 360.0 - 180.0) < 0.1
        assert width == pytest.approx(np.count_nonzero(turn == code) * STEP, abs=0.1)
    assert reading.table.absolute


def xml(table: tuple[int, ...], name: str = "foc_hall_table__{}") -> str:
    inner = "".join(f"<{name.format(k)}>{entry}</{name.format(k)}>" for k, entry in enumerate(table))
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<MCConfiguration>{inner}</MCConfiguration>\n'


@pytest.mark.parametrize("name", ["foc_hall_table__{}", "foc_hall_table_{}"])
def test_the_xml_of_either_vesc_tool_holds_the_table(tmp_path: Path, name: str) -> None:
    table = next(iter(REAL.values()))
    (tmp_path / "mcconf.xml").write_text(xml(table, name))
    assert (parsed(str(tmp_path / "mcconf.xml")).middles == parsed(text(table)).middles).all()


@pytest.mark.parametrize(("table", "words"), [
    ("255,166,34,0,101,134,67", "7 numbers"),
    ("255,166,34,0,101,134,67,230", "entry 7 is 230"),
    ("255,166,34,0.5,101,134,67,255", "entry 3 is 0.5"),
    ("255,166,34,-1,101,134,67,255", "entry 3 is -1"),
    ("255,nan,34,0,101,134,67,255", "neither a file nor numbers"),
    ("255,255,255,255,255,255,255,255", "no code was seen"),
    ("255,166,255,0,255,134,255,67", r"sensor a open \(always 1\)"),
    ("10,255,60,255,110,255,160,255", r"sensor a shorted \(always 0\)"),
    ("10,30,60,80,110,130,160,180", "all eight codes"),
    ("255,166,166,0,101,134,67,255", "at one angle"),
    ("255,166,101,0,34,134,67,255", "two sensors at once"),
    ("0,1,2,3,4,9", "got 9"),
    ("0,1,2,3,4,4", "do not follow"),
    ("0.1,0.2,0.1,0.2,0.1,0.2", "do not follow"),
    ("nothing.xml", "No such file"),
])  # fmt: skip
def test_what_is_no_table_is_said_in_a_line(capsys: pytest.CaptureFixture[str], table: str, words: str) -> None:
    with pytest.raises(BenchError, match=words):
        parsed(table)
    _, err = bench(capsys, "hall", "table", table, code=2)
    assert err.startswith("error: ")
    assert err.count("\n") == 1


@given(st.text(max_size=60) | st.lists(st.integers(-5, 300), min_size=5, max_size=9).map(text))
@settings(max_examples=300, deadline=None)
def test_whatever_is_typed_gives_a_table_or_a_line(typed: str) -> None:
    with suppress(BenchError):
        assert np.isfinite(examined(parsed(typed)).edges).all()


# -- two tables -----------------------------------------------------------------------------------------------------


def test_entries_that_moved_by_the_detections_own_scatter_are_the_same() -> None:
    """A rover's notes (esc_config_audit): a table was taken for faulty, its entry 1 being 1 and not 198, the others 1
    to 3 counts off. Those others are not published; these are made up."""
    before, after = (255, 198, 64, 32, 131, 165, 99, 255), (255, 1, 66, 31, 134, 166, 98, 255)
    told = compared(parsed(text(before)), parsed(text(after)))
    assert told.same
    assert np.degrees(np.abs(told.differences)).max() == pytest.approx(5.4)


@given(motors, st.sampled_from(ORDERS), st.integers(0, 7), st.sampled_from([0.0, 25.0, 100.0]))
@settings(max_examples=60, deadline=None)
def test_what_makes_one_table_of_another_is_among_the_explanations(motor, order, inverted: int, rotated: float) -> None:
    ring, displaced, *_ = motor
    places, duty = ring + PLACES + displaced, np.full(3, 0.5)
    first, second = codes(places, duty), codes(places + rotated, duty, order, inverted)
    told = compared(parsed(text(vesc(first))), parsed(text(vesc(second))))
    if (order, inverted, rotated) == ((0, 1, 2), 0, 0.0):
        assert told.same
        return
    assert not told.same
    swapped = [name for k, name in enumerate("abc") if order[k] != k]
    words = [f"sensors {' and '.join(swapped)} exchanged"] * (len(swapped) == 2)
    words += ["all three sensors rotated"] * (len(swapped) == 3) + [f"rotated by {rotated:.1f}"[:-2]] * (
        rotated == 25.0
    )
    which = [name for k, name in enumerate("abc") if inverted >> k & 1]
    words += [f"input{'s' * (len(which) > 1)} {', '.join(which)} inverted"] * bool(which)
    changes = len(words) + (rotated == 100.0)
    assert told.explanations
    assert told.explanations[0].count(";") + 1 <= changes  # nothing that takes more
    if changes == 1 and rotated == 0.0:
        assert words[0] in told.explanations


def test_a_sensor_that_moved_has_no_such_explanation(capsys: pytest.CaptureFixture[str]) -> None:
    moved = PLACES + np.array([0.0, 33.0, 0.0])
    tables = [text(vesc(codes(places, np.full(3, 0.5)))) for places in (PLACES, moved)]
    assert compared(*map(parsed, tables)).explanations == ()
    out, _ = bench(capsys, "hall", "table", tables[0], "--compare", tables[1], code=1)
    assert "no exchange of wires" in out


def test_motors_of_three_and_of_two_kinds_of_rings_are_told_apart() -> None:
    for first, second in itertools.combinations(REAL.values(), 2):
        told = compared(parsed(text(first)), parsed(text(second)))
        assert told.same or told.explanations  # they all have sensors in their places


# -- for the simulated drive ----------------------------------------------------------------------------------------


WIRED = vesc(codes(PLACES + np.array([20.0, 26.0, 13.0]), np.full(3, 0.5), (1, 0, 2), 4, -1))
"""Wires exchanged, one input inverted, phases exchanged."""


@pytest.mark.parametrize(("table", "seed"), [(table, k) for k, table in enumerate([*[*REAL.values()][::3], WIRED])])
def test_the_simulated_motor_has_the_sectors_of_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: tuple[int, ...], seed: int
) -> None:
    file = tmp_path / "edges.toml"
    bench(capsys, "hall", "table", text(table), "--out", str(file))
    quiet = {"hall.hysteresis_deg": 0.0, "hall.jitter_deg": 0.0}
    raw = {"firmware.hall_swap_hat": 0, "firmware.hall_invert_hat": 0}  # its inputs, as a VESC reads them
    sampled = turned(SimulatedDevice(load_params(file, quiet | raw), seed).bench)
    for code, entry in enumerate(table):
        at = sampled["theta_true"][sampled["hall"] == code] * ANGLE
        assert len(at) > 100 or entry == 255
        if entry != 255:
            angle = math.degrees(np.angle(np.exp(1j * at).mean()))
            assert abs((angle - 1.8 * (entry + 0.5) + 180.0) % 360.0 - 180.0) < 1.9
    mapped = turned(SimulatedDevice(load_params(file, quiet), seed).bench)
    offset = load_params(file).firmware.hall_offset
    sector = ((mapped["theta_true"] * ANGLE - offset) // (math.pi / 3.0)).astype(int) % 6
    assert np.mean(np.array(CODES)[sector] == mapped["hall"]) > 0.85  # and its firmware knows them


@pytest.mark.long("a check turns the simulated motor for ten seconds")
@pytest.mark.parametrize("table", [WIRED, REAL["a fork of vedderb/bldc, header with a motor limit of 100 C"]])
def test_a_check_of_that_motor_measures_what_the_table_tells(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: tuple[int, ...]
) -> None:
    file = tmp_path / "edges.toml"
    bench(capsys, "hall", "table", text(table), "--out", str(file), "--json", str(tmp_path / "table.json"))
    bench(capsys, "hall", "check", "sim", "--config", str(file), "--json", str(tmp_path / "check.json"))
    told, measured = (json.loads((tmp_path / name).read_text()) for name in ("table.json", "check.json"))
    by_input = [told["sensors"][name]["displaced_deg"] for name in "abc"]
    on = [told["wired_sensors"].index(name) for name in "abc"]  # the drive undoes the wires
    assert [measured["sensors"][name]["displaced_deg"] for name in "abc"] == pytest.approx(
        [by_input[at] for at in on], abs=0.1
    )
    if told["wires"] == "as specified":
        widths = dict(zip(told["sectors"], told["widths_deg"], strict=True))
        assert measured["sector_widths_deg"] == pytest.approx([widths[k] for k in range(1, 7)], abs=0.1)


def turned(rig: SimulatedBench) -> np.ndarray:
    """Samples of a few electrical revolutions, turned by the load machine."""
    for state in (DriveState.ARMED, DriveState.RUNNING):
        rig.load_enter_state(state)
        rig.advance(1)
    rig.load_setpoint(SetpointMode.SPEED, 40.0)
    rig.advance(3200)
    return np.concatenate([rig.advance(1600).samples for _ in range(3)])


# -- the command ----------------------------------------------------------------------------------------------------


def test_json_has_all_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    table = "255,168,34,198,97,134,66,255"
    out, _ = bench(capsys, "hall", "table", table, "--compare", table, "--json")
    told = json.loads(out)
    assert told["codes"] == [2, 6, 4, 5, 1, 3]
    assert sum(told["widths_deg"]) == pytest.approx(360.0)
    assert told["compared"]["same"] is True
    assert told["verdict"] == "PASS"
    assert told["edges_told"] is False


def test_sixty_degrees_apart_is_no_fault(capsys: pytest.CaptureFixture[str]) -> None:
    table = vesc(codes(PLACES, np.full(3, 0.5), inverted=2))
    out, _ = bench(capsys, "hall", "table", text(table))
    assert "60 deg apart, b in the middle" in out
    assert "no fault seen" in out


def test_nothing_is_overwritten_unasked(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    table, file = text(next(iter(REAL.values()))), tmp_path / "edges.toml"
    file.write_text("mine")
    bench(capsys, "hall", "table", table, "-o", str(file), code=2)
    assert file.read_text() == "mine"
    _, err = bench(capsys, "hall", "table", table, "-o", str(tmp_path / "edges.txt"), code=2)
    assert "must end in .toml or .json" in err
    bench(capsys, "hall", "table", table, "-o", str(tmp_path / "edges.json"))
    assert json.loads((tmp_path / "edges.json").read_text())["hall_offset"]

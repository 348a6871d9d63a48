"""What `bench live` says of Hall sensors while it runs: of shafts known by formula, and of the simulated drive."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hall_motor import REAL, TABLE_I, TICK_HZ, Motor, capture
from virtual_run import RecordingScreen, WatchedLink, run, simulated

from bench.device.client import Client
from bench.device.heard import ClockRestarted
from bench.device.node import Node
from bench.findings.health import examine
from bench.hall.trace import Recorded, trace
from bench.live.hall_sensors import HallSensors, Said
from bench.record.reader import Run
from bench.signal.capture import Capture
from bench.signal.units import RPM
from protocol.streams import Gap, SampleChunk
from sim.ports.virtual import VirtualLink
from tests.bench.hall_cases.drives import healthy
from tests.bench.hall_cases.recording import Contact, Encoder, Pulses, Recording, pieces
from tests.bench.hall_cases.shaft import Way
from tests.choice import chosen

CHUNK = 320  # samples, 20 ms
RAMP = tuple((6.0 * math.pi * k, 0.05) for k in range(1, 11))  # to 30 electrical revolutions a second in 0.5 s
STEADY = ((60.0 * math.pi, 1.0),)
SLOW = ((4.0 * math.pi, 8.0),)  # 16 electrical revolutions
MOTOR = Motor(delta_deg=TABLE_I, turns=RAMP)
FORWARD = Recording(way=Way(((0.0, 240.0), (13.0, 240.0)), ((0.0, 13.0),)))
"""24 electrical revolutions a second, one way."""


def judged(motor: Motor, late: float, lost: range = range(0), chunk: int = CHUNK, every: int = 1) -> HallSensors:
    """The samples, each `every`, in chunks, and edges `late`, s, after the samples of their time, without `lost`."""
    seen = capture(motor)
    samples, edges = seen.samples, seen.edges
    config = replace(samples.config, decimation=samples.config.decimation * every)
    judge = HallSensors(config, True, seen.parameters)
    came = edges.tick + round(late * TICK_HZ)
    given = 0
    for first in range(0, len(samples), chunk):
        at = slice(first, first + chunk, every)
        part = SampleChunk(config, samples.index[at], samples.tick[at], samples.raw[at], ())
        upto = int(np.searchsorted(came, part.tick[-1], side="right"))
        now = np.setdiff1d(np.arange(given, upto), lost)
        given = upto
        if len(now):
            behind = tuple(Gap(int(k), len(lost), 1, False) for k in np.flatnonzero(now == lost.stop) if len(lost))
            columns = ("tick", "hall_old", "hall_new", "illegal", "encoder", "index")
            judge.take(replace(edges, **{name: getattr(edges, name)[now] for name in columns}, gaps=behind))
        judge.take(part)
    return judge


def causes(judge: HallSensors) -> list[str]:
    return [finding.cause for finding in judge.findings()]


def of_capture(seen: Capture, edges: bool = True) -> tuple[HallSensors, list[Said]]:
    """Piece by piece; `edges`: whether they are streamed."""
    judge = HallSensors(seen.samples.config, edges, seen.parameters)
    for piece in pieces(seen):
        if edges or isinstance(piece, SampleChunk):
            judge.take(piece)
    judge.findings()
    return judge, list(judge.news())


@pytest.mark.parametrize("late", [0.0, 0.02, 0.2, 0.4])
@pytest.mark.parametrize(
    "turns", [RAMP + STEADY, STEADY, RAMP[:5] + STEADY, SLOW], ids=["ramp", "steady", "half", "slow"]
)
def test_edges_that_come_late_are_counted_where_they_belong(turns: tuple[tuple[float, float], ...], late: float):
    for sign in (1.0, -1.0):
        judge = judged(MOTOR.but(turns=[(sign * omega, seconds) for omega, seconds in turns]), late)
        assert causes(judge) == []
        turned = sum(abs(omega) * seconds for omega, seconds in turns) / math.tau
        assert judge.turned == pytest.approx(turned, rel=0.05)
        assert not judge.pieces.too_late


@pytest.mark.parametrize("late", [0.0, 0.2])
@pytest.mark.parametrize("knows", [2, 4, 5, 7, 9])
def test_wrong_pole_pairs_are_named_all_the_same(knows: int, late: float) -> None:
    """The shaft has six; the firmware makes an electrical angle of the encoder's with what it knows."""
    motor = MOTOR.but(turns=RAMP + STEADY, n_p=knows, encoder=lambda theta: theta * knows / 6)
    [cause] = causes(judged(motor, late))
    assert cause.startswith(f"wrong number of pole pairs: {knows} in the drive, 6 would fit; or ")


@pytest.mark.parametrize("late", [0.9, 1.5])
def test_edges_that_come_after_all_waiting_leave_it_open(late: float) -> None:
    """A device that keeps its edges too long, or dates them by another clock: no accusation, and not ok either."""
    judge = judged(MOTOR.but(turns=((60.0 * math.pi, 3.0),)), late)
    assert judge.pieces.too_late
    assert causes(judge) == []


def test_hall_sensors_of_which_no_edge_comes_are_named() -> None:
    [cause] = causes(judged(MOTOR.but(turns=STEADY), 10.0))
    assert "no Hall edge came" in cause


def test_lost_edges_are_no_fault() -> None:
    """Of 360 edges in 2 s 60 in a row are missing."""
    assert causes(judged(MOTOR.but(turns=((60.0 * math.pi, 2.0),)), 0.02, range(100, 160))) == []


def test_too_few_samples_are_told() -> None:
    """100 electrical revolutions a second: 50 samples cannot follow them, 500 can."""
    motor = MOTOR.but(turns=((200.0 * math.pi, 2.0),))
    few, enough = judged(motor, 0.1, every=320, chunk=3200), judged(motor, 0.1, every=32, chunk=3200)
    assert causes(few) == causes(enough) == []
    assert (few.pieces.too_fast, enough.pieces.too_fast) == (True, False)
    assert few.turned == 0.0


REWIRED = {
    "exchanged": lambda abc: (abc[1], abc[0], abc[2]),
    "rotated": lambda abc: (abc[2], abc[0], abc[1]),
    "inverted": lambda abc: (abc[0], 1 - abc[1], abc[2]),
    "open": lambda abc: (abc[0], abc[1], 1),
    "shorted": lambda abc: (0, abc[1], abc[2]),
}


@pytest.mark.parametrize("edges", [True, False], ids=["edges", "samples alone"])
@pytest.mark.parametrize("rewire", REWIRED.values(), ids=REWIRED)
def test_a_run_names_wires_as_a_check_of_its_recording_does(rewire, edges: bool) -> None:
    recorded = capture(REAL.but(rewire=rewire, parameters={"hall_offset": 0.0}))
    judge, _ = of_capture(recorded, edges)
    [of_run], [of_check] = judge.findings(), examine(trace(recorded)).findings
    assert of_check.cause.startswith(of_run.cause)


@pytest.mark.parametrize("rewire", REWIRED.values(), ids=REWIRED)
def test_wires_are_named_of_a_motor_that_cannot_start(rewire) -> None:
    """It turns for 1.2 electrical revolutions: too little for a check."""
    recorded = capture(REAL.but(rewire=rewire, turns=((6.0, 1.25), (-6.0, 1.25)), parameters={"hall_offset": 0.0}))
    assert examine(trace(recorded)).missing
    full = capture(REAL.but(rewire=rewire, parameters={"hall_offset": 0.0}))
    [of_run], [of_check] = of_capture(recorded)[0].findings(), examine(trace(full)).findings
    named, name = of_check.cause, of_run.cause
    assert named.startswith(name)


FAULTS = {
    "contact": (FORWARD.with_effect(Contact((1,), 0.3, 0.01, since=6.0)), "contact", 6.0, 3.0),
    "dead": (FORWARD.with_effect(Contact((2,), 1.0, 0.0, 0, since=6.0)), "dead", 6.0, 3.0),
    "pulses": (FORWARD.with_effect(Pulses((0, 1, 2), 20.0, (5e-6, 10e-6))), "pulses", 0.0, 3.0),
    "slip": (FORWARD.but(encoder=Encoder(slips=((6.0, 12.0),))), "encoder_slipped", 6.0, 7.0),
}


@pytest.mark.parametrize(("recording", "code", "since", "within"), FAULTS.values(), ids=FAULTS)
def test_a_fault_is_said_once_soon_after_it_began(recording: Recording, code: str, since: float, within: float) -> None:
    seen = recording.capture()
    judge, said = of_capture(seen)
    assert [each.finding.code for each in said] == [code]
    assert since < said[0].last / seen.tick_hz < since + within
    assert {finding.code for finding in judge.findings()} == {f.code for f in examine(trace(seen)).findings} == {code}


@pytest.mark.slow
def test_of_many_edges_of_which_some_are_measured_none_seems_dead() -> None:
    """600 edges a second: of those of the last seconds, and of all, every second block is kept."""
    fast = Recording(way=Way(((0.0, 1000.0), (25.0, 1000.0)), ((0.0, 25.0),)))
    for recording in (fast, fast.but(encoder=None)):
        with patch("bench.live.hall_sensors.MOST_EDGES", 5_000):
            judge, said = of_capture(recording.capture())
        assert (judge.findings(), said) == ([], [])


@pytest.mark.slow
def test_gaps_and_a_new_clock_are_no_faults() -> None:
    """Pieces are lost, samples and edges; then the drive boots again."""
    seen = healthy(11).capture()
    judge = HallSensors(seen.samples.config, True, seen.parameters)
    lost: set[type] = set()
    for number, piece in enumerate([*pieces(seen), ClockRestarted(1, 0), *pieces(seen)]):
        if isinstance(piece, ClockRestarted):
            judge.take(piece)
        elif number % 17 in (5, 6):
            lost.add(type(piece))
        else:
            judge.take(replace(piece, gaps=(Gap(0, 100, 3, False),)) if type(piece) in lost else piece)
            lost.discard(type(piece))
    assert (judge.findings(), list(judge.news())) == ([], [])


def test_what_was_found_before_the_drive_booted_again_stays() -> None:
    faulty = FORWARD.with_effect(Contact((2,), 1.0, 0.0, 0, since=6.0)).capture()
    judge = HallSensors(faulty.samples.config, True, faulty.parameters)
    for piece in [*pieces(faulty), ClockRestarted(1, 0), *pieces(FORWARD.capture())]:
        judge.take(piece)
    assert [finding.code for finding in judge.findings()] == ["dead"]


def test_a_judge_that_fails_ends_no_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise ValueError("five is no number")

    monkeypatch.setattr("bench.live.hall_sensors.examine", fails)
    ended = run(WatchedLink(simulated()), duration=1.5)
    assert ended.exit_code == 0
    assert "Hall sensors (they could not be judged: ValueError: five is no number)" in ended.summary.result


@pytest.mark.slow
def test_of_a_healthy_drive_nothing_is_said() -> None:
    for seed in chosen("live hall", range(300), 4):
        judge, said = of_capture(healthy(seed).capture())
        assert (judge.findings(), said, judge.error) == ([], [], "")


# -- the simulated drive --------------------------------------------------------------------------------------------


def test_a_bounce_that_begins_is_told_while_the_motor_turns_on(tmp_path: Path) -> None:
    """Sensor b of the simulated drive bounces from 2 s after its boot on."""
    faulty = simulated(faults__hall__bounce=[0.0, 0.5, 0.0], faults__begin=2.0)
    screen, link = RecordingScreen(), WatchedLink(faulty)
    ended = run(link, screen=screen, duration=4.5, save=tmp_path / "a.run", observer="encoder")
    said = [note for note in screen.notes if "Hall sensors" in note]
    assert [note.partition(": ")[2][:16] for note in said] == ["sensor b bounces"]
    recording = Run(tmp_path / "a.run")
    [mark] = [mark for mark in recording.marks if "bounces" in mark.name]
    assert 2.0 < mark.last_tick / recording.info.tick_hz < 5.0
    assert ended.exit_code == 1
    assert ended.summary.result.startswith("implausible: sensor b bounces")
    assert ended.summary.asked[0].speed_came_rpm == pytest.approx(500.0, rel=0.02)  # to the end
    assert [finding.code for finding in examine(trace(Recorded(recording))).findings] == ["bounce"]


def test_a_drive_that_is_only_watched_is_judged_by_its_hall_sensors_alone() -> None:
    """Somebody else turns it."""
    for bounce, exit_code in ((0.0, 0), (0.5, 1)):
        device = simulated(faults__hall__bounce=[bounce, 0.0, 0.0], firmware__watchdog=1.0)
        node = Node(Client(VirtualLink(device)), 1)
        node.arm()
        node.start()
        node.speed(500.0 * RPM)
        ended = run(WatchedLink(device), duration=2.0, speed_rpm=None)
        assert ended.exit_code == exit_code


@pytest.mark.parametrize(("declared", "exit_code"), [(math.radians(30.0), 0), (0.0, 1)])
def test_a_ring_at_30_deg(declared: float, exit_code: int) -> None:
    """It is no fault where the drive knows it."""
    ended = run(WatchedLink(simulated(hall__offset_deg=30.0, firmware__hall_offset=declared)), duration=3.0,
                observer="encoder")  # fmt: skip
    assert ended.exit_code == exit_code
    assert ("hall_offset" in ended.summary.result) == bool(exit_code)

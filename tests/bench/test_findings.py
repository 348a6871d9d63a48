"""What `bench.findings` says of a shaft known by formula: of pieces of a run as of a recording, by one table."""

from __future__ import annotations

import ast
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hall_motor import PWM_HZ, REAL, TABLE_I, TICK_HZ, Motor, capture

from bench.findings import thresholds
from bench.findings.health import examine
from bench.findings.pole_pairs import ComparedTurns
from bench.findings.wiring import Wires
from bench.hall.trace import trace
from bench.signal.waveforms.sectors import steps_between
from protocol.streams import Gap, SampleChunk

CHUNK = 320  # samples, 20 ms
RAMP = tuple((6.0 * math.pi * k, 0.05) for k in range(1, 11))  # to 30 electrical revolutions a second in 0.5 s
STEADY = ((60.0 * math.pi, 1.0),)
SLOW = ((4.0 * math.pi, 8.0),)  # 16 electrical revolutions
MOTOR = Motor(delta_deg=TABLE_I, turns=RAMP)


def found(motor: Motor, late: float, lost: range = range(0), chunk: int = CHUNK, every: int = 1) -> ComparedTurns:
    """The samples, each `every`, in chunks, and edges `late`, s, after the samples of their time, without `lost`."""
    seen = capture(motor)
    samples, edges = seen.samples, seen.edges
    turns = ComparedTurns(PWM_HZ / every, motor.n_p)
    came = edges.tick + round(late * TICK_HZ)
    given = 0
    for first in range(0, len(samples), chunk):
        at = slice(first, first + chunk, every)
        part = SampleChunk(samples.config, samples.index[at], samples.tick[at], samples.raw[at], ())
        upto = int(np.searchsorted(came, part.tick[-1], side="right"))
        now = np.setdiff1d(np.arange(given, upto), lost)
        given = upto
        if len(now):
            behind = tuple(Gap(int(k), len(lost), 1, False) for k in np.flatnonzero(now == lost.stop) if len(lost))
            columns = ("tick", "hall_old", "hall_new", "illegal", "encoder", "index")
            came_now = replace(edges, **{name: getattr(edges, name)[now] for name in columns}, gaps=behind)
            turns.edges(came_now, steps_between(came_now.hall_old, came_now.hall_new))
        turns.samples(part, part.physical("theta_enc"))
    return turns


@pytest.mark.parametrize("late", [0.0, 0.02, 0.1, 0.2])
@pytest.mark.parametrize(
    "turns", [RAMP + STEADY, STEADY, RAMP[:5] + STEADY, SLOW], ids=["ramp", "steady", "half", "slow"]
)
def test_edges_that_come_late_are_counted_where_they_belong(turns: tuple[tuple[float, float], ...], late: float):
    for sign in (1.0, -1.0):
        judged = found(MOTOR.but(turns=[(sign * omega, seconds) for omega, seconds in turns]), late)
        assert judged.compared
        assert list(judged.findings()) == []


@pytest.mark.parametrize("late", [0.0, 0.2])
@pytest.mark.parametrize("knows", [2, 4, 5, 7, 9])
def test_wrong_pole_pairs_are_named_all_the_same(knows: int, late: float) -> None:
    """The shaft has six; the firmware makes an electrical angle of the encoder's with what it knows."""
    motor = MOTOR.but(turns=RAMP + STEADY, n_p=knows, encoder=lambda theta: theta * knows / 6)
    [finding] = found(motor, late).findings()
    assert finding.cause == f"n_p = {knows} is wrong, or sensors or encoder are (6.0 would fit)"
    both_ways = motor.but(turns=(*motor.turns, *((-omega, seconds) for omega, seconds in motor.turns)))
    [checked] = examine(trace(capture(both_ways))).findings
    assert checked.cause.startswith(f"wrong number of pole pairs: {knows} in the drive, 6 would fit; or ")


@pytest.mark.parametrize("late", [0.9, 1.5])
def test_edges_that_come_after_all_waiting_leave_it_open(late: float) -> None:
    """A device that keeps its edges too long, or dates them by another clock: no accusation, and not ok either."""
    judged = found(MOTOR.but(turns=((60.0 * math.pi, 3.0),)), late)
    assert judged.too_late
    assert not judged.compared
    assert list(judged.findings()) == []


def test_dead_hall_sensors_are_named() -> None:
    [finding] = found(MOTOR.but(turns=STEADY), 10.0).findings()
    assert "the Hall sensors 0.0 in that direction" in finding.evidence[0]


def test_lost_edges_are_no_wrong_pole_pairs() -> None:
    """A block with a gap is left out: of 360 edges in 2 s 60 in a row are missing, more than a block has."""
    judged = found(MOTOR.but(turns=((60.0 * math.pi, 2.0),)), 0.02, range(100, 160))
    assert judged.compared
    assert list(judged.findings()) == []


def test_a_short_run_is_not_judged() -> None:
    judged = found(MOTOR, 0.1)
    assert not judged.compared
    assert list(judged.findings()) == []


def test_too_few_samples_are_told() -> None:
    """100 electrical revolutions a second: 50 samples cannot follow them, 500 can."""
    motor = MOTOR.but(turns=((200.0 * math.pi, 2.0),))
    assert found(motor, 0.1, every=320, chunk=3200).too_fast
    assert not found(motor, 0.1, every=32, chunk=3200).too_fast


@pytest.mark.parametrize("rewire", [
    lambda abc: (abc[1], abc[0], abc[2]), lambda abc: (abc[2], abc[0], abc[1]),
    lambda abc: (abc[0], 1 - abc[1], abc[2]), lambda abc: (abc[0], abc[1], 1), lambda abc: (0, abc[1], abc[2]),
], ids=["exchanged", "rotated", "inverted", "open", "shorted"])  # fmt: skip
def test_a_run_names_wires_as_a_check_of_its_recording_does(rewire) -> None:
    recorded = capture(REAL.but(rewire=rewire, parameters={"hall_offset": 0.0}))
    theta, wires = recorded["theta_enc"].copy(), Wires(0.0)
    theta[::97] = math.nan  # a float angle may be none, and slow links deliver single samples
    for rows in np.split(np.arange(len(recorded)), [1, 2, 2, *range(3000, len(recorded), 3000)]):
        wires.add(theta[rows], recorded.samples.raw["hall"][rows])
    [of_run], [of_check] = wires.findings(), examine(trace(recorded)).findings
    assert of_check.cause.startswith(of_run.cause)
    assert of_check.advice.startswith(of_run.advice.partition(",")[0])


def test_every_threshold_says_where_it_comes_from() -> None:
    table = ast.parse(Path(thresholds.__file__).read_text()).body
    said = [isinstance(after, ast.Expr) for node, after in pairwise(table) if isinstance(node, ast.Assign)]
    assert len(said) > 20
    assert all(said)

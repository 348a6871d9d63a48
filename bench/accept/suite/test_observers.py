"""Every observer that the drive has, in both directions, at two speeds: its angle by the encoder.

The drive runs on the encoder and the load machine holds the speed, so that no observer spoils another's signals. What
is asked of an angle is what its kind can reach: half a Hall sector for a centre that is held, the Hall ring's own
misplacement for those that take edges for ideal, little for those that look at the back-EMF or know the edges.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest

from bench.accept import Capture, Drive, Limits, Ratings, called, energises, limits, needs
from bench.accept.fixtures import Record
from bench.accept.suite.common import (
    TURNS,
    Measure,
    electrical_turn,
    offsets_by_encoder,
    ratio,
    speed_rpm,
    whole_turns,
)
from bench.rig.loads import NodeLoad
from bench.signal.waveforms import FORWARD, REVERSE
from protocol.signals import SOURCE_NAMES, AngleSource

SPEEDS = {"slow": 1 / 6, "fast": 2 / 3}  # of the rated speed
WAYS = {"forwards": 1, "backwards": -1}
LOAD = 1 / 4  # of the rated current
LESSONS = (1 / 16, 1 / 2, 1.0, 1 / 8)
"""Currents, as shares, with which an observer that learns is turned both ways: it takes a load that varies."""
LEARNING = 1 / 3, 0.7  # of the rated speed, and s for each of them
EDGES = tuple(f"edge_{way}_{s}" for way in ("up", "down") for s in range(1, 7))


class Reach(NamedTuple):
    """What an observer can reach, deg, at the slow speed and at the fast one."""

    mean: tuple[float, float]
    """Either sign, apart from the Hall ring's where `of_ring`."""
    std: tuple[float, float]
    of_ring: bool = False
    """It takes the edges for ideal: its mean error is that of the edges, and is measured from there."""
    taught: bool = False
    """It is told where the edges lie, by the parameters `edge_up_1` … `edge_down_6`."""
    learns: bool = False
    """It has to be turned both ways with several loads first."""
    settling: float = 0.4
    """s after a change of the speed: one that models the shaft takes its time."""
    than: str = ""
    """The channel of an observer that it is meant to better where sensors are good, and must not be worse than."""


BACK_EMF = Reach((2.5, 2.5), (4.5, 5.5))
SECTOR = Reach((2.5, 2.5), (21.0, 21.0), of_ring=True)
REACH = {
    "average-speed": Reach((2.5, 2.5), (12.0, 12.0), of_ring=True),
    "vector-tracking": BACK_EMF,
    "load-angle": BACK_EMF,
    "sector-centre": SECTOR,
    "lookup-table": Reach((1.5, 1.5), (2.0, 2.0), taught=True),
    "hall-vector": Reach((3.0, 3.0), (5.0, 4.0), of_ring=True, settling=2.0),
    "hall-vector-decoupled": Reach((3.0, 3.0), (4.0, 4.0), of_ring=True, settling=2.0, than="hv"),
    "programmable-filter": BACK_EMF,
    "vector-tracking-q15": BACK_EMF,
    "edge-kalman": Reach((2.5, 2.5), (1.0, 0.8), learns=True),
}
"""By the name of the angle source; one that is not here reaches what the centre of a sector does."""
LITTLE = 1.0  # deg


def _declared(short: str, reach: Reach) -> list[Limits]:
    from_ring = ", from where the Hall ring is" if reach.of_ring else ""
    found = []
    for speed, mean, std in zip(SPEEDS, reach.mean, reach.std, strict=True):
        for way in WAYS:
            found += [
                Limits(f"error_mean.{speed}.{way}", "deg", -mean, mean, f"mean error of theta_{short}{from_ring}"),
                Limits(f"error_std.{speed}.{way}", "deg", None, std, "its standard deviation"),
            ]
        if reach.than:
            about = f"std over that of theta_{reach.than}, larger of both directions; below {LITTLE:g} deg as that"
            found.append(Limits(f"ratio.{speed}", "", None, 1.0, about))
    return found


def _needed(short: str, reach: Reach) -> list[str]:
    more = [f"parameter:{name}" for name in EDGES] if reach.taught else []
    return [f"channel:theta_{name}" for name in (short, reach.than) if name] + more


def _case(name: str, source: AngleSource) -> Any:
    short, reach = source.short, REACH.get(name, SECTOR)
    return pytest.param(short, reach, id=name, marks=[limits(*_declared(short, reach)), needs(*_needed(short, reach))])


CASES = [_case(name, source) for name, source in SOURCE_NAMES.items() if source != AngleSource.ENCODER]


@called("Observer: {id}")
@needs(*TURNS, "encoder", "observer:encoder", "load.speed", "feature:EDGES", "channel:hall")
@energises(rated_speed=SPEEDS["fast"], rated_current=1)
@pytest.mark.parametrize(("short", "reach"), CASES)
def test_observer(
    short: str, reach: Reach, drive: Drive, rated: Ratings, load: NodeLoad, record: Record, measure: Measure
) -> None:
    """An observer's angle at 1/6 and 2/3 of the rated speed, forward and reverse, at a quarter of the current."""
    points = {
        (name, way): sign * speed_rpm(drive, rated, share)
        for name, share in SPEEDS.items()
        for way, sign in WAYS.items()
    }
    drive.start("encoder")
    drive.current(LOAD * rated.current)
    if reach.taught:
        _teach(drive, [_run(drive, load, record, points["slow", way], reach.settling) for way in WAYS])
    elif reach.learns:
        share, seconds = LEARNING
        for sign in WAYS.values():
            load.speed(rpm=sign * speed_rpm(drive, rated, share))
            for current in LESSONS:
                drive.current(current * rated.current)
                record.wait(seconds)
        drive.current(LOAD * rated.current)
    runs = {point: _run(drive, load, record, speed, reach.settling) for point, speed in points.items()}
    drive.stop()
    for (speed, way), run in runs.items():
        error = run.position_error(f"theta_{short}")
        ring = _ring(run, WAYS[way]) if reach.of_ring else 0.0
        mean = math.atan2(np.sin(error).mean(), np.cos(error).mean())
        measure(f"error_mean.{speed}.{way}", math.degrees(mean + ring), run)
        measure(f"error_std.{speed}.{way}", np.degrees(error.std()), run)
    for speed in SPEEDS if reach.than else ():
        both = [runs[speed, way] for way in WAYS]
        measure(f"ratio.{speed}", max(_ratio(run, short, reach.than) for run in both), *both)


def _run(drive: Drive, load: NodeLoad, record: Record, speed: float, settling: float) -> Capture:
    """Whole turns at a forced speed in r/min, `settling` s after the change."""
    load.speed(rpm=speed)
    record.wait(settling + 6.0 * electrical_turn(drive, speed))
    return whole_turns(record(max(0.25, 2.2 * 60.0 / abs(speed))))


def _ratio(run: Capture, short: str, other: str) -> float:
    mine, theirs = (float(np.degrees(run.position_error(f"theta_{name}").std())) for name in (short, other))
    return ratio(mine, theirs, LITTLE)


def _ring(run: Capture, sign: int) -> float:
    """Mean of ideal less actual angle of the edges met in one direction, rad, each sector as wide as it is."""
    delta = offsets_by_encoder([run]).mean
    way = delta[:, FORWARD if sign > 0 else REVERSE]
    width = math.pi / 3.0 + way - np.roll(way, -1)
    return float((width * 0.5 * (way + np.roll(way, -1))).sum() / math.tau)


def _teach(drive: Drive, turning: Sequence[Capture]) -> None:
    """Tell the drive where the edges lie by the encoder, each way."""
    delta = offsets_by_encoder(turning).mean
    farthest = math.degrees(float(np.abs(delta).max()))
    assert farthest < 30.0, f"a Hall edge lies {farthest:.0f} deg from its place: wires or ring are not as told"
    for way, column in (("up", FORWARD), ("down", REVERSE)):
        for s in range(6):
            drive.set(f"edge_{way}_{s + 1}", float(delta[s, column]))

"""What the Kalman filter on Hall edges has learned of a drive: its own filter, or the host's over what was recorded.

A lesson is what a parameter of the drive should be, with its standard deviation. Nothing here energises or writes
anything.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.hall.trace import Recorded, pieces_of
from bench.rig.rig import Rig
from bench.signal.capture import Capture
from bench.signal.trace import INPUTS as HALL_INPUTS
from protocol.descriptor import Channel
from protocol.signals import LESSONS
from sim.observers.hall_edges import EDGES

OBSERVER = "edge_kalman"
TOLD_BY = ("lesson_ek", "lesson_value_ek", "lesson_sigma_ek", "sensors_ek")
READS = 5.0  # s within which a drive has told all of them
LOOK = 0.1  # s between looks at what has come
HEADERS = ("parameter", "now", "learned", "sd")
NOT_BELIEVED = 0b111  # of the channel `sensors_ek`


class Lesson(NamedTuple):
    """What a parameter should be, and the standard deviation of that, in its unit."""

    value: float
    sd: float


@dataclass(frozen=True)
class Lessons:
    """What was learned, by the names of the drive's parameters, all edges among them."""

    of: Mapping[str, Lesson]
    whose: str
    """Which filter learned it, in words."""
    before: Mapping[str, float]
    """The drive's parameters as they were."""


def channels(rig: Rig) -> tuple[Channel, ...]:
    """What the drive has to stream that it tells its lessons."""
    return rig.drive.node.channels(TOLD_BY)


def read(rig: Rig) -> Capture:
    """Let the drive tell its lessons. BenchError where it tells nothing."""
    first, end = rig.tick(), rig.client.now() + READS
    while True:
        rig.wait(LOOK)
        capture = rig.between(first, rig.recorder.newest)
        if len(np.unique(capture.samples.raw["lesson_ek"])) >= len(LESSONS) or rig.client.now() > end:
            return capture


def learned(whole: Capture | Recorded, by: str) -> Lessons:
    """What the `drive`'s own filter has told, or the host's `filter` learns. BenchError where neither can be."""
    return _of_drive(whole) if by == "drive" else _of_host(whole)


def _of_drive(whole: Capture | Recorded) -> Lessons:
    last = _Last("the drive's own filter")
    for capture in pieces_of(whole, TOLD_BY):
        if lacking := [name for name in TOLD_BY if name not in capture]:
            asked = ",".join(f"+{name}" for name in TOLD_BY)
            missing = ", ".join(lacking)
            raise BenchError(f"no edges learned: {missing} not recorded: use bench live --channels {asked}")
        last.add(*(capture[name] for name in TOLD_BY))
    return last.lessons(capture.parameters)


def _of_host(whole: Capture | Recorded) -> Lessons:
    from bench.replay.estimators import INPUTS, Estimators, unfit  # numba takes 0.5 s, which a check has no need of
    from bench.replay.replay import not_replayable

    last = _Last("the host's filter, on the recorded data")
    estimators: Estimators | None = None
    for capture in pieces_of(whole, INPUTS):
        config = capture.samples.config
        if estimators is None:
            if why := not_replayable(config, capture.edges.config) or unfit(config, taught_by()):
                raise BenchError(f"no edges learned: the Kalman filter cannot run on this recording: {why}")
            estimators = Estimators([OBSERVER], capture.parameters, config, follow=False)
        estimators.edges(capture.edges)
        found = estimators.records(capture.samples)[OBSERVER]
        last.add(*(found[name] for name in ("lesson", "learned", "learned_sd", "sensors")))
    return last.lessons(capture.parameters)


def taught_by() -> tuple[str, ...]:
    """The channels that edges are learned from: on edges alone the filter knows where they lie to each other only."""
    from sim.observers.catalogue import CATALOGUE

    return CATALOGUE[OBSERVER].needs.helpful


class _Last:
    """What `whose` filter told last of each lesson."""

    def __init__(self, whose: str) -> None:
        self._whose = whose
        self._of: dict[int, Lesson] = {}
        self._sensors = 0

    def add(self, number: NDArray[Any], value: NDArray[Any], sd: NDArray[Any], sensors: NDArray[Any]) -> None:
        """Add samples, (n,) each: which lesson, what it is, its standard deviation; the sensors not believed."""
        numbers, back = np.unique(number[::-1], return_index=True)
        newest = zip(numbers.tolist(), (len(number) - 1 - back).tolist(), strict=True)
        self._of |= {int(k): Lesson(float(value[at]), float(sd[at])) for k, at in newest}
        self._sensors = int(sensors[-1])

    def lessons(self, before: Mapping[str, float]) -> Lessons:
        """All of them. BenchError where one of the edges never came, or a sensor is not believed."""
        whose = self._whose
        of = {LESSONS[k]: lesson for k, lesson in sorted(self._of.items()) if k < len(LESSONS)}
        of = {name: one for name, one in of.items() if math.isfinite(one.value) and 0.0 <= one.sd < math.inf}
        if missing := [name for name in EDGES if name not in of]:
            raise BenchError(f"no edges learned: {whose} reported nothing for {', '.join(missing)}")
        if wrong := self._sensors & NOT_BELIEVED:
            which = [name for bit, name in enumerate(HALL_INPUTS) if wrong >> bit & 1]
            raise BenchError(f"no edges learned: {whose} distrusts sensor {', '.join(which)}: run bench hall check")
        return Lessons(of, whose, before)


def as_json(lessons: Lessons) -> dict[str, dict[str, float]]:
    """Value and standard deviation by parameter, in its unit."""
    return {name: lesson._asdict() for name, lesson in lessons.of.items()}


def rows(lessons: Lessons) -> list[list[str]]:
    """A row for each: parameter, what it is now, what it should be, standard deviation; edges in degrees."""
    made = []
    for name, lesson in lessons.of.items():
        factor, unit = (math.degrees(1.0), " deg") if name in EDGES else (1.0, "")
        now = f"{factor * lessons.before[name]:.4g}" if name in lessons.before else "-"
        made.append([name + unit, now, f"{factor * lesson.value:.4g}", f"{factor * lesson.sd:.2g}"])
    return made

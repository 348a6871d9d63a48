"""How states look in the timelines: words, colours and lanes for the drive, its faults and the Hall sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
import rerun as rr

from bench.record.info import Mark, RunInfo
from bench.signal.colours import BAD, FAULTY, GOOD, OBSERVERS, OFF, QUIET, RGB, WARNING
from bench.signal.verdict import Verdict, worst
from bench.signal.waveforms.sectors import NUMERALS
from bench.view import schema
from protocol.codes import fault_names
from protocol.messages import DeviceEvent, DriveState, ErrorCode, EventCode, Fault
from protocol.signals import OTHER_SOURCE, SECTOR_OF_CODE, AngleSource

ILLEGAL = "invalid"
NO_EDGE = "no edge yet"
LOW, HIGH, NOT_KNOWN = "0", "1", "?"

HALL_COLOURS: dict[str, RGB] = {
    **dict.fromkeys((LOW, NOT_KNOWN, NO_EDGE), OFF),
    HIGH: (150, 150, 150),
    ILLEGAL: BAD,
    **{sector: (48 + 24 * i, 48 + 24 * i, 48 + 24 * i) for i, sector in enumerate(NUMERALS)},
}
"""Sectors are brighter from I to VI, so that a shaft that turns is a staircase where no name has room."""


def _shade(short: str) -> RGB:
    """An observer's colour as a ground of words."""
    red, green, blue = (6 * part // 10 for part in OBSERVERS[short].rgb)
    return red, green, blue


_ANGLE = "angle"  # the lane that the channel `status` alone can fill
UNKNOWN = "unknown"
NO_FAULT, COMPLETE, GAP = "no fault", "complete", "GAP"
CORRECTED = ", back-EMF correction on"
SOURCES = ("encoder", "average speed", "vector tracking", "another observer")
"""By the two bits of `status` that name an AngleSource."""
_SOURCE_COLOURS = {
    SOURCES[AngleSource.ENCODER]: _shade("enc"),
    SOURCES[AngleSource.AVERAGE_SPEED]: _shade("avg"),
    SOURCES[AngleSource.VECTOR_TRACKING]: _shade("vt"),
    SOURCES[OTHER_SOURCE]: QUIET,
}
DRIVE_LANES: dict[str, dict[str, RGB]] = {
    "state": {
        DriveState.BOOT.name: QUIET,
        DriveState.IDLE.name: QUIET,
        DriveState.ARMED.name: WARNING,
        DriveState.RUNNING.name: GOOD,
        DriveState.FAULT.name: BAD,
    },
    "faults": {NO_FAULT: OFF, **{fault.name or "": BAD for fault in Fault}},
    _ANGLE: {f"{word}{more}": colour for word, colour in _SOURCE_COLOURS.items() for more in ("", CORRECTED)},
    "telemetry": {COMPLETE: OFF, GAP: BAD},
}
"""Words of each lane of the drive, by its entity."""
VERDICT_COLOURS: dict[Verdict, RGB] = {
    Verdict.PASS: GOOD,
    Verdict.FAIL: BAD,
    Verdict.INVALID: WARNING,
    Verdict.ERROR: FAULTY,
    Verdict.ABORTED: QUIET,
    Verdict.SKIPPED: OFF,
}
UNMARKED = "unmarked"
_NAMED = 2  # marks that a stretch of the lane names; the log has them all
DRIVE_COLOURS = {UNKNOWN: OFF} | {word: colour for lane in DRIVE_LANES.values() for word, colour in lane.items()}


def state_colours(run: RunInfo) -> dict[str, dict[str, RGB]]:
    """Colours of states, by entity."""
    return {schema.HALL_LANES: HALL_COLOURS, drive_entity(run): DRIVE_COLOURS}


def _hall_words() -> pa.Array:
    lanes = []
    for code, sector in enumerate(SECTOR_OF_CODE):
        sensors = [(LOW, HIGH)[code >> bit & 1] for bit in range(3)]
        lanes.append([*sensors, NUMERALS[sector] if sector >= 0 else ILLEGAL])
    lanes.append([NOT_KNOWN] * 3 + [NO_EDGE])
    return pa.array(lanes, pa.list_(pa.string()))


HALL_WORDS = _hall_words()
"""By Hall code, and for UNKNOWN_CODE: states of the lanes a, b, c and sector."""


def lanes(run: RunInfo) -> tuple[str, ...]:
    """The lanes of the drive that the run can fill."""
    return tuple(lane for lane in DRIVE_LANES if lane != _ANGLE or "status" in run.words)


def drive_entity(run: RunInfo) -> str:
    """The entity of the drive's lanes: its name tells which there are."""
    return schema.DRIVE if _ANGLE in lanes(run) else schema.DRIVE_WITHOUT_ANGLE


def angle_text(source: int, corrected: bool) -> str:
    """Whose angle the control uses, and whether vector tracking's is corrected by the back-EMF."""
    return f"{SOURCES[source]}{CORRECTED if corrected else ''}"


def configuration(colours: Mapping[str, RGB]) -> rr.StateConfiguration:
    """Colours and labels of the states of an entity."""
    packed = np.array([r << 24 | g << 16 | b << 8 | 0xFF for r, g, b in colours.values()], np.uint32)
    visible = [value not in (UNKNOWN, UNMARKED) for value in colours]
    return rr.StateConfiguration(values=list(colours), labels=list(colours), colors=packed, visible=visible)


def fault_text(faults: int) -> str:
    """Names of the fault bits."""
    return " ".join(fault_names(faults)) or NO_FAULT


def mark_lane(marks: Sequence[Mark], moment: int) -> tuple[list[tuple[int, str]], dict[str, RGB]]:
    """One lane for marks that may overlap: ticks with the words from there on, and the words' colours.

    A mark of a moment, as one sets it by hand, is drawn as long as `moment` ticks.
    Where marks overlap, the worst verdict of them stands there, with the names that it belongs to.
    """
    lane: list[tuple[int, str]] = []
    colours: dict[str, RGB] = {UNMARKED: OFF}
    spans = [
        (mark.first_tick, mark.last_tick if mark.last_tick > mark.first_tick else mark.first_tick + moment, mark)
        for mark in marks
    ]
    for tick in sorted({tick for first, last, _ in spans for tick in (first, last)}):
        there = [mark for first, last, mark in spans if first <= tick < last]
        words = UNMARKED
        if there:
            judged = [mark.verdict for mark in there if mark.verdict is not None]
            verdict = worst(judged) if judged else None
            names = [mark.name for mark in there if mark.verdict is verdict]
            more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
            words = f"{verdict or 'mark'} {', '.join(names[:_NAMED])}{more}"
            colours[words] = QUIET if verdict is None else VERDICT_COLOURS[verdict]
        lane.append((tick, words))
    return lane, colours


MARK_LEVELS: dict[Verdict, str] = {Verdict.FAIL: "ERROR", Verdict.ERROR: "ERROR", Verdict.INVALID: "WARN"}
LEVEL_COLOURS: dict[str, RGB] = {"CRITICAL": (255, 90, 90), "ERROR": (255, 90, 90), "WARN": WARNING}
"""Colours of the log's lines, by level; all other levels have LINE_COLOUR: without one, the last colour would stay."""
LINE_COLOUR: RGB = (205, 205, 205)
EVENT_LEVELS: dict[int, str] = {
    EventCode.FAULT: "ERROR",
    EventCode.SETPOINT_REJECTED: "WARN",
    EventCode.ARM_LAPSED: "WARN",
}


def event_text(node: int, event: DeviceEvent) -> str:
    """One line for an event of node `node`."""
    match event.code:
        case EventCode.STATE_CHANGED:
            text = f"state {event.arg:g}" if event.number is None else DriveState(event.number).name
            text = f"state {text.removeprefix('state ')}"
        case EventCode.FAULT:
            text = f"FAULT {fault_text(event.faults)}"
        case EventCode.SETPOINT_REJECTED:
            text = f"setpoint rejected: {ErrorCode(event.number or 0).name} ({event.detail:g})"
        case EventCode.ARM_LAPSED:
            text = f"ARMED lapsed after {event.arg:g} s without START"
        case _:
            text = f"event {event.code} ({event.arg:g})"
    return f"node {node}: {text}"

"""How states look in the timelines: words, colours and lanes for the drive, its faults and the Hall sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
import rerun as rr

from bench.analysis.verdict import Verdict, worst
from bench.rerunio import schema
from protocol.codes import fault_names
from protocol.messages import DeviceEvent, DriveState, ErrorCode, EventCode, Fault
from protocol.signals import OTHER_SOURCE, SECTOR_OF_CODE, AngleSource

SECTORS = ("I", "II", "III", "IV", "V", "VI")
ILLEGAL = "illegal"
NO_EDGE = "no edge yet"

Colour = tuple[int, int, int]
_DARK, _DIM, _RED = (52, 52, 52), (84, 84, 84), (230, 40, 40)
_GREEN, _AMBER = (40, 130, 76), (200, 140, 20)

HALL_COLOURS: dict[str, Colour] = {
    **{f"{sensor}=0": _DARK for sensor in "abc"},
    **{f"{sensor}=1": schema.COLOURS[f"i_{sensor}"] for sensor in "abc"},
    **{sector: (_DIM, (110, 110, 110))[i % 2] for i, sector in enumerate(SECTORS)},
    **{f"{sensor}=?": _DARK for sensor in "abc"},
    ILLEGAL: _RED,
    NO_EDGE: _DARK,
}
_HALL_LABELS = {f"{sensor}={bit}": label for sensor in "abc" for bit, label in (("0", "0"), ("1", sensor), ("?", "?"))}

# Lanes of the drive: every word tells by itself which lane it stands in.
_LANES = ("state", "faults", "source", "correction", "telemetry")
_STATUS_LANES = frozenset(("source", "correction"))  # that the channel `status` alone can fill
UNKNOWN = "unknown"
NO_FAULT, COMPLETE, GAP = "no fault", "telemetry complete", "TELEMETRY GAP"
CORRECTION = ("back-EMF correction off", "back-EMF correction on")
_SOURCES = (  # by what `status` can tell
    "angle: encoder",
    "angle: average speed",
    "angle: vector tracking",
    "angle: another observer",
)
DRIVE_COLOURS: dict[str, Colour] = {
    UNKNOWN: _DARK,
    DriveState.BOOT.name: _DIM,
    DriveState.IDLE.name: _DIM,
    DriveState.ARMED.name: _AMBER,
    DriveState.RUNNING.name: _GREEN,
    DriveState.FAULT.name: _RED,
    NO_FAULT: _DARK,
    **{fault.name or "": _RED for fault in Fault},
    _SOURCES[AngleSource.ENCODER]: _DIM,
    _SOURCES[AngleSource.AVERAGE_SPEED]: (176, 116, 10),
    _SOURCES[AngleSource.VECTOR_TRACKING]: (40, 120, 180),
    _SOURCES[OTHER_SOURCE]: (120, 80, 180),
    CORRECTION[0]: _DARK,
    CORRECTION[1]: (60, 84, 140),
    COMPLETE: _DARK,
    GAP: _RED,
}
_VERDICT_COLOURS: dict[Verdict, Colour] = {
    Verdict.PASS: (38, 84, 58),
    Verdict.FAIL: _RED,
    Verdict.INVALID: _AMBER,
    Verdict.ERROR: (150, 70, 170),
    Verdict.ABORTED: _DIM,
    Verdict.SKIPPED: _DARK,
}
UNMARKED = "unmarked"
_NAMED = 2  # marks that a stretch of the lane names; the log has them all
STATE_COLOURS: dict[str, dict[str, Colour]] = {schema.HALL_LANES: HALL_COLOURS, schema.DRIVE: DRIVE_COLOURS}


def _hall_lanes() -> pa.Array:
    lanes = []
    for code in range(8):
        sector = SECTOR_OF_CODE[code]
        sensors = [f"{sensor}={code >> bit & 1}" for bit, sensor in enumerate("abc")]
        lanes.append([*sensors, SECTORS[sector] if sector >= 0 else ILLEGAL])
    lanes.append([*(f"{sensor}=?" for sensor in "abc"), NO_EDGE])
    return pa.array(lanes, pa.list_(pa.string()))


HALL_LANES = _hall_lanes()  # by Hall code, and for UNKNOWN_CODE: states of the lanes a, b, c and sector


def lanes(run: schema.RunInfo) -> tuple[str, ...]:
    """The lanes of the drive that the run can fill."""
    return tuple(lane for lane in _LANES if lane not in _STATUS_LANES or "status" in run.words)


def configuration(colours: Mapping[str, Colour]) -> rr.StateConfiguration:
    """Colours and labels of the states of an entity."""
    packed = np.array([r << 24 | g << 16 | b << 8 | 0xFF for r, g, b in colours.values()], np.uint32)
    visible = [value not in (UNKNOWN, UNMARKED) for value in colours]
    labels = [_HALL_LABELS.get(value, value) for value in colours]
    return rr.StateConfiguration(values=list(colours), labels=labels, colors=packed, visible=visible)


def state_name(value: int) -> str:
    """Name of a DriveState; an unknown one keeps its number."""
    return DriveState(value).name


def source_name(value: int) -> str:
    """Words for the two bits of `status` that name an AngleSource."""
    return _SOURCES[value]


def fault_text(faults: int) -> str:
    """Names of the fault bits."""
    return " ".join(fault_names(faults)) or NO_FAULT


def mark_lane(marks: Sequence[schema.Mark]) -> tuple[list[tuple[int, str]], dict[str, Colour]]:
    """One lane for marks that may overlap: ticks with the words from there on, and the words' colours.

    Where marks overlap, the worst verdict of them stands there, with the names that it belongs to.
    """
    lane: list[tuple[int, str]] = []
    colours: dict[str, Colour] = {UNMARKED: _DARK}
    for tick in sorted({tick for mark in marks for tick in (mark.first_tick, mark.last_tick)}):
        there = [mark for mark in marks if mark.first_tick <= tick < mark.last_tick]
        words = UNMARKED
        if there:
            verdict = worst(mark.verdict for mark in there)
            names = [mark.name for mark in there if mark.verdict is verdict]
            more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
            words = f"{verdict} {', '.join(names[:_NAMED])}{more}"
            colours[words] = _VERDICT_COLOURS[verdict]
        lane.append((tick, words))
    return lane, colours


MARK_LEVELS: dict[Verdict, str] = {Verdict.FAIL: "ERROR", Verdict.ERROR: "ERROR", Verdict.INVALID: "WARN"}
LEVEL_COLOURS: dict[str, Colour] = {"CRITICAL": (255, 90, 90), "ERROR": (255, 90, 90), "WARN": (240, 180, 60)}
"""Colours of the log's lines, by level; all other levels have LINE_COLOUR: without one, the last colour would stay."""
LINE_COLOUR: Colour = (205, 205, 205)
EVENT_LEVELS: dict[int, str] = {
    EventCode.FAULT: "ERROR",
    EventCode.SETPOINT_REJECTED: "WARN",
    EventCode.ARM_LAPSED: "WARN",
}


def event_text(node: int, event: DeviceEvent) -> str:
    """One line for an event of node `node`."""
    match event.code:
        case EventCode.STATE_CHANGED:
            text = f"state {event.arg:g}" if event.number is None else state_name(event.number)
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

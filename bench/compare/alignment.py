"""Where two runs are laid on each other: at a mark, at an event, or at their begin. Exact to a tick of each."""

from __future__ import annotations

import math
from fractions import Fraction

from bench.errors import BenchError
from bench.record.reader import Run
from bench.record.times import Side
from protocol.codes import DriveState, EventCode, fault_names
from protocol.messages import DeviceEvent

BEGIN = "begin"
_COMMANDS = {"ARM": DriveState.ARMED.name, "START": DriveState.RUNNING.name}
"""What a command brings about is what a user may call it."""
_NS = 10**9


def aligned(a: Run, b: Run, to: str, begin: float | None, end: float | None) -> tuple[Side, Side]:
    """Both runs from `begin` to `end`, s after what they are aligned `to`; None: as far as both go.

    `to`: "begin", the name of a mark, or that of an event (see `events`); NAME#2 is the second of that name. BenchError
    for a name that there is not or that there is more than once, and where the runs have no time in common.
    """
    zeros = [zero_of(run, to) for run in (a, b)]
    spans = [
        [Fraction(tick - zero, run.info.tick_hz) for tick in run.span] for run, zero in zip((a, b), zeros, strict=True)
    ]
    low, high = max(span[0] for span in spans), min(span[1] for span in spans)
    if begin is not None:
        low = max(low, _exact(begin))
    if end is not None:
        high = min(high, _exact(end))
    if low >= high:
        told = ", ".join(
            f"{run.path} from {float(span[0]):.3f} to {float(span[1]):.3f} s"
            for run, span in zip((a, b), spans, strict=True)
        )
        limits = [f"{option} {at:g}" for option, at in (("--from", begin), ("--to", end)) if at is not None]
        asked = f" within {' '.join(limits)}" if limits else ""
        raise BenchError(f"the runs have no time in common{asked}: aligned at {to} {told}")
    sides = []
    for run, zero in zip((a, b), zeros, strict=True):
        hz = run.info.tick_hz
        sides.append(Side(run, zero, zero + math.ceil(low * hz), zero + math.floor(high * hz)))
    return sides[0], sides[1]


def _exact(seconds: float) -> Fraction:
    """To a nanosecond: 0.1 s is a tenth."""
    return Fraction(round(seconds * _NS), _NS)


def seconds_of(run: Run, at: float | str | None, last: bool = False) -> float | None:
    """Device time in s of what `--from` or `--to` say: a time, or a name as `aligned` takes it; see `zero_of`."""
    return zero_of(run, at, last) / run.info.tick_hz if isinstance(at, str) else at


def zero_of(run: Run, to: str, last: bool = False) -> int:
    """The tick of `to`, see `aligned`; of a mark where it begins, or with `last` where it ends."""
    if not run.segments:
        raise BenchError(f"{run.path} has no samples and no Hall edges")
    if to == BEGIN:
        return run.span[0]
    name, sign, number = to.rpartition("#")
    if not sign or not number.isdigit():
        name, number = to, ""
    ticks = [mark.last_tick if last else mark.first_tick for mark in run.marks if mark.name == name]
    if not ticks:
        wanted = _COMMANDS.get(name.upper(), name.upper())
        ticks = [tick for tick, known in events(run) if known == wanted]
    if not ticks:
        raise BenchError(f"{run.path} has no mark and no event '{name}'; it has {_told(run)}")
    if not number and len(ticks) > 1:
        times = ", ".join(map(run.at, ticks[:10])) + (", …" if len(ticks) > 10 else "")
        raise BenchError(
            f"'{name}' occurs {len(ticks)} times in {run.path}, at {times}: choose one, such as {name}#1; "
            f"it has {_told(run)}"
        )
    chosen = int(number or 1)
    if not 1 <= chosen <= len(ticks):
        raise BenchError(f"'{name}' occurs {len(ticks)} times in {run.path}: there is no {to}")
    return ticks[chosen - 1]


def events(run: Run) -> list[tuple[int, str]]:
    """Tick and name of the drive's events: the new state of a change of state, else the event's code."""
    return [(event.tick, event_name(event)) for event in run.events if event.node == run.info.node]


def event_name(event: DeviceEvent) -> str:
    """Such as RUNNING, FAULT, SETPOINT_REJECTED; a change to the state FAULT is STATE_FAULT."""
    if event.code == EventCode.STATE_CHANGED and event.number is not None:
        name = DriveState(event.number).name
        return f"STATE_{name}" if name == EventCode.FAULT.name else name
    return EventCode(event.code).name


def event_words(event: DeviceEvent, node: int) -> str:
    """The name with what goes with it, and the device where it is not `node`."""
    words = event_name(event)
    if event.code == EventCode.FAULT and event.number is not None:
        words += f" {' '.join(fault_names(event.number))}"
    return words if event.node == node else f"node {event.node}: {words}"


def _told(run: Run) -> str:
    """The names that there are."""
    names = list(dict.fromkeys([BEGIN, *(mark.name for mark in run.marks), *(name for _, name in events(run))]))
    return ", ".join(names[:20]) + (f" and {len(names) - 20} more" if len(names) > 20 else "")

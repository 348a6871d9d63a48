"""Level 3, fourth part: captures that a change of state or a fault freezes. Chapter 19 of SPEC."""

from __future__ import annotations

import math

from bench.conform.captured import (
    NEVER,
    PART,
    RECORDS,
    armed,
    between,
    fitting_records,
    frozen,
    give_up,
    place_of,
    require_capture,
    status,
    taken,
)
from bench.conform.checks import Group
from bench.conform.device import EDGE_BYTES, PATIENCE, Device, faults_text, ids, require_granted
from bench.conform.levels import STATES
from bench.conform.verdicts import Failed, Unknown
from protocol.codes import CaptureState, CaptureTrigger, Command, EventCode, Fault
from protocol.messages import BlobRead, BlobReply, CaptureArm, CaptureReply

check = Group("capture", STATES)

WAITS = 0.2  # s in which a capture must not be frozen by nothing
ABOUT = 0.003  # s by which an event's tick may be off from what it tells
SHORT = 20  # records


def _around(device: Device, kind: CaptureTrigger) -> CaptureArm:
    """A request of few records before the trigger and from it on."""
    chosen = device.channels[:2]
    records = fitting_records(device, chosen, 2 * SHORT)
    return CaptureArm(kind, 0, 1, records // 2, records - records // 2, NEVER, chosen[0].id, channels=ids(chosen))


def _still_waits(device: Device, number: int, what: str) -> None:
    told = status(device)
    if (told.state, told.number) != (CaptureState.ARMED, number):
        raise Failed(f"{what}: capture {told.number} is {told.state.name}, {number} was armed")


@check("state-trigger", "19.19 19.14")
def state_trigger(device: Device) -> list[str]:
    """A capture that waits for STATE is frozen by ARM and by STOP, and by nothing before."""
    require_capture(device)
    probe, words = device.probe, []
    for command, argument in ((Command.ARM, device.hello.boot_id), (Command.STOP, 0)):
        request = _around(device, CaptureTrigger.STATE)
        begun = armed(device, request)
        probe.listen(WAITS)
        probe.command(Command.ARM, device.hello.boot_id ^ 1)
        _still_waits(device, begun.number, f"before {command.name}")
        began = probe.tick()[0]
        require_granted(probe.command(command, argument), command.name)
        ended = probe.tick()[1]
        if command == Command.ARM:
            device.feed()
        try:
            told = frozen(device, begun)
        except Unknown as never:
            raise Failed(f"{command.name} changed the state: {never}") from None
        taken(device, told)
        if told.trigger != CaptureTrigger.STATE or not between(began, told.tick, ended + 2 * device.ticks_per_period):
            raise Failed(f"{command.name} from tick {began} to {ended}: {told.trigger.name} at tick {told.tick}")
        words.append(f"{command.name}: the trigger's record {(told.tick - began) / device.hz * 1e3:.2f} ms after it")
        give_up(device)
    return words


def _by_fault(device: Device, begun: CaptureReply, words: str) -> CaptureReply:
    """Let the watchdog trip while this capture waits; what is FROZEN then. Raises Failed."""
    since, number = len(device.events(EventCode.FAULT)), begun.number
    beat = device.fault()
    try:
        told = frozen(device, begun)
    except Unknown as never:
        raise Failed(f"{words}, {faults_text(beat.faults)}: {never}") from None
    events = device.events(EventCode.FAULT)[since:]
    if told.number != number or told.trigger != CaptureTrigger.FAULT or not told.faults & Fault.WATCHDOG:
        raise Failed(
            f"{words}, number {number}: number {told.number}, trigger {told.trigger.name}, "
            f"faults {faults_text(told.faults) or 'none'}"
        )
    about = round(ABOUT * device.hz)
    if events and not between(events[0].tick - about, told.tick, events[0].tick + about):
        raise Failed(f"{words}: the trigger's record has tick {told.tick}, the EVENT FAULT {events[0].tick}")
    return told


def _ends(device: Device, told: CaptureReply) -> bytes:
    """The first and the last bytes of blob 1, which may be long. Raises Failed where its length is wrong."""
    size = told.records * told.sample_bytes + EDGE_BYTES * told.edges
    last = device.probe.get(BlobRead(1, PART, max(0, told.size - PART)), BlobReply)
    if not size == told.size == last.total:
        raise Failed(
            f"blob 1 has {last.total} bytes, size is {told.size}, {told.records} records of {told.sample_bytes} and "
            f"{told.edges} edges make {size}"
        )
    return device.probe.get(BlobRead(1, PART, 0), BlobReply).data + last.data


@check("fault-unasked", "19.15 19.16 19.17 19.21 19.22")
def fault_unasked(device: Device) -> str:
    """A fault freezes the last periods though nobody asked, and they stay through FAULT_CLEAR until OFF."""
    begun = require_capture(device)
    tick0 = device.configure(0, ids(device.channels[:1]), 100.0).reply.tick0
    device.probe.listen(WAITS)
    told = _by_fault(device, begun, "nothing was asked for")
    before = _ends(device, told)
    if wrong := place_of(told, tick0, device.ticks_per_period):
        raise Failed(wrong)
    if not told.first:
        raise Failed(f"none of the {told.records} records is before the fault")
    require_granted(device.probe.command(Command.FAULT_CLEAR, device.fresh().faults), "FAULT_CLEAR")
    if (now := status(device)) != told or _ends(device, told) != before:
        raise Failed(f"before FAULT_CLEAR it was {told}, after it {now}, or other bytes")
    give_up(device)
    words = f"WATCHDOG: {told.first} records before it and {told.after} from it on, {told.size} bytes"
    return f"{words}; the same after FAULT_CLEAR"


@check("fault-before-its-trigger", "19.16")
def fault_before_its_trigger(device: Device) -> str:
    """A fault freezes what waits for another trigger, and tells that it was a fault."""
    require_capture(device)
    begun = armed(device, _around(device, CaptureTrigger.ABOVE))
    told = _by_fault(device, begun, "ABOVE a level that is not reached")
    give_up(device)
    return f"armed by ABOVE; WATCHDOG: FROZEN by {told.trigger.name}, {told.first} records before it"


@check("fault-after-its-trigger", "19.16")
def fault_after_its_trigger(device: Device) -> str:
    """A fault after the trigger cuts nothing off: all records that were asked for are taken."""
    require_capture(device)
    chosen = device.channels[:1]
    records = fitting_records(device, chosen, RECORDS)
    seconds = 2 * device.watchdog + PATIENCE
    decimation = min(math.ceil(seconds * device.pwm_hz / records), 0xFFFF)
    device.arm()
    request = CaptureArm(CaptureTrigger.NOW, 0, decimation, 0, records, channels=ids(chosen))
    begun = armed(device, request)
    device.trip()
    told = frozen(device, begun)
    taken(device, told)
    give_up(device)
    if (told.number, told.trigger) != (begun.number, CaptureTrigger.NOW) or told.records < records:
        raise Failed(f"NOW, then a fault: trigger {told.trigger.name}, {told.records} of {records} records")
    return f"NOW, then WATCHDOG: all {told.records} records"

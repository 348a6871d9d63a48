"""Level 3, second part: SETPOINT. Chapters 5 and 8 of SPEC. Zero is the only valid setpoint sent."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator

from bench.conform.checks import Group
from bench.conform.device import Device
from bench.conform.levels import STATES
from bench.conform.probe import refusal
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from protocol.codes import DriveState, ErrorCode, EventCode, Feature, MessageType, SetpointMode
from protocol.messages import DeviceEvent, Heartbeat

check = Group("setpoint", STATES)

NO_MODE = 99
MODES = (SetpointMode.CURRENT, SetpointMode.SPEED, SetpointMode.TORQUE)
"""In the order in which zero is tried: no current is less than no speed."""


def payload(mode: int, counter: int, value: float = 0.0, value2: float = 0.0) -> bytes:
    """Of a SETPOINT."""
    return struct.pack("<BxHff", mode, counter & 0xFFFF, value, value2)


def send(device: Device, mode: int, counter: int, value: float = 0.0, value2: float = 0.0) -> Heartbeat:
    """Send a setpoint; returns a heartbeat that was made after it."""
    device.probe.send(device.probe.frame(MessageType.SETPOINT, payload(mode, counter, value, value2)))
    return device.fresh()


def is_taken(device: Device, mode: int, counter: int, value: float = 0.0, value2: float = 0.0) -> bool:
    """Send a setpoint; whether it is accepted: its counter is told, or no rejection is."""
    before, since = device.fresh().setpoints_rejected, len(device.events(EventCode.SETPOINT_REJECTED))
    beat = send(device, mode, counter, value, value2)
    rejected = beat.setpoints_rejected != before or len(device.events(EventCode.SETPOINT_REJECTED)) > since
    return beat.setpoint_counter == counter or not rejected


def accepted_mode(device: Device) -> SetpointMode:
    """A mode in which zero is accepted, in RUNNING. Raises Unknown."""
    for counter, mode in enumerate(MODES, 0x1201):
        if is_taken(device, mode, counter):
            return mode
    raise Unknown("zero was not accepted in any of the modes SPEED, CURRENT, TORQUE")


@check("length", "8.13 8.2")
def length(device: Device) -> str:
    """A SETPOINT of 11 or 13 bytes is refused with tid 0, before the state is checked, and counts as rejected."""
    before, since = device.fresh(), len(device.probe.heard)
    words = []
    for n in (11, 13):
        frame = device.probe.frame(MessageType.SETPOINT, (payload(1, 1) + b"\0")[:n])
        answer = device.probe.ask_frame(frame, tries=1)
        words.append(refusal(answer, ErrorCode.BAD_LENGTH, n, f"SETPOINT of {n} bytes in IDLE"))
    counted = (device.fresh().setpoints_rejected - before.setpoints_rejected) & 0xFFFF
    if counted != 2:
        raise Failed(f"{'; '.join(words)}; setpoints_rejected counted {counted} of 2")
    events = [event for _, event in device.probe.came(DeviceEvent, since) if event.code == EventCode.SETPOINT_REJECTED]
    if events and not _says(events[0], ErrorCode.BAD_LENGTH, 11):
        raise Failed(f"a SETPOINT of 11 bytes has the EVENT {code_name(events[0])}, detail {events[0].detail:.9g}")
    return f"{'; '.join(words)}; both counted"


@check("unanswered", "3.5")
def unanswered(device: Device) -> str:
    """A SETPOINT is not answered, whether it is accepted or rejected."""
    probe = device.probe
    rejected = probe.silence(probe.line.encode(probe.frame(MessageType.SETPOINT, payload(1, 2))), "a SETPOINT in IDLE")
    device.run()
    mode = accepted_mode(device)
    words = [rejected]
    for each, what in ((mode, "a SETPOINT in RUNNING"), (NO_MODE, "one of an unknown mode")):
        words.append(probe.silence(probe.line.encode(probe.frame(MessageType.SETPOINT, payload(each, 3))), what))
    return "; ".join(words)


@check("value2-unused", "8.7")
def value2_unused(device: Device) -> str:
    """SPEED 0 with a finite value2, which SPEED does not use without the feature COMMISSION, is accepted."""
    if device.offers(Feature.COMMISSION):
        raise NotApplicable("value2 of SPEED is i_d: the device has COMMISSION")
    device.run()
    if not is_taken(device, SetpointMode.SPEED, 0x0101):
        raise Unknown("SPEED 0 was not accepted")
    if not is_taken(device, SetpointMode.SPEED, 0x0102, 0.0, 1e9):
        raise Failed("SPEED 0 with value2 1e9 was rejected")
    return "SPEED 0 with value2 1e9: accepted"


@check("accepted", "8.15 5.15")
def accepted(device: Device) -> str:
    """Zero is accepted in RUNNING, and the heartbeat has its counter, also after a HELLO."""
    device.run()
    mode = accepted_mode(device)
    beat = send(device, mode, 0xFEDC)
    if beat.setpoint_counter == 0xFEDC:
        device.probe.hello()
        beat = device.fresh()
    if beat.setpoint_counter != 0xFEDC:
        raise Failed(f"setpoint_counter is {beat.setpoint_counter:#x}, the last setpoint had 0xfedc")
    return f"{mode.name} 0 with counter 0xfedc: accepted, setpoint_counter 0x{beat.setpoint_counter:x}"


@check("rejections", "8.1 8.3 8.4 8.5 8.12")
def rejections(device: Device) -> Iterator[str]:
    """State, finite values, mode: an EVENT reports the first that is wrong."""
    yield rejected(device, "zero in IDLE", (1, 7), ErrorCode.WRONG_STATE, DriveState.IDLE)
    yield rejected(device, "NaN in IDLE", (1, 8, 0.0, math.nan), ErrorCode.WRONG_STATE, DriveState.IDLE)
    device.arm()
    yield rejected(device, "zero in ARMED", (1, 8), ErrorCode.WRONG_STATE, DriveState.ARMED)
    device.rest()
    device.run()
    mode = accepted_mode(device)
    nan = (mode, 9, 0.0, math.nan)
    yield rejected(device, f"{mode.name} 0 with value2 NaN", nan, ErrorCode.BAD_VALUE, math.nan)
    both = (mode, 9, math.inf, math.nan)
    yield rejected(device, f"{mode.name} inf with value2 NaN", both, ErrorCode.BAD_VALUE, math.inf)
    second = (SetpointMode.SPEED, 9, 0.0, -math.inf)
    yield rejected(device, "SPEED 0 with value2 -inf", second, ErrorCode.BAD_VALUE, -math.inf)
    unknown = (NO_MODE, 10, 0.0, math.inf)
    yield rejected(device, f"mode {NO_MODE} with value2 inf", unknown, ErrorCode.BAD_VALUE, math.inf)
    yield rejected(device, f"mode {NO_MODE}", (NO_MODE, 11), ErrorCode.NOT_SUPPORTED, NO_MODE)
    yield rejected(device, "mode 0 with 1e30", (0, 12, 1e30, 0.0), ErrorCode.NOT_SUPPORTED, 0)


def rejected(
    device: Device,
    what: str,
    given: tuple[int, int] | tuple[int, int, float, float],
    code: ErrorCode,
    detail: float,
    again: bool = True,
) -> str:
    """Evidence that a setpoint (mode, counter, value, value2) is rejected with this code and detail. Raises Failed."""
    since, began = len(device.events(EventCode.SETPOINT_REJECTED)), device.probe.tick()[0]
    beat = send(device, *given)
    if beat.setpoint_counter == given[1]:
        raise Failed(f"{what}: setpoint_counter is {given[1]}, so it was accepted")
    events = device.events(EventCode.SETPOINT_REJECTED)[since:]
    if not events and again:  # a device may drop one
        return rejected(device, what, given, code, detail, again=False)
    if not events:
        raise Failed(f"{what}: no EVENT SETPOINT_REJECTED received, twice, although the link had room")
    if not _says(events[0], code, detail):
        told = f"{code_name(events[0])}, detail {events[0].detail:.9g}"
        raise Failed(f"{what}: {told}, not {code.name}, detail {detail:.9g}")
    if not began <= events[0].tick <= beat.tick or events[0].node != device.probe.node:
        raise Failed(f"{what}: an EVENT of node {events[0].node}, tick {events[0].tick}, not {began} to {beat.tick}")
    return f"{what}: {code.name}, detail {detail:.9g}"


def code_name(event: DeviceEvent) -> str:
    """The ErrorCode of a SETPOINT_REJECTED in words."""
    return f"code {event.arg:g}" if event.number is None else ErrorCode(event.number).name


def _says(event: DeviceEvent, code: ErrorCode, detail: float) -> bool:
    return event.arg == code and (event.detail == detail or (math.isnan(detail) and math.isnan(event.detail)))


@check("rejected-counted", "8.12 5.15")
def rejected_counted(device: Device) -> str:
    """Each rejected setpoint is counted, in every state, and setpoint_counter does not change."""
    idle = device.fresh().setpoints_rejected
    for n in range(2):
        device.probe.send(device.probe.frame(MessageType.SETPOINT, payload(1, 0x0300 + n)))
    if (counted := (device.fresh().setpoints_rejected - idle) & 0xFFFF) != 2:
        raise Failed(f"2 rejected in IDLE: setpoints_rejected counted {counted}")
    device.run()
    before = send(device, accepted_mode(device), 0x0100)
    for n in range(3):
        device.probe.send(device.probe.frame(MessageType.SETPOINT, payload(NO_MODE, 0x0200 + n)))
    after = device.fresh()
    counted = (after.setpoints_rejected - before.setpoints_rejected) & 0xFFFF
    device.probe.hello()
    if (device.fresh().setpoints_rejected - after.setpoints_rejected) & 0xFFFF:
        raise Failed("setpoints_rejected, which counts since boot, changed at a HELLO")
    if counted != 3 or after.setpoint_counter != before.setpoint_counter:
        counters = f"setpoint_counter {after.setpoint_counter:#x}, was {before.setpoint_counter:#x}"
        raise Failed(f"3 rejected: setpoints_rejected counted {counted}, {counters}")
    return f"3 rejected: setpoints_rejected counted 3, setpoint_counter stays {after.setpoint_counter:#x}"


@check("feeds", "7.26 8.15")
def feeds(device: Device) -> str:
    """An accepted setpoint feeds the watchdog, also one with the counter of the last."""
    device.run()
    mode = accepted_mode(device)
    device.probe.feed_every = None
    sent, end = 0, device.probe.now() + 2.5 * device.watchdog
    while device.probe.now() < end:
        sent += 1
        device.probe.send(device.probe.frame(MessageType.SETPOINT, payload(mode, 7)))
        device.probe.listen(device.watchdog / 5)
    beat = device.fresh()
    if beat.state != DriveState.RUNNING:
        raise Failed(f"{sent} setpoints in {2.5 * device.watchdog:.2f} s without ALIVE: the state is {beat.state.name}")
    return f"{sent} setpoints of zero in {2.5 * device.watchdog:.2f} s without ALIVE: still RUNNING"

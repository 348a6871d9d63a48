"""Level 3, second part: what does not feed the watchdog. Chapter 7 of SPEC. Outputs go on, at zero current."""

from __future__ import annotations

import itertools
import math
import random
import struct
from collections.abc import Callable, Iterator, Sequence

from bench.conform.checks import Group
from bench.conform.device import Device, ids
from bench.conform.levels import STATES
from bench.conform.lines import BusLine
from bench.conform.link import UNKNOWN_TYPES
from bench.conform.probe import HELLO
from bench.conform.setpoints import NO_MODE
from bench.conform.setpoints import payload as setpoint
from bench.conform.states import Trip, late, trip_after, trips
from bench.conform.verdicts import Failed, Unknown
from protocol.canmap.ids import STATUS_SLOTS, CanClass, CanId
from protocol.codes import Command, DriveState, MessageType, SetpointMode
from protocol.framing import MAJOR, REPLY, Frame
from protocol.messages import BlobRead, Feature, ParamGet, ParamSet
from protocol.signals import Flag

check = Group("watchdog", STATES)

AT_ONCE = 4  # requests
WITH_EVENT = 64  # bytes of a message and of the event that says it was rejected
STREAM = 3  # that is used meanwhile
ALIVE = MessageType.ALIVE


@check("not-fed-by-requests", "7.27")
def not_fed_by_requests(device: Device) -> Iterator[str]:
    """No request feeds the watchdog, of any type, executed, refused or repeated."""
    asked = [
        (MessageType.TIME_SYNC, b""), (MessageType.BLOB_READ, BlobRead(0, 8, 0).pack()),
        (MessageType.HELLO, HELLO.pack(random.getrandbits(32), 1, 1, 1024)),
        (MessageType.STATE_CMD, struct.pack("<BxxxI", Command.FAULT_CLEAR, 0)),
        (MessageType.STATE_CMD, struct.pack("<BxxxI", Command.ARM, device.hello.boot_id ^ 1)),
        (MessageType.STREAM_GET, bytes([STREAM, 0, 0, 0])),
    ]  # fmt: skip
    if channels := device.descriptor.channels:
        asked.append((MessageType.STREAM_SET, struct.pack("<BBHHHH", STREAM, 0, 1000, 20, 1, channels[0].id)))
        mask = struct.pack("<I", 1 << STREAM)
        asked += [(MessageType.STREAM_START, mask), (MessageType.STREAM_STOP, mask)]
    for record in device.descriptor.parameters[:1]:
        asked.append((MessageType.PARAM_GET, ParamGet(record.id).pack()))
    settable = [p for p in device.descriptor.parameters if not p.flags & Flag.READ_ONLY and p.name != "watchdog"]
    for record in settable[:1]:
        asked.append((MessageType.PARAM_SET, ParamSet(record.id, device.parameter(record).value).pack()))
    if not device.hello.features & Feature.COMMIT:
        asked.append((MessageType.PARAM_COMMIT, b""))
    frames = [device.probe.frame(*each) for each in asked]
    for at in range(0, len(frames), AT_ONCE):  # all of them would take a slow link longer than the watchdog waits
        yield _not_fed(device, DriveState.ARMED, _asks(device, frames[at : at + AT_ONCE]), "requests")
    again = device.probe.frame(MessageType.BLOB_READ, BlobRead(0, 8, 0).pack())
    yield _not_fed(device, DriveState.ARMED, lambda: _once_more(device, again), "a repeated request")


def _asks(device: Device, frames: Sequence[Frame]) -> Callable[[], None]:
    def ask() -> None:
        for frame in frames:
            device.probe.ask_frame(frame._replace(tid=device.probe.tid()))

    return ask


def _once_more(device: Device, frame: Frame) -> None:
    device.probe.ask(MessageType.TIME_SYNC)  # on CAN a frame that comes twice in a row is taken once
    device.probe.ask_frame(frame)


@check("not-fed-by-refused", "7.27")
def not_fed_by_refused(device: Device) -> Iterator[str]:
    """An ALIVE of another major, with a tid, of a wrong length, damaged or for another node does not feed it."""
    probe, four = device.probe, bytes(4)
    frames = [
        probe.frame(ALIVE, four, flags=2), probe.frame(ALIVE, four, tid=5), probe.frame(ALIVE, four[:3]),
        probe.frame(ALIVE, bytes(5)), probe.frame(ALIVE, four, flags=MAJOR | REPLY), probe.frame(UNKNOWN_TYPES[0]),
        probe.frame(MessageType.TIME_SYNC, flags=2), probe.frame(MessageType.TIME_SYNC, tid=0),
    ]  # fmt: skip
    wires = [probe.line.encode(frame) for frame in frames] + _astray(device, probe.frame(ALIVE, four))
    yield from _not_fed_by(device, DriveState.ARMED, wires, "wrong messages")


def _astray(device: Device, alive: Frame) -> list[bytes]:
    """ALIVE where it is not for this device, or not to be taken."""
    line, node = device.probe.line, device.probe.node
    if isinstance(line, BusLine):
        status = [CanId(CanClass.STATUS, node % 15 + 1, STATUS_SLOTS[ALIVE])]
        status.append(CanId(CanClass.STATUS, node, STATUS_SLOTS[MessageType.SETPOINT]))
        return [line.transfer(can_id, alive) for can_id in (*status, CanId(CanClass.TO_DEVICE, node, line.host))]
    others = {node % 255 + 1, device.hello.nodes % 255 + 1} - {node}
    wire = bytearray(line.encode(alive))
    wire[-3] = wire[-3] % 255 + 1  # of its CRC
    return [*(line.encode(alive._replace(node=other)) for other in sorted(others)), bytes(wire)]


@check("not-fed-by-rejected", "7.27")
def not_fed_by_rejected(device: Device) -> Iterator[str]:
    """Rejected setpoints do not feed the watchdog, neither in ARMED nor in RUNNING."""
    for state in (DriveState.ARMED, DriveState.RUNNING):
        yield from _not_fed_by(device, state, _rejected(device, state), "rejected setpoints")


def _rejected(device: Device, state: DriveState) -> list[bytes]:
    frame, counter = device.probe.frame, itertools.count(1)
    payloads = [setpoint(NO_MODE, next(counter)), setpoint(SetpointMode.SPEED, next(counter), math.nan)]
    payloads += [setpoint(SetpointMode.SPEED, next(counter), 0.0, math.inf), setpoint(1, next(counter))[:11]]
    if state == DriveState.ARMED:
        payloads += [setpoint(mode, next(counter)) for mode in SetpointMode]
    frames = [frame(MessageType.SETPOINT, each) for each in payloads]
    frames.append(frame(MessageType.SETPOINT, setpoint(1, next(counter)), tid=7))
    frames.append(frame(MessageType.SETPOINT, setpoint(1, next(counter)), flags=2))
    return [device.probe.line.encode(each) for each in frames]


@check("not-fed-by-start", "7.24")
def not_fed_by_start(device: Device) -> Iterator[str]:
    """START does not feed the watchdog, neither in ARMED nor in RUNNING."""
    trips(device)
    device.rest()
    device.arm()
    first, last = device.unfed()
    device.probe.listen(device.watchdog / 2)
    answer = device.probe.command(Command.START)
    entered = device.probe.tick()[1]
    state = DriveState.RUNNING if answer.error is None else DriveState.ARMED
    yield _judged(device, trip_after(device, state, first, last, lambda: None, entered), "with START meanwhile")

    def start() -> None:
        device.probe.command(Command.START)

    yield _not_fed(device, DriveState.RUNNING, start, "START")


@check("not-fed-by-telemetry", "7.27")
def not_fed_by_telemetry(device: Device) -> str:
    """A running stream does not feed the watchdog."""
    device.configure(STREAM, ids(device.channels[:1]), 100.0)
    device.start_streams(1 << STREAM)
    return _not_fed(device, DriveState.ARMED, lambda: None, "times nothing but a running stream")


def _not_fed_by(device: Device, state: DriveState, wires: Sequence[bytes], what: str) -> Iterator[str]:
    """All at once, or as many as a slow link takes, with the events that they lead to, while the watchdog waits."""
    at_once = max(1, int(device.watchdog / 4 / max(device.probe.takes(WITH_EVENT), 1e-9)))
    for at in range(0, len(wires), at_once):
        some = wires[at : at + at_once]
        yield _not_fed(device, state, lambda some=some: _write(device, some), f"{len(some)} {what}")  # type: ignore[misc]


def _write(device: Device, wires: Sequence[bytes]) -> None:
    for wire in wires:
        device.probe.write(wire)
        device.probe.poll(0.0)


def _not_fed(device: Device, state: DriveState, send: Callable[[], None], what: str) -> str:
    """The watchdog ends a state as soon as ever, although `send` is called again and again."""
    trips(device)  # where it is dead this would tell nothing more
    device.rest()
    device.enter(state)
    first, last = device.unfed()
    sent = 0

    def again() -> None:
        nonlocal sent
        sent += 1
        send()

    trip = trip_after(device, state, first, last, again)
    if not sent:
        raise Unknown(f"{trip}, before {what} could be sent")
    return _judged(device, trip, f"with {sent} times {what} meanwhile")


def _judged(device: Device, trip: Trip, what: str) -> str:
    words = f"{trip}, {what}"
    usual = max(each.least for each in trips(device))
    if trip.least > usual + late(device) + trip.resolution:
        raise Failed(f"{words}; {1e3 * usual:.0f} ms without them")
    return words

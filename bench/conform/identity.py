"""Level 1, first part: HELLO, descriptor, heartbeat, clock. Chapters 4, 5, 9 and 10 of SPEC."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from zlib import crc32

from bench.conform.checks import Group
from bench.conform.device import Device, require_granted
from bench.conform.levels import IDENTITY
from bench.conform.probe import HELLO, Answer, Probe, read, steps
from bench.conform.verdicts import Failed, Unknown
from protocol.codes import DriveState, ErrorCode, MessageType
from protocol.descriptor import Descriptor
from protocol.errors import DeviceDefect, HbpError
from protocol.messages import BlobRead, BlobReply, Heartbeat, HelloReply
from protocol.validity import check_reply

check = Group("identity", IDENTITY)

HELLO_BYTES = 116
TEXTS = (("name", 36, 16), ("firmware", 52, 16), ("serial", 68, 24), ("build", 92, 24))
OTHER_BLOBS = (1, 2, 255)
WATCHED = 1.6  # s that heartbeats are watched
RATE_ERROR = 0.05
"""Tolerance of `tick_hz` against the host's clock: SPEC gives no value; this finds a wrong one."""
STABLE = ("boot_id", "major", "minor", "rx_max", "tx_max", "features", "schema_crc", "tick_hz", "pwm_hz", "node",
          "role", "nodes", "name", "firmware", "serial", "build")  # fmt: skip
FREE_FAULT_BITS = 0xFF000000


@check("hello-fields", 4, "A host refuses a device, naming the field and its value, if its HELLO has another `major`")
def hello_fields(device: Device) -> str:
    """The fields of HELLO have valid values."""
    answer = _hello(device.probe, 1024)
    payload = answer.frame.payload
    if len(payload) < HELLO_BYTES:
        raise Failed(f"the reply has {len(payload)} bytes, not {HELLO_BYTES}")
    hello = read(answer.frame, HelloReply)
    try:
        check_reply(hello, answer.frame.node)
    except HbpError as error:
        raise Failed(str(error)) from None
    if not 0 < hello.tx_max <= 1024:
        raise Failed(f"tx_max is {hello.tx_max}, this host accepts 1024")
    if not hello.nodes and not device.probe.line.bus:
        raise Failed("nodes is 0, but one answers")
    sizes = f"rx_max {hello.rx_max}, tx_max {hello.tx_max}"
    return f"node {hello.node} of {hello.nodes}, {sizes}, tick_hz {hello.tick_hz}, pwm_hz {hello.pwm_hz}"


def _hello(probe: Probe, rx_max: int) -> Answer:
    return probe.ask(MessageType.HELLO, HELLO.pack(probe.tid() << 8, 1, 1, rx_max))


@check("texts", 0, "(a text that fills its field has no terminating zero)")
def texts(device: Device) -> str:
    """Texts are UTF-8, padded with zeros only."""
    payload = _hello(device.probe, 1024).frame.payload
    found = []
    for name, at, room in TEXTS:
        raw = payload[at : at + room]
        text, _, rest = raw.partition(b"\0")
        if rest.strip(b"\0"):
            raise Failed(f"{name} has bytes after its first zero: {raw.hex()}")
        try:
            found.append(f"{name} {text.decode()!r}")
        except UnicodeDecodeError:
            raise Failed(f"{name} is not UTF-8: {raw.hex()}") from None
    return ", ".join(found)


@check("hello-stable", 4, "HELLO is legal in every state and does not change it")
def hello_stable(device: Device) -> str:
    """Repeated HELLO replies have the same fields."""
    first, again = device.probe.hello(), device.probe.hello()
    for name in STABLE:
        if getattr(first, name) != getattr(again, name):
            raise Failed(f"{name} was {getattr(first, name)}, then {getattr(again, name)}")
    return f"{len(STABLE)} fields are the same in two replies, boot_id {first.boot_id:08x}"


@check("rx-max", 4, "after that it never sends a payload longer than the host's `rx_max`")
def rx_max(device: Device) -> str:
    """No payload is longer than the host's rx_max."""
    hello = device.probe.hello(rx_max=128)
    if hello.tx_max > 128:
        raise Failed(f"tx_max is {hello.tx_max} for a host that accepts 128")
    answer = require_granted(device.probe.ask(MessageType.BLOB_READ, BlobRead(0, 1024, 0).pack()), "BLOB_READ")
    if (n := len(answer.frame.payload)) > 128:
        raise Failed(f"BLOB_READ was answered with {n} bytes to a host that accepts 128")
    return f"rx_max 128: tx_max {hello.tx_max}, BLOB_READ answered with {n} bytes"


@check("descriptor", 9, "Blob 0 is an array of 32-byte records, at most 4096 of them")
def descriptor(device: Device) -> str:
    """The descriptor follows the rules."""
    if len(device.blob) % 32:
        raise Failed(f"the descriptor has {len(device.blob)} bytes: not whole records")
    try:
        found = Descriptor.unpack(device.blob)
    except DeviceDefect as defect:
        raise Failed(str(defect)) from None
    for number, raw, _, flags, reserved, scale, offset, name in struct.iter_unpack("<HBBHHff16s", device.blob):
        what = f"record {number} ({name.rstrip(bytes(1)).decode('utf-8', 'replace')})"
        if reserved:
            raise Failed(f"{what} has {reserved} in its reserved field")
        if name.rstrip(b"\0").count(0):
            raise Failed(f"{what} has bytes after the first zero of its name")
        if flags & 3 == 2 and (raw, scale, offset) != (7, 1.0, 0.0):
            raise Failed(f"{what} is a parameter with type {raw}, scale {scale:g}, offset {offset:g}")
    return f"{len(device.blob) // 32} records: {len(found.channels)} channels, {len(found.parameters)} parameters"


@check("schema-crc", 5, "CRC-32 of the descriptor")
def schema_crc(device: Device) -> str:
    """schema_crc in HELLO matches the descriptor."""
    crc = crc32(device.blob)
    if crc != device.hello.schema_crc:
        raise Failed(f"HELLO has {device.hello.schema_crc:08x}, the descriptor {crc:08x}")
    return f"{crc:08x} over {len(device.blob)} bytes"


@check("blob-clipped", 5, "A read is clipped to the end of the blob and to what fits in a frame")
def blob_clipped(device: Device) -> str:
    """A read that is too long is clipped, not refused."""
    probe, blob = device.probe, device.blob
    if len(blob) < 8:
        raise Unknown(f"the descriptor has {len(blob)} bytes")
    wide = probe.get(BlobRead(0, 0xFFFF, 0), BlobReply)
    room = device.hello.tx_max - 12
    if wide.data != blob[: len(wide.data)] or not 0 < len(wide.data) <= room or wide.total != len(blob):
        raise Failed(
            f"65535 bytes from 0: got {len(wide.data)} of {wide.total} bytes; {room} fit, the blob has {len(blob)}"
        )
    last = probe.get(BlobRead(0, 64, len(blob) - 8), BlobReply)
    if last.data != blob[-8:] or last.offset != len(blob) - 8:
        raise Failed(f"64 bytes from {len(blob) - 8}: got {len(last.data)} bytes from {last.offset}; 8 are left")
    return f"65535 bytes from 0: got {len(wide.data)} of {len(blob)}; 64 bytes from 8 before the end: got 8"


@check("blob-past-end", 5, "An offset past the end is refused (OUT_OF_RANGE, `detail` = the length)")
def blob_past_end(device: Device) -> Iterator[str]:
    """A read past the end is refused."""
    probe, total = device.probe, len(device.blob)
    offsets = (total + 1, 0xFFFFFFFF)
    return (
        f"from {at}: "
        + probe.refused(ErrorCode.OUT_OF_RANGE, float(total), MessageType.BLOB_READ, BlobRead(0, 16, at).pack())
        for at in offsets
    )


@check("other-blobs", 5, "every other one, 1 and 2 included, is refused (UNKNOWN_ID, `detail` = the blob)")
def other_blobs(device: Device) -> Iterator[str]:
    """Blobs other than 0 are refused."""
    return (
        f"blob {blob}: "
        + device.probe.refused(ErrorCode.UNKNOWN_ID, blob, MessageType.BLOB_READ, BlobRead(blob, 16, 0).pack())
        for blob in OTHER_BLOBS
    )


@check("heartbeat-rate", 5, "Unsolicited, 10 Hz, from boot on, in every state")
def heartbeat_rate(device: Device) -> str:
    """A heartbeat comes every 100 ms of device time; none is missing."""
    beats = _beats(device)
    between = [1e3 * step / device.hz for step in steps([beat.tick for beat in beats])]
    mean = sum(between) / len(between)
    words = f"{len(beats)} heartbeats, {mean:.1f} ms apart ({min(between):.0f} to {max(between):.0f})"
    if not 90 <= mean <= 110 or max(between) > 190:
        raise Failed(words)
    return words


def _beats(device: Device) -> list[Heartbeat]:
    """Heartbeats of a while, kept for all that look at them."""

    def watched() -> list[Heartbeat]:
        device.probe.listen(WATCHED)
        return [beat for _, beat in device.probe.beats]

    found = device.once("beats", watched)
    if len(found) < 3:
        raise Failed(f"{len(found)} heartbeats received within {WATCHED:g} s")
    return found


@check("heartbeat-fields", 5, "1 = the power stage is on, according to the hardware")
def heartbeat_fields(device: Device) -> str:
    """Heartbeats are consistent, and agree with HELLO."""
    beats = _beats(device)
    for beat in beats:
        known = beat.state in list(DriveState)
        reasons = {
            f"boot_id {beat.boot_id:08x}, in HELLO {device.hello.boot_id:08x}": beat.boot_id != device.hello.boot_id,
            f"state {int(beat.state)}": not known,
            f"faults 0x{int(beat.faults):x}: bits 24 to 31 are not 0": bool(beat.faults & FREE_FAULT_BITS),
            f"first_fault 0x{int(beat.first_fault):x} is not among faults 0x{int(beat.faults):x}": bool(
                beat.first_fault & ~beat.faults
            ),
            f"faults 0x{int(beat.faults):x} in {beat.state.name}": bool(beat.faults)
            != (beat.state == DriveState.FAULT),
            f"outputs on in {beat.state.name}": bool(beat.outputs_on) and beat.state != DriveState.RUNNING,
        }
        for words, wrong in reasons.items():
            if wrong:
                raise Failed(words)
    last = beats[-1]
    outputs = "on" if last.outputs_on else "off"
    said = f"{last.state.name}, faults 0x{int(last.faults):x}, outputs {outputs}"
    return f"{len(beats)} heartbeats: {said}, boot_id as in HELLO"


@check("last-tid", 5, "of the last request that was executed and answered without refusal")
def last_tid(device: Device) -> str:
    """last_tid is the tid of the last request that was not refused."""
    probe = device.probe
    good = probe.ask(MessageType.BLOB_READ, BlobRead(0, 8, 0).pack())
    bad = probe.ask(MessageType.BLOB_READ, BlobRead(9, 8, 0).pack())
    if good.error is not None or bad.error is None:
        raise Unknown(f"BLOB_READ: {good}; of blob 9: {bad}")
    probe.beat()  # one may have been made before
    told = probe.beat().last_tid
    if told != good.frame.tid:
        raise Failed(f"last_tid is {told}; {good.frame.tid} was executed, then {bad.frame.tid} refused")
    return f"last_tid {told} was executed; {bad.frame.tid} after it was refused, and does not count"


@check("tick-goes-on", 10, "`tick` is a free-running counter at `tick_hz`")
def tick_goes_on(device: Device) -> str:
    """The tick never goes back, neither in TIME_SYNC nor in heartbeats."""
    probe = device.probe
    ticks: list[int] = []
    for _ in range(30):
        ticks += probe.tick()
        probe.listen(0.005)
    beats = [beat.tick for beat in _beats(device)]
    for name, row in (("TIME_SYNC", ticks), ("heartbeat", beats)):
        worst = min(steps(row))
        if worst < 0:
            raise Failed(f"the tick of {name} goes back by {-worst} ({-1e3 * worst / device.hz:.2f} ms)")
        if max(row) >= 1 << 62:
            raise Failed(f"the tick of {name} is {max(row)}, not below 2^62")
    return f"{len(ticks)} ticks of TIME_SYNC and {len(beats)} of heartbeats, none goes back"


@check("tick-hz", 10, "Device ticks are the time base")
def tick_hz(device: Device) -> str:
    """The tick rate is tick_hz, by the host's clock."""
    probe = device.probe
    began = probe.now()
    first = probe.tick()[0]
    heard = probe.now()
    probe.listen(1.0)
    asked = probe.now()
    last = probe.tick()[1]
    ended = probe.now()
    seconds = (last - first) / device.hz
    low, high = asked - heard, ended - began
    words = f"{seconds:.4f} s by the device's tick, {low:.4f} to {high:.4f} s by this host"
    if not low * (1 - RATE_ERROR) <= seconds <= high * (1 + RATE_ERROR):
        raise Failed(words)
    return words

"""Level 1, first part: HELLO, descriptor, heartbeat, clock. Chapters 4, 5, 9 and 10 of SPEC."""

from __future__ import annotations

import struct
import unicodedata
from collections.abc import Iterator
from zlib import crc32

from bench.conform.checks import Group
from bench.conform.device import Device, require_granted
from bench.conform.levels import IDENTITY
from bench.conform.lines import Heard
from bench.conform.probe import HELLO, Answer, Probe, name_of, read, state_name, steps
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from protocol.codes import Command, DriveState, ErrorCode, Feature, MessageType
from protocol.descriptor import Descriptor
from protocol.errors import DeviceDefect, HbpError
from protocol.framing import MAJOR
from protocol.messages import BlobRead, BlobReply, Heartbeat, HelloReply, ParamGet, ParamSet
from protocol.signals import Flag
from protocol.validity import check_reply

check = Group("identity", IDENTITY)

UNASKED = (MessageType.HEARTBEAT, MessageType.EVENT, MessageType.LOG, MessageType.DATA, MessageType.EDGES)
TEXTS = (("name", 36, 16), ("firmware", 52, 16), ("serial", 68, 24), ("build", 92, 24))
BLOBS = {1: Feature.CAPTURE, 2: None, 3: Feature.MEANINGS, 4: Feature.WAVEFORM, 5: None, 255: None}
"""Blobs beside the descriptor: which feature has them."""
WATCHED = 1.6  # s that heartbeats are watched
RATE_ERROR = 0.05
"""Tolerance of `tick_hz` against the host's clock: SPEC gives no value; this finds a wrong one."""
STABLE = ("boot_id", "major", "minor", "rx_max", "tx_max", "features", "schema_crc", "tick_hz", "pwm_hz", "node",
          "role", "nodes", "name", "firmware", "serial", "build")  # fmt: skip
FREE_FAULT_BITS, RESERVED_FAULT_BITS = 0xFF000000, 0xFF00
BEAT_EARLY, BEAT_LATE = 0.078, 0.122  # s between two heartbeats, each of which may be 20 ms late
OF_THE_HALLS = ("hall_offset", "hall_swap_hat", "hall_invert_hat")
OUTPUTS_ON = 37  # where it stands in a heartbeat
UNFED = 0xFFFF  # watchdog_ms while it is inactive
BEHIND = 0.05  # s that a heartbeat may wait on a link that has nothing else to carry


@check("hello-fields", "5.2 2.5 16.2 4.17")
def hello_fields(device: Device) -> str:
    """The fields of HELLO have valid values."""
    answer = _hello(device.probe, 1024)
    if len(answer.frame.payload) < HelloReply.FIXED_BYTES:
        raise Unknown("the reply is too short: see link.hello")
    hello = read(answer.frame, HelloReply)
    try:
        check_reply(hello, answer.frame.node)
    except HbpError as error:
        raise Failed(str(error)) from None
    if not 0 < hello.tx_max <= 1024:
        raise Failed(f"tx_max is {hello.tx_max}, this host accepts 1024")
    if hello.nodes < (1 if device.probe.line.bus else hello.node):
        raise Failed(f"nodes is {hello.nodes}, but node {hello.node} answers")
    if not hello.role:
        raise Failed("role is 0")
    sizes = f"rx_max {hello.rx_max}, tx_max {hello.tx_max}"
    return f"node {hello.node} of {hello.nodes}, {sizes}, tick_hz {hello.tick_hz}, pwm_hz {hello.pwm_hz}"


def _hello(probe: Probe, rx_max: int) -> Answer:
    return probe.ask(MessageType.HELLO, HELLO.pack(probe.tid() << 8, 1, 1, rx_max))


@check("texts", "0.2 0.3")
def texts(device: Device) -> str:
    """Texts are UTF-8, padded with zeros only."""
    payload = _hello(device.probe, 1024).frame.payload
    found = []
    for name, at, room in TEXTS:
        raw = payload[at : at + room]
        text, _, rest = raw.partition(b"\0")
        if rest.strip(b"\0"):
            raise Failed(f"{name} has bytes after its first zero: {raw.hex()}")
        found.append(f"{name} {_plain(text, name)!r}")
    return ", ".join(found)


def _plain(raw: bytes, what: str) -> str:
    """Text of UTF-8 without control characters. Raises Failed."""
    try:
        text = raw.decode()
    except UnicodeDecodeError:
        raise Failed(f"{what} is not UTF-8: {raw.hex()}") from None
    if bad := [letter for letter in text if unicodedata.category(letter) == "Cc"]:
        raise Failed(f"{what} has the control character U+{ord(bad[0]):04X}: {raw.hex()}")
    return text


@check("hello-stable", "5.3 4.16 9.4")
def hello_stable(device: Device) -> str:
    """Repeated HELLO replies have the same fields, and the state of the heartbeats."""
    first, again = device.probe.hello(), device.probe.hello()
    for name in STABLE:
        if getattr(first, name) != getattr(again, name):
            raise Failed(f"{name} was {getattr(first, name)}, then {getattr(again, name)}")
    beat = device.fresh()
    if again.state != beat.state:
        raise Failed(f"HELLO has {state_name(again.state)}, a heartbeat after it {state_name(beat.state)}")
    return f"{len(STABLE)} fields are the same in two replies, boot_id {first.boot_id:08x}"


@check("rx-max", "4.18 4.19")
def rx_max(device: Device) -> str:
    """No payload is longer than the host's rx_max, and tx_max is the smaller of that and what the device can send."""
    for most in (128, 200):
        hello, due = device.probe.hello(rx_max=most), min(most, device.hello.tx_max)
        if hello.tx_max != due:
            words = f"tx_max is {hello.tx_max} for a host that accepts {most}"
            raise Failed(f"{words}, {device.hello.tx_max} for one that accepts 1024")
    hello = device.probe.hello(rx_max=128)
    answer = require_granted(device.probe.ask(MessageType.BLOB_READ, BlobRead(0, 1024, 0).pack()), "BLOB_READ")
    if (n := len(answer.frame.payload)) > 128:
        raise Failed(f"BLOB_READ was answered with {n} bytes to a host that accepts 128")
    return f"rx_max 128: tx_max {hello.tx_max}, BLOB_READ answered with {n} bytes"


@check("descriptor", "9.1 9.2 9.3 0.3 12.6 14.2")
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
        if flags & 3:
            _plain(name.partition(b"\0")[0], what)
        if flags & Flag.TRUTH and not device.hello.features & Feature.SIMULATED:
            raise Failed(f"{what} has the flag TRUTH, but the device is not simulated")
        if flags & 3 == 2 and name.rstrip(b"\0").decode() in OF_THE_HALLS and not flags & Flag.IDLE_ONLY:
            raise Failed(f"{what} is not IDLE_ONLY")
        if flags & 3 == 2 and (raw, scale, offset) != (7, 1.0, 0.0):
            raise Failed(f"{what} is a parameter with type {raw}, scale {scale:g}, offset {offset:g}")
    return f"{len(device.blob) // 32} records: {len(found.channels)} channels, {len(found.parameters)} parameters"


@check("schema-crc", "5.2")
def schema_crc(device: Device) -> str:
    """schema_crc in HELLO matches the descriptor."""
    crc = crc32(device.blob)
    if crc != device.hello.schema_crc:
        raise Failed(f"HELLO has {device.hello.schema_crc:08x}, the descriptor {crc:08x}")
    return f"{crc:08x} over {len(device.blob)} bytes"


@check("blob-clipped", "5.22 5.21 5.23")
def blob_clipped(device: Device) -> str:
    """A read that is too long is clipped, not refused; one of nothing, and one at the end, give nothing."""
    probe, blob = device.probe, device.blob
    if len(blob) < 8:
        raise Unknown(f"the descriptor has {len(blob)} bytes")
    first = probe.ask(MessageType.BLOB_READ, BlobRead(0, 0xFFFF, 0).pack())
    if first.error is not None:
        raise Failed(f"65535 bytes from 0: {first}")
    wide, room = read(first.frame, BlobReply), device.hello.tx_max - 12
    if wide.data != blob[: len(wide.data)] or not 0 < len(wide.data) <= room or wide.total != len(blob):
        raise Failed(
            f"65535 bytes from 0: got {len(wide.data)} of {wide.total} bytes; {room} fit, the blob has {len(blob)}"
        )
    last = probe.get(BlobRead(0, 64, len(blob) - 8), BlobReply)
    if last.data != blob[-8:] or last.offset != len(blob) - 8:
        raise Failed(f"64 bytes from {len(blob) - 8}: got {len(last.data)} bytes from {last.offset}; 8 are left")
    for wanted, at in ((64, len(blob)), (0, 0), (0xFFFF, len(blob)), (1, len(blob) - 1), (3, 5)):
        answer = probe.ask(MessageType.BLOB_READ, BlobRead(0, wanted, at).pack())
        if answer.error is not None:
            raise Failed(f"{wanted} bytes from {at} of {len(blob)}: {answer}")
        part = read(answer.frame, BlobReply)
        told = (part.id, part.data, part.offset, part.total)
        if told != (0, blob[at : at + wanted], at, len(blob)):
            raise Failed(
                f"{wanted} bytes from {at}: got {part.data.hex() or 'none'}, for blob {part.id} from {part.offset} "
                f"of {part.total}; the blob has {len(blob)}"
            )
    length = probe.ask(MessageType.BLOB_READ, BlobRead(0, 0xFFFF, 8).pack()).frame.payload
    if int.from_bytes(length[2:4], "little") != len(length) - 12:
        raise Failed(f"`length` is {int.from_bytes(length[2:4], 'little')}, but {len(length) - 12} bytes follow")
    return f"65535 bytes from 0: got {len(wide.data)} of {len(blob)}; from 8 before the end 8, from the end none"


@check("blob-past-end", "5.21")
def blob_past_end(device: Device) -> Iterator[str]:
    """A read past the end is refused."""
    probe, total = device.probe, len(device.blob)
    offsets = (total + 1, 0xFFFFFFFF)
    return (
        f"from {at}: "
        + probe.refused(ErrorCode.OUT_OF_RANGE, float(total), MessageType.BLOB_READ, BlobRead(0, 16, at).pack())
        for at in offsets
    )


@check("other-blobs", "5.20 17.1")
def other_blobs(device: Device) -> Iterator[str]:
    """Blobs that belong to no feature of the device are refused."""
    absent = [blob for blob, feature in BLOBS.items() if feature is None or not device.offers(feature)]
    return (
        f"blob {blob}: "
        + device.probe.refused(ErrorCode.UNKNOWN_ID, blob, MessageType.BLOB_READ, BlobRead(blob, 16, 0).pack())
        for blob in absent
    )


@check("heartbeat-rate", "5.8")
def heartbeat_rate(device: Device) -> str:
    """A heartbeat comes every 100 ms of device time; none is missing."""
    beats = _beats(device)
    between = [1e3 * step / device.hz for step in steps([beat.tick for beat in beats])]
    mean = sum(between) / len(between)
    words = f"{len(beats)} heartbeats, {mean:.1f} ms apart ({min(between):.0f} to {max(between):.0f})"
    if not 90 <= mean <= 110 or not 1e3 * BEAT_EARLY <= min(between) <= max(between) <= 1e3 * BEAT_LATE:
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


@check("heartbeat-fields", "5.12 5.11 5.13 5.17 5.18 7.15")
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
            f"faults 0x{int(beat.faults):x}: bits 8 to 15 are not 0": bool(beat.faults & RESERVED_FAULT_BITS),
            f"watchdog_ms {beat.watchdog_ms} in {beat.state.name}": beat.watchdog_ms != UNFED
            and beat.state not in (DriveState.ARMED, DriveState.RUNNING),
        }
        for words, wrong in reasons.items():
            if wrong:
                raise Failed(words)
    device.probe.beat()
    if outputs_told(device) > 1:
        raise Failed(f"outputs_on is {outputs_told(device)}")
    last = beats[-1]
    outputs = "on" if last.outputs_on else "off"
    said = f"{last.state.name}, faults 0x{int(last.faults):x}, outputs {outputs}"
    return f"{len(beats)} heartbeats: {said}, boot_id as in HELLO"


def outputs_told(device: Device) -> int:
    """The byte `outputs_on` of the newest heartbeat that came."""
    beats = [each.frame for each in device.probe.heard if each.frame.type == MessageType.HEARTBEAT]
    return next(beat.payload[OUTPUTS_ON] for beat in reversed(beats) if beat.node == device.probe.node)


@check("last-tid", "5.16")
def last_tid(device: Device) -> str:
    """last_tid is the tid of the last request that was executed: not of a refused or a repeated one, nor of ALIVE."""
    probe = device.probe
    good = probe.ask(MessageType.BLOB_READ, BlobRead(0, 8, 0).pack())
    bad = probe.ask(MessageType.BLOB_READ, BlobRead(9, 8, 0).pack())
    if good.error is not None or bad.error is None:
        raise Unknown(f"BLOB_READ: {good}; of blob 9: {bad}")
    probe.beat()  # one may have been made before
    told = probe.beat().last_tid
    if told != good.frame.tid:
        raise Failed(f"last_tid is {told}; {good.frame.tid} was executed, then {bad.frame.tid} refused")
    words = f"last_tid {told} was executed; {bad.frame.tid} after it was refused, and does not count"
    kept = probe.frame(MessageType.BLOB_READ, BlobRead(0, 8, 0).pack())
    probe.ask_frame(kept)
    for kind, payload in (
        (MessageType.STREAM_STOP, bytes(4)), (MessageType.HELLO, HELLO.pack(_nonce(probe), 1, 1, 1024)),
        (MessageType.TIME_SYNC, b""),
    ):  # fmt: skip
        asked = probe.ask(kind, payload)
        probe.alive()
        if kind == MessageType.STREAM_STOP:
            probe.ask_frame(kept)  # which is answered, but not executed
        told = _after_now(device).last_tid
        if told != asked.frame.tid:
            raise Failed(f"last_tid is {told}; {asked.frame.tid} was a {kind.name}, executed last (before an ALIVE)")
    return f"{words}; so do STREAM_STOP, HELLO and TIME_SYNC, and not ALIVE, nor a kept reply"


def _nonce(probe: Probe) -> int:
    return probe.tid() << 8 | 1


def _after_now(device: Device) -> Heartbeat:
    """A heartbeat made from now on, without a request that would change last_tid."""
    device.probe.beat()  # one may have been made before
    return device.probe.beat()


@check("heartbeat-clock", "5.10 5.7")
def heartbeat_clock(device: Device) -> str:
    """A heartbeat's tick lies between those of the TIME_SYNCs before and after it."""
    probe, hz = device.probe, device.hz
    ahead, behind = [], []
    for _ in range(4):
        since = len(probe.heard)
        probe.beat()  # the next one is 100 ms away
        probe.listen(0.05)
        before = probe.tick()[0]
        beat = probe.beat()
        after = probe.tick()[1]
        if len(probe.came(Heartbeat, since)) > 2:
            continue
        behind.append((before - beat.tick) / hz)
        ahead.append((beat.tick - after) / hz)
    if not ahead:
        raise Unknown("no heartbeat received alone between two TIME_SYNCs")
    if max(ahead) > 0:
        raise Failed(f"the tick of a heartbeat is {1e3 * max(ahead):.1f} ms later than that of a TIME_SYNC after it")
    if min(behind) > BEHIND + probe.takes(100):
        raise Failed(f"the tick of heartbeats is {1e3 * min(behind):.1f} ms earlier than of TIME_SYNCs before them")
    return f"{len(ahead)} heartbeats lie between the TIME_SYNCs before and after them"


@check("log", "0.3")
def log(device: Device) -> str:
    """LOG has a level and text of UTF-8 without control characters."""
    device.probe.listen(0.25)
    lines = [each.frame for each in device.probe.heard if each.frame.type == MessageType.LOG]
    if not lines:
        raise NotApplicable("it sent no LOG")
    for line in lines:
        if not line.payload or line.payload[0] > 7:
            raise Failed(f"a LOG of {len(line.payload)} bytes has level {line.payload[:1].hex() or 'none'}")
        _plain(line.payload[1:], "a LOG")
    return f"{len(lines)} LOGs"


SPARE: dict[tuple[int, bool], tuple[tuple[int, int], ...]] = {
    (MessageType.HELLO, False): ((14, 2),), (MessageType.BLOB_READ, False): ((1, 1),),
    (MessageType.PARAM_GET, False): ((2, 2),), (MessageType.PARAM_SET, False): ((2, 2),),
    (MessageType.STATE_CMD, False): ((1, 3),), (MessageType.STREAM_SET, False): ((1, 1), (13, 3)),
    (MessageType.STREAM_GET, False): ((14, 2),), (MessageType.HEARTBEAT, False): ((38, 2),),
    (MessageType.EVENT, False): ((11, 1),), (MessageType.BLOB_READ, True): ((3, 1),),
    (MessageType.STREAM_GET, True): ((3, 1),),
}  # fmt: skip
"""Where `pad` bytes stand, and how many, by type of message and whether it is a refusal."""


def spare(heard: Heard) -> str:
    """What a message has in bits and bytes that are sent as 0, in words."""
    frame = heard.frame
    if frame.flags & 0xC0 or heard.reserved:
        return f"{name_of(frame.type)} has flags 0x{frame.flags:02x}, reserved byte 0x{heard.reserved:02x}"
    for at, n in SPARE.get((frame.type, frame.is_error), ()):
        if any(pad := frame.payload[at : at + n]):
            return f"{name_of(frame.type)} has pad bytes {pad.hex()} at {at}"
    return ""


@check("sent-as-zero", "0.1 1.14")
def sent_as_zero(device: Device) -> str:
    """Bits 6 and 7 of the flags, the reserved byte and pad bytes of replies, refusals and heartbeats are 0."""
    probe = device.probe
    probe.hello()
    asked: list[tuple[int, bytes]] = [
        (MessageType.TIME_SYNC, b""), (MessageType.BLOB_READ, BlobRead(0, 16, 0).pack()),
        (MessageType.BLOB_READ, BlobRead(9, 16, 0).pack()),
        (MessageType.STATE_CMD, struct.pack("<BxxxI", Command.STOP, 0)),
    ]  # fmt: skip
    for record in device.descriptor.parameters[:1]:
        asked.append((MessageType.PARAM_GET, ParamGet(record.id).pack()))
        if not record.flags & Flag.READ_ONLY:
            asked.append((MessageType.PARAM_SET, ParamSet(record.id, device.parameter(record).value).pack()))
    for channel in device.descriptor.channels[:1]:
        asked.append((MessageType.STREAM_SET, struct.pack("<BBHHHH", 0, 0, 100, 20, 1, channel.id)))
        asked.append((MessageType.STREAM_GET, bytes(4)))
    for kind, payload in asked:
        probe.ask(kind, payload)
    probe.beat()
    heard = [each for each in probe.heard if each.frame.node == probe.node]
    for each in heard:
        if words := spare(each):
            raise Failed(words)
    return f"{len(heard)} messages of {len({each.frame.type for each in heard})} types: all are 0"


@check("envelope", "3.1 2.2")
def envelope(device: Device) -> str:
    """What a device sends has its major and its node; heartbeats have neither flag nor tid, replies a tid."""
    probe = device.probe
    probe.ask(MessageType.BLOB_READ, BlobRead(9, 8, 0).pack())
    probe.ask(MessageType.TIME_SYNC)
    probe.listen(0.25)
    nodes = range(1, max(device.hello.nodes, probe.node) + 1)
    heard = [each.frame for each in probe.heard if not probe.line.bus or each.frame.node == probe.node]
    for frame in heard:
        unasked = frame.type in UNASKED
        reasons = {
            f"flags 0x{frame.flags:02x}": frame.major != MAJOR or (frame.is_error and not frame.is_reply),
            f"flags 0x{frame.flags:02x}, tid {frame.tid}": unasked and bool(frame.is_reply or frame.tid),
            f"node {frame.node}": frame.node not in nodes,
        }
        for words, wrong in reasons.items():
            if wrong:
                raise Failed(f"{name_of(frame.type)} has {words}")
    return f"{len(heard)} messages with major {MAJOR} and the device's node"


@check("tick-goes-on", "10.1 5.7")
def tick_goes_on(device: Device) -> str:
    """The tick never goes back, neither in TIME_SYNC nor in heartbeats; rx_tick is not after tx_tick."""
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


@check("tick-hz", "10.2")
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

"""Level 0: frames, damage, the order of checks, retries. Chapters 1 to 4 of SPEC."""

from __future__ import annotations

import math
import random
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from zlib import crc32

from bench.conform.checks import Carrier, Group
from bench.conform.device import PART, Device, require_granted
from bench.conform.levels import LINK
from bench.conform.lines import ByteLine
from bench.conform.probe import GRACE, HELLO, PATIENCE, Answer, NoAnswer, Probe, accepted, name_of, read, refusal
from bench.conform.verdicts import Failed, Hopeless, NotApplicable, Unknown
from protocol.codes import Command, ErrorCode, Feature, MessageType
from protocol.framing import ERROR, MAJOR, MAX_PAYLOAD, REPLY, Frame, wrapped
from protocol.messages import BlobRead, BlobReply, HelloReply, StreamGet, StreamInfo, StreamReply, TimeSyncReply

check = Group("link", LINK)
framing = Group("link", LINK, Carrier.BYTES)

UNKNOWN_TYPES = (0x00, 0x07, 0x34, 0x7F, 0x06)  # chapter 17 reserves the last one
OF_FEATURES = {
    MessageType.BLOB_WRITE: Feature.WAVEFORM,
    MessageType.CAPTURE_ARM: Feature.CAPTURE,
    MessageType.CAPTURE_STATUS: Feature.CAPTURE,
}
"""Types of requests that only a device with the feature knows."""
NO_REQUESTS = (0x04, 0x40, 0x41, 0x42, 0x43)  # what a device sends unasked
LONG = MAX_PAYLOAD + 1
ANSWER = 0.1  # s in which a request is answered
LATE = 0.03  # s that this host may be late in seeing it
PATIENT = 1.5  # s for which a late answer is waited for
IN_BETWEEN = 300  # bytes that a UART may carry from a request to its answer: both, a heartbeat, an event
RUNS = (253, 254, 255, 508, 509)  # bytes without a zero: COBS has blocks of 254
NOISE = 5000  # bytes without a delimiter
LENGTHS = {
    MessageType.TIME_SYNC: 0, MessageType.BLOB_READ: 8, MessageType.PARAM_GET: 4, MessageType.PARAM_SET: 8,
    MessageType.STATE_CMD: 8, MessageType.STREAM_START: 4, MessageType.STREAM_STOP: 4, MessageType.STREAM_GET: 4,
}  # fmt: skip
"""Of requests whose length is fixed. A device that took PARAM_COMMIT with a payload would wear out its store."""
WRONG_LENGTHS = (
    (MessageType.BLOB_WRITE, 7), (MessageType.BLOB_WRITE, 9), (MessageType.CAPTURE_ARM, 21),
    (MessageType.CAPTURE_ARM, 23), (MessageType.CAPTURE_ARM, 24), (MessageType.CAPTURE_STATUS, 1),
)  # fmt: skip
"""Of requests of a feature, all of whose bytes are zero."""
NOISE_TAKES = 10.0  # s that they may be under way: a UART of 9600 baud carries them in 5.2 s
ROUNDS = 20
TIME_SYNC = MessageType.TIME_SYNC


@check("hello", "5.2")
def hello(device: Device) -> str:
    """The reply to HELLO has its nonce."""
    nonce = random.getrandbits(32)
    answer = device.probe.ask(MessageType.HELLO, HELLO.pack(nonce, 1, 1, 1024))
    accepted(answer, "HELLO")
    told = struct.unpack_from("<I", answer.frame.payload.ljust(4, b"\0"))[0]
    if told != nonce:
        raise Failed(f"the reply has nonce {told:08x}, not {nonce:08x}")
    if (n := len(answer.frame.payload)) < HelloReply.FIXED_BYTES:
        raise Failed(f"the reply has {n} bytes, not {HelloReply.FIXED_BYTES}")
    return f"nonce {nonce:08x} came back after {1e3 * answer.after:.0f} ms"


@check("in-time", "3.8 1.13")
def in_time(device: Device) -> str:
    """Requests of each type are answered within 100 ms, one of up to three times."""
    probe, none = device.probe, struct.pack("<I", 0)
    kinds = [
        (TIME_SYNC, b""), (MessageType.BLOB_READ, BlobRead(0, 64, 0).pack()), (MessageType.PARAM_GET, bytes(4)),
        (MessageType.PARAM_SET, struct.pack("<Hxxf", 0xFFFF, math.nan)), (MessageType.STREAM_GET, bytes(4)),
        (MessageType.STREAM_SET, bytes(8)), (MessageType.STREAM_START, none), (MessageType.STREAM_STOP, none),
        (MessageType.STATE_CMD, struct.pack("<BxxxI", Command.STOP, 0)),
    ]  # fmt: skip
    kinds += [(kind, bytes(1)) for kind, feature in OF_FEATURES.items() if device.offers(feature)]  # refused, at once
    found = {kind: soonest(probe, kind, payload) for kind, payload in kinds}
    slow = {kind: after for kind, after in found.items() if after > ANSWER + LATE + probe.takes(IN_BETWEEN)}
    words = [_after(kind, after) for kind, after in slow.items()]
    if TIME_SYNC in slow:
        raise Hopeless(f"{words[0]}: no other check was made")
    if slow:
        raise Failed(", ".join(words))
    slowest = max(found, key=lambda kind: found[kind])
    return f"{len(kinds)} types of request, the slowest: {_after(slowest, found[slowest])}"


def soonest(probe: Probe, kind: int, payload: bytes) -> float:
    """s until a request is answered, the least of up to three attempts; PATIENT if it is not."""
    least = PATIENT
    for _ in range(3):
        with suppress(NoAnswer):
            frame = probe.frame(kind, payload)
            least = min(least, probe.ask_frame(frame, tries=1, patience=PATIENT).after)
        if least <= ANSWER or least == PATIENT:
            break
    if least == PATIENT:
        probe.mute[kind] = "link.in-time"
    return least


def _after(kind: int, seconds: float) -> str:
    if seconds == PATIENT:
        return f"{name_of(kind)} was not answered within {PATIENT:g} s"
    return f"{name_of(kind)} was answered after {1e3 * seconds:.0f} ms" + " at the soonest" * (seconds > ANSWER)


# -- framing ----------------------------------------------------------------------------------------------------------


@framing("split-anywhere", "1.3 15.1")
def split_anywhere(device: Device) -> str:
    """A frame that arrives in parts is received, wherever it is split."""
    probe = device.probe
    for at in (1, 2, 5, 9, 13):
        frame = probe.frame(TIME_SYNC)
        wire, since = probe.line.encode(frame), len(probe.heard)
        for part in (wire[:at], wire[at:-1], wire[-1:]):
            probe.write(part)
            probe.listen(0.005)
        if not probe.until(lambda frame=frame, since=since: bool(probe.answers(frame, since)), 0.25):  # type: ignore[misc]
            raise Failed(f"a frame split after {at} bytes was not answered")
    return "frames split after 1, 2, 5, 9 and 13 bytes were answered"


@framing("after-noise", "1.12 15.1")
def after_noise(device: Device) -> str:
    """A frame after noise is received."""
    noise = bytes(random.randrange(1, 256) for _ in range(60))
    return f"after 60 bytes of noise and a delimiter: {_answered(device.probe, noise + bytes(1))}"


@framing("empty-frames", "1.2")
def empty_frames(device: Device) -> str:
    """Delimiters between frames are ignored."""
    before = device.fresh().rx_bad
    words = _answered(device.probe, bytes(40))
    if (counted := device.fresh().rx_bad - before) > 0:
        raise Failed(f"rx_bad rose by {counted} for 40 delimiters")
    return f"after 40 delimiters: {words}; rx_bad unchanged"


@framing("no-delimiter", "1.12 1.10 1.9")
def no_delimiter(device: Device) -> str:
    """The device recovers from a run of bytes without a delimiter, and rx_bad counts it once."""
    probe = device.probe
    before = device.fresh().rx_bad
    probe.write(b"\0")
    for _ in range(NOISE // 100):
        probe.write(bytes([0x55]) * 100)
        probe.poll(0.005)
    words = f"after {NOISE} bytes without a delimiter: {_answered(probe, bytes(1), NOISE_TAKES)}"
    if (counted := (device.fresh().rx_bad - before) & 0xFFFFFFFF) != 1:
        raise Failed(f"{words}; rx_bad rose by {counted}, not by 1")
    return f"{words}; rx_bad rose by 1"


@framing("long-blocks", "1.3 4.2")
def long_blocks(device: Device) -> str:
    """A HELLO with 253 to 509 bytes without a zero in a row is received."""
    probe = device.probe
    runs = [n for n in RUNS if n + HELLO.size + 1 <= device.hello.rx_max]
    for n in runs:
        payload = HELLO.pack(probe.tid() << 8, 1, 1, 1024) + bytes([0, *[0xA5] * n])
        try:
            accepted(probe.ask(MessageType.HELLO, payload), f"HELLO with {n} bytes A5 behind it")
        except NoAnswer:
            raise Failed(f"a HELLO with {n} bytes A5 and no zero among them was not answered") from None
    if not runs:
        raise NotApplicable(f"rx_max is {device.hello.rx_max}: such a frame is too long")
    return f"HELLO with {', '.join(map(str, runs))} bytes without a zero: answered"


@framing("both-delimiters", "1.1")
def both_delimiters(device: Device) -> str:
    """Between two frames of the device there are two delimiters at least."""
    probe = device.probe
    for _ in range(6):
        probe.ask(TIME_SYNC)
    came = bytes(probe.line.came) if isinstance(probe.line, ByteLine) else b""
    gaps = [len(gap) for gap in re.findall(rb"(?<=[^\0])\0+(?=[^\0])", came)]
    if len(gaps) < 5:
        raise Unknown(f"{len(gaps) + 1} frames received")
    if min(gaps) < 2:
        raise Failed(f"of {len(gaps)} gaps between frames, {gaps.count(1)} have one delimiter only")
    return f"{len(gaps)} gaps between frames have at least {min(gaps)} delimiters"


def _answered(probe: Probe, before: bytes, patience: float = PATIENCE) -> str:
    frame = probe.frame(TIME_SYNC)
    wire = before + probe.line.encode(frame)
    return accepted(probe.ask_frame(frame, tries=1, wire=wire, patience=patience), "TIME_SYNC")


# -- damage -----------------------------------------------------------------------------------------------------------


def _body(device: Device, payload: bytes = b"", kind: int = TIME_SYNC) -> bytes:
    """Header and payload of a valid request."""
    return device.probe.frame(kind, payload).pack()


def bad_crc(device: Device) -> bytes:
    """A frame with one bit of its payload changed after its CRC was made."""
    body = _body(device, struct.pack("<BxHI", 0, 16, 0), MessageType.BLOB_READ)
    crc = crc32(body).to_bytes(4, "little")
    body = body[:10] + bytes([body[10] ^ 4]) + body[11:]
    return wrapped(body + crc, summed=False)


def bad_length(device: Device, number: int, payload: bytes = b"") -> bytes:
    """A frame whose `len` is this number, with a valid CRC."""
    body = _body(device)
    return wrapped(body[:4] + number.to_bytes(2, "little") + body[6:] + payload)


DAMAGE: dict[str, tuple[str, str, Callable[[Device], bytes]]] = {
    "crc": ("1.5", "a frame with a wrong CRC", bad_crc),
    "length": ("1.8", "a frame whose len does not match its length", lambda device: bad_length(device, 1)),
    "more": ("1.8", "a frame with a byte more than its len", lambda device: bad_length(device, 0, b"\1")),
    "cobs": ("1.6", "a frame whose COBS code runs past its end", lambda device: b"\0\xfe" + wrapped(_body(device))[2:]),
    "short": ("1.7", "a frame of 11 bytes", lambda device: wrapped(_body(device)[:7])),
    "too-long": (
        "1.9",
        "a frame of 1037 bytes",
        lambda device: bad_length(device, LONG, bytes(LONG)),
    ),
}


def _enter_damage(name: str, cites: str, words: str, made: Callable[[Device], bytes]) -> None:
    def silent(device: Device) -> str:
        return device.probe.silence(made(device), words)

    silent.__doc__ = f"{words[0].upper()}{words[1:]} is not answered."
    framing(f"{name}-damage-is-silent", f"{cites} 1.11")(silent)


for _name, (_cites, _words, _made) in DAMAGE.items():
    _enter_damage(_name, _cites, _words, _made)


@framing("damage-is-counted", "1.10 5.14")
def damage_is_counted(device: Device) -> str:
    """rx_bad counts each damaged frame."""
    probe, n = device.probe, len(DAMAGE)
    counted = before = 0
    for _ in range(2):  # a link may damage a frame of its own
        before = device.fresh().rx_bad
        for _, _, made in DAMAGE.values():
            probe.write(made(device))
            probe.listen(GRACE)
        counted = (device.fresh().rx_bad - before) & 0xFFFFFFFF
        if counted == n:
            break
    probe.hello()
    if counted == n and (left := (device.fresh().rx_bad - before) & 0xFFFFFFFF) < n:
        raise Failed(f"rx_bad counted {n} damaged frames, {left} of them after a HELLO")
    if counted == n:
        return f"rx_bad counted {n} of {n}: CRC, len, COBS, short, long"
    raise Failed(f"rx_bad counted {counted} of {n} damaged frames")


@check("rx-max-taken", "4.17 1.9 4.2 16.19")
def rx_max_taken(device: Device) -> str:
    """A payload of rx_max bytes is received; one of a byte more is not answered, and counted."""
    probe, most = device.probe, device.hello.rx_max
    if not HELLO.size <= most <= MAX_PAYLOAD:
        raise Unknown(f"rx_max in HELLO is {most}")

    def hello_of(n: int) -> Frame:
        payload = HELLO.pack(probe.tid() << 8, 1, 1, 1024).ljust(n, b"\x5a")
        return probe.frame(MessageType.HELLO, payload)

    try:
        words = accepted(probe.ask_frame(hello_of(most)), f"HELLO of {most} bytes")
    except NoAnswer:
        raise Failed(f"a HELLO of {most} bytes was not answered, rx_max is {most}") from None
    if most == MAX_PAYLOAD:
        return words
    before = device.fresh().rx_bad
    words += f"; {probe.silence(probe.line.encode(hello_of(most + 1)), f'a HELLO of {most + 1} bytes')}"
    if (counted := (device.fresh().rx_bad - before) & 0xFFFFFFFF) != 1:
        raise Failed(f"{words}; rx_bad rose by {counted}, not by 1")
    return words


@check("reply-flags-ignored", "3.2 3.23")
def reply_flags_ignored(device: Device) -> str:
    """Frames with the reply or error flag are not answered, executed or counted in rx_bad, whatever their node."""
    probe = device.probe
    before = device.fresh().rx_bad
    frames = [
        (words, probe.frame(*asked, flags=MAJOR | flags))
        for flags in (REPLY, ERROR, REPLY | ERROR)
        for words, asked in (("TIME_SYNC", (TIME_SYNC,)), ("STREAM_SET", _effect(device)))
    ]
    if not probe.line.bus and device.hello.nodes < 255:
        frames.append(("TIME_SYNC to an absent node", frames[0][1]._replace(node=_absent(device), tid=probe.tid())))
    for words, frame in frames:
        probe.silence(probe.line.encode(frame), f"{words} with flags 0x{frame.flags:02x}")
    if probe.ask(MessageType.STREAM_GET, StreamGet(0).pack()).error is None:
        raise Failed("a STREAM_SET with the reply or error flag was executed")
    if bad := (device.fresh().rx_bad - before) & 0xFFFFFFFF:
        raise Failed(f"rx_bad rose by {bad} for {len(frames)} frames with the reply or error flag")
    return f"{len(frames)} frames with flags 11, 21, 31: neither answered, executed nor counted"


@check("reserved-bits", "1.14")
def reserved_bits(device: Device) -> str:
    """Unused flag bits and the reserved byte are ignored."""
    probe = device.probe
    for bits in (0x40, 0x80, 0xC0):
        accepted(probe.ask_frame(probe.frame(TIME_SYNC, flags=MAJOR | bits)), f"TIME_SYNC with bits 0x{bits:02x}")
    if probe.line.bus:
        return "flag bits 6 and 7 set: answered as usual"
    frame = probe.frame(TIME_SYNC)
    accepted(probe.ask_frame(frame, wire=probe.line.encode(frame, reserved=0xA5)), "TIME_SYNC, reserved byte A5")
    return "flag bits 6 and 7 set, reserved byte A5: answered as usual"


@check("padding", "0.1")
def padding(device: Device) -> str:
    """Padding bytes are ignored."""
    probe, stop = device.probe, struct.pack("<BBBBI", Command.STOP, 0xA5, 0xA5, 0xA5, 0)
    require_granted(probe.stop(), "STOP")
    accepted(probe.ask(MessageType.STATE_CMD, stop), "STOP with padding bytes A5")
    padded_get = probe.ask(MessageType.STREAM_GET, b"\x03\xa5\xa5\xa5")
    refusal(padded_get, ErrorCode.UNKNOWN_ID, 3, "STREAM_GET of a free stream, with padding bytes A5")
    plain = device.probe.ask(MessageType.BLOB_READ, BlobRead(0, 16, 0).pack())
    padded = device.probe.ask(MessageType.BLOB_READ, struct.pack("<BBHI", 0, 0xA5, 16, 0))
    if plain.frame.is_error:
        raise Unknown(f"BLOB_READ: {plain}")
    if plain.frame.payload != padded.frame.payload:
        raise Failed(f"BLOB_READ with padding byte A5: {padded}, not the same as with 00")
    return "BLOB_READ with padding byte A5: same answer as with 00; STOP and STREAM_GET likewise"


@check("one-answer", "3.4 3.5 2.2 1.13")
def one_answer(device: Device) -> str:
    """Each request is answered exactly once, by the node that it was sent to; ALIVE is not answered."""
    probe = device.probe
    none = struct.pack("<I", 0)
    kinds = (
        (MessageType.BLOB_READ, BlobRead(0, 16, 0).pack()), (MessageType.STREAM_GET, bytes(4)),
        (MessageType.PARAM_GET, bytes(4)), (MessageType.STREAM_START, none), (MessageType.STREAM_STOP, none),
        _effect(device) if device.descriptor.channels else (TIME_SYNC, b""),
        (MessageType.STATE_CMD, struct.pack("<BxxxI", Command.STOP, 0)),
    )  # fmt: skip
    frames = [probe.frame(TIME_SYNC) for _ in range(ROUNDS)] + [probe.frame(*asked) for asked in kinds]
    answers = []
    for frame in frames:
        probe.alive()
        answers.append(probe.ask_frame(frame, tries=1))
    probe.listen(2 * GRACE)
    came = [each.frame for each in probe.heard if each.frame.is_reply]
    if len(came) != len(frames):
        others = {name_of(each.type) for each in came} - {name_of(each.type) for each in frames}
        raise Failed(f"{len(frames)} requests got {len(came)} answers {', '.join(others)}".rstrip())
    if nodes := {answer.frame.node for answer in answers} - {probe.node}:
        raise Failed(f"requests to node {probe.node} were answered by node {', '.join(map(str, nodes))}")
    slowest = max(answer.after for answer in answers)
    return f"{len(frames)} requests got as many answers, the slowest after {1e3 * slowest:.0f} ms"


@check("four-at-once", "3.31")
def four_at_once(device: Device) -> str:
    """Four requests that are sent at once are all answered."""
    probe = device.probe
    frames = [probe.frame(TIME_SYNC) for _ in range(4)]
    probe.write(b"".join(map(probe.line.encode, frames)))
    probe.until(lambda: all(map(probe.answers, frames)), PATIENCE + probe.takes(IN_BETWEEN))
    came = sum(len(probe.answers(frame)) for frame in frames)
    if came != len(frames):
        raise Failed(f"four TIME_SYNCs at once got {came} answers")
    return "four TIME_SYNCs at once got four answers"


# -- versions, types, tids, nodes, lengths ----------------------------------------------------------------------------


@check("other-major", "4.1 3.25")
def other_major(device: Device) -> str:
    """Another major is refused with BAD_VERSION and the device's own major, and not executed."""
    probe = device.probe
    words = []
    for major in (0, 2, 15):
        answer = probe.ask_frame(probe.frame(TIME_SYNC, flags=major))
        words.append(refusal(answer, ErrorCode.BAD_VERSION, MAJOR, f"TIME_SYNC with major {major}"))
    alive = probe.ask_frame(probe.frame(MessageType.ALIVE, bytes(4), flags=2))
    return "; ".join([*words, refusal(alive, ErrorCode.BAD_VERSION, MAJOR, "ALIVE with major 2")])


@check("hello-of-any-major", "4.1 4.2 4.17 5.1")
def hello_of_any_major(device: Device) -> str:
    """HELLO may have any major in its flags and may be longer; only its own fields can have it refused."""
    probe = device.probe
    nonce = random.getrandbits(32)
    answer = probe.ask_frame(probe.frame(MessageType.HELLO, HELLO.pack(nonce, 1, 2, 1024) + b"more", flags=2))
    accepted(answer, "HELLO with major 2 in its flags, for majors 1 to 2, four bytes longer")
    refused = probe.ask(MessageType.HELLO, HELLO.pack(nonce, 2, 3, 1024))
    refusal(refused, ErrorCode.BAD_VERSION, MAJOR, "HELLO for majors 2 to 3")
    older = probe.ask(MessageType.HELLO, HELLO.pack(nonce, 0, 0, 1024))
    refusal(older, ErrorCode.BAD_VERSION, MAJOR, "HELLO for major 0")
    both = probe.ask(MessageType.HELLO, HELLO.pack(nonce, 2, 3, 1))
    refusal(both, ErrorCode.BAD_VERSION, MAJOR, "HELLO for majors 2 to 3 with rx_max 1")
    small = probe.ask(MessageType.HELLO, HELLO.pack(nonce, 1, 1, 127))
    refusal(small, ErrorCode.OUT_OF_RANGE, 128, "HELLO with rx_max 127")
    return f"major 2, longer: {answer}; for majors 2 to 3: {refused}; rx_max 127: {small}"


@check("unknown-type", "3.26 17.1 3.18 6.1")
def unknown_type(device: Device) -> Iterator[str]:
    """Types that are reserved, not assigned, of a feature that is lacking, or not a host's are refused as unknown."""
    sent = () if device.probe.line.bus else NO_REQUESTS
    lacking = [kind for kind, feature in OF_FEATURES.items() if not device.offers(feature)]
    return (device.probe.refused(ErrorCode.UNKNOWN_TYPE, kind, kind) for kind in (*UNKNOWN_TYPES, *lacking, *sent))


@check("tid", "3.27 3.6 8.10")
def tid(device: Device) -> tuple[str, ...]:
    """Requests need a tid; ALIVE and SETPOINT must not have one. None is executed."""
    probe = device.probe
    kind, payload = _effect(device)
    before = device.fresh()
    effect = probe.ask_frame(probe.frame(kind, payload, tid=0))
    stop = probe.ask_frame(probe.frame(MessageType.STATE_CMD, struct.pack("<BxxxI", Command.STOP, 0), tid=0))
    setpoint = probe.ask_frame(probe.frame(MessageType.SETPOINT, bytes([1, *bytes(11)]), tid=6))
    none = probe.ask_frame(probe.frame(TIME_SYNC, tid=0))
    one = probe.ask_frame(probe.frame(MessageType.ALIVE, bytes(4), tid=5))
    return (
        refusal(none, ErrorCode.BAD_VALUE, 0, "TIME_SYNC with tid 0"),
        refusal(one, ErrorCode.BAD_VALUE, 5, "ALIVE with tid 5"),
        refusal(effect, ErrorCode.BAD_VALUE, 0, "STREAM_SET with tid 0"),
        refusal(stop, ErrorCode.BAD_VALUE, 0, "STOP with tid 0"),
        refusal(setpoint, ErrorCode.BAD_VALUE, 6, "SETPOINT with tid 6"),
        _not_executed(device, before.setpoints_rejected),
    )


def _not_executed(device: Device, rejected: int) -> str:
    if device.probe.ask(MessageType.STREAM_GET, StreamGet(0).pack()).error is None:
        raise Failed("a STREAM_SET with tid 0 was refused, and executed")
    if (now := device.fresh().setpoints_rejected) != rejected:
        raise Failed(f"a SETPOINT with a tid counts as rejected: setpoints_rejected was {rejected}, is {now}")
    return "no stream was configured, and no setpoint counted as rejected"


@framing("absent-node", "2.3 3.24")
def absent_node(device: Device) -> str:
    """A request to an absent node is refused with UNKNOWN_NODE and the node."""
    words = []
    for node in {_absent(device), 255}:
        answer = device.probe.ask_frame(device.probe.frame(TIME_SYNC)._replace(node=node))
        words.append(refusal(answer, ErrorCode.UNKNOWN_NODE, node, f"TIME_SYNC to node {node}"))
    return "; ".join(words)


@framing("node-0", "2.1 2.2")
def node_0(device: Device) -> str:
    """A request to node 0 is executed by the first device, which answers with its own node."""
    frame = device.probe.frame(TIME_SYNC)._replace(node=0)
    answer = device.probe.ask_frame(frame)
    accepted(answer, "TIME_SYNC to node 0")
    if answer.frame.node != device.hello.node:
        raise Failed(f"TIME_SYNC to node 0 was answered by node {answer.frame.node}, HELLO by {device.hello.node}")
    return f"TIME_SYNC to node 0 was answered by node {answer.frame.node}"


@framing("nodes-apart", "2.4")
def nodes_apart(device: Device) -> str:
    """What another node is asked leaves this one's stream and kept replies alone."""
    probe = device.probe
    others = [node for node in range(1, min(device.hello.nodes, 16) + 1) if node != probe.node]
    if not others:
        raise NotApplicable("the link leads to one node only")
    frame = probe.frame(*_effect(device))
    first = probe.ask_frame(frame)
    _cfg_id(first)
    for kind, payload in (
        (MessageType.HELLO, HELLO.pack(random.getrandbits(32), 1, 1, 1024)),
        (MessageType.STREAM_STOP, struct.pack("<I", 0xFFFFFFFF)),
    ):
        answer = probe.ask_frame(probe.frame(kind, payload)._replace(node=others[0]))
        if answer.frame.node != others[0]:
            raise Failed(f"{name_of(kind)} to node {others[0]} was answered by node {answer.frame.node}")
    if probe.ask(MessageType.STREAM_GET, StreamGet(0).pack()).error is not None:
        raise Failed(f"STREAM_STOP of node {others[0]} freed a stream of node {probe.node}")
    if not _same(first, probe.ask_frame(frame)):
        raise Failed(f"HELLO to node {others[0]} cleared the kept replies of node {probe.node}")
    return f"HELLO and STREAM_STOP to node {others[0]}: stream and kept replies of node {probe.node} are as before"


def _absent(device: Device) -> int:
    if device.hello.nodes >= 255:
        raise NotApplicable("all 255 nodes exist")
    return max(device.hello.nodes, device.probe.node) + 1


@check("bad-length", "3.20 3.29 6.1")
def bad_length_refused(device: Device) -> Iterator[str]:
    """A wrong length is refused with BAD_LENGTH and the payload's length."""
    probe = device.probe
    kinds = [(kind, n) for kind, right in LENGTHS.items() for n in (right - 1, right + 1) if n > 0]
    kinds += [(MessageType.HELLO, 7), (MessageType.STREAM_SET, 7), (MessageType.STREAM_SET, 9)]
    kinds += [(kind, n) for kind, n in WRONG_LENGTHS if device.offers(OF_FEATURES[kind])]
    yield from (probe.refused(ErrorCode.BAD_LENGTH, n, kind, bytes(n)) for kind, n in kinds)
    alive = probe.ask_frame(probe.frame(MessageType.ALIVE, bytes(3)))
    yield refusal(alive, ErrorCode.BAD_LENGTH, 3, "ALIVE")


@check("order-of-checks", "3.22 3.30")
def order_of_checks(device: Device) -> Iterator[str]:
    """Of two errors, the one that is checked first is reported."""
    probe = device.probe
    frame = probe.frame
    unknown = UNKNOWN_TYPES[-1]
    pairs = [
        ("another major and an unknown type", frame(unknown, flags=2), ErrorCode.BAD_VERSION),
        ("an unknown type and tid 0", frame(unknown, tid=0), ErrorCode.UNKNOWN_TYPE),
        ("an unknown type and a payload", frame(unknown, bytes(3)), ErrorCode.UNKNOWN_TYPE),
        ("another major and tid 0", frame(TIME_SYNC, flags=2, tid=0), ErrorCode.BAD_VERSION),
        ("another major and a wrong length", frame(TIME_SYNC, bytes(3), flags=2), ErrorCode.BAD_VERSION),
        ("tid 0 and an unknown blob", frame(MessageType.BLOB_READ, b"\7" * 8, tid=0), ErrorCode.BAD_VALUE),
        ("a wrong length and an unknown command", frame(MessageType.STATE_CMD, b"\x63"), ErrorCode.BAD_LENGTH),
        ("an unknown blob and an offset past the end", frame(MessageType.BLOB_READ, b"\7" * 8), ErrorCode.UNKNOWN_ID),
        ("tid 0 and a wrong length", frame(TIME_SYNC, bytes(3), tid=0), ErrorCode.BAD_VALUE),
        ("a wrong length and an unknown blob", frame(MessageType.BLOB_READ, b"\7" * 7), ErrorCode.BAD_LENGTH),
        (
            "ids of the wrong length and stream 9",
            frame(MessageType.STREAM_SET, b"\x09\0\1\0\1\0\2\0\1\0"),
            ErrorCode.BAD_LENGTH,
        ),
    ]
    if not probe.line.bus and device.hello.nodes < 255:
        absent = frame(TIME_SYNC, flags=2)._replace(node=_absent(device))
        pairs.insert(0, ("an absent node and another major", absent, ErrorCode.UNKNOWN_NODE))
        strange = frame(unknown, bytes(3), tid=0)._replace(node=_absent(device))
        pairs.insert(1, ("an absent node, an unknown type and tid 0", strange, ErrorCode.UNKNOWN_NODE))
    return (refusal(probe.ask_frame(asked), code, None, words) for words, asked, code in pairs)


# -- retries ----------------------------------------------------------------------------------------------------------


def _effect(device: Device) -> tuple[int, bytes]:
    """A request whose reply differs each time it is executed: it reconfigures a stream."""
    number = device.channels[0].id
    return MessageType.STREAM_SET, struct.pack("<BBHHHH", 0, 0, min(1000, device.pwm_hz), 20, 1, number)


def _same(first: Answer, again: Answer) -> bool:
    return first.frame == again.frame and first.heard.transfer == again.heard.transfer


def _cfg_id(answer: Answer) -> int:
    return read(require_granted(answer, "STREAM_SET").frame, StreamReply).cfg_id


@check("retry-same-bytes", "3.13")
def retry_same_bytes(device: Device) -> str:
    """A repeated request gets the same reply, byte for byte."""
    probe = device.probe
    frame = probe.frame(MessageType.BLOB_READ, BlobRead(0, PART, 0).pack())
    first, again = probe.ask_frame(frame), probe.ask_again(frame)
    if first.frame != again.frame:
        raise Failed("a repeated BLOB_READ had another reply")
    return f"BLOB_READ repeated: the same {len(first.frame.payload)} bytes after {1e3 * again.after:.0f} ms"


@check("retry-not-executed", "3.13")
def retry_not_executed(device: Device) -> str:
    """A repeated request is not executed again."""
    probe = device.probe
    told = []
    for times in (1, 1, 2):
        frame = probe.frame(*_effect(device))
        replies = [_cfg_id(probe.ask_again(frame)) for _ in range(times)]
        told.append((replies, probe.get(StreamGet(0), StreamInfo).cfg_id))
    _, (once, then), (twice, now) = told
    if once[0] != then:
        raise Unknown(f"STREAM_SET gave cfg_id {once[0]}, STREAM_GET {then}: it does not show what was executed")
    if {*twice, now} != {twice[0]}:
        raise Failed(f"a repeated STREAM_SET was executed again: its replies have cfg_id {twice}, STREAM_GET {now}")
    return f"STREAM_SET repeated: cfg_id {now} both times, and in STREAM_GET"


@check("retry-whole-request", "3.14 3.28")
def retry_whole_request(device: Device) -> str:
    """A request with the tid of an earlier one, or with its payload, but not both, is executed."""
    probe = device.probe
    first = probe.frame(MessageType.BLOB_READ, BlobRead(0, 8, 0).pack())
    probe.ask_frame(first)
    others = {
        "payload": first._replace(payload=BlobRead(0, 8, 1).pack()),
        "length": first._replace(payload=BlobRead(0, 7, 0).pack()),
        "type": first._replace(type=MessageType.STREAM_GET, payload=bytes(4)),
        "wrong length": first._replace(payload=first.payload + b"\0"),
    }
    for what, frame in others.items():
        answer = probe.ask_frame(frame)
        told = answer.frame.payload[2:8] if answer.error is None else answer.error.code
        due: object = {"type": ErrorCode.UNKNOWN_ID, "wrong length": ErrorCode.BAD_LENGTH}.get(what, frame.payload[2:8])
        if told != due:
            raise Failed(f"a request with the tid of another one, but another {what}, had that one's reply: {answer}")
    effect = probe.frame(*_effect(device))
    one = _cfg_id(probe.ask_frame(effect))
    if (other := _cfg_id(probe.ask_frame(effect._replace(tid=probe.tid())))) == one:
        raise Failed(f"a STREAM_SET that differs in its tid only was not executed: cfg_id {other} again")
    return f"same tid, another {', '.join(others)}: executed; same payload, another tid: executed"


@check("retry-only-requests", "3.12")
def retry_only_requests(device: Device) -> str:
    """ALIVE, and what checks 2 to 5 refuse, push no kept reply out."""
    probe = device.probe
    frame = probe.frame(*_effect(device))
    first = probe.ask_frame(frame)
    _cfg_id(first)
    for _ in range(5):
        probe.alive()
        probe.ask_frame(probe.frame(UNKNOWN_TYPES[0]))
        probe.ask_frame(probe.frame(TIME_SYNC, flags=2))
        probe.ask_frame(probe.frame(TIME_SYNC, tid=0))
    again = probe.ask_frame(frame)
    if not _same(first, again):
        raise Failed(f"after ALIVE and refusals by checks 3 to 5, STREAM_SET was executed again: {_cfg_id(again)}")
    return f"after 5 ALIVE and 15 refusals by checks 3 to 5: the kept reply, cfg_id {_cfg_id(again)}"


@check("refused-changes-nothing", "3.19 3.16")
def refused_changes_nothing(device: Device) -> str:
    """A refused HELLO clears no kept reply and limits no payload; a refused STREAM_SET leaves the stream as it is."""
    probe = device.probe
    frame = probe.frame(*_effect(device))
    first = probe.ask_frame(frame)
    _cfg_id(first)
    before = probe.get(StreamGet(0), StreamInfo)
    for lowest, most in ((2, 1024), (1, 127)):
        hello = HELLO.pack(random.getrandbits(32), lowest, 3, most)
        if probe.ask(MessageType.HELLO, hello).error is None:
            raise Unknown(f"HELLO for majors {lowest} to 3 with rx_max {most} was not refused")
    again = probe.ask_frame(frame)
    if not _same(first, again):
        raise Failed("a refused HELLO with another nonce cleared the kept replies")
    whole = probe.get(BlobRead(0, 0xFFFF, 0), BlobReply)
    if len(whole.data) < min(whole.total, device.hello.tx_max - 12):
        raise Failed(f"after a HELLO with rx_max 127, refused, BLOB_READ is answered with {len(whole.data)} bytes")
    kind, payload = _effect(device)
    for refused in (payload[:2] + bytes(2) + payload[4:], payload[:1] + b"\x09" + payload[2:]):
        if probe.ask(kind, refused).error is None:
            raise Unknown("STREAM_SET with decimation 0 or event 9 was not refused")
    now = probe.ask(MessageType.STREAM_GET, StreamGet(0).pack())
    if now.error is not None or read(now.frame, StreamInfo) != before:
        raise Failed(f"after a refused STREAM_SET, STREAM_GET is {now}; the stream was {before}")
    return "after refused HELLOs and STREAM_SETs: kept replies, tx_max and the configured stream as before"


@check("retry-four-kept", "3.12")
def retry_four_kept(device: Device) -> str:
    """A repeated request is recognised after three others."""
    probe = device.probe
    frame = probe.frame(*_effect(device))
    first = probe.ask_frame(frame)
    _cfg_id(first)
    for offset in range(3):
        accepted(probe.ask(MessageType.BLOB_READ, BlobRead(0, 8, offset).pack()), "BLOB_READ")
    again = probe.ask_frame(frame)
    if not _same(first, again):
        raise Failed(f"after three other requests a repeated STREAM_SET was executed again: cfg_id {_cfg_id(again)}")
    return f"STREAM_SET repeated after three others: the kept reply, cfg_id {_cfg_id(again)}"


@check("retry-refusal-kept", "3.12")
def retry_refusal_kept(device: Device) -> str:
    """A refusal is kept like any other reply."""
    probe = device.probe
    start = probe.frame(MessageType.STREAM_START, struct.pack("<I", 1))
    first = probe.ask_frame(start)
    if first.error is None:
        raise Unknown("STREAM_START of a free stream was not refused")
    _cfg_id(probe.ask(*_effect(device)))
    again = probe.ask_frame(start)
    if not _same(first, again):
        raise Failed(f"STREAM_START, refused, then repeated when it could have been accepted: {again}")
    return f"STREAM_START repeated when it could have been accepted: the kept refusal, {again}"


@check("retry-afresh", "3.15")
def retry_afresh(device: Device) -> str:
    """HELLO, TIME_SYNC and STOP are answered afresh when repeated, TIME_SYNC with a later tick."""
    probe = device.probe
    frame = probe.frame(TIME_SYNC)
    first = read(probe.ask_frame(frame).frame, TimeSyncReply)
    probe.listen(0.02)
    again = read(probe.ask_frame(frame).frame, TimeSyncReply)
    if again.rx_tick == first.rx_tick:
        raise Failed(f"a repeated TIME_SYNC had tick {first.rx_tick} again")
    for kind, payload in (
        (MessageType.HELLO, HELLO.pack(random.getrandbits(32), 1, 1, 1024)),
        (MessageType.STATE_CMD, struct.pack("<BxxxI", Command.STOP, 0)),
    ):
        frame = probe.frame(kind, payload)
        require_granted(probe.ask_frame(frame), name_of(kind))
        accepted(probe.ask_frame(frame), name_of(kind))
    return f"TIME_SYNC repeated: {again.rx_tick - first.rx_tick} ticks later; HELLO and STOP repeated: answered"


@check("nonce-empties", "3.16")
def nonce_empties(device: Device) -> str:
    """A HELLO with another nonce or rx_max clears the kept replies, so another host may use the same tids."""
    probe = device.probe
    nonce = random.getrandbits(32)
    probe.hello(nonce)
    frame = probe.frame(*_effect(device))
    first = _cfg_id(probe.ask_frame(frame))
    probe.hello(nonce)
    same = _cfg_id(probe.ask_frame(frame))
    probe.hello(nonce ^ 1)
    other = _cfg_id(probe.ask_frame(frame))
    probe.hello(nonce ^ 1, rx_max=512)
    again = _cfg_id(probe.ask_frame(frame))
    if again == other:
        raise Failed(f"after a HELLO with another rx_max, STREAM_SET was not executed: cfg_id {again} again")
    if same != first:
        raise Failed(f"a HELLO with the same nonce cleared the kept replies: cfg_id {same}, was {first}")
    if other == first:
        raise Failed(f"after a HELLO with another nonce, STREAM_SET was not executed: cfg_id {other} again")
    return f"cfg_id {first}; {same} after the same nonce, {other} after another"

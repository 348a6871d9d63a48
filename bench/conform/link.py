"""Level 0: frames, damage, the order of checks, retries. Chapters 1 to 4 of SPEC."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Iterator
from zlib import crc32

from bench.conform.checks import Carrier, Group
from bench.conform.device import PART, Device, require_granted
from bench.conform.levels import LINK
from bench.conform.probe import GRACE, HELLO, PATIENCE, Answer, Probe, accepted, name_of, read, refusal
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from protocol.codes import Command, ErrorCode, MessageType
from protocol.framing import ERROR, MAJOR, MAX_PAYLOAD, REPLY, wrapped
from protocol.messages import BlobRead, StreamGet, StreamInfo, StreamReply, TimeSyncReply

check = Group("link", LINK)
framing = Group("link", LINK, Carrier.BYTES)

SILENT = "A damaged frame is never answered"
ORDER = "A device makes these checks in this order, and the first one that fails decides the answer"
KEPT = (
    "A request identical to one of these, byte for byte in header and payload, is answered with the kept reply and not "
    "executed"
)
UNKNOWN_TYPES = (0x06, 0x38, 0x39)  # chapter 17 reserves them
NOISE = 5000  # bytes without a delimiter
NOISE_TAKES = 10.0  # s that they may be under way: a UART of 9600 baud carries them in 5.2 s
ROUNDS = 20
TIME_SYNC = MessageType.TIME_SYNC


@check("hello", 4, "sends HELLO with a new random nonce")
def hello(device: Device) -> str:
    """The reply to HELLO has its nonce."""
    nonce = random.getrandbits(32)
    answer = device.probe.ask(MessageType.HELLO, HELLO.pack(nonce, 1, 1, 1024))
    accepted(answer, "HELLO")
    told = struct.unpack_from("<I", answer.frame.payload.ljust(4, b"\0"))[0]
    if told != nonce:
        raise Failed(f"the reply has nonce {told:08x}, not {nonce:08x}")
    return f"nonce {nonce:08x} came back after {1e3 * answer.after:.0f} ms"


# -- framing ----------------------------------------------------------------------------------------------------------


@framing("split-anywhere", 15, "fed whole, byte by byte, split anywhere, after noise and before more bytes")
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


@framing("after-noise", 15, "fed whole, byte by byte, split anywhere, after noise and before more bytes")
def after_noise(device: Device) -> str:
    """A frame after noise is received."""
    noise = bytes(random.randrange(1, 256) for _ in range(60))
    return f"after 60 bytes of noise and a delimiter: {_answered(device.probe, noise + bytes(1))}"


@framing("empty-frames", 1, "Two delimiters in a row enclose an empty frame, which is ignored")
def empty_frames(device: Device) -> str:
    """Delimiters between frames are ignored."""
    before = device.fresh().rx_bad
    words = _answered(device.probe, bytes(40))
    if (counted := device.fresh().rx_bad - before) > 0:
        raise Failed(f"rx_bad rose by {counted} for 40 delimiters")
    return f"after 40 delimiters: {words}; rx_bad unchanged"


@framing("no-delimiter", 1, "A receiver must be able to recover after any number of bytes without a delimiter")
def no_delimiter(device: Device) -> str:
    """The device recovers from a run of bytes without a delimiter."""
    probe = device.probe
    probe.write(b"\0")
    for _ in range(NOISE // 100):
        probe.write(bytes([0x55]) * 100)
        probe.poll(0.005)
    return f"after {NOISE} bytes without a delimiter: {_answered(probe, bytes(1), NOISE_TAKES)}"


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


DAMAGE: dict[str, tuple[str, Callable[[Device], bytes]]] = {
    "crc": ("a frame with a wrong CRC", bad_crc),
    "length": ("a frame whose len does not match its length", lambda device: bad_length(device, 1)),
    "cobs": ("a frame whose COBS code runs past its end", lambda device: b"\0\xfe" + wrapped(_body(device))[2:]),
    "short": ("a frame of 11 bytes", lambda device: wrapped(_body(device)[:7])),
    "too-long": ("a frame of 1037 bytes", lambda device: bad_length(device, MAX_PAYLOAD + 1, bytes(MAX_PAYLOAD + 1))),
}


def _enter_damage(name: str, words: str, made: Callable[[Device], bytes]) -> None:
    def silent(device: Device) -> str:
        return device.probe.silence(made(device), words)

    silent.__doc__ = f"{words[0].upper()}{words[1:]} is not answered."
    framing(f"{name}-damage-is-silent", 1, SILENT)(silent)


for _name, (_words, _made) in DAMAGE.items():
    _enter_damage(_name, _words, _made)


@framing("damage-is-counted", 1, "it counts each (a run of bytes without a delimiter: once)")
def damage_is_counted(device: Device) -> str:
    """rx_bad counts each damaged frame."""
    probe, n = device.probe, len(DAMAGE)
    counted = 0
    for _ in range(2):  # a link may damage a frame of its own
        before = device.fresh().rx_bad
        for _, made in DAMAGE.values():
            probe.write(made(device))
            probe.listen(GRACE)
        counted = (device.fresh().rx_bad - before) & 0xFFFFFFFF
        if counted == n:
            return f"rx_bad counted {n} of {n}: CRC, len, COBS, short, long"
    raise Failed(f"rx_bad counted {counted} of {n} damaged frames")


@check("reply-flags-ignored", 3, "A device ignores a frame with either flag, whatever its node")
def reply_flags_ignored(device: Device) -> str:
    """Frames with the reply or error flag are not answered."""
    probe = device.probe
    for flags in (REPLY, ERROR, REPLY | ERROR):
        frame = probe.frame(TIME_SYNC, flags=MAJOR | flags)
        since = len(probe.heard)
        probe.send(frame)
        barrier = probe.ask(TIME_SYNC)
        probe.listen(GRACE)
        if probe.answers(frame, since):
            raise Failed(f"a frame with flags 0x{MAJOR | flags:02x} was answered")
    return f"flags 11, 21, 31: not answered; the next request: {barrier}"


@check("reserved-bits", 1, "bits 6 and 7 sent as 0 and ignored")
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


@check("padding", 0, "`pad` bytes are sent as 0 and ignored")
def padding(device: Device) -> str:
    """Padding bytes are ignored."""
    plain = device.probe.ask(MessageType.BLOB_READ, BlobRead(0, 16, 0).pack())
    padded = device.probe.ask(MessageType.BLOB_READ, struct.pack("<BBHI", 0, 0xA5, 16, 0))
    if plain.frame.is_error:
        raise Unknown(f"BLOB_READ: {plain}")
    if plain.frame.payload != padded.frame.payload:
        raise Failed(f"BLOB_READ with padding byte A5: {padded}, not the same as with 00")
    return "BLOB_READ with padding byte A5: same answer as with 00"


@check("one-answer", 3, "is answered by exactly one frame of the same type and tid")
def one_answer(device: Device) -> str:
    """Each request is answered exactly once."""
    probe = device.probe
    frames = [probe.frame(TIME_SYNC) for _ in range(ROUNDS)]
    slowest = max(probe.ask_frame(frame, tries=1).after for frame in frames)
    probe.listen(2 * GRACE)
    came = sum(each.frame.is_reply for each in probe.heard)
    if came != ROUNDS:
        raise Failed(f"{ROUNDS} requests got {came} answers")
    return f"{ROUNDS} requests got {ROUNDS} answers, the slowest after {1e3 * slowest:.0f} ms"


# -- versions, types, tids, nodes, lengths ----------------------------------------------------------------------------


@check("other-major", 4, "A device refuses a request with another major")
def other_major(device: Device) -> str:
    """Another major is refused with BAD_VERSION and the device's own major."""
    answer = device.probe.ask_frame(device.probe.frame(TIME_SYNC, flags=2))
    return refusal(answer, ErrorCode.BAD_VERSION, MAJOR, "TIME_SYNC with major 2")


@check("hello-of-any-major", 4, "HELLO, its reply and its refusal keep their layout in all majors")
def hello_of_any_major(device: Device) -> str:
    """HELLO may have any major in its flags and may be longer; only its own fields can have it refused."""
    probe = device.probe
    nonce = random.getrandbits(32)
    answer = probe.ask_frame(probe.frame(MessageType.HELLO, HELLO.pack(nonce, 1, 2, 1024) + b"more", flags=2))
    accepted(answer, "HELLO with major 2 in its flags, for majors 1 to 2, four bytes longer")
    refused = probe.ask(MessageType.HELLO, HELLO.pack(nonce, 2, 3, 1024))
    refusal(refused, ErrorCode.BAD_VERSION, MAJOR, "HELLO for majors 2 to 3")
    small = probe.ask(MessageType.HELLO, HELLO.pack(nonce, 1, 1, 127))
    refusal(small, ErrorCode.OUT_OF_RANGE, 128, "HELLO with rx_max 127")
    return f"major 2, longer: {answer}; for majors 2 to 3: {refused}; rx_max 127: {small}"


@check("unknown-type", 3, "an unknown type, a wrong length, a value that is not allowed, a state that forbids it")
def unknown_type(device: Device) -> Iterator[str]:
    """Reserved types are refused with UNKNOWN_TYPE and the type."""
    return (device.probe.refused(ErrorCode.UNKNOWN_TYPE, kind, kind) for kind in UNKNOWN_TYPES)


@check("tid", 3, "a request with tid 0, are refused (BAD_VALUE, `detail` = the tid) and not executed")
def tid(device: Device) -> tuple[str, ...]:
    """Requests need a tid; ALIVE and SETPOINT must not have one."""
    probe = device.probe
    none = probe.ask_frame(probe.frame(TIME_SYNC, tid=0))
    one = probe.ask_frame(probe.frame(MessageType.ALIVE, bytes(4), tid=5))
    return (
        refusal(none, ErrorCode.BAD_VALUE, 0, "TIME_SYNC with tid 0"),
        refusal(one, ErrorCode.BAD_VALUE, 5, "ALIVE with tid 5"),
    )


@framing("absent-node", 2, "refused by the first device (UNKNOWN_NODE)")
def absent_node(device: Device) -> str:
    """A request to an absent node is refused with UNKNOWN_NODE and the node."""
    node = _absent(device)
    answer = device.probe.ask_frame(device.probe.frame(TIME_SYNC)._replace(node=node))
    return refusal(answer, ErrorCode.UNKNOWN_NODE, node, f"TIME_SYNC to node {node}")


def _absent(device: Device) -> int:
    if device.hello.nodes >= 255:
        raise NotApplicable("all 255 nodes exist")
    return max(device.hello.nodes, device.probe.node) + 1


@check("bad-length", 3, "A request must have exactly the length given here")
def bad_length_refused(device: Device) -> Iterator[str]:
    """A wrong length is refused with BAD_LENGTH and the payload's length."""
    probe = device.probe
    kinds = (
        (MessageType.PARAM_GET, 5), (MessageType.BLOB_READ, 7), (TIME_SYNC, 1), (MessageType.STREAM_GET, 3),
        (MessageType.STREAM_SET, 7), (MessageType.HELLO, 7),
    )  # fmt: skip
    return (probe.refused(ErrorCode.BAD_LENGTH, n, kind, bytes(n)) for kind, n in kinds)


@check("order-of-checks", 3, ORDER)
def order_of_checks(device: Device) -> Iterator[str]:
    """Of two errors, the one that is checked first is reported."""
    probe = device.probe
    frame = probe.frame
    unknown = UNKNOWN_TYPES[-1]
    pairs = [
        ("another major and an unknown type", frame(unknown, flags=2), ErrorCode.BAD_VERSION),
        ("an unknown type and tid 0", frame(unknown, tid=0), ErrorCode.UNKNOWN_TYPE),
        ("an unknown type and a payload", frame(unknown, bytes(3)), ErrorCode.UNKNOWN_TYPE),
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


@check("retry-same-bytes", 3, KEPT)
def retry_same_bytes(device: Device) -> str:
    """A repeated request gets the same reply, byte for byte."""
    probe = device.probe
    frame = probe.frame(MessageType.BLOB_READ, BlobRead(0, PART, 0).pack())
    first, again = probe.ask_frame(frame), probe.ask_again(frame)
    if first.frame != again.frame:
        raise Failed("a repeated BLOB_READ had another reply")
    return f"BLOB_READ repeated: the same {len(first.frame.payload)} bytes after {1e3 * again.after:.0f} ms"


@check("retry-not-executed", 3, KEPT)
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


@check("retry-four-kept", 3, "a device keeps its last 4 replies")
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


@check("retry-refusal-kept", 3, "including refusals by checks 7 and 8 below, with the requests they answer")
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


@check("retry-afresh", 3, "they are executed and answered afresh every time")
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
        for _ in range(2):
            accepted(probe.ask_frame(frame), name_of(kind))
    return f"TIME_SYNC repeated: {again.rx_tick - first.rx_tick} ticks later; HELLO and STOP repeated: answered"


@check("nonce-empties", 3, "A HELLO with a nonce other than the last one clears the kept replies of that node")
def nonce_empties(device: Device) -> str:
    """A HELLO with another nonce clears the kept replies, so another host may use the same tids."""
    probe = device.probe
    nonce = random.getrandbits(32)
    probe.hello(nonce)
    frame = probe.frame(*_effect(device))
    first = _cfg_id(probe.ask_frame(frame))
    probe.hello(nonce)
    same = _cfg_id(probe.ask_frame(frame))
    probe.hello(nonce ^ 1)
    other = _cfg_id(probe.ask_frame(frame))
    if same != first:
        raise Failed(f"a HELLO with the same nonce cleared the kept replies: cfg_id {same}, was {first}")
    if other == first:
        raise Failed(f"after a HELLO with another nonce, STREAM_SET was not executed: cfg_id {other} again")
    return f"cfg_id {first}; {same} after the same nonce, {other} after another"

"""Makes protocol/vectors/*.json with the independent implementation. Run it to write them; a test compares.

Each case is written out by hand from SPEC.md: nothing here is taken from the code under test.
"""

from __future__ import annotations

import json
from pathlib import Path

from hbp_reference import body, can_frames, can_id, cobs_encode, crc32, fd_padded, fields, wire

VECTORS = Path(__file__).resolve().parents[2] / "protocol" / "vectors"
F = fields
Case = dict[str, object]  # bytes in it become hex
CanFrame = tuple[int, bytes]  # identifier, data
Exchange = tuple[bytes, bytes]  # request and reply on the wire
Step = tuple[bytes, bytes | None, bytes]  # request, reply (None: any that is no refusal), rejection of a setpoint


def frame_case(name: str, fields_: Case | None, body_: bytes | None, wire_: bytes, verdict: str = "ok") -> Case:
    """Return a frame, good or damaged: `verdict` is "ok" or the counter that a damaged one adds to."""
    return {"name": name, "fields": fields_, "body_hex": body_, "wire_hex": wire_, "verdict": verdict}


def hello(nonce: int, major_min: int = 1, major_max: int = 1, rx_max: int = 1024) -> bytes:
    """Payload of HELLO."""
    return F(("u32", nonce), ("u8", major_min), ("u8", major_max), ("u16", rx_max))


def flipped(data: bytes, at: int, bits: int) -> bytes:
    """Return the data with some bits of one byte wrong."""
    changed = bytearray(data)
    changed[at] ^= bits
    return bytes(changed)


def framing() -> list[Case]:
    cases: list[Case] = []

    def good(name: str, body_: bytes) -> None:
        header: Case = {
            "type": body_[0],
            "flags": body_[1],
            "tid": int.from_bytes(body_[2:4], "little"),
            "len": int.from_bytes(body_[4:6], "little"),
            "node": body_[6],
        }
        cases.append(frame_case(name, header, body_, wire(body_)))

    def bad(verdict: str, name: str, wire_: bytes, body_: bytes | None = None) -> None:
        cases.append(frame_case(name, None, body_, wire_, verdict))

    printed = body(1, 1, 1, 0, hello(0x12345678))
    good("hello, as printed in SPEC.md", printed)
    good("empty payload", body(0x02, 1, 2, 0, b""))
    good("tid 65535, node 255", body(0x02, 1, 65535, 255, b""))
    ones = bytes(1 + i % 255 for i in range(1024))
    for run in (252, 253, 254, 255, 508, 509):
        good(f"run of {run} without a zero", body(0x10, 0x11, 7, 1, ones[:run] + b"\0\x01"))
        good(f"run of {run} at the end of a payload of zeros", body(0x10, 0x11, 7, 1, b"\0\0" + ones[:run]))
    for length in (1, 4, 240, 241, 242, 243, 1024):
        good(f"{length} zeros", body(0x10, 0x11, 8, 1, bytes(length)))
    good("1024 bytes without a zero", body(0x10, 0x11, 9, 1, ones))
    good("1024 bytes of ff", body(0x10, 0x11, 9, 1, b"\xff" * 1024))
    tid = next(t for t in range(1, 65536) if crc32(body(0x02, 1, t, 0, b"")) & 0xFF == 0)
    good("crc whose first byte is zero", body(0x02, 1, tid, 0, b""))
    tid = next(t for t in range(1, 65536) if crc32(body(0x02, 1, t, 0, b"")) >> 24 == 0)
    good("crc whose last byte is zero", body(0x02, 1, tid, 0, b""))
    good("unknown type: the framing passes it on", body(0x7E, 1, 3, 0, b"\x01\x02\x03\x04"))
    good("unknown flags and major: the framing passes them on", body(0x02, 0x8F, 4, 0, b""))
    good("a byte of the reserved field set: ignored by receivers", body(0x02, 1, 4, 0, b"")[:7] + b"\x01")

    whole, crc = wire(printed), crc32(printed)
    bad("bad_crc", "bad crc", wire(printed, crc ^ 1), printed)
    bad("bad_crc", "crc big-endian", wire(printed, int.from_bytes(crc.to_bytes(4, "little"), "big")), printed)
    bad("bad_crc", "one bit of the payload flipped", flipped(whole, 10, 0x40), printed)
    bad("bad_length", "length field one too small", wire(body(1, 1, 1, 0, printed[8:], 7)))
    bad("bad_length", "length field one too large", wire(body(1, 1, 1, 0, printed[8:], 9)))
    bad("bad_length", "shorter than an empty frame, crc right", wire(printed[:7]))
    bad("bad_length", "crc alone", wire(b""))
    bad("bad_cobs", "truncated: the last block lacks bytes", whole[:-3] + b"\0")
    bad("bad_length", "truncated between blocks", whole[:7] + b"\0")
    bad("too_long", "payload of 1025 bytes", wire(body(0x10, 0x11, 9, 1, ones + b"\x01")))
    bad("too_long", "payload of 1025 bytes that is short enough encoded", wire(body(0x10, 0x11, 9, 1, bytes(1025))))
    bad("too_long", "1100 bytes without a delimiter", b"\0" + b"\x55" * 1100 + b"\0")
    bad("bad_cobs", "cobs code past the end", b"\0\x05\x01\x02\0")
    bad("nothing", "only delimiters", bytes(16))
    assert cobs_encode(b"") == b"\x01"
    return cases


def table_after(mark: str) -> list[list[str]]:
    """Return off, type and field of each row of the byte table of SPEC.md that follows a mark."""
    text = (VECTORS.parent / "SPEC.md").read_text(encoding="utf-8")
    assert text.count(mark) == 1, mark
    table = text.split(mark, 1)[1].split("| off ", 1)[1].split("\n\n", 1)[0]
    return [[cell.strip() for cell in line.strip("|").split("|")][:3] for line in table.splitlines()[2:]]


def laid_out(message: str, values: tuple[object, ...]) -> tuple[Case, bytes]:
    """Return values by their names, and their bytes, as the message's table has them; of a list its number first."""
    if not values:
        return {}, b""
    named: Case = {}
    out, left, tail = b"", iter(values), b""
    mark = "`ErrorReply`, with the flags" if message == "ErrorReply" else f"`{message}`\n\n"
    for offset, kind, name in table_after(mark):
        assert int(offset) == len(out)
        if kind.startswith("pad"):
            out += bytes(int(kind[4:]))
            continue
        value = next(left, None)
        if isinstance(value, list):
            tail = F(*(("u16", each) for each in value))
        if kind:
            out += F((kind, len(value) if isinstance(value, list) else value))
        else:  # to the end
            out += str(value).encode() if isinstance(value, str) else value if isinstance(value, bytes) else tail
        if value is not None:
            named[name] = value
    assert next(left, None) is None
    return named, out


def messages() -> list[Case]:
    """One of each message, by the name of its class and of its fields."""
    cases: list[Case] = []

    def add(message: str, type_: int, flags: int, tid: int, *values: object, node: int = 1) -> None:
        named, payload = laid_out(message, values)
        body_ = body(type_, flags, tid, node, payload)
        cases.append(frame_case(message, named, body_, wire(body_)))

    req, rep, err = 0x01, 0x11, 0x31
    add("Hello", 0x01, req, 1, 0x12345678, 1, 1, 1024, node=0)
    numbers = (0x12345678, 0xCAFE0001, 1, 0, 1024, 512, 7, 0xCBF43926, 20_000_000, 16_000, 1, 1, 1, 2)
    for texts in (
        ("drive", "0.1.0", "33FFD8054D48383611571943", "9f2c61e-dirty"),
        ("drive", "", "", ""),
        ("Ω" * 8, "0123456789abcdef", "µ" * 12, "€" * 8),
    ):
        add("HelloReply", 0x01, rep, 1, *numbers, *texts)
    add("TimeSync", 0x02, req, 2)
    add("TimeSyncReply", 0x02, rep, 2, 0x100000002, 0x100000FFF)
    health = (0x0000000500000001, 0xCAFE0001, 33, 1, 3, 70000, 65535, 2, 17, 65535, 4)
    add("Heartbeat", 0x04, req, 0, *health, False, 0xFFFFFFF0)
    add("Alive", 0x05, req, 0, 0x01020304)
    add("BlobRead", 0x10, req, 3, 0, 1000, 65536)
    add("BlobReply", 0x10, rep, 3, 0, 5, 65536, 65541, bytes(range(5)))
    add("ParamGet", 0x11, req, 4, 102)
    add("ParamReply", 0x11, rep, 4, 102, 0.15625, 0.0, 100.0, 0.25)
    add("ParamSet", 0x12, req, 5, 102, -1.5)
    add("ParamStored", 0x12, rep, 5, 102, 0.5)
    add("ParamCommit", 0x13, req, 6)
    add("Empty", 0x13, rep, 6)
    add("StateCommand", 0x20, req, 7, 1, 0xCAFE0001)
    add("StateReply", 0x20, rep, 7, 2)
    add("ErrorReply", 0x20, err, 7, 6, 0x20, 0.0)
    add("Setpoint", 0x21, req, 0, 2, 9, 4.0, -0.5)
    add("StreamSet", 0x30, req, 8, 0, 0, 16, 20, [3, 5, 1])
    add("StreamReply", 0x30, rep, 8, 0, 0xABCD, 5, 20, 0.125, 17, 0x100000003)
    add("StreamGet", 0x33, req, 8, 2)
    add("StreamInfo", 0x33, rep, 8, 2, True, 0, 17, 16, 20, 0xABCD, 5, 12, 0x100000003, [3, 5, 1])
    add("StreamStart", 0x31, req, 9, 3)
    add("StreamStop", 0x32, req, 10, 0xFFFFFFFF)
    add("DeviceEvent", 0x42, req, 0, 0x1000000000, 3, 1, 4.0, 300.0)
    add("Log", 0x43, req, 0, 6, "R = 0.158 Ω")
    return cases


def refusal(code: int, frame: tuple[int, int, int, int], payload: bytes, detail: float) -> Exchange:
    """Return a request, given as type, flags, tid, node and payload, and its refusal by node 1, on the wire."""
    error = F(("u16", code), ("u8", frame[0]), ("pad", 1), ("f32", detail))
    return wire(body(*frame, payload)), wire(body(frame[0], 0x31, frame[2], 1, error))


def stream_set(stream: int, event: int, decimation: int, *ids: int, n: int | None = None) -> bytes:
    """Payload of STREAM_SET; `n`: another number of ids than there are."""
    head = F(("u8", stream), ("u8", event), ("u16", decimation), ("u16", 20), ("u16", len(ids) if n is None else n))
    return head + F(*(("u16", number) for number in ids))


def command(number: int, argument: int = 0) -> bytes:
    """Payload of STATE_CMD."""
    return F(("u8", number), ("pad", 3), ("u32", argument))


def exchanges() -> list[Case]:
    """Requests that any device answers the same way, whatever its state. The device is node 1 and alone."""

    def ignored(frame: tuple[int, int, int, int], payload: bytes) -> Exchange:
        return wire(body(*frame, payload)), b""

    nan = float("nan")
    speed = F(("u8", 1), ("pad", 1), ("u16", 9), ("f32", 1.0), ("f32", 0.0))
    cases = {
        "unknown type": refusal(1, (0x7E, 1, 5, 0), b"", 0x7E),
        "a reserved type": refusal(1, (0x06, 1, 5, 1), b"\1\2\3\4", 0x06),
        "unsolicited type as a request": refusal(1, (0x04, 1, 6, 1), b"", 0x04),
        "another major": refusal(13, (0x02, 2, 7, 1), b"", 1),
        "HELLO without a common major": refusal(13, (0x01, 2, 8, 0), hello(1, 2, 3), 1),
        "HELLO with a receiver that is too small": refusal(4, (0x01, 1, 8, 0), hello(1, rx_max=127), 128),
        "HELLO with both errors: the major first": refusal(13, (0x01, 1, 8, 0), hello(1, 2, 3, 127), 1),
        "request too short": refusal(2, (0x11, 1, 9, 1), b"\x65\0", 2),
        "request too long": refusal(2, (0x11, 1, 10, 1), b"\x65\0\0\0\0", 5),
        "channel ids disagree with the length": refusal(2, (0x30, 1, 11, 1), stream_set(0, 0, 1, 1, n=3), 10),
        "unknown command": refusal(3, (0x20, 1, 12, 1), command(9), 9),
        "START with an argument": refusal(3, (0x20, 1, 12, 1), command(2, 7), 7),
        "unknown stream event": refusal(15, (0x30, 1, 13, 1), stream_set(0, 7, 1, 1), 7),
        "the reserved stream event SLOW": refusal(15, (0x30, 1, 13, 1), stream_set(0, 1, 1, 1), 1),
        "request with tid 0": refusal(3, (0x02, 1, 0, 1), b"", 0),
        "unacknowledged message with a tid": refusal(3, (0x05, 1, 14, 1), F(("u32", 1)), 14),
        "setpoint with a tid": refusal(3, (0x21, 1, 14, 1), speed, 14),
        "unknown node": refusal(14, (0x02, 1, 15, 9), b"", 9),
        "unknown parameter": refusal(7, (0x11, 1, 16, 1), F(("u16", 0xFFFF), ("pad", 2)), 0xFFFF),
        "unknown parameter and no number": refusal(
            7, (0x12, 1, 16, 1), F(("u16", 0xFFFF), ("pad", 2), ("f32", nan)), 0xFFFF
        ),
        **{
            f"blob {k}": refusal(7, (0x10, 1, 17, 1), F(("u8", k), ("pad", 1), ("u16", 4), ("u32", 0)), k)
            for k in (1, 2, 200)
        },
        "unknown channel": refusal(7, (0x30, 1, 18, 1), stream_set(0, 0, 1, 0xFFFF), 0xFFFF),
        "no channels": refusal(3, (0x30, 1, 18, 1), stream_set(0, 0, 1), 0),
        "stream number too high": refusal(4, (0x30, 1, 19, 1), stream_set(4, 0, 1, 1), 3),
        "how a stream is configured, number too high": refusal(4, (0x33, 1, 19, 1), F(("u8", 4), ("pad", 3)), 3),
        "how a stream is configured that is not": refusal(7, (0x33, 1, 19, 1), F(("u8", 2), ("pad", 3)), 2),
        "start of a stream that is not configured": refusal(7, (0x31, 1, 20, 1), F(("u32", 4)), 2),
        "start of several: the lowest is named": refusal(7, (0x31, 1, 20, 1), F(("u32", 0x8000000C)), 2),
        "start of a stream that no device has": refusal(7, (0x31, 1, 20, 1), F(("u32", 0x80000000)), 31),
        "token that is not boot_id": refusal(6, (0x20, 1, 21, 1), command(1, 1), 0),
        "flag reply": ignored((0x20, 0x11, 22, 1), command(2, 7)),
        "flags reply and error": ignored((0x20, 0x31, 22, 1), command(2, 7)),
        "flag error without reply": ignored((0x20, 0x21, 22, 1), command(2, 7)),
        "flag error without reply, unknown node": ignored((0x20, 0x21, 22, 9), command(2, 7)),
        "bits 6 and 7 of the flags are ignored": refusal(3, (0x20, 0xC1, 23, 1), command(9), 9),
        "order: node before major": refusal(14, (0x02, 2, 24, 9), b"", 9),
        "order: major before type": refusal(13, (0x7E, 2, 25, 1), b"", 1),
        "order: type before tid": refusal(1, (0x7E, 1, 0, 1), b"", 0x7E),
        "order: tid before length": refusal(3, (0x11, 1, 0, 1), b"\x65", 0),
        "order: length before values": refusal(2, (0x20, 1, 26, 1), command(9)[:-1], 7),
        "order: length of the ids before values": refusal(2, (0x30, 1, 27, 1), stream_set(9, 7, 0, 1, n=2), 10),
        "order: stream before event": refusal(4, (0x30, 1, 28, 1), stream_set(9, 7, 0), 3),
        "order: event before decimation": refusal(15, (0x30, 1, 29, 1), stream_set(0, 7, 0), 7),
        "order: decimation before channels": refusal(3, (0x30, 1, 30, 1), stream_set(0, 0, 0, 0xFFFF), 0),
    }  # fmt: skip
    return [{"name": name, "request_hex": pair[0], "reply_hex": pair[1]} for name, pair in cases.items()]


def sequences() -> list[Case]:
    """Requests one after the other, and what comes of each, for the device that SPEC.md describes beside them."""
    cases: list[Case] = []
    boot_id, nan, inf = 0x00B0071D, float("nan"), float("inf")
    idle, armed, running = 1, 2, 3

    def add(name: str, *steps: Step, features: int = 1) -> None:
        keys = ("request_hex", "reply_hex", "rejected_hex")
        cases.append(
            {"name": name, "features": features, "steps": [dict(zip(keys, step, strict=True)) for step in steps]}
        )

    def ask(kind: int, tid: int, payload: bytes, reply: bytes | None) -> Step:
        answer = None if reply is None else wire(body(kind, 0x11, tid, 1, reply))
        return wire(body(kind, 1, tid, 1, payload)), answer, b""

    def no(kind: int, tid: int, payload: bytes, code: int, detail: float) -> Step:
        return *refusal(code, (kind, 1, tid, 1), payload, detail), b""

    def do(tid: int, number: int, argument: int, state: int) -> Step:
        return ask(0x20, tid, command(number, argument), F(("u8", state), ("pad", 3)))

    def setpoint(mode: int, value: float, value2: float, code: int = 0, detail: float = 0.0) -> Step:
        payload = F(("u8", mode), ("pad", 1), ("u16", 9), ("f32", value), ("f32", value2))
        return wire(body(0x21, 1, 0, 1, payload)), b"", rejected(code, detail)

    def rejected(code: int, detail: float) -> bytes:
        event = F(("u16", 3), ("u8", 1), ("pad", 1), ("f32", code), ("f32", detail))
        return event if code else b""

    run = (do(1, 1, boot_id, armed), do(2, 2, 0, running))
    add(
        "STOP in IDLE, ARMED and RUNNING, with any argument",
        do(1, 3, 0, idle), do(2, 3, 7, idle), do(3, 1, boot_id, armed), do(4, 3, 0xFFFFFFFF, idle),
        do(5, 1, boot_id, armed), do(6, 2, 0, running), do(7, 3, boot_id, idle),
    )  # fmt: skip
    add(
        "the same STOP again is obeyed again",
        do(5, 3, 0, idle), do(6, 1, boot_id, armed), do(7, 2, 0, running), do(5, 3, 0, idle),
        no(0x20, 8, command(2), 5, idle),
    )  # fmt: skip
    add(
        "START: its argument before the state; twice",
        no(0x20, 1, command(2, 1), 3, 1), no(0x20, 2, command(2), 5, idle), do(3, 1, boot_id, armed),
        no(0x20, 4, command(2, 1), 3, 1), do(5, 2, 0, running), do(6, 2, 0, running), no(0x20, 7, command(2, 1), 3, 1),
        do(8, 3, 0, idle),
    )  # fmt: skip
    add(
        "ARM: its token before the state; twice",
        do(1, 1, boot_id, armed), do(2, 1, boot_id, armed), do(3, 2, 0, running), no(0x20, 4, command(1, 5), 6, 0),
        no(0x20, 5, command(1, boot_id), 5, running), do(6, 3, 0, idle),
    )  # fmt: skip
    add("FAULT_CLEAR: the state before the bits", no(0x20, 1, command(4, 1), 5, idle))
    add(
        "setpoints that are rejected",
        setpoint(1, 1.0, 0.0, 5, idle), setpoint(9, nan, 0.0, 5, idle), *run,
        setpoint(1, 1.0, 0.0), setpoint(1, 301.0, 0.0, 4, 300.0), setpoint(1, -301.0, 0.0, 4, 300.0),
        setpoint(1, inf, 0.0, 3, inf), setpoint(1, 1.0, nan, 3, nan), setpoint(3, 0.1, 0.0, 15, 3),
        setpoint(9, 0.1, 0.0, 15, 9), setpoint(9, inf, nan, 3, inf),
        (*refusal(2, (0x21, 1, 0, 1), b"\1", 1), rejected(2, 1)), do(3, 3, 0, idle),
    )  # fmt: skip
    start, stop = F(("u32", 1)), F(("u32", 0xFFFFFFFF))
    add(
        "a kept refusal, until there is another host",
        no(0x31, 9, start, 7, 0), ask(0x30, 10, stream_set(0, 0, 1, 3, 1), None), no(0x31, 9, start, 7, 0),
        ask(0x01, 1, hello(77) + b"\5\0\0\0", None), ask(0x31, 9, start, b""),
        ask(0x32, 11, stop, b""),
    )  # fmt: skip
    add(
        "a stream: what is started, started again, configured while it runs",
        ask(0x30, 1, stream_set(0, 0, 1, 3, 1), None), ask(0x30, 2, stream_set(0, 0, 4, 1), None),
        ask(0x33, 3, F(("u8", 0), ("pad", 3)), None), ask(0x31, 4, start, b""), ask(0x31, 5, start, b""),
        no(0x30, 6, stream_set(0, 0, 0, 1), 3, 0), no(0x30, 7, stream_set(0, 0, 1, 1), 12, 0),
        no(0x31, 8, F(("u32", 3)), 7, 1), ask(0x31, 9, F(("u32", 0)), b""), ask(0x32, 10, F(("u32", 0)), b""),
        no(0x30, 11, stream_set(0, 0, 1, 1), 12, 0), ask(0x32, 12, stop, b""), ask(0x32, 13, stop, b""),
        no(0x31, 14, start, 7, 0),
    )  # fmt: skip
    add(
        "a stream's channels, id by id",
        no(0x30, 1, stream_set(0, 0, 1, 1, 0xFFFF, 1), 7, 0xFFFF), no(0x30, 2, stream_set(0, 0, 1, 1, 1, 0xFFFF), 3, 1),
        no(0x30, 3, stream_set(0, 0, 1, 1, 3, 1, 3), 3, 1),
    )  # fmt: skip
    add(
        "Hall edges",
        no(0x30, 1, stream_set(1, 2, 0, 1, 3), 3, 2), ask(0x30, 2, stream_set(1, 2, 0), None), ask(0x32, 3, stop, b""),
    )  # fmt: skip
    add("Hall edges of a device that has none", no(0x30, 1, stream_set(1, 2, 1, 1), 15, 2), features=0)
    return cases


def account(frames: int, index: list[int], gaps: tuple[tuple[int, ...], ...], rejected: dict[str, int]) -> Case:
    """Return what a receiver counts, but for zeros: a frame is used or rejected, and a gap says what it lacks."""
    counts = {
        "samples": len(index),
        "frames": frames - sum(rejected.values()),
        "lost_by_index": sum(gap[1] for gap in gaps),
        "lost_by_seq": sum(gap[2] for gap in gaps),
        "overruns": sum(any(gap[3:]) for gap in gaps),
    }
    return {name: count for name, count in (counts | rejected).items() if count}


def streams() -> list[Case]:
    """DATA and EDGES: frames in, records and account out; wrap-around of seq, index and tick.

    Channel 1 is count, u16, and channel 2 half, i8 (as u8 here), half of it. `gaps` are
    [position, lost_samples, lost_frames, overrun].
    """
    cases: list[Case] = []
    data, edges = 0x40, 0x41

    def frame(
        kind: int, seq: int, index: int, tick: int, records: list[bytes], flags: int = 0, cfg_id: int = 7,
        n: int | None = None,
    ) -> bytes:  # fmt: skip
        head = F(
            ("u8", 2), ("u8", flags), ("u16", len(records) if n is None else n), ("u16", cfg_id),
            ("u16", seq & 0xFFFF), ("u32", index & 0xFFFFFFFF), ("u32", tick & 0xFFFFFFFF),
        )  # fmt: skip
        return body(kind, 1, 0, 1, head + b"".join(records))

    def run(first: int, n: int) -> list[bytes]:
        return [F(("u16", count & 0xFFFF), ("u8", count & 0x7F)) for count in range(first, first + n)]

    def block(seq: int, first: int, n: int = 2, **changes: int) -> bytes:
        """Samples of a device whose tick was 0 at index 0."""
        return frame(data, seq, first, 1250 * first, run(first, n), **changes)

    def add(
        name: str, frames: list[bytes], index: list[int], *gaps: tuple[int, ...], tick: list[int] | None = None,
        reference: int = 0, decimation: int = 1, kind: str = "samples", ids: tuple[int, ...] = (1, 2), **rejected: int,
    ) -> None:  # fmt: skip
        config = {"ids": ids, "stream": 2, "cfg_id": 7, "decimation": decimation, "block": 2, "ticks_per_period": 1250}
        cases.append(
            {
                "name": name,
                "kind": kind,
                "config": config,
                "reference_tick": reference,
                "wire_hex": [wire(each) for each in frames],
                "index": index,
                "tick": [1250 * each for each in index] if tick is None else tick,
                "gaps": gaps,
                "account": account(len(frames), index, gaps, rejected),
            }
        )

    add("two blocks", [block(0, 100), block(1, 102)], [100, 101, 102, 103])
    wrap = 0xFFFFFB1E
    add(
        "index and tick wrap at 2^32",
        [
            frame(data, 0, 0xFFFFFFFE, wrap - 1250, run(0xFFFFFFFE, 2)),
            frame(data, 1, 0x100000000, wrap + 1250, run(0, 2)),
        ],
        [0xFFFFFFFE, 0xFFFFFFFF, 0x100000000, 0x100000001],
        tick=[0x300000000 + wrap + 1250 * k for k in (-1, 0, 1, 2)],
        reference=0x400000000,
    )
    late = [block(0, 20), block(1, 40, 1), block(2, 50)]
    add("decimation 10, a late partial block", late, [20, 30, 40, 50, 60], decimation=10)
    first, second, third = block(0, 0), block(1, 2), block(2, 4)
    add("a frame lost on the link", [first, third], [0, 1, 4, 5], (2, 2, 1, False))
    overrun = [first, block(3, 6, flags=1)]
    add("two frames dropped by the device, overrun flag", overrun, [0, 1, 6, 7], (2, 4, 2, True))
    add("the first frame is lost", [block(1, 12)], [12, 13], (0, 2, 1, False))
    skipped = [first, block(1, 7, flags=2)]
    add("the device skipped periods: discontinuity flag", skipped, [0, 1, 7, 8], (2, 5, 0, False))
    turned = frame(data, 0, 0, 0, [each[2:] + each[:2] for each in run(300, 2)])
    add("channels named as 2, 1", [turned], [0, 1], ids=(2, 1))
    add("a repeated frame", [first, second, second, third], list(range(6)), out_of_order=1)
    add("two frames swapped", [first, third, second], [0, 1, 4, 5], (2, 2, 1, False), out_of_order=1)
    add("a frame of another configuration", [first, block(1, 2, cfg_id=6), second], [0, 1, 2, 3], stale=1)
    wrong = [frame(data, 1, 2, 2500, run(2, 2), n=3), block(1, 2, 0)]
    add("n disagrees with the length; n is 0", [first, *wrong, second], [0, 1, 2, 3], malformed=2)

    def edge(tick: int, old: int, new: int, illegal: bool, encoder: int) -> bytes:
        return F(("u32", tick & 0xFFFFFFFF), ("u8", old | new << 3 | illegal << 6), ("u8", 0), ("u16", encoder))

    add(
        "edges across the wrap of the tick, one lost",
        [
            frame(edges, 0, 41, 0xFFFFFF00, [edge(0xFFFFFF00, 1, 3, False, 100), edge(0x10, 3, 2, False, 160)]),
            frame(edges, 2, 44, 0x2000, [edge(0x2000, 2, 7, True, 220)]),
        ],
        [41, 42, 44],
        (2, 1, 1, False),
        tick=[0x2FFFFFF00, 0x300000010, 0x300002000],
        reference=0x300000000,
        kind="edges",
        ids=(),
    )
    seqs = [0xFFFE, 0xFFFF, 0, 1]
    add(
        "seq wraps at 2^16 (the first 65534 frames are lost)",
        [frame(data, seq, 200000 + 2 * k, 2500 * k, run(2 * k, 2)) for k, seq in enumerate(seqs)],
        [200000 + k for k in range(8)],
        (0, 131068, 65534, False),
        tick=[1250 * k for k in range(8)],
    )
    return cases


def can_messages() -> list[Case]:
    """Transfers to a host: frames on identifiers, the messages that they make (in order of completion), the counts."""
    cases: list[Case] = []

    def add(
        name: str, fd: bool, frames: list[CanFrame], good: list[bytes], extended: bool = False, **counts: int
    ) -> None:
        form: Case = {"name": name, "host": 0, "fd": fd, "extended": extended}
        cases.append(form | {"frames": frames, "bodies_hex": good, "counts": counts})

    def to_host(node: int = 1, extended: bool = False) -> int:
        return can_id(3, node, 0, extended)

    def reply(n: int, tid: int = 5, node: int = 1, first: int = 0x20) -> bytes:
        return body(0x10, 0x11, tid, node, bytes((first + k) % 256 for k in range(n)))

    def on(number: int, frames: list[bytes]) -> list[CanFrame]:
        return [(number, data) for data in frames]

    for fd in (False, True):
        form = "FD" if fd else "classic"
        for n in (0, 1, 2, 3, 4, 10, 56, 57, 58, 116, 120, 1024):
            add(f"{form}, {n} bytes", fd, on(to_host(), can_frames(reply(n), fd, n % 32)), [reply(n)])
        add(f"{form}, 29 bits", fd, on(to_host(2, True), can_frames(reply(30, 6, 2), fd, 3)), [reply(30, 6, 2)], True)
        a, b = can_frames(reply(200), fd, 4), can_frames(reply(150, 6, 2), fd, 9)
        mixed = [each for pair in zip(on(to_host(1), a), on(to_host(2), b), strict=False) for each in pair]
        rest = on(to_host(1), a[len(mixed) // 2 :]) + on(to_host(2), b[len(mixed) // 2 :])
        order = [reply(150, 6, 2), reply(200)] if len(b) < len(a) else [reply(200), reply(150, 6, 2)]
        add(f"{form}, interleaved identifiers", fd, mixed + rest, order)
        add(f"{form}, every frame twice", fd, on(to_host(), [f for f in a for _ in (0, 1)]), [reply(200)],
            duplicates=len(a))  # fmt: skip
        again = can_frames(reply(20, 7), fd, 5)
        for lost in range(1, len(a) - 1):
            after = len(a) - lost - 2
            add(f"{form}, frame {lost} of {len(a)} lost, then another transfer", fd,
                on(to_host(), a[:lost] + a[lost + 1 :] + again), [reply(20, 7)], aborted=1, orphans=after)  # fmt: skip
        add(f"{form}, the last frame lost, then another transfer", fd, on(to_host(), a[:-1] + again), [reply(20, 7)],
            aborted=1)  # fmt: skip
        add(f"{form}, the first frame lost, then another transfer", fd, on(to_host(), a[1:] + again), [reply(20, 7)],
            orphans=len(a) - 1)  # fmt: skip
        for error, bits in (("toggle error", 0x20), ("another transfer id in the middle", 0x01)):
            wrong = [a[0], flipped(a[1], -1, bits), *a[2:]]
            add(f"{form}, {error}", fd, on(to_host(), wrong), [], aborted=1, orphans=len(a) - 2)
        wrong = [a[0], flipped(a[1], 0, 0x80), *a[2:]]
        add(f"{form}, a bit is wrong", fd, on(to_host(), wrong), [], bad_crc=1)
        add(f"{form}, a first frame with toggle 0", fd, on(to_host(), [flipped(again[0], -1, 0x20)]), [], orphans=1)
        tids = [reply(0, 1 + k) for k in range(34)]
        all_frames = [data for k, each in enumerate(tids) for data in can_frames(each, fd, k)]
        add(f"{form}, the transfer id wraps", fd, on(to_host(), all_frames), tids)
    # 20 + 6 + 4 bytes in five frames: without the third and the fourth the toggle is as expected, but not the length
    short = can_frames(reply(20), False, 1)
    add("classic, two frames lost in a row", False, on(to_host(), short[:2] + short[4:]), [], bad_length=1)
    long = can_frames(reply(60), False, 1)
    lie = [long[0][:4] + b"\x18\0" + long[0][6:], *long[1:]]
    add("classic, longer than it says", False, on(to_host(), lie), [], bad_length=1)
    printed = body(1, 1, 1, 1, hello(0x12345678))
    add("HELLO as printed in SPEC.md is for a device", False, on(can_id(2, 1, 0), can_frames(printed, False, 0)), [],
        foreign=3)  # fmt: skip
    add(
        "identifiers of others",
        False,
        [(0x7FF, b"abc"), (0x80000000 | 0x02421310, b"\xe0"), (can_id(3, 1, 4), b"\xe0"), (can_id(1, 1, 9), b"\xe0")],
        [],
        foreign=4,
    )
    return cases


def can_streams() -> list[Case]:
    """Stream frames: what of them is delivered, where there are gaps, and the account. 20 MHz, 1250 ticks a period."""
    cases: list[Case] = []

    def add(
        name: str, config: Case, frames: list[CanFrame], index: list[int], *gaps: tuple[int, ...],
        reference: tuple[int, int] = (0, 0), **rejected: int,
    ) -> None:  # fmt: skip
        base: Case = {"fd": False, "decimation": 1, "types": ["u16"], "slot": 0, "tick0": 0, "block": 3}
        cases.append(
            {
                "name": name,
                "config": base | config,
                "reference_tick": reference[0],
                "reference_edges": reference[1],
                "frames": frames,
                "index": index,
                "gaps": gaps,
                "account": account(len(frames), index, gaps, rejected),
            }
        )

    def classic(slot: int, number: int, *values: int) -> CanFrame:
        """A classic frame of node 1: counter and values."""
        data = F(("u16", number % 65536), *(("u16", value % 65536) for value in values))
        return can_id(5 + slot // 16, 1, slot % 16), data

    def fd(index: int, *values: int) -> CanFrame:
        data = F(("u32", index % 2**32), *(("u16", value % 65536) for value in values))
        return can_id(5, 1, 0), fd_padded(data)

    def three(number: int) -> CanFrame:
        return classic(0, number, number, number + 1, number + 2)

    def ticks(periods: int) -> tuple[int, int]:
        return periods * 1250, 0

    six, nine = list(range(6)), list(range(9))
    add("three samples a frame", {}, [three(0), three(3)], six)
    add("a frame lost", {}, [three(0), three(6)], [0, 1, 2, 6, 7, 8], (3, 3, 1))
    add("a frame twice", {}, [three(0), three(3), three(3), three(6)], nine, out_of_order=1)
    add("an old frame", {}, [three(0), three(3), three(0), three(6)], nine, out_of_order=1)
    wrap = [three(65532), three(65535), three(65538)]
    add("the counter wraps", {}, wrap, list(range(65532, 65541)), reference=ticks(65530))
    name, after = "the first frame is placed by the heartbeat before it", 5 * 65536
    add(name, {"tick0": 77}, [three(after + 3)], [after + 3 + k for k in range(3)], reference=(77 + after * 1250, 0))
    ahead = [three(0), three(3), three(9000), three(6)]
    add("half a second ahead of the heartbeat at most", {}, ahead, nine, out_of_order=1)
    add("a wrong length", {}, [three(0), (three(3)[0], three(3)[1][:6]), three(3)], six, malformed=1)
    name, index = "decimation 10: the counter counts samples", [40, 50, 60, 100, 110, 120]
    add(name, {"decimation": 10}, [three(4), three(10)], index, (3, 3, 1), reference=ticks(400))

    groups: Case = {"types": ["u16", "u16", "u16", "u16"], "block": 1, "slot": 15}

    def halves(number: int) -> list[CanFrame]:
        return [classic(15, number, number, number + 1, number + 2), classic(16, number, number + 3)]

    add("two groups, over the end of the first class", groups, [*halves(0), *halves(1)], [0, 1])
    add("a share lost: its sample is", groups, [*halves(0), halves(1)[0], *halves(2)], [0, 2], (1, 1, 1))
    add("groups that overtake each other", groups, [halves(0)[0], halves(1)[0], halves(0)[1], halves(1)[1]], [0, 1])

    fast: Case = {"fd": True, "block": 3}
    add("FD: filled to 12 bytes", fast, [fd(0, 0, 1, 2), fd(3, 3, 4, 5)], six)
    last = 2**32 - 3
    wrap = [fd(last, -3, -2, -1), fd(2**32, 0, 1, 2)]
    add("FD: the index wraps at 2^32", fast, wrap, [last + k for k in range(6)], reference=ticks(last))
    between = [fd(20, 2, 3, 4), fd(55, 5, 6, 7)]
    add("FD: an index between the samples", fast | {"decimation": 10}, between, [20, 30, 40], malformed=1)

    def edge(number: int, tick: int) -> CanFrame:
        data = F(("u32", tick % 2**32), ("u8", 1 | 3 << 3), ("u8", number % 256), ("u16", tick % 65536))
        return can_id(4, 1, 7), data

    edges: Case = {"types": [], "slot": 7, "block": 1}
    add("edges", edges, [edge(0, 100), edge(1, 200), edge(2, 300)], [0, 1, 2])
    lost = [edge(254, 100), edge(257, 200)]
    add("edges lost, and the counter wraps", edges, lost, [254, 257], (1, 2, 2), reference=(0, 250))
    twice = [edge(5, 100), edge(5, 100), edge(6, 200)]
    add("an edge twice", edges, twice, [5, 6], reference=(0, 5), out_of_order=1)
    older = [edge(5, 200), edge(90, 100), edge(6, 300)]
    add("an edge older than the last", edges, older, [5, 6], reference=(0, 5), out_of_order=1)
    return cases


ALL = {make.__name__: make for make in (framing, messages, exchanges, sequences, streams, can_messages, can_streams)}


def text(name: str) -> str:
    """Return the whole text of a file."""
    return json.dumps(ALL[name](), indent=1, ensure_ascii=False, default=bytes.hex) + "\n"


if __name__ == "__main__":
    for each in ALL:
        (VECTORS / f"{each}.json").write_text(text(each), encoding="utf-8")
        print(VECTORS / f"{each}.json")

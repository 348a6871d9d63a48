"""The vectors: decoded, encoded, answered; each fed whole, cut anywhere, after noise, before more bytes.

They stay as they are while HBP's major is 1. A new one is written by hand from SPEC.md, with `hbp_reference`.
"""

from __future__ import annotations

import inspect
import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import can_rows
import hbp_reference as reference
import numpy as np
import pytest
from small_drive import FEATURES, edges_at, frames_in, small_link, small_link_alone, small_link_in_c, wire_of
from test_spec import KINDS
from test_streams import decode_all, joined

from bench.signal.waveforms import sector_of_angle
from protocol import messages
from protocol.canmap.decoders import Beat, CanFrames
from protocol.canmap.frame import CAN_RECORD, BusRates
from protocol.canmap.host import CanWire
from protocol.canmap.ids import CanClass, CanId
from protocol.canmap.transport import TransferEncoder
from protocol.descriptor import sample_dtype
from protocol.framing import Deframer, Frame, encode_frame, parse_frame
from protocol.messages import Fault, Feature, StreamEvent
from protocol.signals import SECTOR_OF_CODE, Flag, RawType, Signal, Unit, hall_map
from protocol.streams import EDGE_RECORD, EdgeDecoder, SampleDecoder, StreamConfig, TickReference
from tests.devices import FULL
from tests.devices.device import Device
from tests.devices.spec import HALL_CODES
from tests.tools import needs

SECTORS = np.array(SECTOR_OF_CODE)
VECTORS = Path(__file__).resolve().parents[2] / "protocol" / "vectors"


def load(name: str) -> list[dict]:
    return json.loads((VECTORS / f"{name}.json").read_text(encoding="utf-8"))


def each(*names: str, where: Callable[[dict], bool] = lambda case: True) -> Callable:
    """A test of a `case` becomes one of all cases of these files; the first that fails is named."""

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        def run(**given: object) -> None:
            for name in names:
                for case in filter(where, load(name)):
                    try:
                        test(case=case, **given)
                    except BaseException as error:
                        error.add_note(f"in {name}.json: {case['name']}")
                        raise

        signature = inspect.signature(test)
        others = [parameter for name, parameter in signature.parameters.items() if name != "case"]
        run.__signature__ = signature.replace(parameters=others)  # type: ignore[attr-defined]
        return run

    return decorate


@pytest.fixture(params=["at once", "one by one"])
def batches(request: pytest.FixtureRequest) -> Callable[[Sequence], list]:
    """Cut what comes into what comes together."""

    def cut(items: Sequence) -> list:
        step = 1 if request.param == "one by one" else len(items)
        return [items[n : n + step] for n in range(0, len(items), step)]

    return cut


@pytest.fixture(
    params=[small_link, pytest.param(small_link_in_c, marks=needs("C compiler")), small_link_alone],
    ids=["Python", "C", "SPEC alone"],
)
def make(request: pytest.FixtureRequest) -> Callable[..., tuple]:
    """A link with a small drive, behind each device side."""
    return request.param


HAS = {small_link: FEATURES, small_link_in_c: FEATURES, small_link_alone: FULL.features}
"""Features that each device side has at most."""


def check_counts(counters: object, expected: dict[str, int], names: str) -> None:
    """Compare the named counters: those that a case does not tell are 0."""
    assert {name: getattr(counters, name) for name in names.split()} == dict.fromkeys(names.split(), 0) | expected


@each("framing", "messages")
def test_frame_is_found_or_counted_however_it_comes(case: dict) -> None:
    wire, verdict = bytes.fromhex(case["wire_hex"]), case["verdict"]
    good = [bytes.fromhex(case["body_hex"])] if verdict == "ok" else []
    assert [wire] * len(good) == list(map(reference.wire, good))
    counts = {"frames": len(good)} | ({} if verdict in ("ok", "nothing") else {verdict: 1, "bad": 1})

    def check(*pieces: bytes) -> None:
        deframer = Deframer()
        assert [raw for piece in pieces for raw in deframer.feed(piece)] == good
        check_counts(deframer.counters, counts, "frames bad bad_crc bad_cobs bad_length too_long")

    check(wire)
    step = 1 if len(wire) < 100 else 37  # every cut of the short ones, some of the long ones
    for cut in range(0, len(wire) + 1, step):
        check(wire[:cut], wire[cut:])
    check(*(wire[i : i + 1] for i in range(len(wire))))
    check(b"\x17noise\xff" * 300 + wire)  # without a delimiter, before the first one
    follower = Frame(0x02, 1, 99, 1, b"")
    assert parse_frame(Deframer().feed(wire + encode_frame(follower) + wire[:5])[-1]) == follower


@each("framing", where=lambda case: case["verdict"] == "ok")
def test_good_frames_encode_to_the_same_bytes(case: dict) -> None:
    body = bytes.fromhex(case["body_hex"])
    frame = parse_frame(body)
    fields = {"type": frame.type, "flags": frame.flags, "tid": frame.tid, "len": len(frame.payload), "node": frame.node}
    assert fields == case["fields"]
    if body[7] == 0:  # the reserved byte is always sent as 0
        assert encode_frame(frame).hex() == case["wire_hex"]


@each("messages")
def test_messages_pack_and_unpack(case: dict) -> None:
    kind = getattr(messages, case["name"])
    values = dict(case["fields"])
    if "data" in values:
        values["data"] = bytes.fromhex(values["data"])
    if "channels" in values:
        values["channels"] = tuple(values["channels"])
    message = kind(**values)
    frame = parse_frame(bytes.fromhex(case["body_hex"]))
    assert message.pack() == frame.payload
    assert kind.unpack(frame.payload) == message
    if hasattr(kind, "TYPE"):
        assert frame.type == kind.TYPE
    assert encode_frame(frame._replace(payload=message.pack())).hex() == case["wire_hex"]


def test_every_message_has_a_vector() -> None:
    assert {case["name"] for case in load("messages")} == {kind.__name__ for kind in KINDS}


@pytest.mark.parametrize("fault", [False, True])
@each("exchanges")
def test_refusals(case: dict, fault: bool, make: Callable[..., tuple]) -> None:
    link, session, app = make()
    if fault:
        session.fault(Fault.OVERCURRENT)
    link.data_to_send()
    before = (dict(app.values), list(app.states))
    for _ in range(2):  # the answer to a repeated request is the same
        link.receive(bytes.fromhex(case["request_hex"]))
        assert link.data_to_send().hex() == case["reply_hex"]
    assert (app.values, app.states) == before


@each("sequences")
def test_sequences(case: dict, make: Callable[..., tuple]) -> None:
    if Feature(case["features"]) & ~HAS[make]:
        return
    link, _, app = make(features=Feature(case["features"]))
    link.data_to_send()
    for step in case["steps"]:
        request = bytes.fromhex(step["request_hex"])
        link.receive(request)
        frames = frames_in(link.data_to_send())
        replies = [frame for frame in frames if frame.is_reply]
        if step["reply_hex"] is None:
            (asked,) = frames_in(request)
            assert [(f.type, f.tid, f.node, f.is_error) for f in replies] == [(asked.type, asked.tid, 1, False)]
        else:
            assert b"".join(map(encode_frame, replies)).hex() == step["reply_hex"]
        events = [frame.payload for frame in frames if frame.type == messages.MessageType.EVENT]
        rejected = [event for event in events if event[8] == messages.EventCode.SETPOINT_REJECTED]
        assert b"".join(event[8:] for event in rejected).hex() == step["rejected_hex"]
    assert not app.outputs_on


@pytest.mark.parametrize("make", [small_link, pytest.param(small_link_in_c, marks=needs("C compiler"))])
@each("captures")
def test_captures(case: dict, batches: Callable[[Sequence], list], make: Callable[..., tuple]) -> None:
    link, session, app = make(features=Feature.EDGES | Feature.CAPTURE)
    session.push_edges(edges_at([0] * case["edges_before"]))
    arm = messages.CaptureArm.unpack(bytes.fromhex(case["arm_hex"]))
    assert arm.pack().hex() == case["arm_hex"]
    link.receive(wire_of(arm, 1))
    edges = np.frombuffer(bytes.fromhex("".join(case["edges_hex"])), EDGE_RECORD)
    raw = np.frombuffer(bytes.fromhex("".join(case["samples_hex"])), sample_dtype(app.channels))
    moments = [at for at in (case["fault_after"], case["arm_after"]) if at is not None]
    first, sent = case["begin"], 0
    for part in [each for cut in np.split(raw, [at + 1 - first for at in moments]) for each in batches(cut)]:
        last = first + len(part) - 1
        upto = int(np.searchsorted(edges["tick"], last * 1250, "right"))
        session.push_edges(edges[sent:upto])
        session.push_samples(first, first * 1250, part)
        link.advance(last * 1250)
        if last == case["fault_after"]:
            session.fault(Fault.HALL)
        if last == case["arm_after"]:
            link.receive(wire_of(messages.StateCommand(messages.Command.ARM, 0xB0071D), 2))
        first, sent = last + 1, upto
    link.data_to_send()
    link.receive(wire_of(messages.CaptureStatus(), 3) + wire_of(messages.BlobRead(1, 1000, 0), 4))
    status, blob = frames_in(link.data_to_send())
    told = messages.CaptureReply.unpack(status.payload)
    assert told.state == messages.CaptureState.FROZEN
    assert {name: int(getattr(told, name)) for name in case["reply"]} == case["reply"]
    assert messages.BlobReply.unpack(blob.payload).data.hex() == case["blob_hex"]


def stream_config(case: dict, event: StreamEvent, channels: tuple[Signal, ...], *slot: int) -> StreamConfig:
    c = case["config"]
    rates = {"tick_hz": 20_000_000, "pwm_hz": 16_000}
    number, cfg_id = c.get("stream", 0), c.get("cfg_id", 1)
    return StreamConfig(1, number, cfg_id, event, c["decimation"], channels, c["block"], *slot, **rates)


SAMPLE = (
    Signal(1, "count", Unit.COUNT, RawType.U16, 1.0, Flag.CHANNEL, ""),
    Signal(2, "half", Unit.NONE, RawType.I8, 0.5, Flag.CHANNEL, ""),
)


@each("streams")
def test_streams(case: dict, batches: Callable[[Sequence], list]) -> None:
    edges, means = case["kind"] == "edges", case["kind"] == "means"
    channels = tuple(SAMPLE[number - 1] for number in case["config"]["ids"])
    config = stream_config(case, StreamEvent.EDGES if edges else StreamEvent.PWM, channels)
    if means:
        config = stream_config(case, StreamEvent.MEAN, tuple(replace(each, raw=RawType.F32) for each in channels))
    decoder = (EdgeDecoder if edges else SampleDecoder)(config, TickReference(case["reference_tick"]))
    deframer = Deframer()
    frames = [raw for wire in case["wire_hex"] for raw in deframer.feed(bytes.fromhex(wire))]
    chunks, gaps = decode_all(decoder, batches(frames))
    if edges:
        fields = [joined(chunks, name) for name in ("hall_old", "hall_new", "illegal", "encoder")]
        sent = [[1, 3, 2], [3, 2, 7], [False, False, True], [100, 160, 220]]
        assert fields == [each[-len(case["index"]) :] for each in sent]
        assert {chunk.hall_new.dtype for chunk in chunks} == {np.dtype(np.uint8)}
    elif means:
        assert [list(row) for chunk in chunks for row in chunk.raw.tolist()] == case["values"]
    else:
        assert all((chunk.physical("half") == chunk.raw["count"] % 128 / 2).all() for chunk in chunks)
    assert (joined(chunks, "index"), joined(chunks, "tick")) == (case["index"], case["tick"])
    assert gaps == [tuple(gap) for gap in case["gaps"]]
    names = "samples lost_by_index frames lost_by_seq overruns stale out_of_order malformed"
    check_counts(decoder.counters, case["account"], names)


# -- CAN --------------------------------------------------------------------------------------------------------------


def can_wire(case: dict, **changes: object) -> CanWire:
    return CanWire(BusRates(1_000_000, 5_000_000 if case["fd"] else None), **changes)


def can_frames(case: dict) -> list[bytes]:
    return [can_rows.frame(number, bytes.fromhex(data)) for number, data in case["frames"]]


@each("can_messages")
def test_can_messages(case: dict, batches: Callable[[Sequence], list]) -> None:
    wire = can_wire(case, extended=case["extended"], host=case["host"])
    bodies = [item.hex() for part in batches(can_frames(case)) for item in wire.feed(b"".join(part), 0.0)]
    assert bodies == case["bodies_hex"]
    check_counts(wire.counters, case["counts"], "bad_crc bad_length aborted orphans duplicates foreign")


@each("can_messages", where=lambda case: not case["counts"])
def test_can_messages_are_sent_as_the_same_frames(case: dict) -> None:
    """Those without errors, with the transfer ids that they have."""
    encoder = TransferEncoder(case["fd"], case["extended"])
    got, sent = defaultdict(list), defaultdict(list)
    for number, data in case["frames"]:
        got[number].append(data)
    for body_hex in case["bodies_hex"]:
        message = bytes.fromhex(body_hex)
        can_id = CanId(CanClass.TO_HOST, message[6], 0)
        first = got[can_id.pack(case["extended"])][0]
        encoder._next.setdefault(can_id, int(first[-2:], 16) & 31)
        for number, data, _ in can_rows.parts(encoder.encode(can_id, message)):
            sent[number].append(data.hex())
    assert sent == got


@each("can_streams")
def test_can_streams(case: dict, batches: Callable[[Sequence], list]) -> None:
    c = case["config"]
    edges = not c["types"]
    channels = tuple(
        Signal(1 + n, f"c{n}", Unit.NONE, RawType[kind.upper()], 1.0, Flag.CHANNEL, "")
        for n, kind in enumerate(c["types"])
    )
    config = stream_config(case, StreamEvent.EDGES if edges else StreamEvent.PWM, channels, c["slot"], c["tick0"])
    decoder = can_wire(c).decoder(config, TickReference())
    beat = Beat(case["reference_tick"], case["reference_edges"])
    records = np.frombuffer(b"".join(can_frames(case)), CAN_RECORD)
    assert set(records["id"].tolist()) <= set(decoder.ids)
    chunks, gaps = decode_all(decoder, [CanFrames(part, (beat,)) for part in batches(records)])
    for chunk in chunks:
        if edges:
            assert chunk.encoder.tolist() == (chunk.tick % 65536).tolist()
            continue
        assert chunk.tick.tolist() == (c["tick0"] + chunk.index * 1250).tolist()
        for n, channel in enumerate(channels):
            assert chunk.raw[channel.name].tolist() == ((chunk.index // c["decimation"] + n) % 65536).tolist()
    assert joined(chunks, "index") == case["index"]
    assert gaps == [(*gap, False) for gap in case["gaps"]]
    names = "samples lost_by_index frames lost_by_seq out_of_order malformed late"
    check_counts(decoder.counters, case["account"], names)


def test_hello_as_printed_in_the_spec() -> None:
    text = (VECTORS.parent / "SPEC.md").read_text(encoding="utf-8")
    printed = text.split("HELLO of chapter 1 to node 1, classic:\n\n", 1)[1].split("\n\n", 1)[0]
    hello = Frame(0x01, 1, 1, 1, messages.Hello(0x12345678).pack())
    frames = can_rows.parts(CanWire(BusRates(1_000_000)).encode(hello))
    assert [f"    {number:x}  {data.hex(' ').upper()}" for number, data, _ in frames] == printed.split("\n")


def test_hall_codes_of_every_wiring_and_of_some_rings() -> None:
    cases = load("hall")
    wirings = {(case["hall_swap_hat"], case["hall_invert_hat"]): case["codes"] for case in cases if "codes" in case}
    assert len(wirings) == 48
    for (swap, invert), codes in wirings.items():
        assert list(hall_map(swap, invert)) == codes
        device = Device(FULL)  # written from SPEC.md alone
        device.value = lambda name, _, now={"hall_swap_hat": swap, "hall_invert_hat": invert}: now[name]  # type: ignore[method-assign]
        assert [device.hall_code(sector) for sector in range(6)] == [codes[code] for code in HALL_CODES]
    rings = [case for case in cases if "codes_at_deg" in case]
    for case in rings:
        theta, codes = np.array(case["codes_at_deg"]).T
        assert SECTORS[codes.astype(int)].tolist() == sector_of_angle(np.radians(theta), case["hall_offset"]).tolist()
    assert len(rings) == 6

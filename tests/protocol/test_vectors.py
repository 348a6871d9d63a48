"""The vectors: current, decoded, encoded; each fed whole, cut anywhere, after noise, before more bytes."""

from __future__ import annotations

import json
from pathlib import Path

import make_vectors
import numpy as np
import pytest
from small_drive import small_link

from protocol import messages
from protocol.canmap.decoders import Beat, CanFrames
from protocol.canmap.frame import CAN_RECORD, BusRates
from protocol.canmap.host import CanWire
from protocol.canmap.ids import CanClass, CanId
from protocol.canmap.transport import TransferEncoder
from protocol.framing import Deframer, Frame, encode_frame, parse_frame
from protocol.messages import Fault, Feature, StreamEvent
from protocol.signals import Flag, RawType, Signal, Unit
from protocol.streams import EdgeDecoder, SampleDecoder, StreamConfig, TickReference

VECTORS = Path(__file__).resolve().parents[2] / "protocol" / "vectors"


def load(name: str) -> list[dict]:
    return json.loads((VECTORS / f"{name}.json").read_text(encoding="utf-8"))


def cases(name: str) -> list:
    return [pytest.param(case, id=case["name"]) for case in load(name)]


@pytest.mark.parametrize("name", sorted(make_vectors.ALL))
def test_files_are_what_the_independent_implementation_makes(name: str) -> None:
    assert (VECTORS / f"{name}.json").read_text(encoding="utf-8") == make_vectors.text(name)


FOLLOWER = Frame(0x02, 1, 99, 1, b"")


@pytest.mark.parametrize("case", cases("framing") + cases("messages"))
def test_frame_is_found_or_counted_however_it_comes(case: dict) -> None:
    wire, verdict = bytes.fromhex(case["wire_hex"]), case["verdict"]
    good = [bytes.fromhex(case["body_hex"])] if verdict == "ok" else []
    follower = encode_frame(FOLLOWER)
    expected_bad = {} if verdict in ("ok", "nothing") else {verdict: 1}

    def check(frames: list[bytes], expected: list[bytes], deframer: Deframer) -> None:
        counters = deframer.counters
        assert frames == expected
        assert counters.frames == len(expected)
        for name in ("bad_crc", "bad_cobs", "bad_length", "too_long"):
            assert getattr(counters, name) == expected_bad.get(name, 0), name

    deframer = Deframer()
    check(deframer.feed(wire), good, deframer)

    step = 1 if len(wire) < 100 else 37  # every cut of the short ones, some of the long ones
    for cut in range(0, len(wire) + 1, step):
        deframer = Deframer()
        check(deframer.feed(wire[:cut]) + deframer.feed(wire[cut:]), good, deframer)

    deframer = Deframer()
    check([raw for i in range(len(wire)) for raw in deframer.feed(wire[i : i + 1])], good, deframer)

    deframer = Deframer()  # noise without a delimiter, before the first one
    check(deframer.feed(b"\x17noise\xff" * 300 + wire), good, deframer)

    deframer = Deframer()
    after = [parse_frame(raw) for raw in deframer.feed(wire + follower + wire[:5])][-1]
    assert after == FOLLOWER


@pytest.mark.parametrize("case", [c for c in cases("framing") if c.values[0]["verdict"] == "ok"])
def test_good_frames_encode_to_the_same_bytes(case: dict) -> None:
    body, fields = bytes.fromhex(case["body_hex"]), case["fields"]
    frame = parse_frame(body)
    assert (frame.type, frame.flags, frame.tid, frame.node) == tuple(
        fields[name] for name in ("type", "flags", "tid", "node")
    )
    assert len(frame.payload) == fields["len"]
    if body[7] == 0:  # the reserved byte is always sent as 0
        assert encode_frame(frame).hex() == case["wire_hex"]


@pytest.mark.parametrize("case", cases("messages"))
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
    named = {case["name"] for case in load("messages")}
    kinds = {
        cls.__name__ for table in (messages.REQUESTS, messages.REPLIES, messages.UNSOLICITED) for cls in table.values()
    }
    assert kinds | {"ErrorReply"} == named


@pytest.mark.parametrize("case", cases("exchanges"))
@pytest.mark.parametrize("fault", [False, True])
def test_refusals(case: dict, fault: bool) -> None:
    link, session, app = small_link()
    if fault:
        session.fault(Fault.OVERCURRENT)
    link.data_to_send()
    before = (dict(app.values), list(app.states))
    for _ in range(2):  # the answer to a repeated request is the same
        link.receive(bytes.fromhex(case["request_hex"]))
        assert link.data_to_send().hex() == case["reply_hex"]
    assert (app.values, app.states) == before


@pytest.mark.parametrize("case", cases("sequences"))
def test_sequences(case: dict) -> None:
    link, _, app = small_link(features=Feature(case["features"]))
    link.data_to_send()
    for step in case["steps"]:
        request = bytes.fromhex(step["request_hex"])
        link.receive(request)
        sent = link.data_to_send()
        frames = [parse_frame(raw) for raw in Deframer().feed(b"\0" + sent)]
        replies = [frame for frame in frames if frame.is_reply]
        if step["reply_hex"] is None:
            (asked,) = (parse_frame(raw) for raw in Deframer().feed(request))
            assert [(f.type, f.tid, f.node, f.is_error) for f in replies] == [(asked.type, asked.tid, 1, False)]
        else:
            assert b"".join(map(encode_frame, replies)).hex() == step["reply_hex"]
        events = [frame.payload for frame in frames if frame.type == messages.MessageType.EVENT]
        rejected = [event for event in events if event[8] == messages.EventCode.SETPOINT_REJECTED]
        assert b"".join(event[8:] for event in rejected).hex() == step["rejected_hex"]
    assert not app.outputs_on


SAMPLE = (
    Signal(1, "count", Unit.COUNT, RawType.U16, 1.0, Flag.CHANNEL, ""),
    Signal(2, "half", Unit.NONE, RawType.I8, 0.5, Flag.CHANNEL, ""),
)


@pytest.mark.parametrize("feed", ["at once", "one by one"])
@pytest.mark.parametrize("case", cases("streams"))
def test_streams(case: dict, feed: str) -> None:
    c, edges = case["config"], case["kind"] == "edges"
    event = StreamEvent.EDGES if edges else StreamEvent.PWM
    channels = tuple(SAMPLE[number - 1] for number in c["ids"])
    config = StreamConfig(
        1,
        c["stream"],
        c["cfg_id"],
        event,
        c["decimation"],
        channels,
        c["block"],
        tick_hz=c.get("ticks_per_period", 1) * 16_000,
        pwm_hz=16_000,
    )
    reference = TickReference(case["reference_tick"])
    decoder = EdgeDecoder(config, reference) if edges else SampleDecoder(config, reference)
    deframer = Deframer()
    frames = [raw for wire in case["wire_hex"] for raw in deframer.feed(bytes.fromhex(wire))]
    batches = [frames] if feed == "at once" else [[raw] for raw in frames]
    index, tick, gaps = [], [], []
    for batch in batches:
        chunk = decoder.decode(batch)
        if chunk is not None:
            gaps += [[g.position + len(index), g.lost_samples, g.lost_frames, g.overrun] for g in chunk.gaps]
            index += chunk.index.tolist()
            tick += chunk.tick.tolist()
            if not edges:
                start = chunk.raw["count"][0]
                assert chunk.physical("half").tolist() == (chunk.raw["count"] % 128 / 2).tolist(), start
    assert index == case["index"]
    assert tick == case["tick"]
    assert gaps == case["gaps"]
    names = (
        "samples",
        "lost_by_index",
        "frames",
        "lost_by_seq",
        "overruns",
        "stale",
        "out_of_order",
        "malformed",
    )
    assert {name: getattr(decoder.counters, name) for name in names} == {
        name: case["account"].get(name, 0) for name in names
    }


def test_edge_fields() -> None:
    case = next(case for case in load("streams") if case["kind"] == "edges")
    config = StreamConfig(1, 2, 7, StreamEvent.EDGES, 1, (), 2, tick_hz=20_000_000, pwm_hz=16_000)
    decoder = EdgeDecoder(config, TickReference(case["reference_tick"]))
    deframer = Deframer()
    chunk = decoder.decode([raw for wire in case["wire_hex"] for raw in deframer.feed(bytes.fromhex(wire))])
    assert chunk is not None
    assert chunk.hall_old.tolist() == [1, 3, 2]
    assert chunk.hall_new.tolist() == [3, 2, 7]
    assert chunk.illegal.tolist() == [False, False, True]
    assert chunk.encoder.tolist() == [100, 160, 220]
    assert chunk.hall_new.dtype == np.uint8


# -- CAN --------------------------------------------------------------------------------------------------------------


def can_records(frames: list[list]) -> np.ndarray:
    records = np.zeros(len(frames), CAN_RECORD)
    for record, (can_id, data_hex) in zip(records, frames, strict=True):
        data = bytes.fromhex(data_hex)
        record["id"], record["length"] = can_id, len(data)
        record["data"][: len(data)] = np.frombuffer(data, np.uint8)
    return records


def rates(fd: bool) -> BusRates:
    return BusRates(1_000_000, 5_000_000 if fd else None)


@pytest.mark.parametrize("feed", ["at once", "one by one"])
@pytest.mark.parametrize("case", cases("can_messages"))
def test_can_messages(case: dict, feed: str) -> None:
    wire = CanWire(rates(case["fd"]), 1, case["extended"], case["host"])
    records = can_records(case["frames"])
    parts = [records] if feed == "at once" else [records[n : n + 1] for n in range(len(records))]
    bodies = [item.hex() for part in parts for item in wire.feed(part.tobytes(), 0.0)]
    assert bodies == case["bodies_hex"]
    names = ("bad_crc", "bad_length", "aborted", "orphans", "duplicates", "foreign")
    assert {name: getattr(wire.counters, name) for name in names} == {
        name: case["counts"].get(name, 0) for name in names
    }


@pytest.mark.parametrize("case", [c for c in cases("can_messages") if not c.values[0]["counts"]])
def test_can_messages_are_sent_as_the_same_frames(case: dict) -> None:
    """Those without errors, with the transfer ids that they have."""
    encoder = TransferEncoder(case["fd"], case["extended"])
    sent: dict[int, list[str]] = {}
    for body_hex in case["bodies_hex"]:
        message = bytes.fromhex(body_hex)
        can_id = CanId(CanClass.TO_HOST, message[6], 0)
        first = next(data for number, data in case["frames"] if number == can_id.pack(case["extended"]))
        encoder._next.setdefault(can_id, int(first[-2:], 16) & 31)
        for record in np.frombuffer(encoder.encode(can_id, message), CAN_RECORD):
            data = record["data"][: record["length"]].tobytes().hex()
            sent.setdefault(int(record["id"]), []).append(data)
    got: dict[int, list[str]] = {}
    for number, data in case["frames"]:
        got.setdefault(number, []).append(data)
    assert sent == got


@pytest.mark.parametrize("feed", ["at once", "one by one"])
@pytest.mark.parametrize("case", cases("can_streams"))
def test_can_streams(case: dict, feed: str) -> None:
    c = case["config"]
    edges = not c["types"]
    channels = tuple(
        Signal(1 + n, f"c{n}", Unit.NONE, RawType[kind.upper()], 1.0, Flag.CHANNEL, "")
        for n, kind in enumerate(c["types"])
    )
    event = StreamEvent.EDGES if edges else StreamEvent.PWM
    config = StreamConfig(
        1, 0, 1, event, c["decimation"], channels, c["block"], c["slot"], c["tick0"], tick_hz=20_000_000, pwm_hz=16_000
    )
    wire = CanWire(rates(c["fd"]))
    beat = Beat(case["reference_tick"], case["reference_edges"])
    decoder = wire.decoder(config, TickReference())
    records = can_records(case["frames"])
    assert set(records["id"].tolist()) <= set(decoder.ids)
    parts = [records] if feed == "at once" else [records[n : n + 1] for n in range(len(records))]
    index: list[int] = []
    gaps: list[list[int]] = []
    for part in parts:
        chunk = decoder.decode(CanFrames(part, (beat,)))
        if chunk is None:
            continue
        gaps += [[gap.position + len(index), gap.lost_samples, gap.lost_frames] for gap in chunk.gaps]
        index += chunk.index.tolist()
        if edges:
            assert chunk.encoder.tolist() == (chunk.tick % 65536).tolist()
        else:
            assert chunk.tick.tolist() == (c["tick0"] + chunk.index * 1250).tolist()
            for n, channel in enumerate(channels):
                assert chunk.raw[channel.name].tolist() == ((chunk.index // c["decimation"] + n) % 65536).tolist()
    assert index == case["index"]
    assert gaps == case["gaps"]
    names = ("samples", "lost_by_index", "frames", "lost_by_seq", "out_of_order", "malformed", "late")
    account = {name: getattr(decoder.counters, name) for name in names}
    assert account == {name: case["account"].get(name, 0) for name in names}


def test_hello_as_printed_in_the_spec() -> None:
    text = (VECTORS.parent / "SPEC.md").read_text(encoding="utf-8")
    printed = [
        line.split()
        for line in text.split("HELLO of chapter 1 to node 1, classic:", 1)[1].split("\n")
        if "210  " in line
    ]
    message = Frame(0x01, 1, 1, 1, messages.Hello(0x12345678).pack()).pack()
    records = np.frombuffer(CanWire(rates(False)).encode(parse_frame(message)), CAN_RECORD)
    assert len(printed) == len(records) == 3
    for (number, *data), record in zip(printed, records, strict=True):
        assert int(number, 16) == record["id"]
        for byte, sent in zip(data, record["data"][: record["length"]].tolist(), strict=True):
            assert int(byte, 16) == sent

"""The vectors: current, decoded, encoded; each fed whole, cut anywhere, after noise, before more bytes."""

from __future__ import annotations

import json
from pathlib import Path

import make_vectors
import numpy as np
import pytest
from small_drive import small_link

from protocol import messages
from protocol.framing import Deframer, Frame, encode_frame, parse_frame
from protocol.messages import Fault, StreamEvent
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


SAMPLE = (
    Signal(1, "count", Unit.COUNT, RawType.U16, 1.0, Flag.CHANNEL, ""),
    Signal(2, "half", Unit.NONE, RawType.I8, 0.5, Flag.CHANNEL, ""),
)


@pytest.mark.parametrize("feed", ["at once", "one by one"])
@pytest.mark.parametrize("case", cases("streams"))
def test_streams(case: dict, feed: str) -> None:
    c, edges = case["config"], case["kind"] == "edges"
    event = StreamEvent.EDGES if edges else StreamEvent.PWM
    channels = () if edges else SAMPLE
    config = StreamConfig(1, c["stream"], c["cfg_id"], event, c["decimation"], channels, c["block"])
    reference = TickReference(case["reference_tick"])
    decoder = EdgeDecoder(config, reference) if edges else SampleDecoder(config, c["ticks_per_period"], reference)
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
    config = StreamConfig(1, 2, 7, StreamEvent.EDGES, 1, (), 2)
    decoder = EdgeDecoder(config, TickReference(case["reference_tick"]))
    deframer = Deframer()
    chunk = decoder.decode([raw for wire in case["wire_hex"] for raw in deframer.feed(bytes.fromhex(wire))])
    assert chunk is not None
    assert chunk.hall_old.tolist() == [1, 3, 2]
    assert chunk.hall_new.tolist() == [3, 2, 7]
    assert chunk.illegal.tolist() == [False, False, True]
    assert chunk.encoder.tolist() == [100, 160, 220]
    assert chunk.hall_new.dtype == np.uint8

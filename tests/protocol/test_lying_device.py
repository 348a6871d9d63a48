"""A device whose messages say anything, field by field: nothing but a clear error, or a count, comes of it.

The device is sound, but for one field of one kind of message: that is replaced on its way to the host.
"""

from __future__ import annotations

import json
import struct
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, fields

import pytest
from lying_link import LyingCanLink, LyingLink
from test_spec import HEADER_NAMES, RECORD, RECORD_NAMES, walk

from bench.device.client import Client
from bench.device.description import inspect_node
from bench.device.node import Node
from bench.errors import BenchError
from bench.files import finite
from bench.live.summary import CpuMeter, RunStatistics, summarise
from protocol.errors import HbpError
from protocol.framing import Frame
from protocol.messages import REPLIES, UNSOLICITED, BlobReply, ErrorReply, Fault, MessageType, Payload
from protocol.streams import STREAM_HEADER
from tests.choice import also_in, chosen, sampled

pytestmark = pytest.mark.slow

NAN, INF = float("nan"), float("inf")
EXTREMES: dict[str, list[object]] = {
    "B": [0, 1, 7, 0x80, 0xFF],
    "H": [0, 1, 509, 0x8000, 0xFFFF],
    "I": [0, 1, 1 << 20, 0x80000000, 0xFFFFFFFF],
    "Q": [0, 1, 1 << 32, (1 << 62) - 1, 1 << 62, (1 << 64) - 1],
    "f": [0.0, -1.0, 0.5, 1e-45, 3e38, NAN, INF, -INF],
    "16s": [bytes(16), b"\xff" * 16, b"\x1b[2J\n\r\t\x07\xe2\x80\xae", b"x" * 16],
    "24s": [bytes(24), b"\xff" * 24, b"\x1b[2J\n\r\t\x07\xe2\x80\xae", b"x" * 24],
}


@dataclass(frozen=True)
class Field:
    """Where a field stands in the payloads of one kind of frame; `error`: only of refusals, else only of others."""

    name: str
    type: int | None
    error: bool
    offset: int
    code: str


def layout_fields(
    kind: str, type_: int | None, layout: struct.Struct, names: list[str], error: bool = False, at: int = 0
) -> list[Field]:
    left = iter(names)
    return [
        Field(f"{kind}.{next(left)}", type_, error, at + offset, code)
        for offset, code in walk(layout)
        if not code.endswith("x")
    ]


def every_field() -> list[Field]:
    found: list[Field] = []
    kinds: list[tuple[int | None, type[Payload]]] = [*REPLIES.items(), *UNSOLICITED.items(), (None, ErrorReply)]
    for type_, kind in kinds:
        names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
        found += layout_fields(kind.__name__, type_, kind._LAYOUT, names, kind is ErrorReply)
    for type_ in (MessageType.DATA, MessageType.EDGES):
        found += layout_fields(type_.name, type_, STREAM_HEADER, HEADER_NAMES)
    for title, record in (("channel", 0), ("parameter", 5)):  # the first of each in the descriptor
        at = BlobReply.FIXED_BYTES + record * RECORD.size
        found += layout_fields(title, MessageType.BLOB_READ, RECORD, RECORD_NAMES, at=at)
    return found


def talk(link: LyingLink) -> list[str]:
    """Do all that a host does with a drive; return the errors, one line each."""
    client = Client(link)
    errors: list[str] = []

    def attempt(action: Callable[[], object]) -> None:
        try:
            action()
        except (HbpError, BenchError) as error:
            errors.append(str(error))

    attempt(client.connect)
    if client.hello is None:
        return errors
    node = Node(client, client.hello.node)
    statistics = RunStatistics(node.number)
    client.sinks = [statistics]
    for action in (
        lambda: node.descriptor, node.parameters, lambda: node.parameter("n_p"), lambda: node.set("gain", 3.0),
        lambda: node.set("gain", 1e9), lambda: node.set("serial", 1.0), node.stop_streams,
        lambda: node.set_samples(node.channels(None), 1), lambda: node.set_samples(node.channels(None), 16),
        node.set_edges, node.active_streams, node.start_streams, lambda: client.run_for(0.2), node.clock_fit,
        lambda: json.dumps(finite(inspect_node(node)), allow_nan=False), node.start, node.arm, node.start,
        lambda: node.speed(10.0), lambda: node.speed(1e4), lambda: link.session.fault(Fault.OVERCURRENT),
        lambda: client.run_for(0.2), node.fault_text, node.clear_faults, node.arm, node.start, node.resume_streams,
        lambda: client.run_for(0.1), node.stop, node.next_heartbeat, node.stop_streams,
    ):  # fmt: skip
        attempt(action)
    with suppress(HbpError):
        summary = summarise("x", client, statistics, node.identity, 1.0, CpuMeter().percent(), None)
        json.dumps(summary.as_json(), allow_nan=False)
    return errors


def lie_of(field: Field, value: object) -> Callable[[Frame], Frame]:
    packed = struct.pack("<" + field.code, value)

    def lie(frame: Frame) -> Frame:
        if field.error != frame.is_error or field.type not in (None, frame.type):
            return frame
        if field.type in REPLIES and not frame.is_reply:
            return frame
        changed = bytearray(frame.payload)
        if len(changed) < field.offset + len(packed):
            return frame
        changed[field.offset : field.offset + len(packed)] = packed
        return frame._replace(payload=bytes(changed))

    return lie


@pytest.mark.parametrize("link", [LyingLink, LyingCanLink])
def test_the_sound_device_has_only_the_errors_that_are_asked_for(link: type[LyingLink]) -> None:
    errors = talk(link())
    too_much = ["do not fit"] if link is LyingLink else []  # it fits a CAN FD bus
    set_wrongly = ["gain must be", "can only be read"]
    expected = [*set_wrongly, *too_much, "WRONG_STATE", "rejected the setpoint SPEED 10000", "BUSY"]
    assert len(errors) == len(expected), errors
    assert all(words in error for words, error in zip(expected, errors, strict=True)), errors


ON_CAN = ("StreamReply", "TimeSyncReply", "Heartbeat.tick", "Heartbeat.edges", "Heartbeat.boot_id")
"""What decoders on a CAN bus work with."""
fields_of: dict[tuple[type[LyingLink], str], list[Field]] = defaultdict(list)
for _field in every_field():
    _kind = _field.name.partition(".")[0]
    fields_of[LyingLink, _kind].append(_field)
    if _field.name.startswith(ON_CAN):
        fields_of[LyingCanLink, _kind].append(_field)


@also_in(campaign="lies")
@pytest.mark.parametrize(("link", "kind"), sampled("lies", tuple(fields_of), 8, campaign="lies"))
def test_any_value_of_any_field_is_an_error_in_one_line_or_tolerated(link: type[LyingLink], kind: str) -> None:
    for field in fields_of[link, kind]:
        for value in chosen(f"{kind} {field.name}", EXTREMES[field.code], 2):
            for error in talk(link(lie_of(field, value))):
                assert error.isprintable(), (field.name, value, error)
                assert 10 < len(error) < 400, (field.name, value, error)

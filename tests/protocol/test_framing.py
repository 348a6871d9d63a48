"""Framing against the slow reference: round trips, any cut, damage, bounded memory."""

from __future__ import annotations

from itertools import pairwise

import hbp_reference as reference
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import LocalProtocolError
from protocol.framing import MAX_PAYLOAD, Deframer, Frame, encode_frame, encoded_length, parse_frame

payloads = st.one_of(
    st.binary(max_size=64),
    st.integers(0, MAX_PAYLOAD).map(bytes),
    st.builds(lambda n, b: bytes([b]) * n, st.integers(0, MAX_PAYLOAD), st.integers(1, 255)),
    st.binary(min_size=240, max_size=300),
)
frames = st.builds(
    Frame, st.integers(0, 255), st.integers(0, 255), st.integers(0, 65535), st.integers(0, 255), payloads
)


@given(frames)
def test_encoding_agrees_with_the_reference_and_comes_back(frame: Frame) -> None:
    wire = encode_frame(frame)
    body = reference.body(frame.type, frame.flags, frame.tid, frame.node, frame.payload)
    assert wire == reference.wire(body)
    assert len(wire) <= encoded_length(len(frame.payload))
    assert [parse_frame(raw) for raw in Deframer().feed(wire)] == [frame]


@given(st.lists(frames, max_size=4), st.lists(st.integers(0, 5000), max_size=12), st.binary(max_size=30))
def test_any_cut_gives_the_same_frames(sent: list[Frame], cuts: list[int], noise: bytes) -> None:
    data = noise + b"\0" + b"".join(map(encode_frame, sent))
    bounds = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    whole, cut = Deframer(), Deframer()
    expected = whole.feed(data)
    assert [raw for a, b in pairwise(bounds) for raw in cut.feed(data[a:b])] == expected
    assert cut.counters.frames == whole.counters.frames
    assert cut.counters.bad == whole.counters.bad
    assert [parse_frame(raw) for raw in expected][-len(sent) or len(expected) :] == sent


EDITS = st.lists(st.tuples(st.integers(0, 1 << 16), st.integers(0, 4), st.binary(max_size=3)), max_size=4)
"""Where, how many bytes go, and which come instead."""
SENT = st.lists(frames, max_size=4).map(lambda sent: b"".join(map(encode_frame, sent)))


@given(st.one_of(st.binary(max_size=400), SENT), EDITS)
def test_accepts_exactly_what_the_reference_accepts(data: bytes, edits: list[tuple[int, int, bytes]]) -> None:
    """Noise, and frames with bytes that were changed, lost or inserted."""
    for where, gone, new in edits:
        at = where % (len(data) + 1)
        data = data[:at] + new + data[at + gone :]
    data = b"\0" + data + b"\0"
    assert Deframer().feed(data) == reference.receive(data)


def test_memory_is_bounded_without_delimiters() -> None:
    deframer = Deframer()
    deframer.feed(b"\0")
    for _ in range(1000):
        assert deframer.feed(b"\x42" * 997) == []
        assert len(deframer._tail) <= encoded_length(MAX_PAYLOAD)
    assert deframer.counters.too_long == 1  # one run, one count
    assert deframer.counters.noise_bytes == 997_000
    wire = encode_frame(Frame(2, 1, 3, 0, b""))
    assert len(deframer.feed(wire)) == 1


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(LocalProtocolError, match="1025 bytes: a frame carries at most 1024"):
        encode_frame(Frame(1, 1, 1, 0, bytes(1025)))
    with pytest.raises(LocalProtocolError, match="does not fit"):
        encode_frame(Frame(1, 1, 65536, 0, b""))

"""Streams of means: their values against the exact mean of each window, on a byte link."""

from __future__ import annotations

import itertools
from fractions import Fraction
from types import MappingProxyType

import numpy as np
import pytest
from capture_model import Kind, mean, turn_of
from hypothesis import given
from hypothesis import strategies as st
from small_drive import TICKS, SmallDrive, frames_in, identity, wire_of

from protocol.descriptor import Descriptor, sample_dtype
from protocol.device.compiled import CompiledLink
from protocol.device.records import LateSamples
from protocol.device.session import DeviceLink
from protocol.framing import Deframer
from protocol.messages import Feature, MessageType, StreamEvent, StreamReply, StreamSet, StreamStart, StreamStop
from protocol.signals import Flag, RawType, Signal, Unit
from protocol.streams import DISCONTINUITY, SampleDecoder, StreamConfig, TickReference
from tests.tools import needs

KINDS = (
    Kind("u8", unit=False), Kind("i16", wraps=True), Kind("i16"), Kind("u32"), Kind("f32"), Kind("u8", wraps=True),
    Kind("i8", wraps=True), Kind("u16"), Kind("i32"), Kind("f32", 0.5, wraps=True), Kind("f32", -2.0, wraps=True),
    Kind("f32", unit=False), Kind("i32", wraps=True), Kind("u32", wraps=True),
)  # fmt: skip
MIXED = tuple(
    Signal(
        n + 1, f"c{n}", Unit.RAD if kind.unit else Unit.NONE, RawType[kind.type.upper()], kind.scale,
        Flag.CHANNEL | (Flag.WRAPS if kind.wraps else Flag(0)), "",
    )
    for n, kind in enumerate(KINDS)
)  # fmt: skip
DTYPE = sample_dtype(MIXED)


class Drive(SmallDrive):
    channels = MIXED
    meanings = MappingProxyType({"c0": "the first"})


class Means:
    """A device that streams means of the channels `ids`."""

    def __init__(self, ids: tuple[int, ...], decimation: int, link: DeviceLink | CompiledLink) -> None:
        self.link = link
        self.session = self.link.add(Drive(), identity(features=Feature.MEANS))
        self.link.advance(0)
        request = StreamSet(0, StreamEvent.MEAN, decimation, 20, ids)
        self.link.receive(wire_of(request, 1) + wire_of(StreamStart(1), 2))
        replies = [frame for frame in frames_in(self.link.data_to_send()) if frame.is_reply]
        assert not any(frame.is_error for frame in replies)
        reply = StreamReply.unpack(replies[0].payload)
        assert reply.sample_bytes == 4 * len(ids)
        self.config = StreamConfig.of(identity(), request, reply, Descriptor.of(MIXED, []))

    def stop(self) -> list[bytes]:
        self.link.receive(wire_of(StreamStop(1), 3))
        deframer = Deframer()
        return [raw for raw in deframer.feed(b"\0" + self.link.data_to_send()) if raw[0] == MessageType.DATA]


def near(told: float, exact: Fraction, kind: Kind) -> bool:
    """Whether a f32 is an exact value to rounding; an angle that rounds up to a whole turn begins anew."""
    allowed = max(abs(float(exact)) * 2.0**-23, 2.0**-126)
    turn = float(turn_of(kind)) if kind.wraps else 0.0
    if kind.wraps and kind.type == "f32":
        allowed += turn * 2.0**-45  # a turn is no fraction of two whole numbers
    return any(abs(told + more - float(exact)) <= allowed for more in {0.0, turn})


def angles(scale: float) -> st.SearchStrategy[float]:
    """Of an f32 that wraps: within a turn around zero."""
    half = float(np.nextafter(np.float32(np.pi / scale), np.float32(0)))
    return st.floats(-half, half, width=32) | st.sampled_from([-half, half])


raws = st.tuples(
    st.integers(0, 255), st.integers(-32768, 32767) | st.sampled_from([-32768, 32767, 32766]),
    st.integers(-32768, 32767), st.integers(0, 2**32 - 1), st.floats(-1e6, 1e6, width=32),
    st.integers(0, 255), st.integers(-128, 127), st.integers(0, 65535), st.integers(-(2**31), 2**31 - 1),
    angles(0.5), angles(2.0), st.floats(-1e6, 1e6, width=32), st.integers(-(2**31), 2**31 - 1),
    st.integers(0, 2**32 - 1),
)  # fmt: skip


def make(side: str) -> DeviceLink | CompiledLink:
    """Return a link without devices."""
    return DeviceLink() if side == "python" else CompiledLink()


@pytest.mark.parametrize("side", ["python", pytest.param("c", marks=needs("C compiler"))])
@given(
    ids=st.lists(st.integers(1, len(KINDS)), min_size=1, unique=True).map(tuple),
    decimation=st.integers(1, 9) | st.just(40),
    first=st.integers(0, 20),
    rows=st.lists(raws, min_size=1, max_size=80),
    cuts=st.lists(st.integers(0, 80), max_size=8),
    missing=st.none() | st.integers(0, 80),
    late=st.booleans(),
)
def test_a_record_is_the_mean_of_its_periods(
    ids: tuple[int, ...],
    decimation: int,
    first: int,
    rows: list[tuple],
    cuts: list[int],
    missing: int | None,
    late: bool,
    side: str,
) -> None:
    """Of all its periods, and of none else, however they are pushed; where some are missing there is no record."""
    device = Means(ids, decimation, make(side))
    raw = np.array(rows, DTYPE)
    gap = 7 if missing is not None and 0 < missing < len(rows) and side == "python" else 0  # an interrupt misses none
    missing = missing or 0
    index = [first + k + (gap if k >= missing else 0) for k in range(len(rows))]
    edges = sorted({0, len(rows), *([missing] if gap else []), *(cut for cut in cuts if cut < len(rows))})
    for begin, end in itertools.pairwise(edges):
        part = raw[begin:end]
        pushed = LateSamples(len(part), lambda _, part=part: part) if late else part
        device.session.push_samples(index[begin], index[begin] * TICKS, pushed)
    frames = device.stop()
    chunk = SampleDecoder(device.config, TickReference()).decode(frames)
    row_of = dict(zip(index, rows, strict=True))
    windows = {
        last: [row_of.get(k) for k in range(last - decimation + 1, last + 1)]
        for last in range(0, index[-1] + 1, decimation)
    }
    whole = {last: window for last, window in windows.items() if None not in window}
    assert ([] if chunk is None else chunk.index.tolist()) == list(whole)
    if chunk is None:
        return
    assert chunk.tick.tolist() == [last * TICKS for last in whole]
    for number in ids:
        told = chunk.raw[f"c{number - 1}"].tolist()
        exact = [mean([row[number - 1] for row in window], KINDS[number - 1]) for window in whole.values()]
        kind = KINDS[number - 1]
        assert all(near(value, each, kind) for value, each in zip(told, exact, strict=True)), (kind, told, exact)
        if kind.wraps and kind.type != "f32":
            limits = np.iinfo(DTYPE[number - 1])
            assert all(limits.min <= value < limits.max + 1 for value in told)
    steps = np.diff([0, *chunk.index.tolist()][1:])
    jumps = int((steps != decimation).sum())
    assert sum(bool(raw[9] & DISCONTINUITY) for raw in frames) == jumps == len(chunk.gaps)

"""Frames of a stream that follow each other come out of framing as one: nothing may be told otherwise for it."""

from __future__ import annotations

import struct
from dataclasses import asdict

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from protocol.framing import Deframer, Frame, encode_frame
from protocol.messages import StreamEvent
from protocol.signals import Flag, RawType, Signal, Unit
from protocol.streams import EdgeDecoder, SampleDecoder, StreamConfig, TickReference
from protocol.wire import ByteWire, StreamFrames

CHANNELS = tuple(Signal(k, f"x{k}", Unit.A, RawType.I16, 1.0, Flag.CHANNEL, "") for k in (1, 2, 3))
TICKS, DECIMATION, EDGE = 1250, 3, 8  # edge: bytes of a record
SAMPLES = StreamConfig(1, 0, 7, StreamEvent.PWM, DECIMATION, CHANNELS, 40, tick_hz=20_000_000, pwm_hz=16_000)
EDGES = StreamConfig(1, 1, 8, StreamEvent.EDGES, 1, (), 40, tick_hz=20_000_000, pwm_hz=16_000)
LIMIT = 1 << 32


def frame(config: StreamConfig, flags: int, n: int, seq: int, index: int, tick: int, **changes: int) -> bytes:
    """A stream frame on the wire; what is in its records goes on with the index."""
    size = EDGE if config is EDGES else 2 * len(CHANNELS)
    records = b"".join(
        struct.pack("<II", 1000 * (index + k) % LIMIT, 2654435761 * (index + k) % LIMIT)[:size] for k in range(n)
    )
    cfg_id = changes.get("cfg_id", config.cfg_id)
    header = struct.pack("<BBHHHII", config.stream, flags, n, cfg_id, seq % 65536, index % LIMIT, tick % LIMIT)
    kind = 0x41 if config is EDGES else 0x40
    payload = header + records[: len(records) - changes.get("short", 0)]
    return encode_frame(Frame(kind, changes.get("version", 1), changes.get("tid", 0), config.node, payload))


@st.composite
def wires(draw: st.DrawFn) -> bytes:
    """What a device sends of two streams, with all that may happen to frames, and what cannot."""
    out = [b"\0"]
    now = {
        config: [draw(st.sampled_from((0, 5, 65_530))), *draw(st.sampled_from(((0, 9), (LIMIT - 200, LIMIT - 99_000))))]
        for config in (SAMPLES, EDGES)
    }
    happens = st.sampled_from(("",) * 8 + ("lost", "flag", "repeated", "short", "other", "late", "tid", "cut", "none"))
    more = st.sampled_from(("",) * 12 + ("number", "jump", "version"))
    for _ in range(draw(st.integers(1, 40))):
        config = draw(st.sampled_from((SAMPLES, SAMPLES, SAMPLES, EDGES)))
        seq, index, tick = now[config]
        n, what = draw(st.integers(1, 40)), draw(happens) or draw(more)
        seq, index = seq + (what == "number"), index + 30 * (what == "jump")
        step = 1 if config is EDGES else DECIMATION
        tick += {"late": 17, "lost": 0}.get(what, 0)
        tid = {"tid": draw(st.sampled_from((0, 0, 3, 65_535)))}  # a device's own, which says nothing
        changes = {"short": {"short": 1, **tid}, "other": {"cfg_id": 99, **tid}, "tid": tid, "repeated": tid}
        changes["version"] = {"version": 2}
        sent = frame(config, what == "flag", 0 if what == "none" else n, seq, index, tick, **changes.get(what, {}))
        damaged = sent[:-3] + sent[-1:] if what == "cut" else sent
        out += {"lost": [], "repeated": [sent, sent], "cut": [damaged]}.get(what, [sent])
        now[config] = [seq + 1, index + n * step, tick + n * step * TICKS]
    return b"".join(out)


def decoded(frames: list[bytes], decoder: SampleDecoder | EdgeDecoder) -> dict[str, list[object]]:
    """What a decoder makes of frames, as lists that can be joined."""
    chunk = decoder.decode(frames)
    if chunk is None:
        return {}
    names = ("index", "tick") + (("hall_old", "hall_new", "encoder") if chunk.config is EDGES else ("raw",))
    found: dict[str, list[object]] = {name: getattr(chunk, name).tolist() for name in names}
    found["gaps"] = [(int(chunk.index[gap.position]), gap.lost_samples, gap.lost_frames) for gap in chunk.gaps]
    return found


def add(to: dict[str, list[object]], more: dict[str, list[object]]) -> None:
    """Join what two calls found."""
    for name, values in more.items():
        to.setdefault(name, []).extend(values)


MANY = b"\0" + b"".join(frame(SAMPLES, 0, 1, k, k * DECIMATION, k * DECIMATION * TICKS) for k in range(1200))


@given(data=wires(), cuts=st.lists(st.integers(1, 3000), min_size=1, max_size=6))
@example(data=MANY, cuts=[1 << 20])
def test_samples_edges_gaps_and_counts_are_the_same(data: bytes, cuts: list[int]) -> None:
    wire, plain = ByteWire(), Deframer()
    joined = {config.stream: wire.decoder(config, TickReference()) for config in (SAMPLES, EDGES)}
    single: dict[int, SampleDecoder | EdgeDecoder] = {
        0: SampleDecoder(SAMPLES, TickReference()),
        1: EdgeDecoder(EDGES, TickReference()),
    }
    of_joined: dict[int, dict[str, list[object]]] = {0: {}, 1: {}}
    of_single: dict[int, dict[str, list[object]]] = {0: {}, 1: {}}
    at, k = 0, 0
    while at < len(data):
        piece = data[at : at + cuts[k % len(cuts)]]
        at, k = at + len(piece), k + 1
        for item in wire.feed(piece, 0.0):
            if not isinstance(item, StreamFrames):
                assert item[1] == 2
                continue
            decoder = joined[item.stream]
            assert isinstance(decoder, SampleDecoder | EdgeDecoder)
            add(of_joined[item.stream], decoded(item.frames, decoder))
        frames = [raw[:2] + b"\0\0" + raw[4:] for raw in plain.feed(piece)]
        for stream, decoder in single.items():  # frame by frame: joined ones have to equal what each of them says
            for raw in frames:
                if raw[8] == stream and raw[:2] == bytes((0x41 if stream else 0x40, 1)):
                    add(of_single[stream], decoded([raw], decoder))
    assert of_joined == of_single
    assert [asdict(joined[stream].counters) for stream in (0, 1)] == [
        asdict(single[stream].counters) for stream in (0, 1)
    ]
    assert asdict(wire.counters) == asdict(plain.counters)


def test_many_frames_are_one() -> None:
    wire = ByteWire()
    decoder = wire.decoder(SAMPLES, TickReference())
    (item,) = wire.feed(MANY, 0.0)
    assert isinstance(item, StreamFrames)
    assert len(item.frames) == 1
    chunk = decoder.decode(item.frames)
    assert chunk is not None
    assert not chunk.gaps
    assert np.array_equal(chunk.index, DECIMATION * np.arange(1200))
    assert np.array_equal(chunk.tick, TICKS * chunk.index)
    assert (decoder.counters.frames, decoder.counters.samples, wire.counters.frames) == (1200, 1200, 1200)


def test_no_more_records_than_a_frame_can_count() -> None:
    wire = ByteWire()
    decoder = wire.decoder(SAMPLES, TickReference())
    n = 160
    sent = b"".join(frame(SAMPLES, 0, n, k, k * n * DECIMATION, k * n * DECIMATION * TICKS) for k in range(900))
    frames = [item.frames for item in wire.feed(b"\0" + sent, 0.0) if isinstance(item, StreamFrames)]
    assert [len(each) for each in frames] == [3]
    chunk = decoder.decode(frames[0])
    assert chunk is not None
    assert (len(chunk), chunk.gaps, decoder.counters.frames) == (900 * n, (), 900)

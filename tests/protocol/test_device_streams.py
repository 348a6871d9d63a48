"""The device's streams: what is chosen, when it goes out, what is dropped and how it is told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_drive import CHANNELS, TICKS, SmallDrive, edges_at, identity, samples, small_link

from protocol.descriptor import Descriptor
from protocol.device.session import TxQueue
from protocol.errors import Refused
from protocol.framing import Deframer, encoded_length
from protocol.messages import ErrorCode, StreamEvent, StreamReply, StreamSet
from protocol.streams import OVERRUN, STREAM_HEADER, EdgeDecoder, SampleDecoder, StreamConfig, TickReference

DESCRIPTOR = Descriptor.of(CHANNELS, [])
ALL = tuple(channel.id for channel in CHANNELS)
BIG = 1 << 26


class Device:
    """A small drive whose streams are asked for directly, and the frames it sent."""

    def __init__(self, bulk_limit: int = BIG, capacity: float | None = None, **changes: object) -> None:
        self.link, self.session, _ = small_link(TxQueue(bulk_limit, capacity=capacity), **changes)
        self.link.data_to_send()
        self.deframer = Deframer()
        self.deframer.feed(b"\0")

    def start(self, request: StreamSet, tx_max: int = 1024) -> tuple[StreamConfig, StreamReply]:
        reply = self.session.streams.configure(request, tx_max)
        self.session.streams.start(1 << request.stream)
        return StreamConfig.of(identity(), request, reply, DESCRIPTOR), reply

    def push(self, index0: int, n: int) -> None:
        self.session.push_samples(index0, index0 * TICKS, samples(index0, n))

    def frames(self, kind: int = 0x40) -> list[bytes]:
        return [raw for raw in self.deframer.feed(self.link.data_to_send()) if raw[0] == kind]


def pwm(channels: tuple[int, ...] = ALL, decimation: int = 1, latency: int = 20, stream: int = 0) -> StreamSet:
    return StreamSet(stream, StreamEvent.PWM, decimation, latency, channels)


def records_in(raw: bytes) -> int:
    """Return how many samples or edges a frame says that it has."""
    return int.from_bytes(raw[10:12], "little")


@given(
    channels=st.lists(st.sampled_from(ALL), min_size=1, unique=True).map(tuple),
    decimation=st.integers(1, 9),
    first=st.integers(0, 20),
    pushes=st.lists(st.integers(1, 60), min_size=1, max_size=12),
    tx_max=st.integers(128, 300),
)
def test_every_chosen_sample_arrives_once(
    channels: tuple[int, ...], decimation: int, first: int, pushes: list[int], tx_max: int
) -> None:
    device = Device()
    config, reply = device.start(pwm(channels, decimation), tx_max)
    index = first
    for n in pushes:
        device.push(index, n)
        index += n
    device.session.streams.stop(1)
    frames = device.frames()
    assert all(len(raw) - 8 <= tx_max for raw in frames)
    decoder = SampleDecoder(config, TickReference())
    chunk = decoder.decode(frames)
    expected = [i for i in range(first, index) if i % decimation == 0]  # by absolute index
    if not expected:
        assert chunk is None
        return
    assert chunk.index.tolist() == expected
    assert chunk.tick.tolist() == [i * TICKS for i in expected]
    full = samples(first, index - first)[np.array(expected) - first]
    for number in channels:
        name = DESCRIPTOR.channels[number - 1].name
        assert (chunk.raw[name] == full[name]).all()
    assert decoder.counters.lost_by_index == decoder.counters.lost_by_seq == 0
    assert {records_in(raw) for raw in frames[:-1]} <= {reply.block}  # only the last one is partial


def test_a_block_holds_what_fits_and_waits_no_longer_than_asked() -> None:
    device = Device()
    _, reply = device.start(pwm(latency=1000))
    assert (reply.sample_bytes, reply.block) == (10, (1024 - STREAM_HEADER.size) // 10)
    assert device.start(pwm(latency=1, stream=1))[1].block == 16  # 1 ms at 16 kHz
    assert device.start(pwm(latency=1, decimation=10, stream=2))[1].block == 1
    assert device.start(pwm(latency=0, stream=3))[1].block == 1
    assert refusal(Device(), pwm(), tx_max=20) == (ErrorCode.DOES_NOT_FIT, 4)


def test_a_jump_of_the_index_is_told() -> None:
    device = Device()
    config, _ = device.start(pwm())
    device.push(0, 150)
    device.push(200, 150)
    device.session.streams.stop(1)
    chunk = SampleDecoder(config, TickReference()).decode(device.frames())
    assert [(g.position, g.lost_samples, g.lost_frames, g.overrun) for g in chunk.gaps] == [(150, 50, 0, False)]


@given(
    edges=st.lists(st.integers(0, 400 * TICKS), max_size=40).map(sorted),
    pushes=st.lists(st.integers(1, 90), min_size=1, max_size=8),
    latency=st.integers(0, 30),
)
def test_edges_never_trail_the_samples(edges: list[int], pushes: list[int], latency: int) -> None:
    device = Device()
    device.start(pwm(latency=latency))
    device.start(StreamSet(1, StreamEvent.EDGES, 1, 20))
    index = 0
    for n in pushes:
        upper = (index + n - 1) * TICKS
        device.session.push_edges(edges_at([t for t in edges if (index - 1) * TICKS < t <= upper]))
        device.push(index, n)
        index += n
        device.link.advance(upper)
    device.session.streams.stop(3)
    sent = -1
    seen = 0
    for raw in device.deframer.feed(device.link.data_to_send()):
        n, tick = records_in(raw), int.from_bytes(raw[20:24], "little")
        if raw[0] == 0x41:
            ticks = np.frombuffer(raw[24:], "<u4")[::2]
            assert (ticks > sent).all(), "an edge came after a sample at or after it"
            assert tick == ticks[0]
            seen += n
        elif raw[0] == 0x40:
            sent = tick + (n - 1) * TICKS
    assert seen == len([t for t in edges if t <= (index - 1) * TICKS])


reads = st.lists(st.tuples(st.integers(1, 200), st.integers(0, 2500)), min_size=1, max_size=25)


@given(reads, st.integers(0, 3000))
def test_what_the_device_drops_reconciles_three_ways(steps: list[tuple[int, int]], bulk_limit: int) -> None:
    device = Device(bulk_limit)
    config, reply = device.start(pwm())
    decoder = SampleDecoder(config, TickReference())
    edge_config, _ = device.start(StreamSet(1, StreamEvent.EDGES, 1, 20))
    edge_decoder = EdgeDecoder(edge_config, TickReference())
    frames, index, n_edges = [], 0, 0
    for n, read in steps:
        device.session.push_edges(edges_at([(index + n - 1) * TICKS]))
        device.push(index, n)
        index, n_edges = index + n, n_edges + 1
        frames += device.deframer.feed(device.link.data_to_send(read))
    frames += device.deframer.feed(device.link.data_to_send())
    last_n, room = reply.block - index % reply.block, device.session.tx
    room.bulk_limit = BIG
    device.session.push_edges(edges_at([(index + last_n - 1) * TICKS]))
    device.push(index, last_n)  # one more frame of each gets through: every loss before it shows
    frames += device.deframer.feed(device.link.data_to_send())
    data = [raw for raw in frames if raw[0] == 0x40]
    chunk = decoder.decode(data)
    edge_chunk = edge_decoder.decode([raw for raw in frames if raw[0] == 0x41])
    assert (chunk.raw == samples(0, index + last_n)[chunk.index]).all()
    lost, edge_lost = decoder.counters, edge_decoder.counters
    assert lost.samples + lost.lost_by_index == index + last_n
    assert lost.lost_by_seq * reply.block == lost.lost_by_index
    assert lost.lost_by_seq + edge_lost.lost_by_seq == device.session.heartbeat().tx_dropped
    first = int(edge_chunk.index[0])
    before = edge_chunk.gaps[0].lost_samples if first else 0  # a lower bound only: see SPEC.md
    assert first + edge_lost.samples + edge_lost.lost_by_index - before == n_edges + 1
    flagged = [bool(raw[9] & OVERRUN) for raw in data]
    assert sum(flagged) == lost.overruns == sum(gap.overrun for gap in chunk.gaps) == len(chunk.gaps)


def test_drops_are_remembered_after_their_stream_is_gone() -> None:
    device = Device(bulk_limit=2000)
    device.start(pwm())
    device.push(0, 1000)
    device.session.streams.stop(1)
    dropped = 10 - len(device.frames())
    assert dropped > 5
    assert device.session.heartbeat().tx_dropped == dropped
    device.start(pwm())
    assert device.session.heartbeat().tx_dropped == dropped


def test_replies_overtake_streams_but_not_inside_a_frame() -> None:
    device = Device()
    device.start(pwm())
    device.push(0, 1000)
    first = device.link.data_to_send(100)
    device.session.log(6, "here")
    deframer = Deframer()
    kinds = [raw[0] for raw in deframer.feed(first + device.link.data_to_send())]
    assert kinds[:2] == [0x40, 0x43]
    assert deframer.counters.bad == 0


# Configuration


def refusal(device: Device, request: StreamSet, tx_max: int = 1024) -> tuple[int, float]:
    with pytest.raises(Refused) as caught:
        device.session.streams.configure(request, tx_max)
    return caught.value.code, caught.value.detail


def wire_rate(size: int, block: int, decimation: int) -> float:
    """Bytes/s by hand: 8 + 16 + n * size + 4, COBS, two delimiters, 16 kHz."""
    body = 28 + size * block
    return (body + -(-body // 254) + 2) * 16_000 / (decimation * block)


def test_the_load_is_predicted_and_what_does_not_fit_is_refused() -> None:
    assert Device().start(pwm())[1].load == 0.0  # unknown capacity
    capacity = 92_160.0  # UART, 921600 baud
    device = Device(capacity=capacity)
    code, fits = refusal(device, pwm())
    assert code == ErrorCode.DOES_NOT_FIT
    load = device.session.streams.configure(pwm(decimation=int(fits)), 1024).load
    assert load == pytest.approx(wire_rate(10, min(100, 320 // int(fits)), int(fits)) / capacity)
    assert load <= 0.95
    block_before = min(100, 320 // (int(fits) - 1))
    assert wire_rate(10, block_before, int(fits) - 1) / capacity > 0.95


def test_the_load_counts_all_streams_of_the_link() -> None:
    link, first, _ = small_link(TxQueue(capacity=100_000.0))
    second = link.add(SmallDrive(), identity(node=2))
    one = first.streams.configure(pwm(decimation=4), 1024).load
    two = second.streams.configure(pwm(decimation=4), 1024).load
    assert two == pytest.approx(2 * one)
    first.streams.stop(1)
    assert second.streams.configure(pwm(decimation=4), 1024).load == pytest.approx(one)
    edge = first.streams.configure(StreamSet(1, StreamEvent.EDGES, 1, 20), 1024).load
    assert edge - one == pytest.approx(encoded_length(24) * 50 / 100_000)


def test_samples_of_another_shape_are_a_bug_of_the_caller() -> None:
    device = Device()
    device.start(pwm())
    with pytest.raises(TypeError, match="the channels make"):
        device.session.push_samples(0, 0, np.zeros(3, [("x", "<i2")]))

"""Random and mutated frames by the 100 000 into either end: no exception, nothing accepted, nothing changed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from cobs import cobs
from small_drive import TICKS, SmallDrive, edges_at, frames_in, identity, samples, small_link, wire_of

from protocol.descriptor import Descriptor
from protocol.device.session import DeviceLink, DeviceSession, TxQueue
from protocol.framing import MAJOR, Frame, encode_frame
from protocol.host import HostSession
from protocol.messages import (
    Alive,
    Command,
    DriveState,
    Hello,
    ParamGet,
    ParamReply,
    ParamSet,
    Setpoint,
    SetpointMode,
    StateCommand,
    StreamEvent,
    StreamSet,
    StreamStart,
    StreamStop,
)
from protocol.streams import SampleDecoder, StreamConfig, TickReference
from protocol.wire import StreamFrames

RANDOM = 400_000
MUTATED = 100_000
BOOT_ID = 0xB0071D
Device = tuple[DeviceLink, DeviceSession, SmallDrive]


def random_frames(rng: np.random.Generator, n: int) -> bytes:
    """Return n frames of random bytes, half of them sound COBS and length around nonsense."""
    half = n // 2
    noise = rng.integers(1, 256, 24 * half, np.uint8)
    ends = np.sort(rng.choice(24 * half, half, replace=False))
    noise[ends] = 0
    lengths = rng.integers(12, 48, n - half)
    noisy = rng.integers(0, 256, int(lengths.sum()), np.uint8)
    starts = np.cumsum(lengths) - lengths
    noisy[starts + 4], noisy[starts + 5] = lengths - 12, 0  # the length field is right: only the CRC is not
    nonsense = noisy.tobytes()
    bounds = [*starts.tolist(), len(nonsense)]
    encode = cobs.encode
    sound = [encode(nonsense[a:b]) for a, b in pairwise(bounds)]
    return b"\0" + noise.tobytes() + b"\0" + b"\0".join(sound) + b"\0"


def mutate(rng: np.random.Generator, wires: list[bytes], n: int) -> list[bytes]:
    """Return n frames, each damaged inside: bits flipped, bytes inserted or deleted, two frames joined."""
    out = []
    originals = {wire[1:-1] for wire in wires}
    draws = rng.random((n, 4)).tolist()
    values = rng.integers(0, 256, n).tolist()
    for k in range(n):
        wire = wires[k % len(wires)]
        kind, where, how_many, _ = draws[k]
        inside = bytearray(wire[1:-1])
        position = int(where * len(inside))
        if kind < 0.4:
            inside[position] ^= 1 << values[k] % 8
        elif kind < 0.6:
            inside[position] ^= values[k] or 0xFF
        elif kind < 0.75:
            inside.insert(position, values[k])
        elif kind < 0.9:
            del inside[position : position + 1 + int(how_many * 4)]
        else:
            inside = inside[:position] + wires[(k + 1) % len(wires)][1:-1][position:]
        if not originals.isdisjoint(bytes(inside).split(b"\0")):  # still whole, say with a zero before it
            inside = bytearray(wire[1:-1])
            inside[position] ^= 0x40
        out.append(b"\0" + bytes(inside) + b"\0")
    return out


def to_device() -> list[bytes]:
    """Return what a host says in a run, all of which would change something."""
    return [
        wire_of(Hello(1), 1),
        wire_of(StateCommand(Command.ARM, BOOT_ID), 2),
        wire_of(StateCommand(Command.START), 3),
        wire_of(ParamSet(101, 9.0), 4),
        wire_of(Setpoint(SetpointMode.SPEED, 5, 100.0)),
        wire_of(Alive(6)),
        wire_of(StreamSet(0, StreamEvent.PWM, 1, 20, (1, 2, 3)), 7),
        wire_of(StreamStart(1), 8),
        wire_of(StreamStop(), 9),
    ]


def to_host() -> list[bytes]:
    """Return what a device sends in a run: replies, heartbeats, events, samples, edges."""
    link, device, _ = small_link(TxQueue(1 << 24))
    for wire in to_device()[:-1]:
        link.receive(wire)
    link.receive(wire_of(StreamSet(1, StreamEvent.EDGES, 1, 20), 10))
    link.receive(wire_of(StreamStart(2), 11))
    device.push_edges(edges_at(range(0, 160_000, 20_000)))
    device.push_samples(0, 0, samples(0, 2000))
    link.advance(2_000_000)
    reply = Frame(0x11, MAJOR | 0x10, 1, 1, ParamReply(101, 1, 0, 2, 1).pack())
    return [encode_frame(frame) for frame in (*frames_in(link.data_to_send()), reply)]


def device_snapshot(session: DeviceSession, app: SmallDrive) -> object:
    beat = session.heartbeat()
    return (
        session.state, beat.faults, beat.setpoint_counter, beat.setpoints_rejected, beat.last_tid,
        session.ignored, dict(app.values), list(app.states), list(app.setpoints), session.streams.running,
        len(session.tx), list(session._peer.replies), session._peer.nonce, session.machine._fed,
    )  # fmt: skip


def host_snapshot(host: HostSession) -> object:
    counters = host.counters
    return (
        host.busy, dict(host.hellos), host.round_trip, counters.unexpected_replies, counters.malformed,
        counters.unknown_types, counters.other_versions, str(host._pending),
    )  # fmt: skip


@pytest.fixture
def device() -> Device:
    link, session, app = small_link()
    link.data_to_send()
    return link, session, app


@pytest.fixture
def host() -> HostSession:
    session = HostSession()
    session.request(ParamGet(101), 1, 0.0)
    return session


def test_the_oracle_frames_are_sound(device: Device, host: HostSession) -> None:
    """Undamaged, the same frames do have their effect: the tests below are not empty."""
    link, session, app = device
    link.receive(b"".join(to_device()[:6]))
    assert session.state is DriveState.RUNNING
    assert (app.values["gain"], app.setpoints) == (9.0, [(SetpointMode.SPEED, 100.0, 0.0)])
    host.receive_data(b"\0" + b"".join(to_host()), 0.01)
    kinds = {type(event).__name__ for event in iter(host.next_event, None)}
    assert kinds == {"StreamFrames", "HeartbeatReceived", "DeviceEventReceived", "ReplyReceived"}


def test_random_frames_change_nothing(device: Device, host: HostSession) -> None:
    link, session, app = device
    before = device_snapshot(session, app), host_snapshot(host)
    rng = np.random.default_rng(1)
    for _ in range(10):
        data = random_frames(rng, RANDOM // 10)
        for start in range(0, len(data), 1 << 16):
            link.receive(data[start : start + (1 << 16)])
            host.receive_data(data[start : start + (1 << 16)], 0.01)
    for counters in (link.deframer.counters, host.counters.framing):
        assert counters.frames == 0
        assert counters.bad > 0.95 * RANDOM  # two delimiters in a row make no frame
        assert min(counters.bad_crc, counters.bad_cobs, counters.bad_length) > 100
    assert (device_snapshot(session, app), host_snapshot(host)) == before
    assert host.next_event() is None
    assert link.data_to_send() == b""


def test_mutated_requests_change_nothing(device: Device) -> None:
    link, session, app = device
    before = device_snapshot(session, app)
    link.receive(b"".join(mutate(np.random.default_rng(2), to_device(), MUTATED)))
    assert link.deframer.counters.frames == 0
    assert link.deframer.counters.bad >= MUTATED
    assert device_snapshot(session, app) == before
    assert link.data_to_send() == b""


def test_mutated_answers_change_nothing(host: HostSession) -> None:
    before = host_snapshot(host)
    wires = to_host()
    assert {wire[2] for wire in wires} >= {0x40, 0x41, 0x42, 0x04, 0x30}
    data = b"".join(mutate(np.random.default_rng(3), wires, MUTATED))
    for start in range(0, len(data), 1 << 16):
        host.receive_data(data[start : start + (1 << 16)], 0.01)
    assert host.counters.framing.frames == 0
    assert host.counters.framing.bad >= MUTATED
    assert host_snapshot(host) == before
    assert host.next_event() is None


def test_sound_frames_of_nonsense_never_raise_and_never_energise(device: Device, host: HostSession) -> None:
    """A right CRC around random content: what a faulty program may send."""
    link, session, app = device
    rng = np.random.default_rng(4)
    types = [0x01, 0x02, 0x04, 0x05, 0x10, 0x11, 0x12, 0x13, 0x20, 0x21, 0x30, 0x31, 0x32, 0x40, 0x41, 0x42, 0x43]
    n = 20_000
    heads = rng.integers(0, 256, (n, 8), np.uint8)
    lengths = rng.choice([0, 4, 8, 12, 16, 20, 36, 40, 68], n).tolist()
    pool = rng.integers(0, 256, 1 << 16, np.uint8).tobytes()
    flags = rng.choice([1, 0x11, 0x31, 2], n, p=[0.6, 0.2, 0.1, 0.1]).tolist()
    kinds = rng.choice(types, n).tolist()
    for k, (head, length) in enumerate(zip(heads.tolist(), lengths, strict=True)):
        payload = pool[k : k + length]
        if k % 3 == 0:
            payload = bytes(b & 3 for b in payload)  # small numbers: more of them mean something
        wire = encode_frame(Frame(kinds[k], flags[k], head[2] % 3, head[6] % 3, payload))
        link.receive(wire)
        host.receive_data(b"\0" + wire, 0.01)
        if k % 64 == 0:
            link.advance(k * 1000)
            link.data_to_send()
            while host.next_event() is not None:
                pass
    assert DriveState.ARMED not in app.states
    assert DriveState.RUNNING not in app.states
    assert not app.outputs_on
    assert session.heartbeat().setpoint_counter == 0


@pytest.mark.parametrize("seed", range(5))
def test_samples_through_a_damaging_link_are_right_or_missing(seed: int) -> None:
    """Bytes flipped, lost and inserted anywhere: what is delivered is exact, what is not is counted."""
    link, device, _ = small_link(TxQueue(1 << 26))
    ask = StreamSet(0, StreamEvent.PWM, 1, 20, (1, 2, 3, 4, 5))
    reply = device.streams.configure(ask, 128)
    device.streams.start(1)
    total = reply.block * 5000
    device.push_samples(0, 0, samples(0, total))
    data = bytearray(link.data_to_send())
    rng = np.random.default_rng(100 + seed)
    for position in sorted(rng.integers(200, len(data) - 200, 400).tolist(), reverse=True):
        kind = position % 4
        if kind == 0:
            data[position] ^= 1 << seed
        elif kind == 1:
            del data[position : position + 1 + position % 90]
        elif kind == 2:
            data[position:position] = rng.integers(0, 256, 1 + position % 40, np.uint8).tobytes()
        else:
            data[position] = 0
    config = StreamConfig.of(identity(), ask, reply, Descriptor.of(device.app.channels, []))
    decoder = SampleDecoder(config, TickReference())
    host = HostSession()
    delivered = 0
    for start in range(0, len(data), 5000):
        host.receive_data(bytes(data[start : start + 5000]), 0.0)
        for event in iter(host.next_event, None):
            if isinstance(event, StreamFrames):
                chunk = decoder.decode(event.frames)
                assert (chunk.raw == samples(0, total)[chunk.index]).all()
                assert (chunk.tick == chunk.index * TICKS).all()
                delivered += len(chunk)
    counters = decoder.counters
    assert 300 < counters.lost_by_seq < 600
    assert counters.lost_by_seq * reply.block == counters.lost_by_index
    assert delivered + counters.lost_by_index == total
    assert counters.stale == counters.malformed == counters.out_of_order == counters.overruns == 0

"""Sound frames of nonsense into either end, and a link that damages: nothing is energised, nothing wrong believed."""

from __future__ import annotations

import numpy as np
import pytest
from small_drive import TICKS, identity, samples, small_link

from protocol.descriptor import Descriptor
from protocol.device.session import TxQueue
from protocol.framing import Frame, encode_frame
from protocol.host import HostSession
from protocol.messages import (
    DriveState,
    MessageType,
    ParamGet,
    StreamEvent,
    StreamSet,
)
from protocol.streams import SampleDecoder, StreamConfig, TickReference
from protocol.wire import StreamFrames
from tests.choice import chosen

BOOT_ID = 0xB0071D


def test_sound_frames_of_nonsense_never_raise_and_never_energise() -> None:
    """A right CRC around random content: what a faulty program may send."""
    link, session, app = small_link()
    host = HostSession()
    host.request(ParamGet(101), 1, 0.0)
    rng = np.random.default_rng(4)
    n = 5000
    for k in range(n):
        payload = rng.bytes(rng.choice([0, 4, 8, 12, 16, 20, 36, 40, 68]))
        if k % 3 == 0:
            payload = bytes(b & 3 for b in payload)  # small numbers: more of them mean something
        flags = int(rng.choice([1, 0x11, 0x31, 2], p=[0.6, 0.2, 0.1, 0.1]))
        wire = encode_frame(Frame(int(rng.choice(MessageType)), flags, *rng.integers(0, 3, 2).tolist(), payload))
        link.receive(wire)
        host.receive_data(b"\0" + wire, 0.01)
        if k % 64 == 0:
            link.advance(k * 1000)
            link.data_to_send()
            while host.next_event() is not None:
                pass
    assert set(app.states) == {DriveState.IDLE}
    assert not app.outputs_on
    assert session.heartbeat().setpoint_counter == 0


@pytest.mark.parametrize("seed", chosen("damage", range(5), 2))
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

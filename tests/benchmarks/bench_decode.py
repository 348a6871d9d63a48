"""Decoding speed: bytes from a link -> frames -> CRC -> numpy columns, on one core.

`python -m tests.benchmarks decode`. The goal is 5 M samples/s of 32 bytes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from protocol.descriptor import Descriptor
from protocol.device.app import Identity
from protocol.device.carrier import ByteCarrier
from protocol.device.streams import StreamTable
from protocol.device.tx import TxQueue
from protocol.host import HostSession
from protocol.messages import Role, StreamEvent, StreamSet
from protocol.signals import DRIVE_CHANNELS, Flag, RawType, Signal, Unit
from protocol.streams import SampleDecoder, StreamConfig
from protocol.wire import StreamFrames
from tests.benchmarks.table import Quickest, Row

GOAL = 5e6  # samples/s of 32 bytes
N = 500_000  # samples
REPEAT = 3
WORDS = tuple(Signal(k + 1, f"x{k}", Unit.A, RawType.I16, 1 / 1024, Flag.CHANNEL, "") for k in range(16))


def measure(channels: tuple[Signal, ...], read: int) -> Quickest:
    """Time N samples of all channels, read in pieces of `read` bytes: seconds of each step."""
    identity = Identity(1, Role.DRIVE, "bench", "0", boot_id=1)
    descriptor = Descriptor.of(channels, ())
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 256, N * descriptor.dtype.itemsize, np.uint8).view(descriptor.dtype)
    best = Quickest()
    for _ in range(REPEAT):
        tx = TxQueue(1 << 30)
        table = StreamTable(identity, channels, ByteCarrier(tx))
        request = StreamSet(0, StreamEvent.PWM, 1, 100, tuple(c.id for c in channels))
        reply = table.configure(request, 1024)
        table.start(1)
        with best.timed("encode"):
            table.push_samples(0, 0, raw)
        table.stop(1)
        data = tx.take()

        host = HostSession()
        config = StreamConfig.of(identity, request, reply, descriptor)
        decoder = SampleDecoder(config, host.tick_reference(1))
        pieces = [data[k : k + read] for k in range(0, len(data), read)]
        chunks = []
        with best.timed("decode"):
            for piece in pieces:
                host.receive_data(piece, 0.0)
                while (event := host.next_event()) is not None:
                    assert isinstance(event, StreamFrames)
                    chunks.append(decoder.decode(event.frames))
        with best.timed("columns"):
            for chunk in chunks:
                assert chunk is not None
                for channel in channels:
                    chunk.physical(channel.name)
        joined = np.concatenate([chunk.raw for chunk in chunks if chunk])
        assert (joined == raw).all()
        assert decoder.counters.lost_by_index == decoder.counters.lost_by_seq == 0
        assert host.counters.framing.bad == 0
    return best


def rows() -> Iterator[Row]:
    """The figures, in M samples/s on one core; the columns are those of every channel in float64."""
    for name, channels, read, goal in (
        ("32 B samples, reads of 64 KiB", WORDS, 65_536, GOAL / 1e6),
        ("32 B samples, reads of 8 KiB", WORDS, 8192, GOAL / 1e6),
        ("all channels of the drive", DRIVE_CHANNELS, 65_536, None),
    ):
        took = measure(channels, read)
        yield Row(f"{name}: decode", N / 1e6 / took["decode"], "M samples/s", goal)
        yield Row(f"{name}: with every column in SI", N / 1e6 / (took["decode"] + took["columns"]), "M samples/s")
        yield Row(f"{name}: device side", N / 1e6 / took["encode"], "M samples/s")

"""Decoding speed: bytes from a link -> frames -> CRC -> numpy columns, on one core.

`python -m tests.benchmarks decode`. The goal is 5 M samples/s of 32 bytes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

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
from tests.benchmarks.table import Row

GOAL = 5e6  # samples/s of 32 bytes
TICKS = 1250


@dataclass(frozen=True, slots=True)
class Result:
    """Rates in samples/s; `columns` includes every channel in float64."""

    decode: float
    columns: float
    encode: float


def i16_channels(n: int) -> tuple[Signal, ...]:
    """Return n channels of two bytes."""
    return tuple(Signal(k + 1, f"x{k}", Unit.A, RawType.I16, 1 / 1024, Flag.CHANNEL, "") for k in range(n))


def measure(channels: tuple[Signal, ...], n: int = 500_000, read: int = 65_536, repeat: int = 3) -> Result:
    """Time n samples of all channels, read in pieces of `read` bytes; the best of `repeat` runs."""
    identity = Identity(1, Role.DRIVE, "bench", "0", boot_id=1)
    descriptor = Descriptor.of(channels, ())
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 256, n * descriptor.dtype.itemsize, np.uint8).view(descriptor.dtype)
    decode = columns = encode = float("inf")
    for _ in range(repeat):
        tx = TxQueue(1 << 30)
        table = StreamTable(identity, channels, ByteCarrier(tx))
        request = StreamSet(0, StreamEvent.PWM, 1, 100, tuple(c.id for c in channels))
        reply = table.configure(request, 1024)
        table.start(1)
        start = time.perf_counter()
        table.push_samples(0, 0, raw)
        encode = min(encode, time.perf_counter() - start)
        table.stop(1)
        data = tx.take()

        host = HostSession()
        config = StreamConfig.of(identity, request, reply, descriptor)
        decoder = SampleDecoder(config, host.tick_reference(1))
        pieces = [data[k : k + read] for k in range(0, len(data), read)]
        chunks = []
        start = time.perf_counter()
        for piece in pieces:
            host.receive_data(piece, 0.0)
            while (event := host.next_event()) is not None:
                assert isinstance(event, StreamFrames)
                chunks.append(decoder.decode(event.frames))
        decode = min(decode, time.perf_counter() - start)
        start = time.perf_counter()
        for chunk in chunks:
            assert chunk is not None
            for channel in channels:
                chunk.physical(channel.name)
        columns = min(columns, time.perf_counter() - start)
        joined = np.concatenate([chunk.raw for chunk in chunks if chunk])
        assert (joined == raw).all()
        assert decoder.counters.lost_by_index == decoder.counters.lost_by_seq == 0
        assert host.counters.framing.bad == 0
    return Result(n / decode, n / (decode + columns), n / encode)


def rows() -> list[Row]:
    """The figures, in M samples/s on one core."""
    return [
        row
        for name, result, goal in (
            ("32 B samples, reads of 64 KiB", measure(i16_channels(16)), GOAL / 1e6),
            ("32 B samples, reads of 8 KiB", measure(i16_channels(16), read=8192), GOAL / 1e6),
            ("all channels of the drive", measure(DRIVE_CHANNELS), None),
        )
        for row in (
            Row(f"{name}: decode", result.decode / 1e6, "M samples/s", goal),
            Row(f"{name}: with every column in SI", result.columns / 1e6, "M samples/s"),
            Row(f"{name}: device side", result.encode / 1e6, "M samples/s"),
        )
    ]

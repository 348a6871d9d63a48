"""Decoding speed: bytes from a link -> frames -> CRC -> numpy columns, on one core.

`python tests/benchmarks/bench_decode.py` prints a table. The goal is 5 M samples/s of 32 bytes.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from protocol.descriptor import Descriptor
from protocol.device_app import Identity
from protocol.device_streams import StreamTable
from protocol.device_tx import TxQueue
from protocol.host import HostSession, StreamFrames
from protocol.messages import Role, StreamEvent, StreamSet
from protocol.signals import DRIVE_CHANNELS, Flag, RawType, Signal, Unit
from protocol.streams import SampleDecoder, StreamConfig

GOAL = 5e6  # samples/s of 32 bytes
TICKS = 1250


@dataclass(frozen=True, slots=True)
class Result:
    """One row of the table. Rates in samples/s; `columns` includes every channel in float64."""

    name: str
    sample_bytes: int
    decode: float
    columns: float
    encode: float


def i16_channels(n: int) -> tuple[Signal, ...]:
    """Return n channels of two bytes."""
    return tuple(Signal(k + 1, f"x{k}", Unit.A, RawType.I16, 1 / 1024, Flag.CHANNEL, "") for k in range(n))


def measure(name: str, channels: tuple[Signal, ...], n: int = 500_000, read: int = 65_536, repeat: int = 3) -> Result:
    """Time n samples of all channels, read in pieces of `read` bytes; the best of `repeat` runs."""
    identity = Identity(1, Role.DRIVE, "bench", "0", boot_id=1)
    descriptor = Descriptor.of(channels, ())
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 256, n * descriptor.dtype.itemsize, np.uint8).view(descriptor.dtype)
    decode = columns = encode = float("inf")
    for _ in range(repeat):
        tx = TxQueue(1 << 30)
        table = StreamTable(identity, channels, tx)
        request = StreamSet(0, StreamEvent.PWM, 1, 100, tuple(c.id for c in channels))
        reply = table.configure(request, 1024)
        table.start(1)
        start = time.perf_counter()
        table.push_samples(0, 0, raw)
        encode = min(encode, time.perf_counter() - start)
        table.stop(1)
        data = tx.take()

        host = HostSession()
        config = StreamConfig.of(1, request, reply, descriptor)
        decoder = SampleDecoder(config, TICKS, host.tick_reference(1))
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
    return Result(name, descriptor.dtype.itemsize, n / decode, n / (decode + columns), n / encode)


def run() -> list[Result]:
    """Return the rows of the table."""
    return [
        measure("16 x i16, reads of 64 KiB", i16_channels(16)),
        measure("16 x i16, reads of 8 KiB", i16_channels(16), read=8192),
        measure("all channels of the drive", DRIVE_CHANNELS),
    ]


if __name__ == "__main__":
    print(f"{'':28} {'bytes':>5} {'decode':>12} {'of goal':>8} {'+ columns':>12} {'device side':>12}   M samples/s")
    for row in run():
        print(
            f"{row.name:28} {row.sample_bytes:5} {row.decode / 1e6:12.2f} {row.decode / GOAL:7.1f}x"
            f" {row.columns / 1e6:12.2f} {row.encode / 1e6:12.2f}"
        )

"""Decoding speed: bytes from a link -> frames -> CRC -> numpy columns, on one core.

`python -m tests.benchmarks decode`. A read of 8 KiB is what a busy link gives at a time.
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
from tests.benchmarks.table import Quickest, Row, speed

ZEROS = 0.17  # share of zeros in the bytes of tests/data/reversal.run: with many of them COBS takes longer
WORDS = tuple(Signal(k + 1, f"x{k}", Unit.A, RawType.I16, 1 / 1024, Flag.CHANNEL, "") for k in range(16))


def measure(channels: tuple[Signal, ...], read: int, n: int, repeat: int, zeros: float = 0.0) -> Quickest:
    """Time `n` samples of all channels, read in pieces of `read` bytes: seconds of each step, best of `repeat` runs.

    `zeros`: the share of bytes that are zero, beside random ones.
    """
    identity = Identity(1, Role.DRIVE, "bench", "0", boot_id=1)
    descriptor = Descriptor.of(channels, ())
    rng = np.random.default_rng(0)
    data = rng.integers(0, 256, n * descriptor.dtype.itemsize, np.uint8)
    data[rng.random(len(data)) < zeros] = 0
    raw = data.view(descriptor.dtype)
    best = Quickest()
    for _ in range(repeat):
        tx = TxQueue(1 << 30)
        table = StreamTable(identity, channels, ByteCarrier(tx))
        request = StreamSet(0, StreamEvent.PWM, 1, 100, tuple(c.id for c in channels))
        reply = table.configure(request, 1024)
        table.start(1)
        with best.timed("encode"):
            table.push_samples(0, 0, raw)
        table.stop(1)
        wire = tx.take()

        host = HostSession()
        config = StreamConfig.of(identity, request, reply, descriptor)
        decoder = SampleDecoder(config, host.tick_reference(1))
        pieces = [wire[k : k + read] for k in range(0, len(wire), read)]
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
        assert joined.tobytes() == raw.tobytes()  # random bits are no number, as float32
        assert decoder.counters.lost_by_index == decoder.counters.lost_by_seq == 0
        assert host.counters.framing.bad == 0
    return best


def rows(short: bool) -> Iterator[Row]:
    """The figures, in M samples/s on one core; the columns are those of every channel in float64."""
    n, repeat = (5_000, 1) if short else (500_000, 3)
    for channels, read, zeros in (
        (WORDS, 65_536, 0.0),
        (WORDS, 8192, 0.0),
        (WORDS, 65_536, ZEROS),
        (DRIVE_CHANNELS, 65_536, 0.0),
        (DRIVE_CHANNELS, 8192, 0.0),
    ):
        took = measure(channels, read, n, repeat, zeros)
        size = Descriptor.of(channels, ()).dtype.itemsize
        what = f"{size} B samples of {len(channels)} channels, reads of {read // 1024} KiB"
        what += f", {zeros:.0%} zeros" if zeros else ""
        yield speed(f"{what}: decode", n / 1e6 / took["decode"], "M samples/s")
        yield speed(f"{what}: and all in SI", n / 1e6 / (took["decode"] + took["columns"]), "M samples/s")
        if read == 8192:
            yield speed(f"{what}: encode, by the device", n / 1e6 / took["encode"], "M samples/s")

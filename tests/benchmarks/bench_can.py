"""CAN: decoding of stream frames, and a whole run over slcan at more than 5000 frames a second.

python -m tests.benchmarks can

Frames are decoded as the host does it: rows of CAN_RECORDs as they come from a link, sorted to their stream, to numpy
columns with index, tick and account of losses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import SimpleNamespace

import numpy as np

from protocol.canmap.device import CanDevice
from protocol.canmap.frame import CAN_RECORD, RECORD_BYTES, BusRates
from protocol.canmap.host import CanWire
from protocol.descriptor import Descriptor
from protocol.device.app import Identity
from protocol.device.tx import TxQueue
from protocol.messages import Role, StreamEvent, StreamSet
from protocol.signals import DRIVE_CHANNELS
from protocol.streams import StreamConfig, TickReference
from protocol.text import counted
from protocol.wire import StreamFrames
from tests.benchmarks.bench_live import account, run
from tests.benchmarks.table import Quickest, Row, cost, speed

GOAL = 300.0  # k frames/s
PERIOD = 1250  # ticks
CLASSIC = BusRates(1_000_000)
FD = BusRates(1_000_000, 5_000_000)
BATCHES = (60, 500)  # frames: 12 ms and 100 ms of a busy CAN FD bus
BEAT = 1600  # PWM periods between heartbeats
FRAMES = 100_000
CHANNELS = ("hall", "status", "theta_enc", "i_a", "i_b", "i_c", "theta_vt", "omega_vt")


def recorded(rates: BusRates, names: Sequence[str], frames: int) -> tuple[bytes, StreamConfig]:
    """Return CAN_RECORDs of the drive's channels with random values, and their stream."""
    channels = [channel for channel in DRIVE_CHANNELS if channel.name in names]
    app = SimpleNamespace(channels=channels, parameters=(), outputs_on=False, enter_state=lambda state: None)
    device = CanDevice(app, Identity(1, Role.DRIVE, "bench", "0", 1), rates, tx=TxQueue(1 << 30))
    descriptor = Descriptor.of(channels, ())
    request = StreamSet(0, StreamEvent.PWM, 1, 20, tuple(channel.id for channel in channels))
    reply = device.session.streams.configure(request, 1024)
    device.session.streams.start(1)
    rng = np.random.default_rng(0)
    data, index = bytearray(), 0
    while len(data) < frames * RECORD_BYTES:
        raw = rng.integers(0, 256, BEAT * descriptor.dtype.itemsize, np.uint8).view(descriptor.dtype)
        device.session.advance(index * PERIOD)  # a heartbeat
        device.session.push_samples(index, index * PERIOD, raw)
        data += device.tx.take()
        index += BEAT
    return bytes(data), StreamConfig.of(device.session.identity, request, reply, descriptor)


def ours(rates: BusRates, config: StreamConfig, data: bytes, batch: int, repeat: int) -> float:
    """Return the frames/s at which `data` become columns, `batch` frames at a time; the best of `repeat` runs."""
    parts = [data[k : k + batch * RECORD_BYTES] for k in range(0, len(data), batch * RECORD_BYTES)]
    best = Quickest()
    for _ in range(repeat):
        wire = CanWire(rates)
        decoder = wire.decoder(config, TickReference())
        with best.timed():
            for part in parts:
                for item in wire.feed(part, 0.0):
                    if isinstance(item, StreamFrames):
                        decoder.decode(item.frames)
        assert decoder.counters.lost_by_index == decoder.counters.out_of_order == 0
        assert decoder.counters.frames == int(np.isin(np.frombuffer(data, CAN_RECORD)["id"], decoder.ids).sum())
    return len(data) / RECORD_BYTES / best[""]


def _decoding(frames: int, repeat: int) -> Iterator[Row]:
    for names, rates in ((("i_a",), CLASSIC), (CHANNELS, FD)):
        data, config = recorded(rates, names, frames)
        what = f"{rates}, {config.block} samples of {counted(len(config.channels), 'channel')} a frame"
        for batch in BATCHES:
            fast = ours(rates, config, data, batch, repeat)
            goal = GOAL if batch == BATCHES[-1] else None
            yield speed(f"{what}, {batch} at a time", fast / 1e3, "k frames/s", goal)


def rows(short: bool) -> Iterator[Row]:
    """The figures."""
    seconds, frames, repeat = (2.0, 2_000, 1) if short else (60.0, FRAMES, 3)
    yield from _decoding(frames, repeat)
    # 4000 frames of samples and, at 3000 r/min, some 1200 of edges a second
    where = ["--slcan", "--fd", "--bitrate", str(FD.bitrate), "--data-bitrate", str(FD.data_bitrate)]
    summary, streamed, drive_cpu, _, _ = run(seconds, where, ["--speed", "3000", "--channels", ",".join(CHANNELS)])
    what = f"slcan on a pty, {FD}, {streamed}"
    yield Row(f"{what}: frames", summary["bus"]["frames"] / summary["duration_s"], "frames/s", 5000)
    yield Row(f"samples in {seconds:g} s", summary["samples"], "", round(0.99 * seconds * 16000))
    yield from account(summary)
    yield Row("load of the bus, measured", 100 * summary["bus"]["load"], "%")
    yield cost("host with recording", summary["cpu_percent"], "% of a core", 40)
    yield cost("simulated drive and bus", drive_cpu, "% of a core")
    yield Row("sample to sink, p99", summary["latency_ms"]["p99"], "ms", at_most=True)

"""CAN: decoding of stream frames beside cantools, and a whole run over slcan at more than 5000 frames a second.

python -m tests.benchmarks can [--seconds 60]

Frames are decoded as the host does it: rows of CAN_RECORDs as they come from a link, sorted to their stream, to numpy
columns with index, tick and account of losses. cantools decodes the same frames with the DBC that we write.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import SimpleNamespace

import cantools
import numpy as np

from bench.device.dbc import NodeStream, dbc_text
from protocol.canmap.device import CanDevice
from protocol.canmap.frame import CAN_RECORD, RECORD_BYTES, BusRates
from protocol.canmap.host import CanWire
from protocol.canmap.ids import CanClass
from protocol.descriptor import Descriptor
from protocol.device.app import Identity
from protocol.device.tx import TxQueue
from protocol.messages import Role, StreamEvent, StreamSet
from protocol.signals import DRIVE_CHANNELS
from protocol.streams import StreamConfig, TickReference
from protocol.wire import StreamFrames
from tests.benchmarks.bench_live import account, run
from tests.benchmarks.table import Quickest, Row

GOAL = 300e3  # frames/s
PERIOD = 1250  # ticks
CLASSIC = BusRates(1_000_000)
FD = BusRates(1_000_000, 5_000_000)
BATCHES = (60, 500)  # frames: 12 ms and 100 ms of a busy CAN FD bus
BEAT = 1600  # PWM periods between heartbeats
OF_CANTOOLS = 20_000  # frames: it is slow
CHANNELS = ("hall", "status", "theta_enc", "i_a", "i_b", "i_c", "theta_vt", "omega_vt")


def recorded(rates: BusRates, names: Sequence[str], decimation: int, frames: int) -> tuple[bytes, StreamConfig]:
    """Return CAN_RECORDs of the drive's channels with random values, and their stream."""
    channels = [channel for channel in DRIVE_CHANNELS if channel.name in names]
    app = SimpleNamespace(channels=channels, parameters=(), outputs_on=False, enter_state=lambda state: None)
    device = CanDevice(app, Identity(1, Role.DRIVE, "bench", "0", 1), rates, tx=TxQueue(1 << 30))
    descriptor = Descriptor.of(channels, ())
    request = StreamSet(0, StreamEvent.PWM, decimation, 20, tuple(channel.id for channel in channels))
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


def ours(rates: BusRates, config: StreamConfig, data: bytes, batch: int, repeat: int = 3) -> float:
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


def theirs(rates: BusRates, config: StreamConfig, data: bytes) -> float:
    """Return the frames/s of cantools."""
    database = cantools.database.load_string(dbc_text([NodeStream("drive", config)], rates, False), "dbc")
    records = np.frombuffer(data, CAN_RECORD)
    records = records[records["id"] >> 8 >= CanClass.SAMPLES][:OF_CANTOOLS]
    frames = [(int(record["id"]), record["data"][: record["length"]].tobytes()) for record in records]
    start = time.perf_counter()
    for number, content in frames:
        database.decode_message(number, content)  # type: ignore[union-attr]
    return len(frames) / (time.perf_counter() - start)


def rows(seconds: float) -> list[Row]:
    """The figures."""
    out = []
    for name, rates, names, decimation in (
        ("classic, 3 samples of 1 channel", CLASSIC, ("i_a",), 1),
        ("FD, 4 samples of 8 channels", FD, CHANNELS, 1),
    ):
        data, config = recorded(rates, names, decimation, 100_000)
        slow = theirs(rates, config, data)
        for batch in BATCHES:
            fast = ours(rates, config, data, batch)
            goal = GOAL / 1e3 if batch == BATCHES[-1] else None
            out.append(Row(f"{name}, {batch} at a time", fast / 1e3, "k frames/s", goal))
        out.append(Row(f"{name}, cantools", slow / 1e3, "k frames/s"))
        out.append(Row(f"{name}: ours is", fast / slow, "x quicker"))
    # 4000 frames of samples and, at 3000 r/min, some 1200 of edges a second
    where, options = ["--slcan", "--fd"], ["--speed", "3000", "--channels", ",".join(CHANNELS)]
    summary, drive_cpu = run(seconds, where, options)
    frames = summary["bus"]["frames"] / summary["duration_s"]
    return [
        *out,
        Row("slcan, FD 1/5 Mbit/s, on a pty", frames, "frames/s", 5000),
        Row("samples", summary["samples"], "", round(0.99 * seconds * 16000)),
        *account(summary),
        Row("load of the bus, measured", 100 * summary["bus"]["load"], "%"),
        Row("host with recording", summary["cpu_percent"], "% of a core", 40, at_most=True),
        Row("simulated drive and bus", drive_cpu, "% of a core"),
        Row("sample to sink, p99", summary["latency_ms"]["p99"], "ms"),
    ]

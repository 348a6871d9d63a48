"""A run for the tests of exports, made up of all that may come, and the oracle: raw values straight from its files.

75 s, so that there are two segments; three channels' names, units or values are not what a drive of ours has.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from bench.device.heard import Missing, Note, ParameterSet
from bench.device.losses import Continuity
from bench.record.info import Mark, RunInfo, SummaryText
from bench.record.writer import RunWriter
from bench.signal.verdict import Verdict
from protocol.descriptor import Channel
from protocol.host import DeviceEventReceived, HeartbeatReceived
from protocol.messages import DeviceEvent, DriveState, EventCode, Fault, Heartbeat, StreamEvent
from protocol.signals import Flag, RawType, Unit
from protocol.streams import EdgeChunk, Gap, SampleChunk, StreamConfig

TICK_HZ, PWM_HZ, EVERY = 20_000_000, 16_000, 160  # a sample of 160 PWM periods: 100 a second
TICKS = TICK_HZ // PWM_HZ
ANGLE = float(np.float32(math.pi / 32768))
CHANNELS = (
    Channel(1, "hall", Unit.NONE, RawType.U8, 1.0, Flag.CHANNEL),
    Channel(2, "theta_enc", Unit.RAD, RawType.I16, ANGLE, Flag.CHANNEL | Flag.REFERENCE | Flag.WRAPS),
    Channel(3, "u_dc", Unit.V, RawType.U16, float(np.float32(0.0123)), Flag.CHANNEL, 1.7),
    Channel(4, "temperature", Unit.DEG_C, RawType.F32, float(np.float32(0.1)), Flag.CHANNEL, -40.0),
    Channel(5, "time", Unit.S, RawType.U32, 1 / 1024, Flag.CHANNEL),
    Channel(6, "tau", Unit.NM, RawType.I32, 1 / 3, Flag.CHANNEL),
    Channel(7, "i.a", Unit.A, RawType.F32, 1.0, Flag.CHANNEL),
)
OTHER = (
    Channel(1, "omega_m", Unit.RAD_PER_S, RawType.F32, 1.0, Flag.CHANNEL),
    Channel(2, "J", Unit.KGM2, RawType.I8, 1e-6, Flag.CHANNEL),
)
SAMPLES = StreamConfig(1, 0, 7, StreamEvent.PWM, EVERY, CHANNELS, 10, tick_hz=TICK_HZ, pwm_hz=PWM_HZ)
EDGES = StreamConfig(1, 1, 8, StreamEvent.EDGES, 1, (), 100, tick_hz=TICK_HZ, pwm_hz=PWM_HZ)
LOAD = StreamConfig(2, 0, 3, StreamEvent.PWM, 10 * EVERY, OTHER, 10, tick_hz=TICK_HZ, pwm_hz=PWM_HZ)
START = 1000 * PWM_HZ  # index of the first sample
NOTE = 'all "well", he said;\nΩ as ever'
NEWEST = (START + 7499 * EVERY) * TICKS  # when 75 s have come
HEARTBEAT = Heartbeat(
    (START + 5) * TICKS, 9, Fault(0), Fault(0), 4, 2, 0, 1, 0, 200, DriveState.RUNNING, True, edges=3
)  # fmt: skip


def info() -> RunInfo:
    return RunInfo(TICK_HZ, PWM_HZ, CHANNELS, {"n_p": 6.0, "odd": math.nan}, {"serial": "X-1", "versions": {"a": "2"}})


def samples(config: StreamConfig, index: np.ndarray, gaps: tuple[Gap, ...] = (), seed: int = 1) -> SampleChunk:
    """Random samples of all values that there are; of floats some are no numbers."""
    rng = np.random.default_rng([seed, int(index[0])])
    raw = np.empty(len(index), config.dtype)
    for channel in config.channels:
        if channel.raw == RawType.F32:
            raw[channel.name] = rng.normal(size=len(index))
            raw[channel.name][::7] = rng.choice([np.nan, np.inf, -np.inf], len(index[::7]))
        else:
            kind = np.iinfo(channel.raw.dtype)
            raw[channel.name] = rng.integers(kind.min, kind.max, len(index), kind.dtype, endpoint=True)
    return SampleChunk(config, index, index * TICKS, raw, gaps)


def edges(index: np.ndarray) -> EdgeChunk:
    rng = np.random.default_rng(int(index[0]))
    n = len(index)
    tick = START * TICKS + index * 3_000_017  # no multiple of a PWM period
    codes = rng.integers(0, 8, (2, n), np.uint8)
    return EdgeChunk(EDGES, tick, *codes, rng.random(n) < 0.2, rng.integers(0, 4000, n, np.uint16), index, ())


def record(path: Path, seconds: int = 75) -> Path:
    """The run: a gap within a chunk, an outage that no gap tells, a node 2, and everything that is said."""
    writer, continuity = RunWriter(path, info()), Continuity()
    writer.take(DeviceEventReceived(1, DeviceEvent(START * TICKS - 500, EventCode.STATE_CHANGED, 1, 3.0, 0.25)))
    writer.take(HeartbeatReceived(1, HEARTBEAT))
    writer.take(HeartbeatReceived(1, HEARTBEAT))  # tells nothing new
    per_second = PWM_HZ // EVERY
    for second in range(seconds):
        if second == 30:
            continue  # an outage
        index = START + (second * per_second + np.arange(per_second, dtype=np.int64)) * EVERY
        gaps: tuple[Gap, ...] = ()
        if second == 12:
            index, gaps = np.delete(index, [40, 41, 42]), (Gap(40, 3, 1, True),)
        writer.take(edges(np.arange(second * 6, second * 6 + 6, dtype=np.int64)))
        writer.take(continuity.chunk(samples(SAMPLES, index, gaps)))
        load = START + (second * 10 + np.arange(10, dtype=np.int64)) * 10 * EVERY
        writer.take(continuity.chunk(samples(LOAD, load, seed=2)))
    writer.take(ParameterSet(NEWEST, 1, "k_p", math.inf))
    writer.take(Note(NEWEST, NOTE, "WARN"))
    writer.take(Mark("step.rise", at(10), at(20), Verdict.FAIL))
    writer.take(Mark("by hand", at(5), at(6)))
    writer.take(Missing(NEWEST, 2, 4, 1))
    writer.take(SummaryText("# Summary"))
    writer.close()
    return path


def at(seconds: float) -> int:
    """Tick, `seconds` after the first sample."""
    return round(START * TICKS + seconds * TICK_HZ)


# -- the oracle -----------------------------------------------------------------------------------------------------


def stored(run: Path, stream: str) -> pa.Table:
    """A stream as it is stored, read with nothing of ours."""
    return pa.concat_tables([pq.read_table(file) for file in sorted(run.glob(f"{stream}-0*.parquet"))])


def expected(run: Path, stream: str) -> dict[str, tuple[np.ndarray, str]]:
    """Values in their unit, and the unit, by the name that an export gives: raw * scale + offset in float64."""
    table = stored(run, stream)
    found: dict[str, tuple[np.ndarray, str]] = {}
    for field, column in zip(table.schema, table.columns, strict=True):
        raw, told = column.to_numpy(), field.metadata or {}
        if field.name == "tick":
            found["time"] = raw / float(json.loads(table.schema.metadata[b"hallbench:run"])["tick_hz"]), "s"
            found["tick"] = raw, ""
        elif b"offset" in told:
            name = "time_" if field.name == "time" else field.name
            values = raw.astype(np.float64) * float(told[b"scale"]) + float(told[b"offset"])
            found[name] = values, told[b"unit"].decode()
        else:
            found[field.name] = raw, ""
    return found


def said(run: Path) -> list[dict[str, Any]]:
    """The lines of the log, with nothing of ours."""
    return [json.loads(line) for line in (run / "run.jsonl").read_text().splitlines()]

"""A made-up drive's telemetry for tests of the sinks: kinematics, Hall edges by Table I, plain currents.

No dynamics.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from bench.device.heard import Note
from bench.device.losses import Continuity
from bench.record.info import RunInfo
from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.view import schema
from bench.view.viewing import write_rrd
from protocol.descriptor import Channel, Descriptor
from protocol.host import DeviceEventReceived, HeartbeatReceived
from protocol.messages import DeviceEvent, DriveState, EventCode, Fault, Heartbeat, StreamEvent
from protocol.signals import DRIVE_CHANNELS, AngleSource, RawType
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

TICK_HZ, PWM_HZ = 20_000_000, 16_000
TICKS = TICK_HZ // PWM_HZ
N_P = 6
TABLE_I = np.radians([-1.2, -3.0, 7.2, -3.3, 0.6, 5.6])
CODES = np.array([0b001, 0b011, 0b010, 0b110, 0b100, 0b101], np.uint8)
CHANNELS = Descriptor.of(DRIVE_CHANNELS, ()).channels


def wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return (angle + np.pi) % (2 * np.pi) - np.pi


def config(channels=CHANNELS, cfg_id: int = 7) -> StreamConfig:
    return StreamConfig(1, 0, cfg_id, StreamEvent.PWM, 1, tuple(channels), 15, tick_hz=20_000_000, pwm_hz=16_000)


EDGE_CONFIG = StreamConfig(1, 1, 8, StreamEvent.EDGES, 1, (), 100, tick_hz=20_000_000, pwm_hz=16_000)


def named(*names: str) -> tuple[Channel, ...]:
    return tuple(channel for channel in CHANNELS if channel.name in names)


def run_info(**changes) -> RunInfo:
    values = {
        "tick_hz": TICK_HZ,
        "pwm_hz": PWM_HZ,
        "channels": CHANNELS,
        "parameters": {"n_p": 6.0, "i_max": 8.0},
        "identity": {"drive": "synthetic", "target": "test"},
    } | changes
    return RunInfo(**values)


@dataclass
class SyntheticRun:
    """Samples and edges of `seconds`, from device time `start`; speed rises to `rpm` over the first quarter."""

    seconds: float
    rpm: float = 500.0
    start: float = 100.0  # s of device time
    seed: int = 1
    config: StreamConfig = field(default_factory=config)

    def __post_init__(self) -> None:
        n = round(self.seconds * PWM_HZ)
        rng = np.random.default_rng(self.seed)
        self.index = round(self.start * PWM_HZ) + np.arange(n, dtype=np.int64)
        self.tick = self.index * TICKS
        t = np.arange(n) / PWM_HZ
        omega = N_P * self.rpm * 2 * np.pi / 60 * np.clip(t / (0.25 * self.seconds), 0.02, 1.0)
        theta = np.cumsum(omega) / PWM_HZ
        self._edges(theta)
        sector_time = np.searchsorted(self.edge_tick, self.tick, side="right") - 1
        passed = np.append(self.edge_tick, 0)  # one is there even where the shaft rests
        since = np.where(sector_time < 0, 0, self.tick - passed[np.maximum(sector_time, 0)]) / TICK_HZ
        theta_avg = np.where(sector_time < 0, 0.3, sector_time * np.pi / 3 + np.pi / 3 + np.minimum(omega * since, 1.2))
        hall_wave = 0.05 * np.sin(3 * theta) + 0.03 * np.sin(theta + 0.4)
        theta_vt = theta + hall_wave * 0.6 + 0.004 * rng.normal(size=n) + 0.3 * np.exp(-t / 0.1)
        i_q = 2.0 + 2.0 * (t > 0.6 * self.seconds)
        u = 0.00655 * omega
        late = t > 0.5 * self.seconds
        error = wrap(theta - np.where(late, theta_vt, theta_avg))
        values = {
            "hall": self._code(theta),
            "status": int(DriveState.RUNNING)
            | (np.where(late, AngleSource.VECTOR_TRACKING, AngleSource.AVERAGE_SPEED) << 5)
            | np.where(omega > 60, 16, 0),
            "theta_enc": wrap(theta),
            "omega_enc": omega + rng.normal(size=n),
            "u_alpha": u * np.cos(theta + 1.6),
            "u_beta": u * np.sin(theta + 1.6),
            "u_dc": np.full(n, 24.0) + 0.02 * rng.normal(size=n),
            "i_d": -i_q * np.sin(error) + 0.05 * rng.normal(size=n),
            "i_q": i_q * np.cos(error) + 0.05 * rng.normal(size=n),
            "i_q_ref": i_q,
            "omega_ref": omega,
            "theta_avg": wrap(theta_avg),
            "omega_avg": omega * (1 + hall_wave),
            "theta_vt": wrap(theta_vt),
            "omega_vt": omega * (1 + 0.1 * hall_wave),
            "e_alpha": -u * np.sin(theta),
            "e_beta": u * np.cos(theta),
        }
        for phase, name in enumerate(("i_a", "i_b", "i_c")):
            angle = theta - error + np.pi / 2 - phase * 2 * np.pi / 3
            values[name] = i_q * np.cos(angle) + 0.05 * rng.normal(size=n)
        self.raw = np.zeros(n, self.config.dtype)
        for channel in self.config.channels:
            if channel.name in values and channel.raw != RawType.F32:
                info = np.iinfo(channel.raw.dtype)
                counts = np.rint((values[channel.name] - channel.offset) / channel.scale)
                self.raw[channel.name] = np.clip(counts, info.min, info.max)

    def _code(self, theta: NDArray[np.float64]) -> NDArray[np.uint8]:
        return CODES[(np.searchsorted(self.edge_theta, theta, side="right")) % 6]

    def _edges(self, theta: NDArray[np.float64]) -> None:
        k = np.arange(1, int(theta[-1] / (np.pi / 3)) + 2)
        positions = k * np.pi / 3 - TABLE_I[k % 6]
        self.edge_theta = positions[positions < theta[-1]]
        row = np.interp(self.edge_theta, theta, np.arange(len(theta)))
        self.edge_tick = np.rint(self.tick[0] + row * TICKS).astype(np.int64)
        count = np.arange(1, len(self.edge_theta) + 1)
        self.edge_new = CODES[count % 6]
        self.edge_old = CODES[(count - 1) % 6]

    def chunks(self, samples: int = 160) -> Iterator[SampleChunk | EdgeChunk]:
        """Chunks as a client delivers them: edges first, then the samples that cover them."""
        sent = 0
        for first in range(0, len(self.index), samples):
            part = slice(first, min(first + samples, len(self.index)))
            upto = int(np.searchsorted(self.edge_tick, self.tick[part.stop - 1], side="right"))
            if upto > sent:
                yield self.edge_chunk(sent, upto)
                sent = upto
            yield SampleChunk(self.config, self.index[part], self.tick[part], self.raw[part], ())

    def sample_chunks(self, samples: int = 160) -> list[SampleChunk]:
        return [chunk for chunk in self.chunks(samples) if isinstance(chunk, SampleChunk)]

    def edge_chunk(self, first: int, stop: int) -> EdgeChunk:
        n = stop - first
        return EdgeChunk(
            EDGE_CONFIG,
            self.edge_tick[first:stop],
            self.edge_old[first:stop],
            self.edge_new[first:stop],
            np.zeros(n, bool),
            (np.arange(first, stop) * 2400 // 60).astype(np.uint16),
            np.arange(first, stop, dtype=np.int64) + 5,
            (),
        )

    def feed(self, *sinks, samples: int = 160) -> None:
        """Give everything to the sinks, with a heartbeat ten times a second and a few events."""
        next_beat = int(self.tick[0])
        for sink in sinks:
            sink.take(
                DeviceEventReceived(
                    1, DeviceEvent(int(self.tick[0]), EventCode.STATE_CHANGED, 1, float(DriveState.RUNNING))
                )
            )
        for chunk in self.chunks(samples):
            for sink in sinks:
                sink.take(chunk)
            while chunk.tick[-1] >= next_beat:
                for sink in sinks:
                    sink.take(HeartbeatReceived(1, heartbeat(next_beat)))
                next_beat += TICK_HZ // 10
        for sink in sinks:
            sink.take(Note(int(self.tick[-1]), "all of it"))


def recorded(path: Path, *chunks: SampleChunk | EdgeChunk, **changes) -> Path:
    """A recording of these chunks, in a run with these changes, as they come through a client."""
    sink = RunSink(path, run_info(**changes), wait=True)
    for chunk in map(Continuity().chunk, chunks):
        sink.take(chunk)
    sink.close()
    return path


def heartbeat(tick: int, **changes) -> Heartbeat:
    values = {
        "tick": tick,
        "boot_id": 1,
        "faults": Fault(0),
        "first_fault": Fault(0),
        "tx_dropped": 0,
        "rx_bad": 0,
        "setpoint_counter": 0,
        "setpoints_rejected": 0,
        "last_tid": 0,
        "watchdog_ms": 200,
        "state": DriveState.RUNNING,
        "outputs_on": True,
    } | changes
    return Heartbeat(**values)


def viewed(path: Path) -> Path:
    """What rerun's viewer is given of a recording: written beside it the first time. An .rrd is that itself."""
    rrd = path.with_suffix(".rrd")
    if not rrd.exists():
        write_rrd(Run(path), rrd)
    return rrd


def column(path: Path, entity: str, component: str) -> list[tuple[int, Any]]:
    """Times in ns and values of a component as the viewer has them, in order of time; the last that was logged last."""
    found: list[tuple[int, Any]] = []
    for chunk in RrdReader(viewed(path)).stream().filter(content=f"/{entity}").to_chunks():
        batch = chunk.to_record_batch()
        if component in batch.schema.names and schema.TIMELINE in batch.schema.names:
            times = batch.column(schema.TIMELINE).cast("int64").to_pylist()
            found += zip(times, batch.column(component).to_pylist(), strict=True)
    return sorted(found, key=lambda row: row[0])


def components(path: Path) -> dict[str, dict[str, int]]:
    """Entities that the viewer is given of a recording, their components, and how many values each of them has."""
    found: dict[str, dict[str, int]] = {}
    for chunk in RrdReader(viewed(path)).stream().to_chunks():
        batch = chunk.to_record_batch()
        entity = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            entity[name] = entity.get(name, 0) + len(batch) - batch.column(name).null_count
    return found

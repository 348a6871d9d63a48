"""Runs of the simulated drive in virtual time for docs/observers.md: what it does, recorded. Nothing is measured here.

In the runs that are recorded for the scoreboard the encoder is in the control loop, so that all observers see the same.
The noise of a run is that of its name, so the same version makes the same recordings again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

import numpy as np

from bench.analysis.units import RPM
from bench.device.client import Client, SinkBase
from bench.device.node import DRIVE, LOAD, Node
from bench.errors import NodeError
from bench.rerunio.schema import RunInfo
from bench.rerunio.sinks import FileSink
from protocol.messages import DriveState
from protocol.signals import AngleSource
from protocol.streams import SampleChunk
from sim.config.params import BenchParams, load_params
from sim.ports.virtual import VirtualLink

SPEEDS = (50, 100, 200, 500, 1000, 2000, 3000)  # r/min
LOADS = (1.0, 4.0, 8.0)  # A of q current
BACKWARDS = (2000, 500, 100)  # r/min, at 4 A
SLOPE = 500.0  # rad/s2 of a forced speed: the observers follow, and no current steps while they are scored as steady
SETTLING = 0.2  # s after a change of the speed: the scoreboard takes 0.1 s of it for a transient
LIGHT, FULL = 4.0, 7.0  # A that the load steps are worth; 8 A is the drive's limit and leaves nothing to recover with
LEARNING = 2.0  # s of each of the speeds of `learning`
CHANNELS = ("theta_enc", "omega_enc", "i_a", "i_q")


class Rig:
    """Drive and load machine of a new simulated bench, with the table of its edges as parameters where `table` is set.

    `path`: the file that the run is recorded to.
    """

    def __init__(self, name: str, observer: AngleSource, table: bool = True, path: Path | None = None) -> None:
        self.params = load_params(None, {"load.alpha_m_max": SLOPE})
        self.client = Client(VirtualLink.of(self.params, crc32(name.encode())))
        hello = self.client.connect()
        self.drive, self.load = Node(self.client, DRIVE), Node(self.client, LOAD)
        if table:
            for key, value in edges(self.params).items():
                self.drive.set(key, value)
        self.drive.set("observer", observer)
        self.channels = self.drive.channels(None if path else CHANNELS)
        self.sink: FileSink | Kept = Kept()
        if path:
            parameters = self.drive.parameters()
            info = RunInfo(
                hello.tick_hz, hello.pwm_hz, self.channels, parameters, {"target": "virtual:"}, node=hello.node
            )
            self.sink = FileSink(path, info, wait=True)
        self.client.sinks = [self.sink]
        self.drive.set_edges()
        self.drive.set_samples(self.channels, 1)
        self.drive.start_streams()

    @property
    def amperes(self) -> float:
        """N m of an ampere of q current."""
        motor = self.params.motor
        return 1.5 * motor.n_p * motor.psi_f

    def force(self, rpm: float) -> None:
        """The load machine holds the shaft at this speed, and the drive keeps its q current."""
        self.load.speed(rpm * RPM)

    def run(self, seconds: float) -> None:
        """Let it run."""
        self.client.run_for(seconds)

    def start(self, *, load_first: bool = False) -> None:
        """Both machines on, at rest."""
        for node in (self.load, self.drive) if load_first else (self.drive, self.load):
            node.arm()
            node.start()

    def kept(self) -> dict[str, np.ndarray]:
        """Of a run that is not recorded: the channels since the last call."""
        assert isinstance(self.sink, Kept)
        return self.sink.take()

    def end(self) -> None:
        """Both machines off, the recording closed."""
        self.drive.stop()
        self.load.stop()
        self.run(0.05)
        if isinstance(self.sink, FileSink):
            self.sink.close()


class Kept(SinkBase):
    """Keeps the samples since the last `take`."""

    def __init__(self) -> None:
        self._chunks: list[SampleChunk] = []

    def samples(self, chunk: SampleChunk) -> None:
        """See `Sink`."""
        self._chunks.append(chunk)

    def take(self) -> dict[str, np.ndarray]:
        """The channels by name, in their units, and forget them."""
        chunks, self._chunks = self._chunks, []
        return {name: np.concatenate([chunk.physical(name) for chunk in chunks]) for name in CHANNELS}


def edges(params: BenchParams) -> dict[str, float]:
    """The table that commissioning would find: where the simulated sensors switch, as parameters of the drive, rad."""
    half = 0.5 * params.hall.hysteresis_deg
    return {
        f"edge_{way}_{s}": math.radians(delta + sign * half)
        for way, sign in (("up", -1.0), ("down", 1.0))
        for s, delta in enumerate(params.hall.delta_deg, 1)
    }


def steady(rig: Rig) -> None:
    """The whole range of speeds and loads, and some of it backwards."""
    rig.run(0.2)
    rig.start(load_first=True)
    held = [(rpm, load) for load in LOADS for rpm in SPEEDS] + [(-rpm, 4.0) for rpm in BACKWARDS]
    before = 0.0
    for rpm, load in held:
        rig.force(rpm)
        rig.drive.current(load)
        rig.run(abs(rpm - before) * RPM / SLOPE + SETTLING + max(0.3, 60.0 / abs(rpm)))
        before = rpm
    rig.drive.current(0.0)


def start_up(rig: Rig) -> None:
    """From rest, 30 deg off the middle of the sector, to 500 r/min."""
    rig.run(0.2)
    rig.start()
    rig.drive.speed(500 * RPM)
    rig.run(0.6)


def speed_step(rig: Rig) -> None:
    """500 to 1000 r/min and back, near no load."""
    start_up(rig)
    for rpm in (1000, 500):
        rig.drive.speed(rpm * RPM)
        rig.run(0.5)


def load_step_light(rig: Rig) -> None:
    """Near no load to what 4 A make, at 500 r/min."""
    start_up(rig)
    rig.load.torque(LIGHT * rig.amperes)
    rig.run(0.6)


def load_step_full(rig: Rig) -> None:
    """Near no load to what 7 A make, at 500 r/min."""
    start_up(rig)
    rig.load.torque(FULL * rig.amperes)
    rig.run(0.6)


def reversal(rig: Rig) -> None:
    """From 500 to -500 r/min near no load."""
    start_up(rig)
    rig.drive.speed(-500 * RPM)
    rig.run(0.6)


def learning(rig: Rig) -> None:
    """50 r/min at 4 A, with 1000 r/min at 1 A in between, from a drive that knows nothing of its edges."""
    rig.run(0.2)
    rig.start(load_first=True)
    for rpm, load in ((50, 4.0), (1000, 1.0), (50, 4.0)):
        rig.force(rpm)
        rig.drive.current(load)
        rig.run(1000 * RPM / SLOPE + LEARNING)


EVENTS: dict[str, Callable[[Rig], None]] = {
    "start_up": start_up,
    "speed_step": speed_step,
    "load_step_light": load_step_light,
    "load_step_full": load_step_full,
    "reversal": reversal,
}
"""What the scoreboard sees beside `steady`."""


def record(folder: Path) -> dict[str, Path]:
    """All recordings by name, in `folder`."""
    paths = {}
    for name, course in {"steady": steady, **EVENTS, "learning": learning}.items():
        paths[name] = folder / f"{name}.rrd"
        rig = Rig(name, AngleSource.ENCODER, table=name != "learning", path=paths[name])
        course(rig)
        rig.end()
    return paths


@dataclass(frozen=True)
class InTheLoop:
    """What became of the drive with one observer in its control loop."""

    currents: dict[int, tuple[np.ndarray, np.ndarray]]
    """By speed, r/min: electrical angle, rad unwrapped, and i_a, A, at 4 A; without those that tripped."""
    tripped: dict[int, str]
    """The others: the faults' names."""
    course: list[str]
    """What happened, a stage each: empty where the shaft ended at its speed."""


STAGES = {
    "start to 500 r/min": (500.0, 0.0),
    "load of 4 A": (500.0, LIGHT),
    "load of 7 A": (500.0, FULL),
    "reversal to -500 r/min": (-500.0, 0.0),
    "-50 r/min": (-50.0, 0.0),
}
"""What the drive does alone: speed in r/min, and what the load is worth in A."""


def in_the_loop(observer: AngleSource) -> InTheLoop:
    """Three speeds, held by the load machine, at 4 A; then a start, two load steps and a reversal on its own."""
    currents: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    tripped: dict[int, str] = {}
    for rpm in (500, 1000, 2000):
        rig = Rig(f"forced {rpm}", observer)
        rig.start(load_first=True)
        rig.force(rpm)
        with suppress(NodeError):  # it has tripped
            rig.drive.current(4.0)
        rig.run(rpm * RPM / SLOPE + 0.3)
        rig.kept()
        rig.run(0.25)
        seen = rig.kept()
        if rig.drive.state == DriveState.FAULT:
            tripped[rpm] = f"trips: {rig.drive.fault_text()}"
        else:
            currents[rpm] = np.unwrap(seen["theta_enc"]), seen["i_a"]
        rig.end()
    return InTheLoop(currents, tripped, _course(Rig("course", observer)))


def _course(rig: Rig) -> list[str]:
    """What happened in each of `STAGES`; after a trip no others follow."""
    found: list[str] = []
    rig.start()
    for target, load in STAGES.values():
        rig.load.torque(0.0)
        rig.run(0.4)
        with suppress(NodeError):  # it has tripped
            rig.drive.speed(target * RPM)
        rig.load.torque(load * rig.amperes)
        rig.run(0.7)
        rig.kept()
        rig.run(60.0 / abs(target))
        rpm = rig.kept()["omega_enc"] / (RPM * rig.params.motor.n_p)
        if rig.drive.state == DriveState.FAULT:
            found.append(f"trips: {rig.drive.fault_text()}")
            break
        mean, low, high = rpm.mean(), rpm.min(), rpm.max()
        if high - low > abs(target):
            found.append(f"swings from {low:.0f} to {high:.0f} r/min")
        else:
            found.append("" if abs(mean - target) < 0.1 * abs(target) else f"ends at {mean:.0f} r/min")
    rig.end()
    return found

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

from bench.errors import NodeError
from bench.rig.drive import RanAway
from bench.rig.outputs import Recording
from bench.rig.rig import Plan, Rig
from bench.signal.sources import source_number
from bench.signal.units import RPM
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


def rig_for(name: str, observer: str, table: bool = True, path: Path | None = None) -> Rig:
    """A new simulated bench, with the table of its edges as parameters where `table` is set; recorded to `path`."""
    params = load_params(None, {"load.alpha_m_max": SLOPE})
    rig = Rig(Plan(lambda: VirtualLink.of(params, crc32(name.encode())), "virtual:", virtual=True))
    drive = rig.drive.node
    for key, value in (edges(params) if table else {}).items():
        drive.set(key, value)
    number = source_number(observer)
    assert number is not None, observer
    drive.set("observer", number)
    return rig.prepare([drive.channels(None if path else CHANNELS)], Recording(path))


def start(rig: Rig, *, load_first: bool = False) -> None:
    """Both machines on, at rest."""
    for machine in reversed(rig.machines) if load_first else rig.machines:
        machine.energise()


def force(rig: Rig, rpm: float) -> None:
    """The load machine holds the shaft at this speed, and the drive keeps its q current."""
    rig.load.speed(rpm=rpm)


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
    rig.wait(0.2)
    start(rig, load_first=True)
    held = [(rpm, load) for load in LOADS for rpm in SPEEDS] + [(-rpm, 4.0) for rpm in BACKWARDS]
    before = 0.0
    for rpm, load in held:
        force(rig, rpm)
        rig.drive.current(load)
        rig.wait(abs(rpm - before) * RPM / SLOPE + SETTLING + max(0.3, 60.0 / abs(rpm)))
        before = rpm
    rig.drive.current(0.0)


def start_up(rig: Rig) -> None:
    """From rest, 30 deg off the middle of the sector, to 500 r/min."""
    rig.wait(0.2)
    start(rig)
    rig.drive.speed(rpm=500)
    rig.wait(0.6)


def speed_step(rig: Rig) -> None:
    """500 to 1000 r/min and back, near no load."""
    start_up(rig)
    for rpm in (1000, 500):
        rig.drive.speed(rpm=rpm)
        rig.wait(0.5)


def load_step_light(rig: Rig) -> None:
    """Near no load to what 4 A make, at 500 r/min."""
    start_up(rig)
    rig.load.torque(LIGHT * rig.drive.torque_constant)
    rig.wait(0.6)


def load_step_full(rig: Rig) -> None:
    """Near no load to what 7 A make, at 500 r/min."""
    start_up(rig)
    rig.load.torque(FULL * rig.drive.torque_constant)
    rig.wait(0.6)


def reversal(rig: Rig) -> None:
    """From 500 to -500 r/min near no load."""
    start_up(rig)
    rig.drive.speed(rpm=-500)
    rig.wait(0.6)


def learning(rig: Rig) -> None:
    """50 r/min at 4 A, with 1000 r/min at 1 A in between, from a drive that knows nothing of its edges."""
    rig.wait(0.2)
    start(rig, load_first=True)
    for rpm, load in ((50, 4.0), (1000, 1.0), (50, 4.0)):
        force(rig, rpm)
        rig.drive.current(load)
        rig.wait(1000 * RPM / SLOPE + LEARNING)


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
        paths[name] = folder / f"{name}.run"
        with rig_for(name, "encoder", table=name != "learning", path=paths[name]) as rig:
            course(rig)
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


def in_the_loop(observer: str) -> InTheLoop:
    """Three speeds, held by the load machine, at 4 A; then a start, two load steps and a reversal on its own."""
    currents: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    tripped: dict[int, str] = {}
    for rpm in (500, 1000, 2000):
        with rig_for(f"forced {rpm}", observer) as rig, rig.drive.may_trip():
            start(rig, load_first=True)
            force(rig, rpm)
            with suppress(NodeError):  # it has tripped
                rig.drive.current(4.0)
            rig.wait(rpm * RPM / SLOPE + 0.3)
            seen = rig.record(0.25)
            if rig.drive.faults:
                tripped[rpm] = f"trips: {', '.join(rig.drive.faults)}"
            else:
                currents[rpm] = seen.theta, seen["i_a"]
    with rig_for("course", observer) as rig, rig.drive.may_trip():
        return InTheLoop(currents, tripped, _course(rig))


def _course(rig: Rig) -> list[str]:
    """What happened in each of `STAGES`; after a trip, or a motor that ran away, no others follow."""
    found: list[str] = []
    start(rig)
    for target, load in STAGES.values():
        try:
            rig.load.torque(0.0)
            rig.wait(0.4)
            with suppress(NodeError):  # it has tripped
                rig.drive.speed(rpm=target)
            rig.load.torque(load * rig.drive.torque_constant)
            rig.wait(0.7)
            rpm = rig.record(60.0 / abs(target))["omega_enc"] / (RPM * rig.drive.n_p)
        except RanAway:
            found.append("runs away")
            break
        if rig.drive.faults:
            found.append(f"trips: {', '.join(rig.drive.faults)}")
            break
        mean, low, high = rpm.mean(), rpm.min(), rpm.max()
        if high - low > abs(target):
            found.append(f"swings from {low:.0f} to {high:.0f} r/min")
        else:
            found.append("" if abs(mean - target) < 0.1 * abs(target) else f"ends at {mean:.0f} r/min")
    return found

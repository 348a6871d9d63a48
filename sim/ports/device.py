"""The simulated bench behind a byte link or on a CAN bus: node 1 is the drive, node 2 the load machine on its shaft.

`SimulatedDevice` runs on periods, not on a clock: whoever owns it decides how fast they pass. It does no I/O.
"""

from __future__ import annotations

import math
import os
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np

from protocol import __version__
from protocol.device.records import LateSamples
from protocol.device.session import DeviceLink, Identity
from protocol.device.tx import TxQueue
from protocol.messages import DriveState, Fault, Feature, Role
from protocol.signals import STATUS_STATE_MASK
from sim.compile import compile_apart
from sim.config.params import BenchParams
from sim.drive import tick, tick_record
from sim.drive.apps import DriveApp, LoadApp
from sim.drive.machine import Recorded, SimulatedBench
from sim.native import Native
from sim.numba_cache import source_hash
from sim.observers import against, sample
from sim.observers.catalogue import CATALOGUE
from sim.ports import can_bits
from sim.ports.networks import ByteNetwork, Network, Session

FIRMWARE = "hallbench-sim"
BUILD = f"{__version__}-{source_hash()[:12]}"
TX_BYTES = 1 << 23  # of a byte link in virtual time: nothing is dropped however long a step
FEATURES = Feature.SIMULATED | Feature.MEANINGS | Feature.MEANS  # of both nodes
OF_THE_DRIVE = Feature.EDGES | Feature.CAPTURE | Feature.COMMISSION | Feature.WAVEFORM
PORTION = 0.075  # s that the bench runs at most before its sessions look at the time


class SimulatedDevice:
    """A simulated bench with its two sessions.

    Args:
        params: the bench.
        seed: of its noise and jitter, and of its boot_id.
        boot_id: another boot_id; give a random one where boots must be told apart.
        store: file that keeps the drive's parameters over a boot; None = PARAM_COMMIT is refused.
        network: how its two devices reach the host, by default a byte link that is never full.
        notice: called with a line of text whenever outputs go on or off.

    Raises:
        ConfigError: the store holds something else than this drive's parameters.
    """

    def __init__(
        self,
        params: BenchParams,
        seed: int = 0,
        *,
        boot_id: int | None = None,
        store: Path | None = None,
        network: Network | None = None,
        notice: Callable[[str], None] | None = None,
    ) -> None:
        self.bench = SimulatedBench(params, seed)
        self.network: Network = ByteNetwork(DeviceLink(TxQueue(TX_BYTES))) if network is None else network
        self.periods = 0
        """PWM periods since boot."""
        clock = params.clock
        self.pwm_hz = clock.pwm_hz
        self._period_ticks = clock.period_ticks
        self._portion = max(1, round(PORTION * clock.pwm_hz))
        self._notice = notice
        boot = random.Random(seed).getrandbits(32) if boot_id is None else boot_id

        def identity(node: int, role: Role, name: str, features: Feature, capture_bytes: int = 0) -> Identity:
            return Identity(
                node, role, name, FIRMWARE, boot, clock.tick_hz, clock.pwm_hz, FEATURES | features,
                tick0=clock.start_tick, serial=f"SIM-{node:04}", build=BUILD, capture_bytes=capture_bytes,
            )  # fmt: skip

        commit = Feature.COMMIT if store is not None else Feature(0)
        drive = DriveApp(self.bench, store)
        self._channels = tuple(drive.channels)
        self.drive: Session = self.network.add(
            drive,
            identity(1, Role.DRIVE, "simulated drive", OF_THE_DRIVE | commit, params.memory.capture),
        )
        self.load: Session = self.network.add(LoadApp(self.bench), identity(2, Role.LOAD, "load machine", Feature(0)))
        self.sessions = (self.drive, self.load)
        self._were_on = [False, False]
        self.network.advance(self.bench.tick)

    @property
    def tick(self) -> int:
        """Device tick of the last sample (of the first, before there is one)."""
        return self.bench.tick - self._period_ticks if self.periods else self.bench.tick

    @property
    def frames_dropped(self) -> int:
        """Stream frames that found no room to wait in."""
        return sum(session.streams.dropped for session in self.sessions)

    def receive(self, data: bytes) -> None:
        """Take bytes from the host, cut anywhere, at the present tick."""
        self.network.receive(data)
        if self._notice:
            self._report(self._watchdogs(), 0, self._notice)

    def advance(self, periods: int) -> None:
        """Run control periods; what they produce waits in `data_to_send`."""
        while periods > 0:
            left = self._watchdogs()
            # the outputs go off on time however long the portions
            n = min(periods, self._portion, math.ceil((min(left) + 1) * self.pwm_hz / 1000))
            self.bench.watch(self.drive.channels)
            recorded = self.bench.advance(n)
            self.periods += n
            periods -= n
            self.network.carry(self.periods / self.pwm_hz)
            if self.load.streams.running:
                self.load.push_samples(recorded.index, recorded.tick, recorded.load_samples)
            tripped = self._tripped(recorded)
            for begin, end in ((0, tripped), (tripped, n)):
                if begin < end:
                    self._push(recorded, begin, end)
            if self._notice:
                self._report(left, n, self._notice)

    def data_to_send(self, limit: int | None = None) -> bytes:
        """Return and forget the bytes that wait for the link, at most `limit`."""
        return self.network.data_to_send(limit)

    def _tripped(self, recorded: Recorded) -> int:
        """After how many of these periods the firmware has found a first fault; all, if it has not."""
        if not self.bench.faults or self.drive.machine.faults:
            return len(recorded)
        states = recorded["status"].view(np.int64) & STATUS_STATE_MASK
        return int(np.argmax(states == DriveState.FAULT)) + 1

    def _push(self, recorded: Recorded, begin: int, end: int) -> None:
        """Give the drive's session the periods from `begin` up to `end`, then let both sessions look at the time."""
        tick = recorded.tick + begin * self._period_ticks
        last = recorded.tick + (end - 1) * self._period_ticks
        edges = recorded.edges
        if end - begin < len(recorded):
            edges = edges[slice(*np.searchsorted(recorded.edge_tick, [tick - self._period_ticks, last], "right"))]
        self.drive.push_edges(edges)
        samples = LateSamples(end - begin, lambda names: recorded.raw(self._channels, names)[begin:end])
        self.drive.push_samples(recorded.index + begin, tick, samples)
        self.network.advance(last)
        if self.bench.faults:
            self.drive.fault(self.bench.faults)  # does nothing with those that are latched already

    def _watchdogs(self) -> list[int]:
        """ms until each session's watchdog runs out, WATCHDOG_OFF where it is not at work."""
        return [session.machine.watchdog_ms(self.tick) for session in self.sessions]

    def _report(self, left: list[int], periods: int, notice: Callable[[str], None]) -> None:
        """Say what outputs went on or off in the last `periods`, before which `left` was what `_watchdogs` says."""
        for n, session in enumerate(self.sessions):
            on = session.app.outputs_on
            if on == self._were_on[n]:
                continue
            self._were_on[n] = on
            name = f"node {session.identity.node}, {session.identity.name}"
            faults = session.machine.faults
            if on:
                notice(f"outputs on ({name})")
            elif faults & Fault.WATCHDOG:
                unfed = session.app.get_param("watchdog") * 1000 - left[n] + periods * 1000 / self.pwm_hz
                notice(f"outputs off {unfed:.0f} ms after the last ALIVE: watchdog ({name})")
            else:
                notice(f"outputs off: {faults.name if faults else 'STOP'} ({name})")


def kernels() -> list[Native]:
    """All that comes compiled."""
    return [*_of_a_device(), against.fold]


def _of_a_device() -> list[Native]:
    """The loop first, which takes as long as all the others."""
    observers = dict.fromkeys(entry.function for entry in CATALOGUE.values())
    return [tick.advance, tick.advance_usual, tick_record.pack, sample.run, can_bits.count, *observers]


def compile_all() -> None:
    """Compile and load what a device may run, before it runs in real time: it must not stand still for an observer.

    In virtual time nothing waits, and each function is compiled when it is first used.
    """
    loop, *others = _of_a_device()
    compile_apart([loop], others)
    for one in (loop, *others):
        one.load()


def random_boot_id() -> int:
    """A boot_id that no earlier boot had, for all practical purposes."""
    return int.from_bytes(os.urandom(4), "little")

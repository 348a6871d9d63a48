"""The simulated bench behind a byte link: node 1 is the drive, node 2 the load machine on its shaft.

`SimulatedDevice` runs on periods, not on a clock: whoever owns it decides how fast they pass. It does no I/O.
"""

from __future__ import annotations

import math
import os
import random
from collections.abc import Callable
from pathlib import Path

from protocol.device import DeviceLink, DeviceSession, Identity
from protocol.device_state import WATCHDOG_OFF
from protocol.device_tx import TxQueue
from protocol.messages import Fault, Feature, Role
from sim.drive.apps import DriveApp, LoadApp
from sim.drive.machine import SimulatedBench
from sim.params import BenchParams

FIRMWARE = "hallbench-sim"
PORTION = 0.075  # s that the bench runs at most before its sessions look at the time


class SimulatedDevice:
    """A simulated bench with its two sessions on one link.

    Args:
        params: the bench.
        seed: of its noise and jitter, and of its boot_id.
        boot_id: another boot_id; give a random one where boots must be told apart.
        store: file that keeps the drive's parameters over a boot; None = PARAM_COMMIT is refused.
        tx_bytes: stream bytes that may wait for the link; what does not fit is dropped and counted.
        capacity: bytes/s that the link carries, None = unknown; streams that need more are refused.
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
        tx_bytes: int = 1 << 16,
        capacity: float | None = None,
        notice: Callable[[str], None] | None = None,
    ) -> None:
        self.bench = SimulatedBench(params, seed)
        self.link = DeviceLink(TxQueue(bulk_limit=tx_bytes, capacity=capacity))
        self._delimiters = 0
        self.periods = 0
        """PWM periods since boot."""
        clock = params.clock
        self.pwm_hz = clock.pwm_hz
        self._period_ticks = clock.period_ticks
        self._portion = max(1, round(PORTION * clock.pwm_hz))
        self._notice = notice
        boot = random.Random(seed).getrandbits(32) if boot_id is None else boot_id

        def identity(node: int, role: Role, name: str, features: Feature) -> Identity:
            return Identity(node, role, name, FIRMWARE, boot, clock.tick_hz, clock.pwm_hz, features)

        commit = Feature.COMMIT if store is not None else Feature(0)
        self.drive: DeviceSession = self.link.add(
            DriveApp(self.bench, store),
            identity(1, Role.DRIVE, "simulated drive", Feature.EDGES | Feature.SIMULATED | commit),
        )
        self.load: DeviceSession = self.link.add(
            LoadApp(self.bench), identity(2, Role.LOAD, "load machine", Feature.SIMULATED)
        )
        self._sessions = (self.drive, self.load)
        self._were_on = [False, False]
        self.link.advance(self.bench.tick)

    @property
    def sessions(self) -> tuple[DeviceSession, DeviceSession]:
        """Drive and load machine."""
        return self._sessions

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
        self.link.receive(data)
        if self._notice:
            self._report([0.0, 0.0], self._notice)

    def advance(self, periods: int) -> None:
        """Run control periods; what they produce waits in `data_to_send`."""
        while periods > 0:
            n = min(periods, self._portion, self._until_watchdog())
            unfed = [self._unfed(session) + n / self.pwm_hz for session in self._sessions] if self._notice else []
            recorded = self.bench.advance(n)
            self.periods += n
            periods -= n
            self.drive.push_edges(recorded.edges)
            self.drive.push_samples(recorded.index, recorded.tick, recorded.samples)
            self.load.push_samples(recorded.index, recorded.tick, recorded.load_samples)
            self.link.advance(self.tick)
            if self.bench.faults:
                self.drive.fault(self.bench.faults)  # does nothing with those that are latched already
            if self._notice:
                self._report(unfed, self._notice)

    @property
    def has_data(self) -> bool:
        """Whether anything waits for the link."""
        return len(self.link.tx) > 0

    def data_to_send(self, limit: int | None = None) -> bytes:
        """Return and forget the bytes that wait for the link, at most `limit`."""
        fits = limit is None or len(self.link.tx) <= limit
        data = self.link.data_to_send(None if fits else limit)  # all at once is quicker than frame by frame
        self._delimiters += data.count(0)
        return data

    @property
    def frames_sent(self) -> int:
        """Frames given to the link: each lies between two zero bytes, and there are no others."""
        return self._delimiters // 2

    def _until_watchdog(self) -> int:
        """Periods until a watchdog may run out, so that the outputs go off on time however long the portions."""
        left = min(session.machine.watchdog_ms(self.tick) for session in self._sessions)
        return math.ceil((left + 1) * self.pwm_hz / 1000)

    def _unfed(self, session: DeviceSession) -> float:
        """Seconds since the session's watchdog was fed, 0 where it is not at work."""
        left = session.machine.watchdog_ms(self.tick)
        return 0.0 if left == WATCHDOG_OFF else session.app.get_param("watchdog") - left / 1000

    def _report(self, unfed: list[float], notice: Callable[[str], None]) -> None:
        for n, session in enumerate(self._sessions):
            on = session.app.outputs_on
            if on == self._were_on[n]:
                continue
            self._were_on[n] = on
            name = f"node {session.identity.node}, {session.identity.name}"
            faults = session.machine.faults
            if on:
                notice(f"outputs on ({name})")
            elif faults & Fault.WATCHDOG:
                notice(f"outputs off {unfed[n] * 1000:.0f} ms after the last ALIVE: watchdog ({name})")
            else:
                notice(f"outputs off: {faults.name if faults else 'STOP'} ({name})")


def random_boot_id() -> int:
    """A boot_id that no earlier boot had, for all practical purposes."""
    return int.from_bytes(os.urandom(4), "little")

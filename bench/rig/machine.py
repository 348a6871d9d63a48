"""A node that can turn the shaft, drive or load machine: energised, watched, switched off, its parameters put back."""

from __future__ import annotations

from collections.abc import Callable

from bench.device.client import WATCHDOG
from bench.device.node import Node
from bench.device.safety import is_off
from bench.errors import BenchError, OutputsMayBeOn
from bench.rig.envelope import Envelope
from bench.rig.restore import not_put_back, put_back
from bench.signal.units import RPM
from protocol.codes import Fault, fault_names
from protocol.messages import DriveState


class Machine:
    """Node `node`, within `envelope`."""

    title = "the machine"
    advice = ""
    """What to do where this program did not feed the watchdog, to follow these words."""
    place = ""
    """Where its parameters are, after "not restored", if it is not the drive."""
    agreed: Callable[[], None] = staticmethod(lambda: None)
    """Called before it is energised; raises where nobody agrees to that."""

    def __init__(self, node: Node, envelope: Envelope) -> None:
        self.node = node
        self.envelope = envelope
        self.on = False
        """From before it is armed until it was seen to be off."""
        self._energised = False  # whether it ever was, from here
        self._before: dict[str, float] = {}  # parameters that were set, in that order, as they were before

    def __repr__(self) -> str:
        return f"{self.title} {self.state.name}"

    @property
    def name(self) -> str:
        """It, and where it is, to begin a sentence with."""
        return self.title

    @property
    def watchdog(self) -> float:
        """s that it waits for ALIVE."""
        return WATCHDOG

    @property
    def state(self) -> DriveState:
        """By the last heartbeat."""
        return self.node.state

    def energise(self) -> None:
        """Arm and start. NodeError where it refuses, DriveFailed where it does not do what it answers."""
        self.agreed()
        self.node.require_alive()
        self.on = self._energised = True  # before it is: whatever happens, it gets a STOP
        self.node.arm()
        self.node.start()

    def stop(self) -> DriveState:
        """Outputs off, from any state, and seen to be off. Raises DriveFailed or OutputsMayBeOn."""
        ours, self.on = self.on or self._energised, False
        try:
            return self.node.stop()
        except OutputsMayBeOn:
            heartbeat = self.node.client.heartbeats.get(self.node.number)
            if not ours and heartbeat is not None and is_off(heartbeat):  # nobody here has switched it on
                return heartbeat.state
            self.on = True
            raise

    def trouble(self) -> str:
        """Why it does not run as it should, while it is on; empty while it does."""
        if self.on and self.node.state == DriveState.FAULT:
            return self.tripped()
        return f"{self.title}: {why}" if (why := self.node.astray()) else ""

    def look(self) -> None:
        """Raise BenchError for `trouble`."""
        if words := self.trouble():
            raise BenchError(words)

    def tripped(self) -> str:
        """That it has, by which faults, and why its watchdog has run out, if it has and the reason is here."""
        client, number = self.node.client, self.node.number
        faults = client.faults.get(number, Fault(0))
        words = f"{self.name} tripped: {', '.join(fault_names(faults))}"
        if unfed := self.unfed():
            advice = self.advice if client.starved(number, self.watchdog) else ""
            return f"{words}: {unfed}{advice}"
        return words

    def unfed(self) -> str:
        """Why its watchdog ran out; empty if it has not."""
        return self.node.unfed(self.node.client.faults.get(self.node.number, Fault(0)), self.watchdog)

    def put_back(self) -> None:
        """Every parameter as it was before. All of it is tried; the first error is raised at the end.

        Not while outputs may still be on: limits that were lowered stay as they are then.
        """
        if not self.on:
            put_back(self.node, self._before)

    def not_put_back(self) -> str:
        """Parameters that are not as they were before, as a part of a sentence; empty where all are."""
        return not_put_back(self._before, self.place)


def require_announced_speed(what: str, omega_m: float, envelope: Envelope) -> None:
    """Raise BenchError if `omega_m`, mechanical rad/s, is beyond the speed that was announced."""
    require_announced(what, abs(omega_m) / RPM, envelope.rpm, "r/min", "rpm")


def require_announced(what: str, value: float, limit: float, unit: str, argument: str) -> None:
    """Raise BenchError if `value` is beyond what was announced by that argument."""
    if not value <= limit * (1 + 1e-9):
        raise BenchError(
            f"{what} {value:.4g} {unit} is beyond the announced limit of {limit:g} {unit}: @energises({argument}=…), "
            f"or limits=Envelope({argument}=…)"
        )

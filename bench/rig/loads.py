"""What turns or brakes the shaft: a second node, a class of the user's own, or a person who is asked.

A load says what it can do in `abilities`: "torque" (N·m against the drive's positive direction) and "speed" (forced,
mechanical rad/s, and no faster than the test announced). Nothing here decides when it acts; `off` always works and is
always called at a test's end.

A class of one's own needs no base class. One object is made of it at first use and kept for all tests; its `close`,
if it has one, is called after the last:

    class Brake:
        abilities = {"torque"}
        def __init__(self): self.port = pyvisa.ResourceManager().open_resource("TCPIP::…")
        def torque(self, tau): self.port.write(f"TORQ {tau:.3f}")
        def off(self): self.port.write("OUTP OFF")
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Collection
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Protocol

from bench.device.node import Node
from bench.errors import BenchError
from bench.rig.envelope import Envelope
from bench.rig.machine import Machine, require_announced_speed
from bench.rig.restore import try_all
from bench.signal.units import shaft_speed
from protocol.errors import HbpError
from protocol.messages import DriveState

TORQUE, SPEED = "torque", "speed"
LOAD_SPEED = "load.speed"


class Load(Protocol):
    """What a test does with a load."""

    @property
    def abilities(self) -> Collection[str]:
        """Of `torque` and `speed`."""

    def torque(self, tau: float) -> None:
        """Brake with `tau` N·m against the drive's positive direction."""

    def speed(self, *, rpm: float | None = None, rad_s: float | None = None) -> None:
        """Force the shaft to a mechanical speed, in one of two units. BenchError beyond what was announced."""

    def off(self) -> None:
        """Leave the shaft alone; from any state, as often as one likes."""


class NoLoad:
    """Where there is none: who asks for one is told."""

    abilities: frozenset[str] = frozenset()

    def torque(self, tau: float = 0.0, **speed: float | None) -> None:
        """BenchError."""
        raise BenchError("there is no load: no node 2 answers on the drive's link, or bench.toml has load = none")

    speed = torque

    def off(self) -> None:
        """Nothing."""


class NodeLoad(Machine):
    """A load machine that speaks HBP: node 2 on the drive's link, or a device on a link of its own."""

    title = "the load machine"
    place = " in the load machine"
    abilities = frozenset((TORQUE, SPEED))

    def __init__(self, node: Node, envelope: Envelope) -> None:
        super().__init__(node, envelope)
        self.forced: float | None = None
        """The speed that it forces on the shaft, mechanical rad/s."""
        self._armed = False
        self._told = False  # that it has tripped since it is on

    def torque(self, tau: float) -> None:
        """See `Load`."""
        self.start()
        self.node.torque(tau)
        self.forced = None

    def speed(self, *, rpm: float | None = None, rad_s: float | None = None) -> None:
        """See `Load`."""
        omega_m = shaft_speed(rpm, rad_s)
        require_announced_speed(LOAD_SPEED, omega_m, self.envelope)
        self.start()
        self.forced = omega_m
        self.node.speed(omega_m)

    def start(self) -> None:
        """Arm and start, if it is not on. BenchError if it is, and has tripped."""
        if self.on:
            self.look()
            return
        self._armed = self._told = False
        self.energise()
        self._armed = True

    def set(self, name: str, value: float) -> None:
        """Set a parameter; `off` puts back what it was."""
        self._before.setdefault(name, self.node.parameter(name).value)
        self.node.set(name, value)

    def off(self) -> None:
        """STOP, and every parameter as it was before; BenchError if it has tripped and nobody was told."""
        try_all([self._stop, self.put_back])

    def _stop(self) -> None:
        self.forced = None
        if not self.on:
            return
        told, state = self._told, self.stop()
        if state == DriveState.FAULT and self._armed:  # a fault that was there before is not this test's to clear
            self.node.next_heartbeat()  # it names the fault
            tripped = self.tripped()
            self.node.clear_faults()
            if not told:
                raise BenchError(tripped)

    @property
    def name(self) -> str:
        """See `Machine.name`."""
        return f"{self.title}, node {self.node.number} on {self.node.client.link.name},"

    def tripped(self) -> str:
        """See `Machine.tripped`; whoever asks, tells it."""
        self._told = True
        return super().tripped()


class PersonLoad:
    """Somebody with a brake and a knob. `ask` tells them what to do and returns when it is done."""

    abilities = frozenset((TORQUE,))

    def __init__(self, ask: Callable[[str], None]) -> None:
        self._ask = ask
        self._set = 0.0

    def torque(self, tau: float) -> None:
        """Ask for a torque."""
        if tau != self._set:
            self._ask(f"Set the brake to {tau:.3f} N·m")
            self._set = tau

    def speed(self, *, rpm: float | None = None, rad_s: float | None = None) -> None:
        """BenchError: it takes a machine."""
        raise BenchError("a person with a brake cannot force a speed")

    def off(self) -> None:
        """Ask to release the brake, if it was set."""
        if self._set:
            with suppress(BenchError):  # the drive is off, and nobody may be there any more
                self.torque(0.0)


class OwnLoad:
    """An object of the user's class, whose errors become one line."""

    envelope = Envelope()
    """What the present test announced."""

    def __init__(self, name: str, own: object) -> None:
        self.forced: float | None = None
        """See `NodeLoad`."""
        self._name = name
        self._own = own
        for method in ("torque", "off"):
            if not callable(getattr(own, method, None)):
                raise BenchError(f"load {name}: the class has no method {method}()")

    @property
    def abilities(self) -> Collection[str]:
        """What the class says, or what methods it has."""
        default = {TORQUE, SPEED} if callable(getattr(self._own, SPEED, None)) else {TORQUE}
        return frozenset(getattr(self._own, "abilities", default))

    def torque(self, tau: float) -> None:
        """See `Load`."""
        self._call("torque", tau)
        self.forced = None

    def speed(self, *, rpm: float | None = None, rad_s: float | None = None) -> None:
        """See `Load`."""
        omega_m = shaft_speed(rpm, rad_s)
        require_announced_speed(LOAD_SPEED, omega_m, self.envelope)
        self.forced = omega_m
        self._call("speed", omega_m)

    def off(self) -> None:
        """See `Load`."""
        self.forced = None
        self._call("off")

    def close(self) -> None:
        """It is used no more."""
        if callable(getattr(self._own, "close", None)):
            self._call("close")

    def _call(self, method: str, *arguments: float) -> None:
        try:
            getattr(self._own, method)(*arguments)
        except (HbpError, BenchError):
            raise
        except Exception as error:
            raise BenchError(f"load {self._name}: {method}() raised {type(error).__name__}: {error}") from error


class OwnLoads:
    """The objects of the user's classes that a session has made: one of each."""

    def __init__(self) -> None:
        self._made: dict[tuple[str, Path], OwnLoad] = {}

    def get(self, text: str, directory: Path, envelope: Envelope) -> OwnLoad:
        """See `own_load`; made at first use, and from now on for a test that announced `envelope`."""
        key = (text, directory.absolute())
        if key not in self._made:
            self._made[key] = own_load(text, directory)
        self._made[key].envelope = envelope
        return self._made[key]

    def close(self) -> None:
        """Close all of them, whatever one of them raises; that is a BenchError."""
        with ExitStack() as stack:
            while self._made:
                stack.callback(self._made.popitem()[1].close)


def own_load(text: str, directory: Path) -> OwnLoad:
    """An object of the class that `text` names as FILE.py:Class, relative to `directory`. BenchError if none."""
    file, _, name = text.rpartition(":")
    path = directory / file
    spec = importlib.util.spec_from_file_location(f"hallbench_load_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise BenchError(f"load '{text}': no Python file {path}; write it as my_brake.py:Brake")
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # where dataclasses look for it
    try:
        spec.loader.exec_module(module)
        own = getattr(module, name)()
    except Exception as error:
        raise BenchError(f"load '{text}': {type(error).__name__}: {error}") from error
    return OwnLoad(text, own)

"""A host for tests: the project's own client over any link, one call for one thing, everything kept."""

from __future__ import annotations

from collections.abc import Callable

from bench.device.client import POLL, Client
from bench.device.heard import Heard, Note
from bench.device.node import DRIVE, LOAD, Node
from bench.signal.chunks import join
from protocol.links import Link
from protocol.messages import (
    Alive,
    Command,
    DriveState,
    EventCode,
    ParamReply,
    ParamSet,
    Payload,
    Request,
    Setpoint,
    SetpointMode,
    StateCommand,
    StreamStop,
)
from protocol.streams import EdgeChunk, SampleChunk
from tests.bench.collect import Collector


class Kept(Collector):
    def take(self, item: Heard) -> None:
        super().take(item._replace(text=f"{item.level}: {item.text}") if isinstance(item, Note) else item)


class SmallHost(Client):
    """`pump` lets the device run, where it does not do so by itself. ALIVE is sent by `alive` and `run` only."""

    def __init__(self, link: Link, pump: Callable[[], None] = lambda: None, wait: float = 0.005) -> None:
        super().__init__(link)
        self.nodes = {number: Node(self, number) for number in (DRIVE, LOAD)}
        self.kept = Kept()
        self.sinks = [self.kept]
        self._pump = pump
        self._wait = wait
        self._alive = 0

    def poll(self, timeout: float = POLL) -> None:
        self._pump()
        super().poll(min(timeout, self._wait))

    def run(self, seconds: float, alive: bool = True) -> None:
        """Let time pass by the link's clock, feeding the watchdogs."""
        end = self.now() + seconds
        next_alive = 0.0
        while self.now() < end:
            if alive and self.now() >= next_alive:
                next_alive = self.now() + 0.05
                self.alive()
            self.poll()

    def request(self, message: Request, node: int = DRIVE, reply: type[Payload] = Payload) -> Payload:
        return super().request(message, node, reply)

    def get(self, name: str, node: int = DRIVE) -> ParamReply:
        return self.nodes[node].parameter(name)

    def set(self, name: str, value: float, node: int = DRIVE) -> float:
        return self.request(ParamSet(self.nodes[node].descriptor.parameter(name).id, value), node).stored

    def command(self, command: Command, argument: int = 0, node: int = DRIVE) -> DriveState:
        return self.request(StateCommand(command, argument), node).state

    def start(self, node: int = DRIVE) -> None:
        """ARM and START."""
        assert self.command(Command.ARM, self.connect().boot_id, node) is DriveState.ARMED
        assert self.command(Command.START, 0, node) is DriveState.RUNNING

    def setpoint(self, mode: SetpointMode, value: float, value2: float = 0.0, node: int = DRIVE) -> None:
        self.session.send(Setpoint(mode, 1, value, value2), node)

    def alive(self) -> None:
        self._alive += 1
        for node in self.nodes:
            self.session.send(Alive(self._alive), node)

    def stream(
        self, names: list[str] | None = None, node: int = DRIVE, edges: bool = True, decimation: int = 1
    ) -> None:
        """Stop all streams, start stream 0 with these channels (default: all) and stream 1 with the edges."""
        self.connect()
        self.request(StreamStop(), node)
        device = self.nodes[node]
        if edges:
            device.set_edges()
        channels = device.descriptor.channels
        device.set_samples(tuple(c for c in channels if names is None or c.name in names), decimation)
        device.start_streams()

    def samples(self, node: int = DRIVE) -> SampleChunk:
        """All that have come."""
        return join([c for c in self.kept.chunks if isinstance(c, SampleChunk) and c.config.node == node])

    def edges(self) -> EdgeChunk:
        """All that have come."""
        return join([c for c in self.kept.chunks if isinstance(c, EdgeChunk)])

    def codes(self, node: int = DRIVE) -> list[tuple[EventCode, float]]:
        """Events of a node as (code, arg)."""
        return [(event.code, event.arg) for each, event in self.kept.events if each == node]

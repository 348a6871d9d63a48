"""A host for tests: the project's own session over any link, one call for one thing, everything kept."""

from __future__ import annotations

from collections.abc import Callable

from protocol.descriptor import Descriptor
from protocol.errors import Refused
from protocol.host import (
    Connected,
    DeviceEventReceived,
    Event,
    HeartbeatReceived,
    HostSession,
    LogReceived,
    ReplyReceived,
    RequestRefused,
    RequestTimedOut,
    StreamFrames,
)
from protocol.links import Link
from protocol.messages import (
    Alive,
    BlobRead,
    Command,
    DeviceEvent,
    DriveState,
    EventCode,
    Heartbeat,
    HelloReply,
    Log,
    ParamGet,
    ParamReply,
    ParamSet,
    Payload,
    Request,
    Setpoint,
    SetpointMode,
    StateCommand,
    StreamEvent,
    StreamSet,
    StreamStart,
    StreamStop,
)
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig
from protocol.wire import Decoder

MOST_READS = 20_000


class SmallHost:
    """`pump` lets the device run, where it does not do so by itself."""

    def __init__(self, link: Link, pump: Callable[[], None] | None = None, wait: float = 0.005) -> None:
        self.link = link
        self.session = HostSession(link.wire())
        self.heartbeats: dict[int, Heartbeat] = {}
        self.events: list[tuple[int, DeviceEvent]] = []
        self.logs: list[Log] = []
        self.samples: dict[tuple[int, int], list[SampleChunk]] = {}
        self.edges: list[EdgeChunk] = []
        self.decoders: dict[tuple[int, int], Decoder] = {}
        self._pump = pump
        self._wait = wait
        self._replies: list[Event] = []
        self._alive = 0

    def poll(self, wait: float | None = None) -> None:
        """Send what is to be sent, read once, take all events."""
        self.session.tick(self.link.clock())
        if data := self.session.data_to_send():
            self.link.write(data)
        if self._pump is not None:
            self._pump()
        data = self.link.read(self._wait if wait is None else wait)
        self.session.receive_data(data, self.link.clock())
        while (event := self.session.next_event()) is not None:
            self._take(event)

    def until(self, condition: Callable[[], bool]) -> None:
        """Poll until something is so."""
        for _ in range(MOST_READS):
            if condition():
                return
            self.poll()
        raise AssertionError(f"not so after {MOST_READS} reads")

    def run(self, seconds: float, alive: bool = True) -> None:
        """Let device time pass, by its heartbeats' or the link's clock, feeding the watchdogs."""
        end = self.link.clock() + seconds
        next_alive = 0.0
        while self.link.clock() < end:
            if alive and self.link.clock() >= next_alive:
                next_alive = self.link.clock() + 0.05
                self.alive()
            self.poll()

    def connect(self, nonce: int = 0x1234, node: int = 0) -> HelloReply:
        self.session.connect(nonce, self.link.clock(), node)
        event = self._answer()
        assert isinstance(event, Connected), event
        return event.hello

    def request(self, message: Request, node: int = 1) -> Payload:
        self.session.request(message, node, self.link.clock())
        event = self._answer()
        if isinstance(event, RequestRefused):
            raise Refused(str(event.error), event.error.code, event.error.detail)
        assert isinstance(event, ReplyReceived), event
        return event.message

    def get(self, name: str, node: int = 1) -> ParamReply:
        return self.request(ParamGet(self.descriptor(node).parameter(name).id), node)

    def set(self, name: str, value: float, node: int = 1) -> float:
        return self.request(ParamSet(self.descriptor(node).parameter(name).id, value), node).stored

    def descriptor(self, node: int = 1) -> Descriptor:
        blob = b""
        while True:
            reply = self.request(BlobRead(0, 1024, len(blob)), node)
            blob += reply.data
            if len(blob) >= reply.total:
                return Descriptor.unpack(blob)

    def command(self, command: Command, argument: int = 0, node: int = 1) -> DriveState:
        return self.request(StateCommand(command, argument), node).state

    def start(self, node: int = 1) -> None:
        """ARM and START."""
        hello = self.connect(node=node)
        assert self.command(Command.ARM, hello.boot_id, node) is DriveState.ARMED
        assert self.command(Command.START, 0, node) is DriveState.RUNNING

    def setpoint(self, mode: SetpointMode, value: float, value2: float = 0.0, node: int = 1) -> None:
        self.session.send(Setpoint(mode, 1, value, value2), node)

    def alive(self) -> None:
        self._alive += 1
        for node in (1, 2):
            self.session.send(Alive(self._alive), node)

    def stream(
        self,
        names: list[str] | None = None,
        node: int = 1,
        edges: bool = True,
        decimation: int = 1,
        latency: int = 20,
    ) -> None:
        """Stop all streams, start stream 0 with these channels (default: all) and stream 1 with the edges."""
        hello = self.connect(node=node)
        self.request(StreamStop(), node)
        channels = self.descriptor(node).channels
        chosen = tuple(c for c in channels if names is None or c.name in names)
        requests = [StreamSet(0, StreamEvent.PWM, decimation, latency, tuple(c.id for c in chosen))]
        if edges:
            requests.insert(0, StreamSet(1, StreamEvent.EDGES, 1, latency))
        for request in requests:
            reply = self.request(request, node)
            config = StreamConfig.of(hello, request, reply, self.descriptor(node))
            self.decoders[node, request.stream] = self.session.decoder(config)
        self.samples[node, 0] = []
        self.request(StreamStart(3 if edges else 1), node)

    def codes(self, node: int = 1) -> list[tuple[EventCode, float]]:
        """Events of a node as (code, arg)."""
        return [(event.code, event.arg) for each, event in self.events if each == node]

    def _answer(self) -> Event:
        self._replies.clear()
        self.until(lambda: bool(self._replies))
        return self._replies.pop()

    def _take(self, event: Event) -> None:
        if isinstance(event, Connected | ReplyReceived | RequestRefused | RequestTimedOut):
            self._replies.append(event)
        elif isinstance(event, HeartbeatReceived):
            self.heartbeats[event.node] = event.heartbeat
        elif isinstance(event, DeviceEventReceived):
            self.events.append((event.node, event.event))
        elif isinstance(event, LogReceived):
            self.logs.append(event.log)
        elif isinstance(event, StreamFrames):
            decoder = self.decoders.get((event.node, event.stream))
            chunk = None if decoder is None else decoder.decode(event.frames)
            if isinstance(chunk, SampleChunk):
                self.samples[event.node, event.stream].append(chunk)
            elif isinstance(chunk, EdgeChunk):
                self.edges.append(chunk)

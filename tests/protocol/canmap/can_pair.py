"""A small drive and a host on a CAN bus in memory: frames pass at once, through a function that may spoil them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from small_drive import SmallDrive, identity, pack_edges, samples

from protocol.canmap.compiled import CompiledCan
from protocol.canmap.device import CanDevice
from protocol.canmap.frame import CAN_RECORD, BusRates
from protocol.canmap.host import CanWire
from protocol.descriptor import Descriptor
from protocol.device.tx import TxQueue
from protocol.host import Event, HostSession, ReplyReceived, RequestRefused, StreamFrames
from protocol.messages import BlobRead, Payload, Request, StreamEvent, StreamReply, StreamSet, StreamStart
from protocol.streams import EdgeChunk, LossCounters, SampleChunk, StreamConfig

CLASSIC = BusRates(1_000_000)
FD = BusRates(1_000_000, 5_000_000)
TICKS = 1250
HZ = 20_000_000

Spoil = Callable[[np.ndarray], np.ndarray]


class CanPair:
    """`now` is both ends' time in s; what spoils a run gets the rows of CAN_RECORDs on their way to the host.

    `in_c`: the device side is that in C, which has queues of its own.
    """

    def __init__(
        self, rates: BusRates, extended: bool = False, node: int = 1, tx: TxQueue | None = None,
        boot_id: int = 0xB0071D, in_c: bool = False, **changes: object,
    ) -> None:  # fmt: skip
        self.app = SmallDrive()
        told = identity(node, boot_id, **changes)
        self.device: CanDevice | CompiledCan
        if in_c:
            self.device = CompiledCan(self.app, told, rates, extended)
        else:
            self.device = CanDevice(self.app, told, rates, extended, tx)
        self.wire = CanWire(rates, node, extended)
        self.host = HostSession(self.wire)
        self.now = 0.0
        self.periods = 0
        self.edges_made = 0
        self._spoil: Spoil = lambda records: records
        self.to_device: list[np.ndarray] = []
        self.events: list[Event] = []
        self.decoders: dict[int, object] = {}
        self.chunks: dict[int, list[SampleChunk | EdgeChunk]] = {}
        self.device.advance(0)

    # -- the bus ----------------------------------------------------------------------------------------------------

    def exchange(self) -> None:
        """Carry what waits in both directions, and take the host's events."""
        sent = self.host.data_to_send()
        self.to_device.append(np.frombuffer(sent, CAN_RECORD))
        self.device.receive(sent)
        self.receive(np.frombuffer(b"".join(iter(self.device.take, b"")), CAN_RECORD))

    def receive(self, records: np.ndarray) -> None:
        records = self._spoil(records).copy()
        records["time"] = self.now
        self.host.receive_data(records.tobytes(), self.now)
        self.take_events()

    def take_events(self) -> None:
        while (event := self.host.next_event()) is not None:
            self.events.append(event)
            if isinstance(event, StreamFrames):
                if event.stream not in self.decoders:
                    continue
                chunk = self.decoders[event.stream].decode(event.frames)
                if chunk is not None:
                    self.chunks[event.stream].append(chunk)

    def run(
        self, periods: int, edges: tuple[int, ...] = (), portion: int = 80, spoil: Spoil = lambda records: records
    ) -> None:
        """Let the device take samples, with frames spoiled meanwhile.

        `edges` are PWM periods, from now on, in the middle of which there is one.
        """
        self._spoil = spoil
        end = self.periods + periods
        at = sorted(self.periods + edge for edge in edges)
        while self.periods < end:
            n = min(portion, end - self.periods)
            mine = [p for p in at if self.periods <= p < self.periods + n]
            if mine:
                self.edge(np.array(mine) * TICKS + TICKS // 2 - TICKS)
            self.device.session.push_samples(self.periods, self.periods * TICKS, samples(self.periods, n))
            self.periods += n
            self.device.advance((self.periods - 1) * TICKS)
            self.now = self.periods * TICKS / HZ
            self.exchange()
        self._spoil = lambda records: records

    def edge(self, ticks: np.ndarray) -> None:
        n = len(ticks)
        old = (1 + (self.edges_made + np.arange(n)) % 6).astype(np.uint8)
        new = (1 + (self.edges_made + 1 + np.arange(n)) % 6).astype(np.uint8)
        self.edges_made += n
        self.device.session.push_edges(
            pack_edges(ticks.astype(np.int64), old, new, np.zeros(n, bool), (ticks % 4096).astype(np.int64))
        )

    # -- requests ---------------------------------------------------------------------------------------------------

    def connect(self, nonce: int = 0x1234) -> None:
        self.host.connect(nonce, self.now)
        self.exchange()

    def ask(self, message: Request, node: int = 1) -> Payload:
        self.host.request(message, node, self.now)
        self.exchange()
        answer = next(e for e in reversed(self.events) if isinstance(e, ReplyReceived | RequestRefused))
        return answer.message if isinstance(answer, ReplyReceived) else answer.error

    def descriptor(self) -> Descriptor:
        blob = b""
        while True:
            reply = self.ask(BlobRead(0, 1024, len(blob)))
            blob += reply.data
            if len(blob) >= reply.total:
                return Descriptor.unpack(blob)

    def stream(
        self, names: tuple[str, ...], decimation: int = 1, edges: bool = True, latency: int = 20,
        event: StreamEvent = StreamEvent.PWM,
    ) -> StreamConfig:  # fmt: skip
        """Configure stream 0 (samples) and 1 (edges) and start them; returns the configuration of the first."""
        descriptor = self.descriptor()
        ids = tuple(descriptor.channel(name).id for name in names)
        mask = 0
        for request in (
            StreamSet(0, event, decimation, latency, ids),
            *((StreamSet(1, StreamEvent.EDGES, 1, latency),) if edges else ()),
        ):
            reply = self.ask(request)
            assert isinstance(reply, StreamReply), reply
            config = StreamConfig.of(self.device.session.identity, request, reply, descriptor)
            self.decoders[request.stream] = self.host.decoder(config)
            self.chunks[request.stream] = []
            mask |= 1 << request.stream
        self.ask(StreamStart(mask))
        return self.decoders[0].config

    # -- what came --------------------------------------------------------------------------------------------------

    def samples(self) -> SampleChunk:
        """All samples, joined; they must be in order and have the values of their index."""
        chunks = self.chunks[0]
        index, tick = (np.concatenate([getattr(c, n) for c in chunks]) for n in ("index", "tick"))
        raw = np.concatenate([c.raw for c in chunks])
        assert (np.diff(index) > 0).all()
        assert (tick == index * TICKS).all()
        expected = samples(int(index[0]), int(index[-1] - index[0]) + 1)[index - index[0]]
        for name in raw.dtype.names:
            assert (raw[name] == expected[name]).all(), name
        return SampleChunk(chunks[0].config, index, tick, raw, ())

    def account(self, decimation: int = 1) -> tuple[SampleChunk, LossCounters]:
        """All samples and what was counted of them: since the first, each one has come or is lost."""
        got, counters = self.samples(), self.decoders[0].counters
        assert counters.samples + counters.lost_by_index == len(range(0, got.index[-1] + 1, decimation))
        return got, counters

    def edges(self) -> EdgeChunk:
        return self.chunks[1]

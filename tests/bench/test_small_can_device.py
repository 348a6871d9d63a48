"""The device side in C with the options of hbp.h as they are, on a CAN bus.

A firmware has room for few frames: whatever a host asks for must come whole, or in parts whose length is told.
"""

from __future__ import annotations

from itertools import pairwise
from types import MappingProxyType
from zlib import crc32

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.device.client import Client
from bench.device.node import Node
from protocol.canmap.compiled import CompiledCan
from protocol.canmap.frame import CAN_RECORD, RECORD_BYTES, BusRates
from protocol.canmap.host import CanWire
from protocol.canmap.ids import CanClass
from protocol.canmap.transport import ID_MASK, START
from protocol.descriptor import Descriptor
from protocol.framing import MAJOR, Frame, parse_frame
from protocol.messages import (
    BlobRead,
    BlobReply,
    CaptureArm,
    CaptureReply,
    CaptureState,
    CaptureStatus,
    CaptureTrigger,
    Feature,
    Hello,
    HelloReply,
    Log,
    MessageType,
    Request,
    StreamEvent,
    StreamGet,
    StreamInfo,
    StreamSet,
)
from protocol.signals import Flag, Parameter, RawType, Signal, Unit
from sim.ports.can_bus import SimulatedBus
from tests.choice import examples
from tests.devices.virtual import VirtualLink
from tests.protocol.small_drive import TICKS, SmallDrive, identity, whole_blob
from tests.tools import needs

pytestmark = needs("C compiler")

TICK_HZ = 20_000_000
CLASSIC, SLOW, FD = BusRates(1_000_000), BusRates(125_000), BusRates(1_000_000, 5_000_000)
BUSES = [
    pytest.param(CLASSIC, "", id="classic"),
    pytest.param(SLOW, "", id="classic, slow"),
    pytest.param(CLASSIC, "HBP_CAN_MESSAGES=64", id="classic, more frames"),
    pytest.param(CLASSIC, "HBP_TX_MAX=1024 HBP_TX_BYTES=4096 HBP_POOL_BYTES=2560", id="classic, longer messages"),
    pytest.param(FD, "HBP_CAN_BYTES=64", id="FD"),
    pytest.param(CLASSIC, "HBP_CAN_BYTES=64", id="classic, compiled for FD"),
]
HOST = 1024  # bytes of a payload that `bench` takes
SMALLEST = 128  # that any device must take and be able to send
HELD = 150  # records of the capture


class LongTables(SmallDrive):
    """A drive with as many channels as hbp.h has room for, a descriptor of three kilobytes, and meanings."""

    channels = tuple(Signal(k, f"channel_{k}", Unit.A, RawType.I16, 0.5, Flag.CHANNEL, "") for k in range(16))
    parameters = tuple(Parameter(100 + k, f"parameter_{k}", Unit.S, -1, 1, Flag.PARAMETER, "") for k in range(80))
    meanings = MappingProxyType({f"channel_{k}": "what it means, in several words" for k in range(16)})

    def __init__(self) -> None:
        super().__init__()
        self.values = {parameter.name: 0.0 for parameter in self.parameters}

    def default_param(self, name: str) -> float:
        return 0.0


def rows(index0: int, n: int) -> np.ndarray:
    """Samples whose values follow from their index."""
    found = np.zeros(n, [(channel.name, channel.raw.dtype) for channel in LongTables.channels])
    for k, channel in enumerate(LongTables.channels):
        found[channel.name] = (np.arange(index0, index0 + n) * (k + 3)) & 0x7FFF
    return found


def made(rates: BusRates, options: str) -> CompiledCan:
    told = identity(features=Feature.EDGES | Feature.CAPTURE | Feature.MEANINGS, capture_bytes=8192)
    device = CompiledCan(LongTables(), told, rates, options=options)
    device.advance(0)
    return device


class BusLink(VirtualLink):
    """A `Link` to a device on a simulated bus, on which each frame takes its time."""

    def __init__(self, device: CompiledCan, rates: BusRates) -> None:
        super().__init__(can=True)
        self._drive, self._rates, self._periods = device, rates, 0
        self._bus = SimulatedBus(rates)
        self._bus.attach(device.take, device.receive, "device", device.receive)
        self._bus.attach(self._next, self._come, "host", self._come)

    def wire(self) -> CanWire:
        return CanWire(self._rates, 1)

    def _next(self) -> bytes:
        record = bytes(self.port.to_device[:RECORD_BYTES])
        del self.port.to_device[:RECORD_BYTES]
        return record

    def _come(self, record: bytes) -> None:
        self.port.to_host += record

    def _turn(self) -> None:
        n = int(self._now * TICK_HZ) // TICKS + 1 - self._periods
        if n > 0:
            self._drive.session.push_samples(self._periods, self._periods * TICKS, rows(self._periods, n))
            self._periods += n
            self._drive.advance((self._periods - 1) * TICKS)
        self._bus.advance(self._now)


@pytest.mark.parametrize(("rates", "options"), BUSES)
def test_bench_reads_all_that_a_small_device_holds(rates: BusRates, options: str) -> None:
    client = Client(BusLink(made(rates, options), rates))
    client.connect()
    node = Node(client, 1)
    assert SMALLEST <= node.identity.tx_max <= HOST
    app = LongTables
    assert node.descriptor.pack() == Descriptor.of(app.channels, app.parameters).pack()
    assert node.meanings() == dict(app.meanings)
    off = CaptureArm(CaptureTrigger.OFF)
    now = CaptureArm(CaptureTrigger.NOW, after=HELD, channels=tuple(channel.id for channel in app.channels))
    for message in (off, now):
        client.request(message, 1, CaptureReply)
    client.run_for(0.1)
    held = client.request(CaptureStatus(), 1, CaptureReply)
    assert (held.state, held.records, held.channels) == (CaptureState.FROZEN, HELD, now.channels)
    data = whole_blob(lambda request: client.request(request, 1, BlobReply), 512)
    assert crc32(data) == held.crc
    assert data == rows(held.index - held.first, HELD).tobytes()
    assert client.session.counters.retries == 0


class Asked:
    """A device whose host takes its frames only when it is told to."""

    def __init__(self, rates: BusRates, options: str) -> None:
        self.device, self._wire, self._tick = made(rates, options), CanWire(rates, 1), 0
        self.transfers: list[int] = []
        """Transfer ids of the answers that came."""
        self.messages()

    def messages(self) -> list[Frame]:
        """All that waits."""
        wire = b"".join(iter(self.device.take, b""))
        for row in np.frombuffer(wire, CAN_RECORD):
            tail = int(row["data"][row["length"] - 1])
            if row["id"] >> 8 & 7 == CanClass.TO_HOST and tail & START:
                self.transfers.append(tail & ID_MASK)
        return [parse_frame(raw) for raw in self._wire.feed(wire, 0.0) if isinstance(raw, bytes)]

    def send(self, request: Request, tid: int) -> None:
        self.device.receive(self._wire.encode(Frame(int(request.TYPE), MAJOR, tid, 1, request.pack())))

    def answers(self) -> list[Frame]:
        return [frame for frame in self.messages() if frame.is_reply]

    def beat(self) -> None:
        """A heartbeat is due."""
        self._tick += TICK_HZ // 10
        self.device.advance(self._tick)


REQUESTS = st.one_of(
    st.builds(BlobRead, st.sampled_from([0, 3]), st.integers(0, 0xFFFF), st.integers(0, 3200)),
    st.builds(Hello, st.integers(0, 2), st.just(1), st.just(1), st.sampled_from([128, 150, 200, 1024, 0xFFFF])),
    st.builds(
        StreamSet, st.integers(0, 1), st.just(StreamEvent.PWM), st.just(64), st.just(0), st.just(tuple(range(16)))
    ),
    st.builds(StreamGet, st.integers(0, 1)),
    st.builds(CaptureStatus),
)


@pytest.mark.parametrize(("rates", "options"), BUSES)
@examples(20, 500, campaign="c")
@given(requests=st.lists(REQUESTS, min_size=1, max_size=20))
def test_each_request_is_answered_even_behind_a_heartbeat(rates: BusRates, options: str, requests: list) -> None:
    """Whether a HELLO has come or not: the answer is whole, and as long as was told."""
    asked, most = Asked(rates, options), HOST
    for tid, request in enumerate(requests, start=1):
        asked.beat()
        asked.send(request, tid)
        (answer,) = asked.answers()
        assert len(answer.payload) <= most
        if answer.is_error:
            continue
        if isinstance(request, Hello):
            told = HelloReply.unpack(answer.payload).tx_max
            assert SMALLEST <= told <= request.rx_max
            most = min(told, HOST)
        elif isinstance(request, BlobRead):
            reply = BlobReply.unpack(answer.payload)
            left = min(request.length, reply.total - request.offset)
            assert len(reply.data) == left or len(answer.payload) >= SMALLEST
        elif isinstance(request, StreamGet):
            assert StreamInfo.unpack(answer.payload).channels == tuple(range(16))


@pytest.mark.parametrize(("rates", "options"), BUSES)
def test_a_line_of_text_comes_however_long_it_is(rates: BusRates, options: str) -> None:
    asked = Asked(rates, options)
    for n in (0, 1, 50, 100, 101, 102, 140, 200, 400, 2000):
        text = "as long as it is " * 200
        asked.device.session.log(6, text[:n])
        (log,) = (Log.unpack(frame.payload) for frame in asked.messages() if frame.type == MessageType.LOG)
        assert log.text == text[: len(log.text)]
        assert len(log.text) == n or len(log.text) > 64


@pytest.mark.parametrize(("rates", "options"), BUSES)
def test_an_answer_that_found_no_room_comes_when_it_is_asked_for_again(rates: BusRates, options: str) -> None:
    """And each transfer has the number after that of the one before, but those that are sent again."""
    asked = Asked(rates, options)
    sent = [BlobRead(0, 512, 32 * tid) for tid in range(40)]
    for tid, request in enumerate(sent, start=1):
        asked.send(request, tid)  # nobody takes an answer
    came = {frame.tid for frame in asked.answers()}
    assert 0 < len(came) < 40
    for tid in (39, 40):
        assert tid not in came
        asked.send(sent[tid - 1], tid)
        (answer,) = asked.answers()
        assert answer.tid == tid
        assert BlobReply.unpack(answer.payload).offset == 32 * (tid - 1)
    asked.send(BlobRead(0, 8, 0), 41)
    asked.answers()
    assert asked.transfers[:-3] == [n % 32 for n in range(len(came))]
    assert [(after - before) % 32 for before, after in pairwise(asked.transfers[-3:])] == [1, 1]

"""How messages and stream frames look on a link, seen from the host: `HostWire`, and the one of byte links.

A wire turns what a link reads into messages (header + payload) and batches of stream frames, in the order they came,
and messages into what a link writes. It knows no requests and no time-outs, and does no I/O.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from protocol.framing import CONNECT_PREAMBLE, MAJOR, Deframer, Frame, ReceiverCounters, encode_frame
from protocol.messages import MessageType, StreamEvent
from protocol.streams import (
    STREAM_OFFSET,
    Beat,
    EdgeChunk,
    EdgeDecoder,
    LossCounters,
    SampleChunk,
    SampleDecoder,
    StreamConfig,
    TickReference,
)


class StreamFrames(NamedTuple):
    """Frames of one stream, DATA or EDGES by `type`, in the order they came: what the stream's decoder takes.

    Edges come before the samples that they precede. On byte links several that follow each other may be one
    (`Deframer.join`).
    """

    node: int
    stream: int
    type: MessageType
    frames: Any


class Decoder(Protocol):
    """Decodes what comes of one configured stream."""

    config: StreamConfig
    counters: LossCounters
    """The stream's account; its records are samples or edges."""

    def decode(self, frames: Any) -> SampleChunk | EdgeChunk | None:
        """Return the records in `StreamFrames.frames`, or None if there are none."""

    def missing(self, first: Beat | None, last: Beat) -> int:
        """Return how many records the device made up to the heartbeat `last`, after those that have come.

        If none has come, they count from `first` on, a heartbeat after STREAM_START; None: not at all. Both are of the
        boot that the stream was configured in.
        """


class HostWire(Protocol):
    """A link's language, at the host's end. `shared`: other hosts may use the link at the same time."""

    shared: bool
    patience: float
    """s that a device may take to answer HELLO after the link was opened."""
    delay: float
    """s after that in which nothing is sent to it."""

    @property
    def counters(self) -> ReceiverCounters:
        """What was heard."""

    def preamble(self) -> bytes:
        """Return what is written before HELLO, and forget what is half received."""

    def encode(self, frame: Frame) -> bytes:
        """Return what is written for a message; its node 0 is the device that the link leads to."""

    def feed(self, data: bytes, now: float) -> Sequence[bytes | StreamFrames]:
        """Return the messages (header + payload) and stream frames that `data` completes.

        `data` as the link read it; `now` in s of the link's clock.
        """

    def decoder(self, config: StreamConfig, reference: TickReference) -> Decoder:
        """Return a decoder for a stream as it was just configured; its frames are looked for from now on."""

    def forget(self, node: int) -> None:
        """The node has rebooted: what was said of its streams is no longer so."""

    def advice(self, heard: bool) -> str:
        """Return what to look at when no device is heard; `heard`: something else came."""

    def unanswered(self, nodes: Sequence[int]) -> str:
        """Return what to look at when these nodes are heard and HELLO is not answered."""


PATIENCE = 3.0  # s that a device may take to answer HELLO


class ByteWire:
    """COBS frames: serial ports, TCP.

    Args:
        baud: rate of a UART, bit/s; inf for what is no UART.
        patience, delay: see `HostWire`.
    """

    shared = False

    def __init__(self, baud: float = math.inf, patience: float = PATIENCE, delay: float = 0.0) -> None:
        self.baud = baud
        self.patience, self.delay = patience, delay
        self._deframer = Deframer()
        self.counters = self._deframer.counters

    def preamble(self) -> bytes:
        """See `HostWire.preamble`."""
        self._deframer.reset()
        return CONNECT_PREAMBLE

    def encode(self, frame: Frame) -> bytes:
        """See `HostWire.encode`."""
        return encode_frame(frame)

    def feed(self, data: bytes, now: float) -> list[bytes | StreamFrames]:
        """See `HostWire.feed`; stream frames between two messages are one batch a stream."""
        out: list[bytes | StreamFrames] = []
        groups: dict[tuple[int, int, int], list[bytes]] = {}
        for raw in self._deframer.feed(data):
            kind = raw[0]
            if (kind == 0x40 or kind == 0x41) and raw[1] & 0x3F == MAJOR and len(raw) >= STREAM_OFFSET:
                groups.setdefault((kind, raw[6], raw[8]), []).append(raw)
            else:
                out += _batches(groups)
                groups.clear()
                out.append(raw)
        return out + _batches(groups)

    def decoder(self, config: StreamConfig, reference: TickReference) -> Decoder:
        """See `HostWire.decoder`."""
        decoder: EdgeDecoder | SampleDecoder
        if config.event == StreamEvent.EDGES:
            kind, decoder = MessageType.EDGES, EdgeDecoder(config, reference)
        else:
            kind, decoder = MessageType.DATA, SampleDecoder(config, reference)
        self._deframer.join(kind, config.node, config.stream, decoder.steps)
        return decoder

    def forget(self, node: int) -> None:
        """See `HostWire.forget`: its frames carry another cfg_id, and their decoders will see that."""

    def advice(self, heard: bool) -> str:
        """See `HostWire.advice`."""
        if heard:
            return "check the baud rate, and that it is an HBP device"
        return "check power, cable, target and baud rate"

    def unanswered(self, nodes: Sequence[int]) -> str:
        """See `HostWire.unanswered`."""
        return "an HBP device is heard, and does not hear this program: check the TX wire and flow control"


def _batches(groups: dict[tuple[int, int, int], list[bytes]]) -> list[StreamFrames]:
    """Turn collected stream frames into batches: edges first, so that they never trail samples."""
    return [
        StreamFrames(node, stream, kind, frames)
        for kind in (MessageType.EDGES, MessageType.DATA)
        for (each, node, stream), frames in groups.items()
        if each == kind
    ]

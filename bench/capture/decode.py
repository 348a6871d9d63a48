"""The bytes of a capture as samples and Hall edges, as they would have come by a stream."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bench.device.node import EDGES, SAMPLES, Node
from bench.errors import NodeError
from bench.signal.capture import Capture
from bench.signal.chunks import no_edge_stream, no_edges
from protocol.descriptor import Channel
from protocol.messages import CaptureReply, StreamEvent
from protocol.streams import EDGE_RECORD, EdgeChunk, Gap, SampleChunk, StreamConfig, unpack_edges
from protocol.text import counted

_WRAP = 1 << 32


@dataclass(frozen=True)
class Captured:
    """A capture that was read: what the drive says of it, its streams, and its bytes, `status.size` of them."""

    status: CaptureReply
    boot_id: int
    stream: StreamConfig
    edge_stream: StreamConfig
    data: bytes

    @cached_property
    def samples(self) -> SampleChunk:
        """Its records, by PWM period and device tick."""
        status, config = self.status, self.stream
        raw = np.frombuffer(self.data, config.dtype, status.records)
        steps = np.arange(status.records, dtype=np.int64) - status.first
        near = status.tick // config.period_ticks
        middle = near + (status.index - near + (_WRAP >> 1)) % _WRAP - (_WRAP >> 1)  # whole, by the tick
        ticks = status.tick + steps * status.decimation * config.period_ticks
        return SampleChunk(config, middle + steps * status.decimation, ticks, raw, ())

    @cached_property
    def edges(self) -> EdgeChunk:
        """Its Hall edges, the gap of those that found no room before the first."""
        status, config = self.status, self.edge_stream
        records = np.frombuffer(self.data, EDGE_RECORD, status.edges, status.records * status.sample_bytes)
        if not len(records):
            return no_edges(config)
        begin = int(self.samples.tick[0])
        low = records["tick"].astype(np.int64)
        since = (low - np.concatenate([[begin], low[:-1]])) % _WRAP
        ticks = begin + np.cumsum(since)
        index = status.first_edge + np.arange(len(records), dtype=np.int64)
        gaps = (Gap(0, status.edges_lost, 0, overrun=True),) if status.edges_lost else ()
        return unpack_edges(config, records, ticks, index, gaps)

    def capture(self, parameters: Mapping[str, float]) -> Capture:
        """The same for measuring, with the drive's `parameters`."""
        first = int(self.samples.tick[0])
        until = int(self.edges.tick[0]) if len(self.edges) else int(self.samples.tick[-1])
        return Capture(self.samples, self.edges, parameters, ((first, until, self.lost),) if self.lost else ())

    @property
    def lost(self) -> str:
        """How many Hall edges are missing, and why; empty where all are there."""
        lost = self.status.edges_lost
        return f"{counted(lost, 'Hall edge')} found no room in the drive's memory" if lost else ""


def streams_of(node: Node, status: CaptureReply, channels: tuple[Channel, ...]) -> tuple[StreamConfig, StreamConfig]:
    """The streams that stand for a capture's samples and edges.

    `channels`: of the capture, in its order. NodeError where they do not make the records that the drive tells, and
    where the trigger's is not among these.
    """
    if not (status.first < status.records and status.after and status.decimation):
        raise NodeError(
            f"node {node.number} tells a capture of {status.records} records, one in {status.decimation} periods, "
            f"{status.first} before its trigger and {status.after} asked for from there on: it has none of a trigger"
        )
    identity = node.identity
    clock = {"tick_hz": identity.tick_hz, "pwm_hz": identity.pwm_hz}
    samples = StreamConfig(
        node.number, SAMPLES, status.number, StreamEvent.PWM, status.decimation, channels, 1, **clock
    )  # fmt: skip
    size = status.records * samples.dtype.itemsize + status.edges * EDGE_RECORD.itemsize
    if samples.dtype.itemsize != status.sample_bytes or size != status.size:
        raise NodeError(
            f"node {node.number} tells {status.records} records of {status.sample_bytes} bytes and {status.edges} "
            f"edges, {status.size} bytes in all; its channels {', '.join(c.name for c in channels)} make "
            f"{samples.dtype.itemsize} bytes a record, {size} in all"
        )
    if not node.offers_edges:
        return samples, no_edge_stream(node.number, **clock)
    return samples, StreamConfig(node.number, EDGES, status.number, StreamEvent.EDGES, 1, (), 1, **clock)

"""What a capture is to hold, and the request that makes a drive hold it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.capture.trigger import Trigger
from bench.device.node import Node
from bench.errors import BenchError, NodeError
from protocol.descriptor import Channel
from protocol.messages import CaptureArm, CaptureTrigger
from protocol.streams import EDGE_RECORD, MAX_DECIMATION
from protocol.text import counted

EDGES_PER_SECOND = 1000.0
"""For which room is kept where nobody knows how fast the shaft can turn."""
MORE_EDGES = 1.25
"""Times as many as the highest speed makes: it is passed on the way to it."""
_SPARE_EDGES = 16


@dataclass(frozen=True)
class Wanted:
    """A capture that somebody wants.

    `seconds` in all, of which the share `pre` (0 to 1) lies before the trigger; `channels` by name, as
    `Node.channels` takes them; `decimation`: PWM periods from sample to sample; `edges`: Hall edges for which room is
    kept, None: as many as the shaft can make.
    """

    trigger: Trigger
    seconds: float = 0.1
    pre: float = 0.2
    channels: Sequence[str] | None = None
    decimation: int = 1
    edges: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.seconds < math.inf:
            raise BenchError(f"a capture lasts more than 0 s, got {self.seconds:g}")
        if not 0.0 <= self.pre <= 1.0:
            raise BenchError(f"the share before the trigger is 0 to 100 %, got {100.0 * self.pre:g} %")
        if not 1 <= self.decimation <= MAX_DECIMATION:
            raise BenchError(
                f"a capture takes every n-th PWM period, n from 1 to {MAX_DECIMATION}, got {self.decimation}"
            )

    def chosen(self, node: Node) -> tuple[Channel, ...]:
        """The channels of the drive that it holds, in the drive's order. NodeError for a name that it does not have."""
        return node.channels(self.channels)

    def request(self, node: Node) -> CaptureArm:
        """The request. Raises BenchError for what the drive does not have, and for more than a request can name."""
        chosen = self.chosen(node)
        most = (node.identity.rx_max - CaptureArm.FIXED_BYTES) // 2
        if len(chosen) > most:
            takes = f"node {node.number} takes at most {counted(most, 'channel')} for a capture"
            raise NodeError(f"{takes}, not {len(chosen)}: choose with --channels (in Python: channels=)")
        at = self.trigger.channel_of(node.descriptor.channels)
        if self.trigger.kind in (CaptureTrigger.ILLEGAL, CaptureTrigger.PULSE) and not node.offers_edges:
            raise NodeError(f"--trigger '{self.trigger.text}': node {node.number} takes no Hall edges down")
        total = max(round(self.seconds * node.identity.pwm_hz / self.decimation), 1)
        pre = 0.0 if self.trigger.kind == CaptureTrigger.NOW else self.pre  # before it nothing is held
        before = min(int(pre * total), total - 1)
        return CaptureArm(
            self.trigger.kind, 0, self.decimation, before, total - before, self.trigger.level,
            0 if at is None else at.id, self._edges(node), tuple(channel.id for channel in chosen),
        )  # fmt: skip

    def _edges(self, node: Node) -> int:
        if not node.offers_edges:
            return 0
        if self.edges is not None:
            return self.edges
        rate = EDGES_PER_SECOND
        if node.has_parameter("n_p") and node.has_parameter("omega_m_max"):
            turns = node.parameter("omega_m_max").value / math.tau
            rate = MORE_EDGES * 6.0 * node.parameter("n_p").value * turns
        return room_for_edges(rate, self.seconds)


def room_for_edges(per_s: float, seconds: float) -> int:
    """Hall edges for which room is asked, where so many a second may come."""
    return min(math.ceil(per_s * seconds) + _SPARE_EDGES, 0xFFFF)


def too_large(node: Node, wanted: Wanted, asked: CaptureArm, fits: int, room: int) -> NodeError:
    """That a capture does not fit, and what would; `fits`: records, by the drive; `room`: bytes, 0 if unknown."""
    chosen = wanted.chosen(node)
    size = sum(np.dtype(channel.raw.dtype).itemsize for channel in chosen)
    total, rate = asked.before + asked.after, node.identity.pwm_hz / asked.decimation
    what = f"{total / rate:g} s of {counted(len(chosen), 'channel')} at {rate:g} Hz"
    memory = f" of {room} bytes" if room else ""
    need = f"{total * size + asked.edges * EDGE_RECORD.itemsize} bytes, {asked.edges} Hall edges among them"
    words = f"{what} ({need}) do not fit into node {node.number}'s memory for captures{memory}"
    if fits < 1:
        return NodeError(f"{words}: choose fewer --channels, or room for fewer --edges")
    slower = math.ceil(asked.decimation * total / fits)
    return NodeError(f"{words}: --for {fits / rate:.3g} does, or --decimation {slower}, or fewer --channels")

"""What a run hears, one item after the other: a client makes the items, every sink takes them.

Chunks are items as they are, and so is what the protocol says of a heartbeat, an event, a reboot. `tick` is the newest
device time that was heard of the item's node, or of the drive.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from protocol.host import DeviceEventReceived, HeartbeatReceived
from protocol.streams import EdgeChunk, SampleChunk


class ClockRestarted(NamedTuple):
    """The device time of `node` begins anew after `tick`: it has `rebooted`, or its clock has jumped back."""

    node: int
    tick: int
    rebooted: bool = True


class Missing(NamedTuple):
    """So many records of `node`, made before its streams ended, did not come after those that did."""

    tick: int
    node: int
    samples: int
    edges: int


class Misdated(NamedTuple):
    """Something of `node` was dated as it cannot be, in words; `tick` is when it came."""

    tick: int
    node: int
    text: str


class ParameterSet(NamedTuple):
    """A parameter of `node` has been set, from here or by another host, to what the node says it took."""

    tick: int
    node: int
    name: str
    value: float
    exact: bool = False
    """Whether the node has dated it (its event PARAM_CHANGED); else `tick` is the newest that was heard."""


class Note(NamedTuple):
    """A line for the log, of something that happened on the host; `level` as rerun's: INFO, WARN, ERROR."""

    tick: int
    text: str
    level: str = "INFO"


Chunk = SampleChunk | EdgeChunk
"""One record or more of a stream, contiguous but for its gaps. Edges come before the samples that cover them."""

Heard = Chunk | HeartbeatReceived | DeviceEventReceived | ClockRestarted | Missing | Misdated | ParameterSet | Note


class Sink(Protocol):
    """What receives a run. Calls come from the acquiring thread and must return at once."""

    def take(self, item: Heard) -> None:
        """Look at an item, if it is of a kind that matters here."""


class Changes:
    """Sink that calls `changed` with each parameter of `node` that is set."""

    def __init__(self, node: int, changed: Callable[[ParameterSet], object]) -> None:
        self._node, self._changed = node, changed

    def take(self, item: Heard) -> None:
        """Hand it on, if it is one."""
        if isinstance(item, ParameterSet) and item.node == self._node:
            self._changed(item)

"""How far a shaft went by its Hall edges, and in what time, of what is known: edges that are lost tell neither.

Known is the time from edge to edge without one lost between, and from the last edge to a heartbeat that counts none
after it. Times are the drive's, whatever samples come.
"""

from __future__ import annotations

import numpy as np

from bench.device.heard import ClockRestarted, Heard
from bench.signal.waveforms.sectors import steps_between
from protocol.host import HeartbeatReceived
from protocol.streams import EdgeChunk

STILL = 1.0
"""s without an edge after which the shaft is taken to stand, where edges before were lost: it is short of none then."""


class Passed:
    """Sink of edges and heartbeats of node `drive`; what it has made out is taken with `up_to`."""

    def __init__(self, drive: int, tick_hz: int) -> None:
        self._drive, self._tick_hz = drive, tick_hz
        self._ticks, self._sectors = 0, 0.0
        self.restart()

    def restart(self) -> None:
        """Ticks and numbers of edges begin anew."""
        self._next: int | None = None  # number of the edge that comes next
        self._known = 0  # tick up to which all edges are known
        self._since: int | None = None  # tick of the heartbeat since which none has come; None: the last edge is known
        self._beats: list[tuple[int, int]] = []  # ticks and counts, before whose ticks edges may still come

    def take(self, item: Heard) -> None:
        """Follow edges and the counts of heartbeats."""
        match item:
            case EdgeChunk() if item.config.node == self._drive and len(item):
                self._edges(item)
            case HeartbeatReceived(node=self._drive, heartbeat=heartbeat):
                self._beats.append((heartbeat.tick, heartbeat.edges))
            case ClockRestarted(node=self._drive):
                self.restart()

    def up_to(self, tick: int) -> tuple[float, float]:
        """s and sectors that were made out since the last call; all edges up to `tick` have come, or never will."""
        while self._beats and self._beats[0][0] <= tick:
            self._beat(*self._beats.pop(0))
        seconds, sectors = self._ticks / self._tick_hz, self._sectors
        self._ticks, self._sectors = 0, 0.0
        return seconds, sectors

    def _edges(self, chunk: EdgeChunk) -> None:
        anchored = self._next is not None and self._since is None
        index = np.concatenate([[self._next if anchored and self._next is not None else -1], chunk.index + 1])
        tick = np.concatenate([[self._known], chunk.tick])
        gone = np.diff(tick)
        known = (np.diff(index) == 1) & (gone >= 0)
        self._ticks += int(gone[known].sum())
        self._sectors += float(steps_between(chunk.hall_old, chunk.hall_new)[known].sum())
        self._next, self._known, self._since = int(index[-1]), int(tick[-1]), None

    def _beat(self, tick: int, edges: int) -> None:
        if tick <= self._known:
            return
        if self._next is None or edges & 0xFFFFFFFF != self._next & 0xFFFFFFFF:  # some were lost before it
            self._next, self._since = edges, tick
        elif self._since is None or tick - self._since > STILL * self._tick_hz:
            self._ticks += tick - self._known
        self._known = tick

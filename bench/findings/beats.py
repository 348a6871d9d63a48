"""What a drive's heartbeats contradict: their own counts, the Hall edges that came, the channel `status`."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from bench.device.heard import ClockRestarted, Heard
from bench.findings.finding import Finding
from bench.findings.thresholds import AT_RANDOM, COUNTS_OFF, FASTEST_EDGES, FEW_BEATS, FEW_RECORDS
from bench.signal.position import states
from protocol.codes import DriveState
from protocol.host import HeartbeatReceived
from protocol.messages import Heartbeat
from protocol.streams import EdgeChunk, SampleChunk

AROUND = 0.02
"""s before and after a heartbeat, in which the channel `status` must have its state: it may be made by a slow task."""
WAITS = 64
"""Heartbeats that samples or edges of their time are waited for, at most."""
COUNTS = {"edges": 32, "tx_dropped": 32, "rx_bad": 32, "setpoints_rejected": 16}
"""Counts since boot, with their bits."""


class Beats:
    """Sink that follows node `drive`."""

    def __init__(self, drive: int, tick_hz: int, edges: bool) -> None:
        """`edges`: whether it sees Hall edges."""
        self._drive, self._tick_hz, self._sees_edges = drive, tick_hz, edges
        self._found: dict[str, Finding] = {}
        self._changes = 0  # of the channel hall from sample to sample, since the first heartbeat
        self._code: tuple[int, int] | None = None  # index and code of the last sample
        self._came, self._counted = False, 0  # whether any edge has, and how many there were by heartbeats
        self._unlike = 0  # heartbeats that the channel status contradicts
        self._restart()

    def _restart(self) -> None:
        self._last: Heartbeat | None = None
        self._for_edges = deque[Heartbeat](maxlen=WAITS)
        self._for_status = deque[Heartbeat](maxlen=WAITS)
        self._edge: tuple[int, int] | None = None  # tick and number of the newest
        self._states: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None  # tick and state of the last samples

    def take(self, item: Heard) -> None:
        """Compare heartbeats with what is around them."""
        match item:
            case HeartbeatReceived(node=self._drive, heartbeat=heartbeat):
                self._heartbeat(heartbeat)
            case EdgeChunk() if item.config.node == self._drive and len(item):
                self._edges(item)
            case SampleChunk() if item.config.node == self._drive:
                self._samples(item)
            case ClockRestarted(node=self._drive):
                self._restart()

    @property
    def all_lost(self) -> bool:
        """Whether heartbeats count edges of which none has come."""
        return not self._came and self._counted > 0

    def findings(self) -> list[Finding]:
        """What contradicts itself."""
        return list(self._found.values())

    def _heartbeat(self, heartbeat: Heartbeat) -> None:
        last, self._last = self._last, heartbeat
        if last is not None:
            self._counted += max(0, heartbeat.edges - last.edges)
            if self._sees_edges and self._changes > AT_RANDOM * self._counted + FEW_RECORDS:
                told = (
                    f"the channel hall changed {self._changes} times, at {self._counted} Hall edges by its heartbeats"
                )
                self._find("hall", told, heartbeat.tick)
        if last is not None and last.boot_id == heartbeat.boot_id and last.tick < heartbeat.tick:
            for name, bits in COUNTS.items():
                before, now = getattr(last, name), getattr(heartbeat, name)
                if (now - before) & (1 << bits) - 1 >= 1 << bits - 1:
                    self._find(f"{name} fell", f"its count {name} fell from {before} to {now}", heartbeat.tick)
            seconds, came = (heartbeat.tick - last.tick) / self._tick_hz, heartbeat.edges - last.edges & 0xFFFFFFFF
            if FASTEST_EDGES * seconds + 1 < came < 1 << 31:
                self._find("edges", f"it counts {came} Hall edges in {seconds:.3g} s", heartbeat.tick)
        self._for_edges.append(heartbeat)
        self._for_status.append(heartbeat)

    def _edges(self, chunk: EdgeChunk) -> None:
        """A heartbeat counts the edges up to its tick: it lies between the numbers of those before and after it."""
        tick, number, self._came = chunk.tick, chunk.index, True
        if self._edge is not None:
            tick, number = np.append(self._edge[0], tick), np.append(self._edge[1], number)
        self._edge = int(tick[-1]), int(number[-1])
        while self._for_edges and self._for_edges[0].tick < tick[-1]:
            beat = self._for_edges.popleft()
            after = int(np.searchsorted(tick, beat.tick, "right"))
            if after:
                least, most = int(number[after - 1]) + 1 - COUNTS_OFF, int(number[after]) + COUNTS_OFF
                if (beat.edges - least) & 0xFFFFFFFF > most - least:
                    told = (
                        f"it counts {beat.edges} Hall edges where edge number {number[after] & 0xFFFFFFFF} comes next"
                    )
                    self._find("edges", told, beat.tick)

    def _samples(self, chunk: SampleChunk) -> None:
        self._codes(chunk)
        told = states(chunk)
        if told is None:
            self._for_status.clear()
            return
        tick = chunk.tick
        if self._states is not None:
            tick, told = np.append(self._states[0], tick), np.append(self._states[1], told)
        around = round(AROUND * self._tick_hz)
        while self._for_status and self._for_status[0].tick + around <= tick[-1]:
            beat = self._for_status.popleft()
            first, last = np.searchsorted(tick, [beat.tick - around, beat.tick + around])
            here = np.searchsorted(tick, beat.tick)
            if first < here < last and not (told[first:last] == beat.state).any():
                self._unlike += 1
                if self._unlike >= FEW_BEATS:
                    both = (
                        f"{DriveState(int(told[here])).name} by the channel status, {beat.state.name} by its heartbeat"
                    )
                    self._find("status", f"its state is {both}", beat.tick)
        kept = int(np.searchsorted(tick, tick[-1] - self._tick_hz))
        self._states = tick[kept:], told[kept:]

    def _codes(self, chunk: SampleChunk) -> None:
        if "hall" not in (chunk.raw.dtype.names or ()) or self._last is None:
            return
        index, codes = chunk.index, chunk.raw["hall"]
        if self._code is not None:
            index, codes = np.append(self._code[0], index), np.append(self._code[1], codes)
        self._changes += int(np.count_nonzero((np.diff(codes) != 0) & (np.diff(index) == chunk.config.index_step)))
        self._code = int(index[-1]), int(codes[-1])

    def _find(self, what: str, words: str, tick: int) -> None:
        if what not in self._found:
            self._found[what] = Finding(
                "heartbeat", f"the drive contradicts itself at {tick / self._tick_hz:.3f} s: {words}"
            )

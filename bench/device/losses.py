"""What is missing of a run: by index and by sequence from the gaps, by the device from its heartbeats."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from bench.device.counters import DeviceCounters
from bench.device.heard import Missing
from protocol.host import HeartbeatReceived
from protocol.streams import EdgeChunk, Gap, SampleChunk

LOSS_FIELDS = ("samples", "sample_frames", "edges", "by_device")
AnyChunk = TypeVar("AnyChunk", bound=SampleChunk | EdgeChunk)


class Continuity:
    """Follows the index of streams over outages, from chunk to chunk: the decoders of a stream end with it."""

    def __init__(self) -> None:
        self._next_index: dict[tuple[int, int, bool], int | None] = {}

    def chunk(self, chunk: AnyChunk) -> AnyChunk:
        """The chunk, with a gap as wide as its index jumps (an outage) if none of its own says so."""
        config = chunk.config
        key = (config.node, config.stream, bool(config.channels))
        step = config.index_step
        first = int(chunk.index[0])
        expected = self._next_index.get(key, first)
        self._next_index[key] = int(chunk.index[-1]) + step
        reported: Gap | None = chunk.gaps[0] if chunk.gaps and chunk.gaps[0].position == 0 else None
        missing = 0 if expected is None else (first - expected) // step
        if missing > (reported.lost_samples if reported else 0) or (expected is None and not reported):
            jump = replace(reported or Gap(0, 0, 0, False), lost_samples=missing)
            return replace(chunk, gaps=(jump, *chunk.gaps[1 if reported else 0 :]))
        return chunk

    def not_kept(self) -> None:
        """What came next has been let go: there is a gap, of nothing that was lost."""
        self._next_index = dict.fromkeys(self._next_index)

    def restarted(self, node: int) -> None:
        """The device has rebooted: its streams begin anew."""
        self._next_index = {key: index for key, index in self._next_index.items() if key[0] != node}


class LossAccount:
    """Counts what is missing of what it is given to take: `counters` by the names of `LOSS_FIELDS`."""

    def __init__(self) -> None:
        self.counters: dict[str, int] = dict.fromkeys(LOSS_FIELDS, 0)
        self._devices: dict[int, DeviceCounters] = {}

    def take(self, item: object) -> None:
        """Count what is missing before records, at the end of streams, and what a device had to drop itself."""
        match item:
            case SampleChunk(gaps=gaps):
                for gap in gaps:
                    self.counters["samples"] += gap.lost_samples
                    self.counters["sample_frames"] += gap.lost_frames
            case EdgeChunk(gaps=gaps):
                for gap in gaps:
                    self.counters["edges"] += gap.lost_samples
            case Missing():
                self.counters["samples"] += item.samples
                self.counters["edges"] += item.edges
            case HeartbeatReceived(node=node, heartbeat=heartbeat):
                self._devices.setdefault(node, DeviceCounters()).add(heartbeat)
                self.counters["by_device"] = sum(device.risen["tx_dropped"] for device in self._devices.values())

    def following(self) -> LossAccount:
        """An account for what comes next, which begins at nothing."""
        new = LossAccount()
        new._devices = {node: device.following() for node, device in self._devices.items()}
        return new

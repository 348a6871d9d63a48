"""What is missing of a run: by index and by sequence from the gaps, by the device from its heartbeats."""

from __future__ import annotations

from dataclasses import replace

from bench.device.counters import DeviceCounters
from bench.signal.chunks import Chunk, index_step
from protocol.messages import Heartbeat
from protocol.streams import Gap

LOSS_FIELDS = ("samples", "sample_frames", "edges", "by_device")


class LossAccount:
    """Counts what is missing: by index and by sequence from the gaps, by the device from its heartbeats."""

    def __init__(self) -> None:
        self.counters: dict[str, int] = dict.fromkeys(LOSS_FIELDS, 0)
        self._next_index: dict[tuple[int, int, bool], int | None] = {}
        self._devices: dict[int, DeviceCounters] = {}

    def chunk(self, chunk: Chunk) -> Chunk:
        """Count a chunk's gaps; return it, with a gap as wide as its index jumps (an outage) if none says so."""
        config = chunk.config
        key = (config.node, config.stream, bool(config.channels))
        step = index_step(config)
        first = int(chunk.index[0])
        expected = self._next_index.get(key, first)
        self._next_index[key] = int(chunk.index[-1]) + step
        reported: Gap | None = chunk.gaps[0] if chunk.gaps and chunk.gaps[0].position == 0 else None
        missing = 0 if expected is None else (first - expected) // step
        if missing > (reported.lost_samples if reported else 0) or (expected is None and not reported):
            jump = replace(reported or Gap(0, 0, 0, False), lost_samples=missing)
            chunk = replace(chunk, gaps=(jump, *chunk.gaps[1 if reported else 0 :]))
        records, frames = ("samples", "sample_frames") if config.channels else ("edges", None)
        for gap in chunk.gaps:
            self.counters[records] += gap.lost_samples
            if frames:
                self.counters[frames] += gap.lost_frames
        return chunk

    def not_kept(self) -> None:
        """What came next has been let go: there is a gap, of nothing that was lost."""
        self._next_index = dict.fromkeys(self._next_index)

    def following(self) -> LossAccount:
        """An account for what comes next, which begins at nothing."""
        new = LossAccount()
        new._next_index = dict(self._next_index)
        new._devices = {node: device.following() for node, device in self._devices.items()}
        return new

    def missing(self, samples: int, edges: int) -> None:
        """Count what was lost after the last chunk of a stream."""
        self.counters["samples"] += samples
        self.counters["edges"] += edges

    def heartbeat(self, node: int, heartbeat: Heartbeat) -> None:
        """Take over what the device of `node` had to drop itself since its first heartbeat."""
        self._devices.setdefault(node, DeviceCounters()).add(heartbeat)
        self.counters["by_device"] = sum(device.risen["tx_dropped"] for device in self._devices.values())

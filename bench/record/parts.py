"""A recording as the runs that it becomes: one, or a part after the other where it is split."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from uuid import uuid4

from bench.device.heard import ClockRestarted, ParameterSet
from bench.errors import RecordingError
from bench.files import is_run
from bench.record import layout
from bench.record.folder import remove
from bench.record.info import Kept, RunInfo
from bench.record.later import Later
from bench.record.ring import Stored
from bench.record.writer import RunWriter
from bench.signal.chunks import END, between
from protocol.streams import EdgeChunk, SampleChunk

AHEAD = 1000  # chunks of edges that may be ahead of their samples


class Parts:
    """Writers of the run `run` at `target`, one at a time: `writer` is the present one.

    Raises RecordingError as RunWriter does, and where a part of an earlier run is in the way.
    """

    def __init__(
        self,
        target: Path,
        run: RunInfo,
        stored: Stored,
        overwrite: bool,
        before_end: Callable[[], None],
        later: Later | None = None,
    ) -> None:
        """`before_end` is called before a part ends and the next one begins; `later` as for `RunWriter`."""
        self._later = later
        self._target, self._run, self._overwrite = target, run, overwrite
        self._before_end = before_end
        self._keep, self._split = stored.keep, stored.split
        self._begun: int | None = None  # first tick of this part's samples
        self._edges: deque[EdgeChunk] = deque(maxlen=AHEAD)
        self._before = (0, 0)
        self._ended: list[Path] = []
        if self._split is not None:
            self._clear()
        self.writer = self._new_writer(run)

    @property
    def paths(self) -> tuple[Path, ...]:
        """The runs that have been begun, oldest first; the last is being written."""
        return *self._ended, self.writer.path

    @property
    def written(self) -> tuple[int, int]:
        """Samples and edges so far, of all parts."""
        return self._before[0] + self.writer.samples_written, self._before[1] + self.writer.edges_written

    def take(self, item: Kept) -> None:
        """Write an item. A new part begins with samples where the old one has its length, or the clock has restarted.

        Edges that came ahead of their samples stand in both parts then.
        """
        if isinstance(item, ParameterSet) and item.node == self._run.node:  # the next part begins with it
            self._run = replace(self._run, parameters={**self._run.parameters, item.name: item.value})
        elif self._split is not None:
            self._look(item, self._split)
        self.writer.take(item)

    def _look(self, item: Kept, split: float) -> None:
        """Begin a new part where it is time for it."""
        match item:
            case SampleChunk(config=config, tick=tick) if config.node == self._run.node:
                first, newest = int(tick[0]), int(tick[-1])
                self._begun = first if self._begun is None else self._begun
                if not 0 <= first - self._begun < split * self._run.tick_hz:
                    self._next(first)
                self._edges = deque((edges for edges in self._edges if int(edges.tick[-1]) > newest), AHEAD)
            case EdgeChunk(config=config) if config.node == self._run.node:
                self._edges.append(item)
            case ClockRestarted():
                self._edges.clear()

    def _next(self, first: int) -> None:
        """End this part and begin the next, at tick `first`."""
        self._before_end()
        old = self.writer
        old.close()
        samples, edges = self.written
        self._begun = first
        self._ended.append(old.path)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self.writer = self._new_writer(replace(self._run, recording_id=uuid4().hex, started=now), old)
        for chunk in self._edges:
            ahead = between(chunk, first, END)
            if len(ahead):
                self.writer.take(replace(ahead, gaps=()))
        self._before = samples, edges - self.writer.edges_written

    def _new_writer(self, run: RunInfo, old: RunWriter | None = None) -> RunWriter:
        if self._split is None:
            return RunWriter(self._target, run, self._overwrite, self._keep, later=self._later)
        number = len(self._ended) + 1
        run = replace(run, identity={**run.identity, "part": number})
        account = None if old is None else old.account.following()
        path = layout.part_name(self._target, number)
        return RunWriter(path, run, self._overwrite, account=account, later=self._later)

    def _clear(self) -> None:
        """Make room for the parts."""
        found = layout.parts_of(self._target)
        if found and not self._overwrite:
            raise RecordingError(f"{min(found)} exists: choose another name, or --overwrite to replace it")
        for part in found:
            if is_run(part):
                remove(part)

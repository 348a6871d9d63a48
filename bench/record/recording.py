"""A recording as `bench.open` gives it, with tables for pandas; and what can stand in its place, such as a capture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.device.heard import ParameterSet
from bench.errors import BenchError
from bench.files import is_run
from bench.record.info import RunInfo
from bench.record.layout import EDGES, SAMPLES, fault_run
from bench.record.reader import Run, capture_of, captures, require_memory
from bench.record.times import ticks_between
from bench.signal.capture import Capture
from bench.signal.parameters import course_of
from bench.signal.position import states
from protocol.codes import EventCode
from protocol.frames import data_frame
from protocol.messages import DriveState
from protocol.streams import EdgeChunk, SampleChunk

if TYPE_CHECKING:
    import pandas as pd


class Recording:
    """A recorded run: captures of any part of it, and tables in SI units by device time `t`, s.

    What was said is read when it is opened, a table when it is first asked for. Iterating gives `pieces()`.
    Raises BenchError where `path` holds no recording.
    """

    def __init__(self, path: str | Path) -> None:
        self.run = Run(path)
        """The reader, by device ticks."""

    def __repr__(self) -> str:
        if not self.run.segments:
            return f"Recording {self.run.path}: empty"
        first, last = self.run.span
        marks, events = len(self.run.marks), len(self.run.events)
        return f"Recording {self.run.path}: {self.run.at(first)} … {self.run.at(last)}, {marks} marks, {events} events"

    def __iter__(self) -> Iterator[Capture]:
        return self.pieces()

    @property
    def info(self) -> RunInfo:
        """What is known of the run before its first sample: channels, parameters, drive, bench."""
        return self.run.info

    @property
    def damage(self) -> list[str]:
        """What is not as it was written, as far as it was read: what, where, and the time that it costs."""
        return self.run.damage

    def read(
        self, begin: float | None = None, end: float | None = None, channels: Sequence[str] | None = None
    ) -> Capture:
        """See `bench.read`."""
        return capture_of(self.run, *ticks_between(self.run, begin, end), channels)

    def pieces(
        self, begin: float | None = None, end: float | None = None, channels: Sequence[str] | None = None
    ) -> Iterator[Capture]:
        """See `bench.pieces`."""
        return captures(self.run, *ticks_between(self.run, begin, end), channels)

    @property
    def at_fault(self) -> Recording | None:
        """What the drive held at a fault of this run, every PWM period of it; None where nothing was kept."""
        path = fault_run(self.run.path)
        return Recording(path) if is_run(path) else None

    @cached_property
    def samples(self) -> pd.DataFrame:
        """A column for each channel in its unit. BenchError where they do not fit into memory."""
        channels = len(self.run.drive_streams[0].channels) if SAMPLES in self.run.names else 0
        require_memory(self.run, further=8 * (channels + 1))
        return self.read().to_pandas()

    @cached_property
    def edges(self) -> pd.DataFrame:
        """The Hall edges: codes before and after, whether that is illegal, the encoder's count; empty for none."""
        edges = self.run.chunk(EDGES) if EDGES in self.run.names else None
        return edges.to_pandas() if isinstance(edges, EdgeChunk) else data_frame({})

    @cached_property
    def marks(self) -> pd.DataFrame:
        """Stretches that were marked, from `t` to `until`, s."""
        marks = self.run.marks
        rows = [(self._seconds(mark.last_tick), mark.name, mark.verdict) for mark in marks]
        return self._table([mark.first_tick for mark in marks], ("until", "name", "verdict"), rows)

    @cached_property
    def events(self) -> pd.DataFrame:
        """What the devices have reported, with `arg` and `detail` as the protocol has them for each `name`."""
        events = self.run.events
        rows = [(event.node, EventCode(event.code).name, event.arg, event.detail) for event in events]
        return self._table([event.tick for event in events], ("node", "name", "arg", "detail"), rows)

    @cached_property
    def notes(self) -> pd.DataFrame:
        """Lines of the host's log."""
        notes = self.run.notes
        return self._table(
            [note.tick for note in notes], ("level", "text"), [(note.level, note.text) for note in notes]
        )

    @cached_property
    def changes(self) -> pd.DataFrame:
        """Parameters that were set during the run, by this host or another."""
        changes = self.run.changes
        rows = [(change.node, change.name, change.value) for change in changes]
        return self._table([change.tick for change in changes], ("node", "name", "value"), rows)

    def _seconds(self, tick: int) -> float:
        return tick / self.info.tick_hz

    def _table(self, ticks: Sequence[int], names: Sequence[str], rows: Sequence[Sequence[Any]]) -> pd.DataFrame:
        columns = {name: [row[k] for row in rows] for k, name in enumerate(names)}
        return data_frame(columns, list(map(self._seconds, ticks)))


class CapturedRun(Run):
    """A capture, read as a recorded run is: nothing was said in it, and it is not read from any file."""

    def __init__(self, capture: Capture) -> None:
        config = capture.samples.config
        self._begin(Path("the capture"))
        self.info = RunInfo(
            config.tick_hz, config.pwm_hz, config.channels, capture.parameters, node=config.node, started="",
            edge_step=capture.edge_step,
        )  # fmt: skip
        self._take(iter(()))
        self.changes = tuple(
            ParameterSet(change.tick, config.node, change.name, change.value, exact=True)
            for change in course_of(capture.parameters).changes
        )
        self.ended = True
        chunks = (SAMPLES, capture.samples), (EDGES, capture.edges)
        there = [(name, chunk) for name, chunk in chunks if len(chunk)]
        self._numbers = {name: number for number, (name, _) in enumerate(there)}
        self._configs = {number: chunk.config for number, (_, chunk) in enumerate(there)}
        self._opened = tuple((number, chunk) for number, (_, chunk) in enumerate(there))

    @property
    def opened(self) -> tuple[tuple[int, SampleChunk | EdgeChunk], ...]:
        """What the capture holds, by number of the stream."""
        return self._opened

    @property
    def ran(self) -> bool:
        """See `Run.ran`."""
        told = [states(chunk) for _, chunk in self._opened if isinstance(chunk, SampleChunk)]
        return any(bool((one == DriveState.RUNNING).any()) for one in told if one is not None)


Source = Run | Recording | Capture | str | Path
"""What can be looked at as a recorded run."""


def run_of(source: Source) -> Run:
    """The source as a run. BenchError for a path that holds none."""
    if isinstance(source, Capture):
        return CapturedRun(source)
    if isinstance(source, Recording):
        return source.run
    return source if isinstance(source, Run) else Run(source)


def readable(source: Source) -> Run:
    """The same with samples of the drive and one clock. BenchError says why it has not."""
    run = run_of(source)
    if SAMPLES not in run.names or not run.segments:
        raise BenchError(f"{run.path} holds no samples of the drive")
    if (back := run.clock_went_back()) is not None:
        run.look_at_times()
        why = "its ticks are damaged" if back.tick in run.leaps else "it rebooted during the run"
        raise BenchError(f"{run.path}: the drive's clock jumped back at {run.at(back.tick)}: {why}")
    return run

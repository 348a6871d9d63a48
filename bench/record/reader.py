"""Reads a run back: any part of it, exactly as it came over the wire, every block verified. Never writes.

A run that was cut short (kill -9, disk full), or is still being written, reads up to where it ends. What is damaged is
left out, counted as lost, and named with its time in `Run.damage`.
"""

from __future__ import annotations

import json
import mmap
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from bench.device.heard import ClockRestarted, Misdated, Missing, Note, ParameterSet
from bench.device.losses import LOSS_FIELDS, Continuity
from bench.errors import BenchError
from bench.files import RRD, is_run, run_folder
from bench.record import journal, layout
from bench.record.changes import course, settled
from bench.record.info import Kept, Mark, RunInfo, stream_from_json
from bench.record.memory import available, in_words
from bench.record.overview import Overview
from bench.signal.capture import Capture, gathered
from bench.signal.chunks import (
    BEGIN,
    END,
    Chunk,
    LostStretches,
    between,
    join,
    narrowed,
    no_edge_stream,
    no_edges,
    of_channels,
    part,
)
from bench.signal.parameters import ParameterCourse
from bench.signal.verdict import Verdict
from bench.system import lock
from protocol.host import DeviceEventReceived, HeartbeatReceived
from protocol.messages import DeviceEvent, DriveState, EventCode, Fault, Heartbeat
from protocol.streams import OFF, OFF_SHARE, EdgeChunk, SampleChunk, StreamConfig

if TYPE_CHECKING:
    import pyarrow as pa

T = TypeVar("T")

MOST_LEAPS = 5  # of the time in a piece, that are named
BESIDE = 50_000_000  # bytes that reading takes beside what is read: a row group or two, and files
_NUMBERED = re.compile(r"(?P<stream>.+)-(?P<number>\d{6})\.parquet$")
_HEARTBEAT = tuple(field.name for field in fields(Heartbeat))
_EVENT = tuple(field.name for field in fields(DeviceEvent))


class NotARecordingError(BenchError):
    """A folder that is no run, or of a newer version than this program reads."""


@dataclass(frozen=True)
class StoredFile:
    """One stream's part of a segment. `groups`: first and last tick and rows of each row group."""

    name: str
    groups: tuple[tuple[int, int, int], ...]
    blocks: tuple[tuple[int, int], ...]


class Run:
    """A recorded run: see the module. Everything but samples and edges is read when it is opened.

    Raises NotARecordingError where `path` holds none.
    """

    def __init__(self, path: str | Path) -> None:
        self._begin(Path(path))
        if not self.path.is_dir():
            raise NotARecordingError(f"{path}: no such run: {_advice(self.path)}")
        try:
            self._data = (self.path / layout.LOG).read_bytes()
        except OSError:
            raise NotARecordingError(f"{path} is not a recorded run: it has no {layout.LOG}") from None
        self.info = self._described(self._data)
        self._take(self._records(self._data))
        self._look_for_files()

    def _begin(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        """What is not as it was written, as far as it was looked at: what, where, and the time that it costs."""
        self.leaps: set[int] = set()
        """Ticks after which the time of a stream leaps though its index goes on, as far as they were read."""
        self._data = b""
        self._configs: dict[int, StreamConfig] = {}
        self._numbers: dict[str, int] = {}
        self._segments: dict[int, dict[str, tuple[StoredFile, ...]]] = {}
        self._lost_groups: set[tuple[str, int, int, int]] = set()  # file, first and last tick, rows
        self.ended = False
        """Whether it came to its end: it was not cut short, and is not being written."""
        self.lost: dict[str, int] | None = None
        """What was missing of it by its end, see `bench.device.losses`; None where it came to no end."""
        self.summary = ""
        """Markdown."""

    # -- the log ------------------------------------------------------------------------------------------------

    def _described(self, data: bytes) -> RunInfo:
        first = layout.record_of(data.partition(b"\n")[0].decode("ascii", "surrogateescape"))
        if first is None or first.get("kind") != "run":
            first = self._described_by_files()
        if first.get("format", layout.FORMAT) > layout.FORMAT:
            raise NotARecordingError(
                f"{self.path} was written by a newer version (format {first['format']}, this one reads "
                f"{layout.FORMAT}): update hallbench"
            )
        return RunInfo.from_json(first, first.get("id", self.path.name))

    def _described_by_files(self) -> dict[str, Any]:
        """What the Parquet files say of the run, where the log does not."""
        for file in sorted(self.path.glob("*.parquet")):
            told = _metadata(file).get("run")
            if told is not None:
                return dict(told)
        raise NotARecordingError(f"{self.path}: the first line of {layout.LOG}, which describes the run, is damaged")

    def _records(self, data: bytes) -> Iterator[dict[str, Any]]:
        """The records of the log; damaged lines are named with the time of those before."""
        *lines, last = data.decode("ascii", "surrogateescape").split("\n")
        tick = None
        for number, line in enumerate([*lines, last] if last else lines, 1):
            record = layout.record_of(line)
            if record is not None:
                tick = record.get("tick", tick)
                yield record
            elif number <= len(lines):  # else it was cut while it was written
                where = "before the first event" if tick is None else f"after {self.at(tick)}"
                self.damage.append(f"{layout.LOG}, line {number}: damaged, {where}")

    def records(self, without: Sequence[str]) -> Iterator[dict[str, Any]]:
        """The records of the log as they are, but for those of the kinds `without`."""
        lines = self._data.decode("ascii", "surrogateescape").split("\n")
        found = (layout.record_of(line) for line in lines)
        return (record for record in found if record is not None and record["kind"] not in without)

    def _take(self, records: Iterator[dict[str, Any]]) -> None:
        said: list[Kept] = []
        self._reboots: list[tuple[int, int]] = []  # number of the segment that follows, and node
        self.removed: set[int] = set()
        """Numbers of the segments that a ring has let go."""
        for record in records:
            match record["kind"]:
                case "event" | "heartbeat" | "note" | "mark" | "parameter" | "missing" | "misdated":
                    said.append(_item(record))
                case "rebooted":
                    self._reboots.append((record["segment"], record["from"]))
                case "stream":
                    self._add_stream(record)
                case "segment":
                    files: dict[str, tuple[StoredFile, ...]] = {}
                    for told in record["files"]:
                        file = StoredFile(told["name"], *(tuple(map(tuple, told[key])) for key in ("groups", "blocks")))
                        files[told["stream"]] = (*files.get(told["stream"], ()), file)
                    self._segments[record["number"]] = files
                case "removed":
                    self.removed.add(record["number"])
                case "summary":
                    self.summary = record["text"]
                case "end":
                    self.ended = True
                    self.lost = dict.fromkeys(LOSS_FIELDS, 0) | record["lost"]
        for number in self.removed:
            self._segments.pop(number, None)
        self.events = tuple(item.event for item in said if isinstance(item, DeviceEventReceived))
        self.heartbeats = tuple(item for item in said if isinstance(item, HeartbeatReceived))
        """Each that told anything new."""
        self.notes = tuple(item for item in said if isinstance(item, Note))
        self.marks = tuple(item for item in said if isinstance(item, Mark))
        """Stretches that were marked, in the order in which they were."""
        self.changes = settled(item for item in said if isinstance(item, ParameterSet))
        """Parameters that were set, by any node and host, each once."""
        self.missing = tuple(item for item in said if isinstance(item, Missing))
        self.misdated = tuple(item for item in said if isinstance(item, Misdated))
        """What devices dated as it cannot be, told as it came; it was put right."""
        self.damage += [item.text for item in self.misdated]

    def _add_stream(self, record: Mapping[str, Any]) -> None:
        number = record.get("number", -1 - len(self._configs))  # of a file whose line in the log is damaged: none
        self._configs[number] = stream_from_json(record, self.info)
        self._numbers[record["name"]] = number

    def _look_for_files(self) -> None:
        """Name files that are not in the log, and segments that are missing."""
        for number in range(1, max(self._segments, default=0)):
            if number not in self._segments and number not in self.removed:
                self.damage.append(f"segment {number} is not in {layout.LOG}: its line is damaged")
        for file in sorted(self.path.glob("*.parquet")):
            found = _NUMBERED.match(file.name)
            if found is None or int(found["number"]) in self.removed:
                continue
            number, stream = int(found["number"]), found["stream"]
            told = self._segments.get(number)
            if told is None and (self.path / layout.journal_name(number)).exists():
                continue  # the run was killed before the log had it: the journal has all of it
            if told is None or file.name not in {part.name for parts in told.values() for part in parts}:
                self.damage.append(f"{file.name} is not in {layout.LOG}, and is not read")
            elif stream in told and stream != layout.OVERVIEW and stream not in self._numbers:
                told_of = _metadata(file).get("stream")
                if told_of is not None:
                    self._add_stream(told_of)

    # -- time ---------------------------------------------------------------------------------------------------

    def at(self, tick: int) -> str:
        """A device tick as words."""
        return f"{tick / self.info.tick_hz:.3f} s"

    @cached_property
    def span(self) -> tuple[int, int]:
        """First and last device tick of which there are samples or edges; ValueError if there are none."""
        spans = [segment.span for segment in self.segments]
        return min(first for first, _ in spans), max(last for _, last in spans)

    @property
    def parameters(self) -> ParameterCourse:
        """The drive's, as the run began, and each change after that."""
        return course(self.info.parameters, (change for change in self.changes if change.node == self.info.node))

    @property
    def being_written(self) -> bool:
        """Whether a program is recording it."""
        with (self.path / layout.LOG).open("rb") as log:
            try:
                lock(log.fileno(), shared=True)
            except OSError:
                return True
        return False

    # -- streams ------------------------------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the streams, in the order in which they began."""
        return tuple(self._numbers)

    @property
    def drive_streams(self) -> tuple[StreamConfig, StreamConfig | None]:
        """How the drive's samples and edges came; KeyError without samples, None without edges."""
        return self.config(layout.SAMPLES), self.config(layout.EDGES) if layout.EDGES in self._numbers else None

    @property
    def ran(self) -> bool:
        """Whether it tells that the drive was RUNNING."""
        node = self.info.node
        return any(its == node and beat.state == DriveState.RUNNING for its, beat in self.heartbeats) or any(
            event.node == node and event.code == EventCode.STATE_CHANGED and event.number == DriveState.RUNNING
            for event in self.events
        )

    @cached_property
    def restarts(self) -> Mapping[int, Sequence[ClockRestarted]]:
        """Where the time of devices begins anew, by the number of the segment that begins so.

        The log says which have rebooted; one that does not (of an earlier version, or where only a clock has jumped)
        has streams whose ticks go back.
        """
        found: dict[int, list[ClockRestarted]] = {}
        last: dict[str, tuple[int, int]] = {}  # reboots before it, and newest tick, by stream
        for segment in self.segments:
            for name in self.names:
                node, span = self.config(name).node, segment.span_of(name)
                if span is None:
                    continue
                boots = sum(number <= segment.number and its == node for number, its in self._reboots)
                before, newest = last.get(name, (boots, span[0]))
                if boots != before or span[0] < newest:
                    found.setdefault(segment.number, []).append(ClockRestarted(node, newest, boots != before))
                last[name] = boots, span[1]
        return found

    def clock_went_back(self) -> ClockRestarted | None:
        """Where a stream's time starts again at first; None if it never does."""
        return next((restarts[0] for restarts in self.restarts.values()), None)

    def journaled(self, stream: str) -> list[SampleChunk | EdgeChunk]:
        """What the journal holds of a stream, in order."""
        return [chunk for number, chunk in self.opened if number == self._numbers[stream]]

    def config(self, stream: str) -> StreamConfig:
        """How a stream was configured. KeyError for a name that is not among `names`."""
        return self._configs[self._numbers[stream]]

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """The parts of the run that are there, in order: in each of them the device's time rises."""
        found = [Segment(self, number, files) for number, files in sorted(self._segments.items())]
        return (*found, Segment(self, max(self._segments, default=0) + 1, None)) if self.opened else tuple(found)

    def pieces(
        self, stream: str, first: int = BEGIN, last: int = END, channels: Collection[str] | None = None
    ) -> Iterator[SampleChunk | EdgeChunk]:
        """A stream from tick `first` to `last`, both included, a row group or less at a time, in order.

        `channels`: of samples, those that are read; None: all. What is missing between two pieces is in the gaps of
        the second.
        """
        continuity = Continuity()
        config = narrowed(self.config(stream), channels)
        newest: tuple[int, int] | None = None
        for segment in self.segments:
            segment.begin(continuity)
            if any(restarted.rebooted for restarted in segment.restarts):
                newest = None
            for piece in segment.pieces(stream, first, last, config):
                self._look_at_time(stream, newest, piece)
                newest = int(piece.tick[-1]), int(piece.index[-1])
                yield continuity.chunk(piece)

    def look_at_times(self, first: int = BEGIN, last: int = END) -> None:
        """Name leaps of time, as whoever reads its streams by `pieces` does, without all that was measured."""
        for name in self.names:
            for _ in self.pieces(name, first, last, [channel.name for channel in self.config(name).channels[:1]]):
                pass

    def _look_at_time(self, stream: str, before: tuple[int, int] | None, piece: SampleChunk | EdgeChunk) -> None:
        """Name leaps of the time of a stream; `before`: tick and index of the record before."""
        tick, index = piece.tick, piece.index
        if before is not None:
            tick, index = np.append(before[0], tick), np.append(before[1], index)
        if piece.config.channels and not np.ptp(tick - index * piece.config.period_ticks):
            return
        went = np.diff(tick)
        due = np.diff(index) * piece.config.period_ticks if piece.config.channels else np.maximum(went, 0)
        off = went - due
        for k in np.flatnonzero(np.abs(off) > OFF * self.info.tick_hz + OFF_SHARE * np.abs(due))[:MOST_LEAPS].tolist():
            leap = f"the time leaps by {off[k] / self.info.tick_hz:+.3f} s after {self.at(int(tick[k]))}"
            self._note_damage(f"{stream}: {leap}; nothing is left out")
            self.leaps.add(int(tick[k]))

    def chunk(
        self, stream: str, first: int = BEGIN, last: int = END, channels: Collection[str] | None = None
    ) -> SampleChunk | EdgeChunk | None:
        """A stream from tick `first` to `last`, both included, in one piece, see `pieces`; None if nothing is there."""
        found = list(self.pieces(stream, first, last, channels))
        return join(found) if found else None

    def rows(self, stream: str, first: int = BEGIN, last: int = END) -> int:
        """How many records of a stream the files hold from tick `first` to `last`, by their row groups: rather more."""
        return sum(segment.rows(stream, first, last) for segment in self.segments) if stream in self.names else 0

    def damaged(self, stream: str, first: int = BEGIN, last: int = END) -> list[tuple[int, int, int]]:
        """First and last tick and rows of what was found damaged of a stream and is not read, as far as it was read."""
        files = {file.name for segment in self.segments for file in segment.files.get(stream, ())}
        found = {(a, b, rows) for name, a, b, rows in self._lost_groups if name in files and a <= last and b >= first}
        return sorted(found)

    @cached_property
    def opened(self) -> tuple[tuple[int, SampleChunk | EdgeChunk], ...]:
        """What the journal holds, by number of the stream."""
        chunks: list[tuple[int, SampleChunk | EdgeChunk]] = []
        for file in sorted(self.path.glob(f"{layout.JOURNAL}*")):
            number = file.name.removeprefix(layout.JOURNAL)
            if not number.isdigit() or int(number) in self._segments:
                continue
            found = journal.read(file.read_bytes(), self._configs)
            for begin, end, before in found.damage:
                ticks = [int(chunk.tick[-1]) for _, chunk in found.chunks[:before]]
                where = f"after {self.at(ticks[-1])}" if ticks else "at its start"
                self.damage.append(f"{file.name}: bytes {begin} to {end} are damaged, {where}")
            chunks += found.chunks
        return tuple(chunks)

    def groups(
        self, files: Sequence[StoredFile], chosen: Sequence[int], columns: Collection[str] | None = None
    ) -> Iterator[pa.Table]:
        """The chosen row groups of files with the same rows, as one table each, if they are as they were written.

        `columns`: those that are read; None: all.
        """
        opened = [opener for file in files if (opener := self._opened_file(file, chosen, columns)) is not None]
        if len(opened) < len(files):
            return iter(())

        def together(k: int) -> pa.Table | None:
            tables = [table for read in opened if (table := read(k)) is not None]
            if len(tables) < len(files):
                return None
            whole, *others = tables
            for other in others:
                for field, column in zip(other.schema, other.columns, strict=True):
                    whole = whole.append_column(field, column)
            return whole

        return filter(lambda table: table is not None, map(together, chosen))  # which hold no table that was taken

    def intact(self, file: StoredFile) -> bool:
        """Whether every block of a file is as it was written."""
        try:
            data = memoryview((self.path / file.name).read_bytes())
        except OSError:
            return False
        starts = [0, *(stop for stop, _ in file.blocks)]
        ends = zip(starts, file.blocks, strict=False)
        return len(data) == starts[-1] and not any(layout.damaged(data, start, *block) for start, block in ends)

    def _opened_file(
        self, file: StoredFile, chosen: Sequence[int], columns: Collection[str] | None
    ) -> Callable[[int], pa.Table | None] | None:
        """What reads a row group of a file, verified; None, and that is noted, where the file is not what it was."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if not chosen:
            return None
        try:
            with (self.path / file.name).open("rb") as opened:
                data = memoryview(mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ))
        except (OSError, ValueError) as error:
            what = "is missing" if isinstance(error, FileNotFoundError) else f"cannot be read: {error}"
            self._lost(file, chosen, what)
            return None
        end = file.blocks[-1][0]
        starts = [0, *(stop for stop, _ in file.blocks)]
        if len(data) != end:
            self._note_damage(f"{file.name} has {len(data)} bytes, not {end}")
        if layout.damaged(data, starts[-2], *file.blocks[-1]):
            self._lost(file, chosen, "is damaged at its end")
            return None
        parquet = pq.ParquetFile(pa.BufferReader(pa.py_buffer(data[:end])))
        names = None if columns is None else [name for name in parquet.schema_arrow.names if name in columns]

        def read(group: int) -> pa.Table | None:
            if layout.damaged(data, starts[group], *file.blocks[group]):
                self._lost(file, [group], "is damaged")
                return None
            pa.default_memory_pool().release_unused()  # what was kept of the group before: more than this one takes
            return parquet.read_row_group(group, columns=names, use_threads=False)

        return read

    def _lost(self, file: StoredFile, groups: Sequence[int], what: str) -> None:
        first, last = file.groups[groups[0]][0], file.groups[groups[-1]][1]
        rows = sum(file.groups[k][2] for k in groups)
        self._lost_groups.add((file.name, first, last, rows))
        self._note_damage(f"{file.name} {what}: {rows} rows from {self.at(first)} to {self.at(last)} are lost")

    def _note_damage(self, text: str) -> None:
        if text not in self.damage:
            self.damage.append(text)

    # -- all of it ----------------------------------------------------------------------------------------------

    @cached_property
    def samples(self) -> SampleChunk:
        """The drive's samples, of a run that fits into memory. KeyError if none were recorded."""
        return _whole(self, layout.SAMPLES, SampleChunk)

    @cached_property
    def edges(self) -> EdgeChunk:
        """The drive's Hall edges, likewise."""
        return _whole(self, layout.EDGES, EdgeChunk)


class Segment:
    """A part of a run, a minute or less, in which the device's time rises."""

    def __init__(self, run: Run, number: int, files: Mapping[str, tuple[StoredFile, ...]] | None) -> None:
        """`files`: by stream; None: what is in the journal."""
        self._run, self._files = run, files
        self.number = number

    @property
    def restarts(self) -> Sequence[ClockRestarted]:
        """Those at its begin, see `Run.restarts`."""
        return self._run.restarts.get(self.number, ())

    def begin(self, continuity: Continuity) -> None:
        """Tell what follows the index from chunk to chunk what lies between this segment and the one before."""
        if self.number - 1 in self._run.removed:
            continuity.not_kept()
        for restarted in self.restarts:
            if restarted.rebooted:
                continuity.restarted(restarted.node)

    @property
    def files(self) -> Mapping[str, tuple[StoredFile, ...]]:
        """Its files, by stream, each with the same rows in other columns; none for what is in the journal."""
        return self._files or {}

    @cached_property
    def span(self) -> tuple[int, int]:
        """First and last device tick of which there are samples or edges."""
        ends = [span for name in self._run.names if (span := self.span_of(name)) is not None]
        return min(first for first, _ in ends), max(last for _, last in ends)

    def span_of(self, stream: str) -> tuple[int, int] | None:
        """First and last tick of a stream in it; None if it has none."""
        if self._files is None:
            chunks = self._run.journaled(stream)
            return (int(chunks[0].tick[0]), int(chunks[-1].tick[-1])) if chunks else None
        if stream not in self._files:
            return None
        groups = self._files[stream][0].groups
        return groups[0][0], groups[-1][1]

    def rows(self, stream: str, first: int = BEGIN, last: int = END) -> int:
        """See `Run.rows`."""
        if self._files is None:
            groups = [(int(chunk.tick[0]), int(chunk.tick[-1]), len(chunk)) for chunk in self._run.journaled(stream)]
        else:
            groups = list(self._files[stream][0].groups) if stream in self._files else []
        return sum(n for a, b, n in groups if a <= last and b >= first)

    def pieces(
        self, stream: str, first: int = BEGIN, last: int = END, config: StreamConfig | None = None
    ) -> Iterator[SampleChunk | EdgeChunk]:
        """See `Run.pieces`; what is missing between two of them is not in their gaps.

        `config`: with those of the stream's channels that are read; None: all.
        """
        run = self._run
        whole_config = run.config(stream)
        config = config or whole_config
        if self._files is None:
            found = self._run.journaled(stream)
            whole: Iterable[SampleChunk | EdgeChunk] = [of_channels(join(found), config)] if found else []
        else:
            columns = None if config is whole_config else layout.column_names(config)
            tables = self.tables(stream, first, last, columns)
            whole = map(partial(layout.to_chunk, config=config), tables)  # which holds no table
        for chunk in whole:
            part = between(chunk, first, last)
            if len(part):
                yield part

    def intact(self) -> bool:
        """Whether every block of its files is as it was written."""
        return all(self._run.intact(part) for parts in self.files.values() for part in parts)

    def tables(
        self, stream: str, first: int = BEGIN, last: int = END, columns: Collection[str] | None = None
    ) -> Iterator[pa.Table]:
        """The row groups of a stream's file that have ticks from `first` to `last`, as they are stored.

        `columns`: those that are read; None: all.
        """
        if files := self.files.get(stream):
            chosen = [k for k, (a, b, _) in enumerate(files[0].groups) if a <= last and b >= first]
            yield from self._run.groups(files, chosen, columns)


def _whole(run: Run, stream: str, kind: type[Chunk]) -> Chunk:
    if not isinstance(whole := run.chunk(stream), kind):
        raise KeyError(stream)
    return whole


def overviews(run: Run, segment: Segment) -> Iterator[pa.Table]:
    """Minima and maxima of the drive's samples in a segment, see `bench.record.overview`: stored, or made here."""
    if layout.OVERVIEW in segment.files:
        yield from segment.tables(layout.OVERVIEW)
        return
    if layout.SAMPLES in run.names:
        overview = Overview(replace(run.info, channels=run.config(layout.SAMPLES).channels))
        for chunk in segment.pieces(layout.SAMPLES):
            if isinstance(chunk, SampleChunk):
                yield overview.table(chunk)


def capture_of(run: Run, first: int = BEGIN, last: int = END, channels: Collection[str] | None = None) -> Capture:
    """A recording as a capture, or its part from tick `first` to `last`; `channels`: those that are read, None: all.

    BenchError where it holds no samples, lacks a channel, or takes more memory than there is.
    """
    require_memory(run, first, last, channels)
    return gathered(captures(run, first, last, channels), run.rows(layout.SAMPLES, first, last))


def captures(
    run: Run, first: int = BEGIN, last: int = END, channels: Collection[str] | None = None
) -> Iterator[Capture]:
    """The same a piece at a time, some ten seconds or less, in bounded memory: their sum is the whole.

    A piece has the Hall edges up to its last sample, the last piece those after it too. What is missing between two
    pieces is in the `dropped` of the second, and what is missing at the ends in that of the last.
    """
    info = run.info
    has_edges = layout.EDGES in run.names
    none = no_edges(run.config(layout.EDGES) if has_edges else no_edge_stream(info.node, info.tick_hz, info.pwm_hz))
    edges = _Edges(run.pieces(layout.EDGES, first, last) if has_edges else iter(()), none)
    stretches, parameters = LostStretches(), run.parameters

    def capture(samples: SampleChunk, until: int) -> Capture:
        covered = edges.until(until)
        lost = stretches.before(samples) + stretches.before(covered)
        if until == END:
            lost += _lost_at_the_ends(run, first, last, stretches)
            lost += [(m.tick, m.tick, m.text) for m in run.misdated if m.node == info.node and first <= m.tick <= last]
        known = parameters.since(int(samples.tick[0]))
        return Capture(samples, covered, known, tuple(lost), edge_step=info.edge_step)

    waiting: SampleChunk | None = None
    for piece in run.pieces(layout.SAMPLES, first, last, channels) if layout.SAMPLES in run.names else ():
        assert isinstance(piece, SampleChunk)
        if waiting is not None:
            yield capture(waiting, int(waiting.tick[-1]))
        waiting = piece
    if waiting is None:
        why = "; ".join(run.damage) or "record a run in which the shaft turns"
        raise BenchError(f"{run.path} holds no samples: {why}")
    yield capture(waiting, END)


def ahead(items: Iterator[T]) -> Iterator[T]:
    """The same; another thread makes the next one while one is looked at."""
    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = thread.submit(next, items, None)
            yield item


def require_memory(
    run: Run,
    first: int = BEGIN,
    last: int = END,
    channels: Collection[str] | None = None,
    further: int = 0,
) -> None:
    """BenchError where a part of a run does not fit into memory at once, with `further` bytes for each sample."""
    if layout.SAMPLES not in run.names:
        return
    config = narrowed(run.config(layout.SAMPLES), channels)
    of_index_and_tick = 16
    size = run.rows(layout.SAMPLES, first, last) * (config.dtype.itemsize + of_index_and_tick + further)
    needed = size + BESIDE
    if needed > (free := available()):
        a, b = run.span
        raise BenchError(
            f"{run.path}: {in_words(size)} from {run.at(max(a, first))} to "
            f"{run.at(min(b, last))} do not fit into memory ({in_words(free)} are free): read a part of "
            f"the time or some channels, bench.read(path, begin, end, channels), or piece by piece, bench.pieces(path)"
        )


class _Edges:
    """Hall edges, handed out up to a tick."""

    def __init__(self, pieces: Iterator[SampleChunk | EdgeChunk], none: EdgeChunk) -> None:
        self._pieces, self._none = pieces, none
        self._held: list[EdgeChunk] = []

    def until(self, last: int) -> EdgeChunk:
        """Those up to the tick `last` that were not handed out yet."""
        while not self._held or int(self._held[-1].tick[-1]) <= last:
            piece = next(self._pieces, None)
            if not isinstance(piece, EdgeChunk):
                break
            self._held.append(piece)
        whole = join(self._held) if self._held else self._none
        now = int(np.searchsorted(whole.tick, last, "right"))
        rest = part(whole, now, len(whole))
        self._held = [rest] if len(rest) else []
        return part(whole, 0, now)


def _lost_at_the_ends(run: Run, first: int, last: int, stretches: LostStretches) -> Iterator[tuple[int, int, str]]:
    """What no gap between two records tells: damaged before the first or after the last, or never come at the end."""
    for stream, noun in ((layout.SAMPLES, "samples"), (layout.EDGES, "Hall edges")):
        oldest, newest = stretches.seen.get(stream == layout.SAMPLES, (END, -1))
        for a, b, rows in run.damaged(stream, first, last):
            if a > newest or b < oldest:
                yield a, b, f"{rows} {noun} are damaged from {run.at(a)} to {run.at(b)}"
    for missing in run.missing:
        if missing.node == run.info.node and first <= missing.tick <= last:
            for since, _, words in stretches.at_the_end(missing.samples, missing.edges, run.info.tick_hz):
                yield since, max(since, missing.tick), words


def _item(record: Mapping[str, Any]) -> Kept:
    """What was said, of a record of the log."""
    match record["kind"]:
        case "event":
            values = {name: record[name] for name in _EVENT}
            event = DeviceEvent(**values | {name: float(values[name]) for name in ("arg", "detail")})
            return DeviceEventReceived(event.node, event)
        case "heartbeat":
            return HeartbeatReceived(record["from"], _heartbeat(record))
        case "note":
            return Note(record["tick"], record["text"], record["level"])
        case "parameter":
            exact = bool(record.get("exact", False))
            return ParameterSet(record["tick"], record["from"], record["name"], float(record["value"]), exact)
        case "missing":
            return Missing(record["tick"], record["from"], record["samples"], record["edges"])
        case "misdated":
            return Misdated(record["tick"], record["from"], record["text"])
    verdict = None if record["verdict"] is None else Verdict(record["verdict"])
    return Mark(record["name"], record["tick"], record["last"], verdict)


def _heartbeat(record: Mapping[str, Any]) -> Heartbeat:
    values = {name: record[name] for name in _HEARTBEAT}
    kinds: dict[str, Callable[[Any], Any]] = {
        "faults": Fault, "first_fault": Fault, "state": DriveState, "outputs_on": bool
    }  # fmt: skip
    return Heartbeat(**values | {name: kind(values[name]) for name, kind in kinds.items()})


def _metadata(file: Path) -> dict[str, Any]:
    """What a Parquet file says of itself; nothing where it cannot be read."""
    import pyarrow.parquet as pq

    try:
        told = pq.read_schema(file).metadata or {}
        return {name.decode().removeprefix("hallbench:"): json.loads(text) for name, text in told.items()
                if name.startswith(b"hallbench:")}  # fmt: skip
    except (OSError, ValueError):
        return {}


def _advice(path: Path) -> str:
    if path.suffix == RRD and is_run(run_folder(path)):
        return f"{path.name} is a file for rerun; the recording is {run_folder(path)}"
    if path.exists():
        return "a run is a folder made by bench live --save"
    return "nothing is there"

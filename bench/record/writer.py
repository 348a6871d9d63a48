"""Writes a run: what it hears in, files out. No thread, no queue, no clock of its own.

Whatever arrives is appended at once: chunks to the journal, everything else to the log. Every ten seconds of device
time become a row group, every minute a segment: a Parquet file for each stream, one line in the log, and a new journal.
A device that has rebooted, or whose time goes back, begins a new segment. A ring lets old segments go, a whole one at a
time: first its line `removed` is on the disk, then its files go.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.device.heard import Chunk, ClockRestarted, Misdated, Missing, Note, ParameterSet
from bench.device.losses import LossAccount
from bench.errors import RecordingError
from bench.record import journal, layout
from bench.record.folder import RunFolder, SegmentFile, write_all
from bench.record.info import Kept, Mark, RunInfo, SummaryText, stream_to_json
from bench.record.later import Later
from bench.record.layout import Columns
from bench.record.overview import BIN, Overview
from bench.record.ring import Ring
from bench.signal.chunks import join, part
from bench.system import append_to, removed, sync
from protocol.host import DeviceEventReceived, HeartbeatReceived
from protocol.messages import EventCode, Heartbeat
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

PIECE = 0.5  # s of device time that become columns at once: what takes longer would keep the rest of a program waiting
ROW_GROUP = 10.0  # s
SEGMENT = 60.0  # s
_TOLD = ("boot_id", "state", "outputs_on", "faults", "first_fault", "tx_dropped", "rx_bad", "setpoints_rejected")
"""Of a heartbeat: it is logged where one of these has changed."""


@contextmanager
def whole_run(path: Path, info: RunInfo, overwrite: bool = False) -> Iterator[RunWriter]:
    """A writer of a run that appears, whole, at the end of the block; after any exception nothing is left of it.

    Raises RecordingError, also where the disk does not take what it is given.
    """
    writer: RunWriter | None = None
    try:
        writer = RunWriter(path, info, overwrite, whole=True)
        yield writer
        writer.close()
    except BaseException as error:
        if writer is not None:
            writer.discard()
        if isinstance(error, OSError):
            raise RecordingError(f"{path} cannot be written: {error.strerror or error}") from None
        raise


class RunWriter:
    """Writes the run `info` to the folder `path`, which appears when it is a run.

    Raises RecordingError where `path` exists (unless `overwrite`, which replaces a run and nothing else) or cannot be
    made, and OSError out of every other call when the disk does not take what it is given.
    """

    def __init__(
        self,
        path: Path,
        info: RunInfo,
        overwrite: bool = False,
        keep: float | None = None,
        account: LossAccount | None = None,
        whole: bool = False,
        later: Later | None = None,
    ) -> None:
        """`keep`: s of device time that a ring holds, see `bench.record.ring`; `account`: of what went before.

        `whole`: it appears when it is closed, not when it is begun. `later`: what does all that can wait, once the
        journal has what came; it is done at once by default.
        """
        self.path, self.info = path, info
        self.account = account or LossAccount()
        self.samples_written = self.edges_written = 0
        self.stored = (0.0, 0)
        """Seconds of device time in segments that have ended, and the bytes that their files took."""
        self._ring = None if keep is None else Ring(keep, info.tick_hz)
        self._streams: dict[object, _Stream] = {}
        self._by_config: dict[StreamConfig, _Stream] = {}
        self._overview: Overview | None = None
        self._overview_file: SegmentFile | None = None
        self._number = 1  # of the segment that is being written
        self._begun: int | None = None  # its first tick
        self.newest = 0
        """The newest device time of the drive, in ticks."""
        self._told: dict[int, tuple[object, ...]] = {}  # of the last heartbeat that was logged, by node
        self._folder = RunFolder(path, info, overwrite)
        self._line = self._folder.line
        self._whole = whole
        self._later = later
        self._held: list[Path] = []  # files of segments that were let go, which another program had open
        if not whole:
            self._folder.put_in_place()
        try:
            self._journal = append_to(self._folder.path / layout.journal_name(1))
        except OSError:
            self._folder.discard()
            raise

    # -- what comes ---------------------------------------------------------------------------------------------

    def take(self, item: Kept) -> None:
        """Write an item: a heartbeat only if it tells anything new."""
        self.account.take(item)
        match item:
            case SampleChunk():
                self._chunk(item)
                self.samples_written += len(item)
            case EdgeChunk():
                self._chunk(item)
                self.edges_written += len(item)
            case HeartbeatReceived(node=node, heartbeat=heartbeat):
                self._heartbeat(node, heartbeat)
            case DeviceEventReceived(node=node, event=event):
                if event.code == EventCode.FAULT:
                    self._moment(event.tick, event.tick)
                name = EventCode(event.code).name if event.code in list(EventCode) else str(event.code)
                self._line({"kind": "event", **asdict(event), "node": node, "name": name})
            case ClockRestarted():
                self._restart(item)
            case Missing():
                self._said("missing", item)
            case Misdated():
                self._said("misdated", item)
            case ParameterSet():
                self._said("parameter", item)
            case Note():
                self._line({"kind": "note", **item._asdict()})
            case Mark():
                if not item.routine:
                    self._moment(item.first_tick, item.last_tick)
                self._line(layout.mark_record(item))
            case SummaryText(markdown=text):
                self._line({"kind": "summary", "text": text})

    def _heartbeat(self, node: int, heartbeat: Heartbeat) -> None:
        self._seen(node, heartbeat.tick)
        told = tuple(getattr(heartbeat, name) for name in _TOLD)
        if self._told.get(node) != told:
            if heartbeat.faults:  # its event may have been lost with the link
                self._moment(heartbeat.tick, heartbeat.tick)
            self._told[node] = told
            self._line({"kind": "heartbeat", "from": node, **asdict(heartbeat)})

    def _restart(self, restarted: ClockRestarted) -> None:
        """Begin a new segment, in which the time of a device starts anew."""
        self._end_segment()
        node, tick, rebooted = restarted
        if rebooted:
            self._line({"kind": "rebooted", "tick": tick, "from": node, "segment": self._number})
        if node == self.info.node:
            self.newest = 0
            if self._ring is not None:
                self._ring.restarted()

    def _said(self, kind: str, item: Missing | Misdated | ParameterSet) -> None:
        """Write a line with all of an item of a node."""
        told = item._asdict()
        self._line({"kind": kind, "tick": told.pop("tick"), "from": told.pop("node"), **told})

    def sync(self) -> None:
        """Have the disk take what was written, so that a power cut costs no more than what comes after."""
        self._do(partial(sync, self._journal))
        self._do(self._folder.sync)

    def _do(self, work: Callable[[], object]) -> None:
        if self._later is None:
            work()
        else:
            self._later.do(work)

    def _wait(self) -> None:
        """Until all that could wait has been done."""
        if self._later is not None:
            self._later.wait()

    def close(self) -> None:
        """End the run."""
        if self._journal < 0:
            return
        try:
            self._end_segment()
            lost = {name: n for name, n in self.account.counters.items() if n}
            self._line({"kind": "end", "samples": self.samples_written, "edges": self.edges_written, "lost": lost})
            self.sync()
            self._wait()
            os.close(self._journal)
            self._journal = -1
            (self._folder.path / layout.journal_name(self._number)).unlink()
            (self._folder.path / layout.ASKED).unlink(missing_ok=True)
            if self._whole:
                self._folder.put_in_place()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Let go of the files, as they are: the run stays readable up to here."""
        with suppress(Exception):  # that is told already
            self._wait()
        for file in [stream.file for stream in self._streams.values()] + [self._overview_file]:
            if file is not None:
                file.discard()
        if self._journal >= 0:
            os.close(self._journal)
            self._journal = -1
        self._folder.close()

    def discard(self) -> None:
        """Remove what was written of a run that has not appeared yet."""
        self.abandon()
        self._folder.discard()

    # -- chunks -------------------------------------------------------------------------------------------------

    def _chunk(self, chunk: Chunk) -> None:
        first, last = int(chunk.tick[0]), int(chunk.tick[-1])
        stream = self._by_config.get(chunk.config) or self._stream_of(chunk.config)
        hz = self.info.tick_hz
        if first < stream.last or (self._begun is not None and first - self._begun >= SEGMENT * hz):
            self._end_segment()
        self._begun = first if self._begun is None else min(self._begun, first)
        write_all(self._journal, journal.frame(stream.number, chunk))
        stream.last = last
        stream.pending.append(chunk)
        self._seen(chunk.config.node, last)
        if last - int(stream.pending[0].tick[0]) >= PIECE * hz:
            self._piece(stream, last - last % round(BIN * hz))
        if stream.group is not None and last - stream.group >= ROW_GROUP * hz:
            self._row_group(stream)

    def _piece(self, stream: _Stream, end: int | None = None) -> None:
        """Make columns of what waits, up to tick `end`: a bin of the overview is of one piece."""
        if not stream.pending:
            return
        whole: Chunk = join(stream.pending)
        stream.pending.clear()
        if end is not None:
            n = int(np.searchsorted(whole.tick, end))
            if n < len(whole):
                stream.pending.append(part(whole, n, len(whole)))
            if not n:
                return
            whole = part(whole, 0, n)
        stream.group = int(whole.tick[0]) if stream.group is None else stream.group
        self._do(partial(self._columns, stream, whole))

    def _columns(self, stream: _Stream, whole: Chunk) -> None:
        overview = None
        if stream.name == layout.SAMPLES and isinstance(whole, SampleChunk):
            if self._overview is None:
                self._overview = Overview(replace(self.info, channels=whole.config.channels))
            overview = self._overview.table(whole)
        table = layout.to_table(whole, stream.columns)
        stream.pieces.append(_Piece(int(whole.tick[0]), int(whole.tick[-1]), table, overview))

    def _row_group(self, stream: _Stream) -> None:
        """Move the pieces of a stream to its file."""
        if stream.group is not None:
            stream.group = None
            self._do(partial(self._write_group, stream, self._number))

    def _write_group(self, stream: _Stream, segment: int) -> None:
        pieces, stream.pieces = stream.pieces, []
        span = pieces[0].first, pieces[-1].last
        if stream.file is None:
            stream.file = SegmentFile(self._folder.path, stream.name, segment, stream.columns)
        stream.file.add(layout.joined([piece.table for piece in pieces]), *span)
        overviews = [piece.overview for piece in pieces if piece.overview is not None]
        if overviews and self._overview is not None:
            if self._overview_file is None:
                columns = self._overview.columns
                self._overview_file = SegmentFile(self._folder.path, layout.OVERVIEW, segment, columns)
            self._overview_file.add(layout.joined(overviews), *span)

    def _end_segment(self) -> None:
        """Close the files of this segment, log them, and begin the next."""
        for stream in self._streams.values():
            self._piece(stream)
            self._row_group(stream)
        self._wait()
        open_files = [stream.file for stream in self._streams.values()] + [self._overview_file]
        files = [file.finish() for file in open_files if file is not None]
        self._overview_file = None
        for stream in self._streams.values():
            stream.file, stream.last = None, -1
        if not files:
            return
        self._line({"kind": "segment", "number": self._number, "files": files})
        self._folder.sync()
        self._ended_segment(files)
        done, self._journal = self._journal, append_to(self._folder.path / layout.journal_name(self._number + 1))
        os.close(done)
        (self._folder.path / layout.journal_name(self._number)).unlink()
        self._number += 1
        self._begun = None

    def _ended_segment(self, files: Sequence[Mapping[str, Any]]) -> None:
        """Count what a segment has taken, and let go of those that the ring does not hold."""
        first = min(groups[0][0] for file in files if (groups := file["groups"]))
        last = max(groups[-1][1] for file in files if (groups := file["groups"]))
        seconds, size = self.stored
        taken = sum(file["blocks"][-1][0] for file in files)
        self.stored = seconds + (last - first) / self.info.tick_hz, size + taken
        gone = self._ring.ended(self._number, first, last) if self._ring is not None else []
        for number in gone:
            self._line({"kind": "removed", "number": number})
        if gone:
            self._folder.sync()
        self._held += [file for number in gone for file in self.path.glob(layout.file_name("*", number))]
        self._held = [file for file in self._held if not removed(file)]

    def _moment(self, first: int, last: int) -> None:
        if self._ring is not None:
            self._ring.moment(first, last)

    def _stream_of(self, config: StreamConfig) -> _Stream:
        key = layout.stream_key(config)
        stream = self._streams.get(key)
        if stream is None:
            name = layout.stream_name(config, self.info.node, [known.name for known in self._streams.values()])
            columns = layout.stream_columns(config, name, self.info)
            stream = self._streams[key] = _Stream(name, len(self._streams), columns)
            self._line({"kind": "stream", "number": stream.number, **stream_to_json(config, name)})
        self._by_config[config] = stream
        return stream

    def _seen(self, node: int, tick: int) -> None:
        if node == self.info.node:
            self.newest = max(self.newest, tick)


@dataclass(frozen=True)
class _Piece:
    """Half a second of a stream as columns, and what is seen of it from afar; its first and last tick."""

    first: int
    last: int
    table: Any
    overview: Any


@dataclass
class _Stream:
    """A stream: what waits for the next row group, and the file that it goes to."""

    name: str
    number: int
    columns: Columns
    pending: list[Any] = field(default_factory=list)
    group: int | None = None  # first tick of the pieces that have not been told to go to the file
    pieces: list[_Piece] = field(default_factory=list)
    file: SegmentFile | None = None
    last: int = -1  # tick, in this segment

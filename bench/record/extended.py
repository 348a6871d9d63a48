"""A new run made of an old one and further columns: the old files are linked, not copied, and the log is taken over.

A segment of which not all is as it was written, or that is in the journal yet, is written anew from what can be read.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.device.losses import Continuity
from bench.errors import RecordingError
from bench.record import layout
from bench.record.folder import RunFolder, SegmentFile
from bench.record.info import RunInfo, stream_to_json
from bench.record.overview import Overview
from bench.record.reader import Run, Segment, ahead
from bench.signal.chunks import with_columns
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

More = Callable[[SampleChunk], Sequence[NDArray[np.generic]]]
"""Gives the raw values of the further channels at the samples of a chunk, (n,) each."""


class Extension:
    """Writes the run `run` with further channels to `path`, as `info` describes it. Raises RecordingError.

    `needed`: names of the channels that the further ones are made of; None: all.
    """

    def __init__(
        self, run: Run, path: Path, info: RunInfo, overwrite: bool = False, needed: Collection[str] | None = None
    ) -> None:
        self._run, self._path = run, path
        self._folder = RunFolder(path, info, overwrite)
        config = run.config(layout.SAMPLES)
        self._config = replace(config, channels=info.channels)
        looked_at = None if needed is None else {*needed, info.position_reference}  # from which errors are taken
        self._narrow = replace(
            config, channels=tuple(c for c in config.channels if looked_at is None or c.name in looked_at)
        )
        self._added = info.channels[len(config.channels) :]
        self._columns = {name: layout.stream_columns(self._configured(name), name, info) for name in run.names}
        self._more = layout.columns_of(
            [layout.channel_field(c, layout.column_of(c.name)) for c in self._added], {"of": layout.SAMPLES}
        )
        self._overview, self._more_overview = Overview(info), Overview(info, self._added)
        self._written = dict.fromkeys((layout.SAMPLES, layout.EDGES), 0)

    def write(self, more: More, edges: Callable[[EdgeChunk], None], summary: Callable[[], str]) -> None:
        """Write it: the edges of a segment are handed to `edges` before its samples to `more`."""
        try:
            for record in self._run.records(("end", "run", "segment", "stream", "summary")):
                self._folder.line(record)
            for number, name in enumerate(self._run.names):
                self._folder.line({"kind": "stream", "number": number, **stream_to_json(self._configured(name), name)})
            continuity = Continuity()
            for segment in self._run.segments:
                segment.begin(continuity)
                self._segment(segment.number, segment, continuity, more, edges)
            self._folder.line({"kind": "summary", "text": summary()})
            if self._run.ended:
                self._folder.line({"kind": "end", **self._written, "lost": self._run.lost})
            self._folder.sync()
            self._folder.put_in_place()
            self._folder.close()
        except OSError as error:
            self._folder.discard()
            raise RecordingError(f"{self._path} cannot be written: {error}") from None
        except BaseException:
            self._folder.discard()
            raise

    def _configured(self, stream: str) -> StreamConfig:
        return self._config if stream == layout.SAMPLES else self._run.config(stream)

    def _segment(
        self, number: int, segment: Segment, continuity: Continuity, more: More, edges: Callable[[EdgeChunk], None]
    ) -> None:
        for chunk in segment.pieces(layout.EDGES) if layout.EDGES in self._run.names else ():
            if isinstance(chunk, EdgeChunk):
                edges(continuity.chunk(chunk))
                self._written[layout.EDGES] += len(chunk)
        whole = segment.files and segment.intact()
        files = (
            self._linked(number, segment, continuity, more)
            if whole
            else self._rewritten(number, segment, continuity, more)
        )
        self._folder.line({"kind": "segment", "number": number, "files": files})

    def _linked(self, number: int, segment: Segment, continuity: Continuity, more: More) -> list[dict[str, Any]]:
        """Link the files of a segment and write one with the new columns beside them."""
        files = []
        for stream, parts in segment.files.items():
            for part in parts:
                _link(self._run.path / part.name, self._folder.path / part.name)
                files.append({"stream": stream, "name": part.name, "groups": part.groups, "blocks": part.blocks})
        if layout.SAMPLES not in segment.files:
            return files
        added = SegmentFile(self._folder.path, layout.SAMPLES, number, self._more, "host")
        overview = SegmentFile(self._folder.path, layout.OVERVIEW, number, self._more_overview.columns, "host")

        read = ahead(segment.pieces(layout.SAMPLES, config=self._narrow))
        chunks = (continuity.chunk(chunk) for chunk in read if isinstance(chunk, SampleChunk))
        for chunk, columns in ahead((chunk, more(chunk)) for chunk in chunks):  # one is read, one made, one written
            first, last = int(chunk.tick[0]), int(chunk.tick[-1])
            added.add(layout.table_of(self._more, columns), first, last)
            overview.add(self._more_overview.table(chunk, columns), first, last)
            self._written[layout.SAMPLES] += len(chunk)
        return [*files, added.finish(), overview.finish()]

    def _rewritten(self, number: int, segment: Segment, continuity: Continuity, more: More) -> list[dict[str, Any]]:
        files: dict[str, SegmentFile] = {}

        def add(name: str, columns: layout.Columns, table: Any, chunk: SampleChunk | EdgeChunk) -> None:
            if name not in files:
                files[name] = SegmentFile(self._folder.path, name, number, columns)
            files[name].add(table, int(chunk.tick[0]), int(chunk.tick[-1]))

        for name in self._run.names:
            for chunk in segment.pieces(name):
                chunk = continuity.chunk(chunk)
                if name == layout.SAMPLES and isinstance(chunk, SampleChunk):
                    chunk = with_columns(chunk, self._config, more(chunk))
                    self._written[name] += len(chunk)
                    add(layout.OVERVIEW, self._overview.columns, self._overview.table(chunk), chunk)
                add(name, self._columns[name], layout.to_table(chunk, self._columns[name]), chunk)
        return [file.finish() for file in files.values()]


def _link(source: Path, target: Path) -> None:
    """The file under another name too; a copy where the file system has no links."""
    with suppress(OSError):
        os.link(source, target)
        return
    shutil.copyfile(source, target)

"""A run's folder as it is made: the log, Parquet files, and the way into its place.

A folder is made under a name of its own and put in its place when it holds a run; so is each Parquet file.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from bench.errors import RecordingError
from bench.files import is_run, part_of
from bench.record import layout
from bench.record.info import RunInfo
from bench.record.layout import CheckedFile, Columns
from bench.system import MOVES_OPEN_FILES, append_to, lock, sync


class RunFolder:
    """A new folder for the run `info`, beside `target` until it is put in its place, with its log begun.

    Raises RecordingError where `target` exists (unless `overwrite`, which replaces a run and nothing else), or no
    folder can be made there.
    """

    def __init__(self, target: Path, info: RunInfo, overwrite: bool) -> None:
        self._target, self._overwrite = target, overwrite
        if os.path.lexists(target) and not (overwrite and is_run(target)):
            what = "choose another name, or --overwrite to replace it" if is_run(target) else "it is not a recorded run"
            raise RecordingError(f"{target} exists: {what}")
        self.path = part_of(target)
        try:
            self.path.mkdir()
            self._log = append_to(self.path / layout.LOG)
        except OSError as error:
            raise RecordingError(f"{target} cannot be created: {error.strerror}") from None
        lock(self._log)  # as long as this is held the run is being written
        self.line({"kind": "run", "format": layout.FORMAT, "id": info.recording_id, **info.to_json()})

    def line(self, record: Mapping[str, Any]) -> None:
        """Add a record to the log. Raises OSError."""
        write_all(self._log, layout.line_of(record).encode())

    def put_in_place(self) -> None:
        """Give the folder its name. Raises RecordingError; it is gone then."""
        try:
            if self._overwrite and is_run(self._target):
                remove(self._target)
            if not MOVES_OPEN_FILES:
                self.close()
            self.path.rename(self._target)
            self.path = self._target
            if not MOVES_OPEN_FILES:
                self._log = append_to(self.path / layout.LOG)
                lock(self._log)
        except OSError as error:
            self.discard()
            raise RecordingError(f"{self._target} cannot be created: {error.strerror}") from None

    def sync(self) -> None:
        """Have the disk take the log."""
        sync(self._log)

    def close(self) -> None:
        """Let go of the log."""
        if self._log >= 0:
            os.close(self._log)
            self._log = -1

    def discard(self) -> None:
        """Remove the folder with what is in it."""
        self.close()
        with suppress(OSError):
            remove(self.path)


class SegmentFile:
    """A Parquet file that is being written, under a name of its own until it is whole."""

    def __init__(self, folder: Path, stream: str, number: int, columns: Columns, part: str = "") -> None:
        """`part`: names further columns of a stream that has a file already."""
        self._stream = stream
        self._groups: list[tuple[int, int, int]] = []  # first and last tick, rows
        self._path = folder / layout.file_name(stream if not part else f"{part}.{stream}", number)
        self._part = part_of(self._path)
        self._file: BinaryIO = self._part.open("xb")
        self._checked = CheckedFile(self._file)
        self._writer = columns.writer(self._checked)

    def add(self, table: Any, first: int, last: int) -> None:
        """Add a row group, of device time from tick `first` to `last`."""
        self._writer.write_table(table, row_group_size=max(1, table.num_rows))
        self._checked.end_block()
        self._groups.append((first, last, table.num_rows))

    def finish(self) -> dict[str, Any]:
        """Put it in its place, and say what the log is to say of it."""
        self._writer.close()
        self._checked.end_block()
        self._file.flush()
        sync(self._file.fileno())
        self._file.close()
        self._part.rename(self._path)
        return {"stream": self._stream, "name": self._path.name, "groups": self._groups, "blocks": self._checked.blocks}

    def discard(self) -> None:
        """Remove it, unless it is in its place."""
        with suppress(Exception):  # its writer may try to end the file that could not be written
            self._writer.close()
        with suppress(OSError):
            self._file.close()
        with suppress(OSError):
            self._part.unlink(missing_ok=True)


def remove(path: Path) -> None:
    """Remove a run, or a file, if there is one, and nothing else that may lie in a run's folder. Raises OSError."""
    if not path.is_dir() or path.is_symlink():
        path.unlink(missing_ok=True)
        return
    ours = [layout.LOG, layout.ASKED, f"{layout.JOURNAL}*", "*-[0-9][0-9][0-9][0-9][0-9][0-9].parquet", ".*.part"]
    for pattern in ours:
        for file in path.glob(pattern):
            file.unlink()
    path.rmdir()


def write_all(descriptor: int, data: bytes) -> None:
    """Write all of it. Raises OSError."""
    view = memoryview(data)
    while len(view):
        view = view[os.write(descriptor, view) :]

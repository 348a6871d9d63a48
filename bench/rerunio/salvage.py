"""Finds the end of what was written whole in an .rrd file that was cut short: by kill -9, a full disk, a power cut.

rerun refuses a file whose last message is incomplete, so it is left out: from a copy for reading, or from the file
itself. An .rrd file is a 12-byte header and then messages of {kind u64, length u64, payload}, little-endian; kind 0
begins the footer that ends a finished file.
"""

from __future__ import annotations

import os
import shutil
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_MAGIC = b"RRF2"
_HEADER_BYTES = 12
_MESSAGE = struct.Struct("<QQ")
_END = 0


def whole_length(path: Path) -> int:
    """Bytes of `path` up to the end of its last whole message; all of them for a finished or a foreign file."""
    return _walked(path)[0]


def ends_early(path: Path) -> bool:
    """Whether `path` is a recording without the footer that ends a finished one: cut short, or still being written."""
    return not _walked(path)[1]


def _walked(path: Path) -> tuple[int, bool]:
    """`whole_length`, and whether the file is finished, or foreign."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(_HEADER_BYTES)[: len(_MAGIC)] != _MAGIC:
            return size, True
        position = _HEADER_BYTES
        while len(head := file.read(_MESSAGE.size)) == _MESSAGE.size:
            kind, length = _MESSAGE.unpack(head)
            end = position + _MESSAGE.size + length
            if end > size:
                break
            if kind == _END:
                return size, True
            position = end
            file.seek(position)
    return position, False


def mend(path: Path) -> None:
    """Cut an incomplete last message off the file itself, so that every program reads it."""
    length = whole_length(path)
    if length < path.stat().st_size:
        os.truncate(path, length)


@contextmanager
def readable(path: Path) -> Iterator[Path]:
    """Give `path`, or a temporary copy without the incomplete last message."""
    length = whole_length(path)
    if length == path.stat().st_size:
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="hallbench-") as folder:
        copy = Path(folder) / path.name
        shutil.copyfile(path, copy)
        os.truncate(copy, length)
        yield copy

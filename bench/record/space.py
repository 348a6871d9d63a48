"""The room on the disk that a recording goes to: said in time, and never used up to the last byte."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

RESERVE = 64 << 20  # bytes that are left alone: what is on its way, and the run's end, go there
LOW = (600.0, 120.0)  # s that are left when it is said
Free = Callable[[Path], int]


def free_bytes(path: Path) -> int:
    """Bytes that can be written where `path` is. Raises OSError."""
    return shutil.disk_usage(path).free


def too_little(path: Path, free: int) -> str:
    """Words for a place where a recording cannot begin, or go on; empty where it can."""
    if free >= RESERVE:
        return ""
    return (
        f"the disk is full: {free >> 20} MiB are free in {path.absolute().parent}, and {RESERVE >> 20} MiB are "
        "reserved; free some space or record elsewhere"
    )


class Room:
    """How long the disk lasts, and what has been said of it.

    `keep`: s of a recording of which no more is kept, infinite for one that grows.
    """

    def __init__(self, keep: float = math.inf) -> None:
        self._keep = keep
        self._left = list(LOW)

    def words(self, free: int, seconds: float, size: int) -> str:
        """What is to be said when `free` bytes are left, and `seconds` of the run took `size` bytes; mostly nothing."""
        rate = size / seconds if seconds > 0.0 else 0.0
        if rate <= 0.0:
            return ""
        lasts = (free - RESERVE) / rate
        if lasts >= self._keep - seconds:
            return ""
        said = [limit for limit in self._left if lasts < limit]
        if not said:
            return ""
        self._left = [limit for limit in self._left if limit not in said]
        return (
            f"the disk will be full in {lasts / 60.0:.1f} min: {free >> 20} MiB are free, at {rate / 1e3:.0f} kB/s; "
            "the recording then ends, complete"
        )

"""Which other programs have a serial port open, on Linux: one that reads it without a lock takes bytes away."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

PROC = Path("/proc")


def rivals(port: str, but: int = 0) -> list[str]:
    """Other programs that have `port` open, as "cat (pid 4711)"; those of other users only if this one may look.

    The other end of a pty, which may have its port open to keep it alive, is none, nor is process `but`. Nothing but on
    Linux.
    """
    try:
        wanted = _device(os.stat(port))
        processes = sorted(int(entry.name) for entry in PROC.iterdir() if entry.name.isdecimal())
    except OSError:
        return []
    found: dict[int, str] = {}
    for pid in processes:
        if pid not in (os.getpid(), but) and _has_open(PROC / str(pid), port, wanted):
            with suppress(OSError):
                if _parent(PROC / str(pid)) not in found:  # else that has it read ahead
                    found[pid] = f"{(PROC / str(pid) / 'comm').read_text('utf-8', 'replace').strip()} (pid {pid})"
    return list(found.values())


def _parent(process: Path) -> int:
    (line,) = (
        line for line in (process / "status").read_text("utf-8", "replace").splitlines() if line.startswith("PPid:")
    )
    return int(line.split()[1])


def _has_open(process: Path, port: str, wanted: int) -> bool:
    index = os.path.realpath(port).removeprefix("/dev/pts/")
    there = False
    with suppress(OSError):  # another user's, or it has ended
        for entry in (process / "fd").iterdir():
            with suppress(OSError):
                place = os.readlink(entry)
                if place.endswith("/ptmx") and f"tty-index:\t{index}\n" in (process / "fdinfo" / entry.name).read_text(
                    "utf-8"
                ):
                    return False
                there |= place.startswith("/dev/") and _device(os.stat(entry)) == wanted
    return there


def _device(status: os.stat_result) -> int:
    return int(getattr(status, "st_rdev", 0))  # Windows has none

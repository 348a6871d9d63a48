"""Which files in a report's directory a report made, so that the next one can take away what it does not replace.

Nothing else there is ever deleted.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from bench.record.folder import remove

LIST = ".report-files"
"""One name a line, relative to the directory; written before the file, so that a run that was killed left no other."""
PLACES = ("figures", "recordings")
"""Directories in that of a report."""


def claim(directory: Path, name: str) -> None:
    """Note that this report makes the file `name`; workers may do so at the same time. Raises OSError."""
    with (directory / LIST).open("a", encoding="utf-8") as file:
        file.write(f"{name}\n")


def keep_only(directory: Path, names: Collection[str]) -> None:
    """Delete what earlier reports made there, and this one has not: all but `names`. Raises OSError."""
    for name in _listed(directory) - set(names):
        path = directory / name
        remove(path)
        with suppress(OSError):  # not empty
            path.parent.rmdir()
    for place in PLACES:
        with suppress(OSError):
            (directory / place).rmdir()
    (directory / LIST).write_text("".join(f"{name}\n" for name in sorted(names)), encoding="utf-8")


def holds_report(directory: Path) -> bool:
    """Whether an earlier report, whole or not, is in a directory."""
    return os.path.exists(directory / LIST) or os.path.exists(directory / "report.html")


def _listed(directory: Path) -> set[str]:
    """What may be deleted: the list is a file that anybody may have changed."""
    try:
        lines = (directory / LIST).read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return set()
    return {line for line in lines if line.partition("/")[0] in PLACES and ".." not in Path(line).parts}

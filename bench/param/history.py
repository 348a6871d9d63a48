"""Why parameters were changed: a file on this computer for each device, by its serial number, a line for each change.

A line is appended whole. One that was cut, or that somebody has damaged, is skipped and counted.
"""

from __future__ import annotations

import getpass
import json
import os
import socket
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from platformdirs import user_data_path

from bench.errors import BenchError
from bench.files import file_name
from bench.param.dump import Reason
from bench.param.table import Parameters, same
from bench.system import append_to, sync

_FIELDS = {"when": str, "who": str, "node": int, "name": str, "before": float, "asked": float, "value": float,
           "reason": str, "by": str}  # fmt: skip


@dataclass(frozen=True)
class Changed:
    """A parameter was changed: from `before` to `value`, which the device made of what was `asked`. `by`: a command."""

    when: str
    who: str
    node: int
    name: str
    before: float
    asked: float
    value: float
    reason: str
    by: str


def who() -> str:
    """Who this is, and on which computer."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # a user without a name, in a container
        user = str(os.getuid()) if hasattr(os, "getuid") else "unknown"
    return f"{user}@{socket.gethostname()}"


def now() -> str:
    """Date and time, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def place(serial: str) -> Path:
    """The file of the device with this serial number."""
    return user_data_path("hallbench") / "parameters" / f"{file_name(serial)}.jsonl"


def add(serial: str, changes: Iterable[Changed]) -> None:
    """Keep changes that were made to the device with this serial number. BenchError where that cannot be written."""
    lines = "".join(json.dumps(asdict(change), allow_nan=False) + "\n" for change in changes)
    if not lines:
        return
    file = place(serial)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        descriptor = append_to(file)
        try:
            os.write(descriptor, lines.encode())
            sync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise BenchError(f"the drive has the new values; why cannot be kept in {file}: {error.strerror}") from None


@dataclass(frozen=True)
class History:
    """The changes of one device that are known here, the oldest first; `damaged`: lines that could not be read."""

    changes: tuple[Changed, ...] = ()
    damaged: int = 0

    def reasons(self, node: int) -> dict[str, Reason]:
        """By parameter of a node, its last change, in the order in which parameters were first changed."""
        return {c.name: Reason(c.before, c.value, c.when, c.who, c.reason) for c in self.changes if c.node == node}

    def rounds(self, node: int, name: str, asked: float, value: float) -> bool:
        """Whether the device has made `value` of `asked` before: its parameter has coarser steps."""
        mine = (c for c in self.changes if c.node == node and c.name == name)
        return any(same(c.asked, asked) and same(c.value, value) for c in mine)


def read(parameters: Parameters) -> History:
    """What is known of the device whose parameters these are; nothing where it tells no serial number."""
    if not parameters.serial:
        return History()
    try:
        lines = place(parameters.serial).read_bytes().split(b"\n")
    except OSError:
        return History()
    found, damaged = [], 0
    for line in filter(None, lines):
        change = _changed(line)
        if change is None:
            damaged += 1
        else:
            found.append(change)
    return History(tuple(found), damaged)


def _changed(line: bytes) -> Changed | None:
    record: Any = None
    with suppress(ValueError, RecursionError):
        record = json.loads(line)
    if not isinstance(record, Mapping):
        return None
    values: dict[str, Any] = {}
    for name, kind in _FIELDS.items():
        value = record.get(name)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or isinstance(value, bool):
            return None
        values[name] = value
    return Changed(**values)

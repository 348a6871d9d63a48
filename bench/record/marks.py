"""Marks from outside: another terminal asks, the program that records answers in the run's log.

Both are on one machine, so that one monotonic clock serves both. An asked mark is a line in the run's folder, with a
number of its own; the recorder writes the mark to the log, with that number.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

from bench.errors import BenchError
from bench.files import RRD, is_run, run_folder
from bench.record import layout
from bench.record.folder import write_all
from bench.record.info import Mark
from bench.record.reader import Run
from bench.system import append_to, lock, sync

ANSWER = 3.0  # s in which a recorder answers
PAUSE = 0.02  # s between looks at the log
LOOKS = 5  # for a run that is being recorded


@dataclass(frozen=True)
class Asked:
    """A mark that somebody asks for: `text`, at host time `host` in s as `time.monotonic` counts it."""

    id: str
    host: float
    text: str


class Inbox:
    """What is asked for of a run, for the program that records it."""

    def __init__(self) -> None:
        self._path = Path()
        self._read = 0  # bytes

    def new(self, path: Path) -> list[Asked]:
        """What was asked for of the run in the folder `path` since the last call. A line that is not whole waits."""
        if path != self._path:
            self._path, self._read = path, 0
        file = path / layout.ASKED
        try:
            if file.stat().st_size <= self._read:
                return []
            data = file.read_bytes()[self._read :]
        except OSError:
            return []
        whole = data.rpartition(b"\n")[0].decode("ascii", "surrogateescape")
        self._read += len(whole) + 1 if whole else 0
        found = (layout.record_of(line) for line in whole.split("\n"))
        return [Asked(record["id"], record["host"], record["text"]) for record in found if record is not None]


def newest(path: Path) -> Path:
    """The folder that is meant by `path`: itself, the one beside an .rrd, or the newest part of a run that is split."""
    folder = run_folder(path) if path.suffix == RRD else path
    if is_run(folder):
        return folder
    parts = sorted(part for part in layout.parts_of(folder) if is_run(part))
    return parts[-1] if parts else folder


def ask(path: Path, text: str, now: Callable[[], float] = time.monotonic) -> tuple[Path, Mark]:
    """Have the program that records the run `path` mark this moment. Returns the run, and the mark as its log has it.

    Raises BenchError where nobody records it, or nobody answers.
    """
    asked = Asked(uuid4().hex[:12], now(), text)
    run = _recorded(path)
    seen = _put(run.path, asked)
    while now() < asked.host + ANSWER:
        present = newest(path)  # before the log is looked at: what another part follows is complete
        for record in _since(run.path / layout.LOG, seen):
            if record.get("id") == asked.id and record["kind"] == "mark":
                return run.path, Mark(record["name"], record["tick"], record["last"])
        if present != run.path:  # that part was ended before it was looked at
            (run.path / layout.ASKED).unlink(missing_ok=True)
            run = Run(present)
            seen = _put(run.path, asked)
        time.sleep(PAUSE)
    if run.being_written:
        raise BenchError(f"the program that records {run.path} did not confirm the mark within {ANSWER:g} s")
    (run.path / layout.ASKED).unlink(missing_ok=True)
    raise BenchError(f"{run.path} has just ended: mark a device time with --at S")


def _recorded(path: Path) -> Run:
    """The run that is being recorded. Between two parts there may be none, for less than `LOOKS` looks."""
    for look in range(LOOKS):
        time.sleep(PAUSE if look else 0.0)
        if (run := Run(newest(path))).being_written:
            return run
    raise BenchError(f"{run.path} is not being recorded: mark a device time with --at S")


def add(path: Path, text: str, seconds: float) -> Mark:
    """Mark the device time `seconds` in the run `path`, which is not being recorded.

    Raises BenchError where it has no such time.
    """
    run = Run(path)
    tick = round(seconds * run.info.tick_hz)
    if not run.segments or not run.span[0] <= tick <= run.span[1]:
        of = f"it is from {run.at(run.span[0])} to {run.at(run.span[1])}" if run.segments else "it holds nothing"
        raise BenchError(f"{path} has no {seconds:g} s: {of}")
    mark = Mark(text, tick, tick)
    try:
        log = append_to(path / layout.LOG)
    except OSError as error:
        raise BenchError(f"{path} cannot be marked: {error.strerror}") from None
    try:
        lock(log)
        data = (path / layout.LOG).read_bytes()
        write_all(log, (b"" if data.endswith(b"\n") else b"\n") + layout.line_of(layout.mark_record(mark)).encode())
        sync(log)
    except BlockingIOError:
        raise BenchError(f"{path} is being recorded: omit --at to mark the present moment") from None
    except OSError as error:
        raise BenchError(f"{path} cannot be marked: {error.strerror}") from None
    finally:
        os.close(log)
    return mark


def _put(folder: Path, asked: Asked) -> int:
    """Ask for a mark of the run in `folder`; returns the bytes of its log before."""
    seen = (folder / layout.LOG).stat().st_size
    descriptor = append_to(folder / layout.ASKED)
    try:
        line = layout.line_of({"id": asked.id, "host": asked.host, "text": asked.text})
        write_all(descriptor, line.encode())
    finally:
        os.close(descriptor)
    return seen


def _since(log: Path, start: int) -> Iterator[dict[str, Any]]:
    """Records of a log from byte `start` on."""
    with log.open("rb") as file:
        file.seek(start)
        lines = file.read().decode("ascii", "surrogateescape").split("\n")
    return (record for line in lines if (record := layout.record_of(line)) is not None)

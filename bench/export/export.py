"""A run in another format: which one, whether it can be, and files that appear whole or not at all."""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.errors import BenchError
from bench.export import ENDINGS
from bench.export.content import Content
from bench.files import check_output, part_of
from bench.record.reader import Run
from protocol.text import either


@dataclass(frozen=True)
class Exported:
    """What was exported: `files` by what they hold, `rows` by table, `notes` for who asked."""

    files: Mapping[str, Path]
    rows: Mapping[str, int]
    span: tuple[float, float]
    """s of device time"""
    notes: tuple[str, ...]


def format_of(out: Path, named: str | None) -> str:
    """The format that `named` says, or the ending of `out`. Raises BenchError where they do not."""
    by_ending = next((name for name, ending in ENDINGS.items() if ending == out.suffix.lower()), None)
    if named is None and by_ending is None:
        raise BenchError(f"{out} has no known extension: use {either(ENDINGS.values())}, "
                         "or --format")  # fmt: skip
    if named is not None and by_ending not in (None, named):
        raise BenchError(f"{out} has the extension of {by_ending}, but --format is {named}: use {ENDINGS[named]}")
    return named or by_ending or ""


def export(
    run: Run,
    out: Path,
    named: str | None = None,
    begin: float | None = None,
    end: float | None = None,
    channels: Sequence[str] | None = None,
    overwrite: bool = False,
) -> Exported:
    """Export the part of a run from `begin` to `end`, s of device time, to `out` and to files beside it.

    `named`: a name of `ENDINGS`; None: as `out` ends. `channels`: those that are wanted; None: all. BenchError for what
    the user can mend; nothing is written then.
    """
    chosen = format_of(out, named)
    if chosen == "rrd" and channels is not None:
        raise BenchError("--format rrd is the dashboard with all channels: omit --channels")
    writer: Any = importlib.import_module(f"bench.export.to_{chosen}")
    content = Content(run, begin, end, channels)
    files: dict[str, Path] = writer.files(content, out)
    for path in files.values():
        check_output(path, str(path), overwrite)
        if path.exists() and not path.is_file():
            raise BenchError(f"{path} cannot be written: it is not a file")
    _write(writer, content, files, out)
    hz = run.info.tick_hz
    return Exported(files, content.rows, (content.first / hz, content.last / hz), _notes(content, writer, files, out))


def as_json(done: Exported) -> dict[str, Any]:
    """The files, counts and notes as plain data, `from_s` and `to_s` of device time."""
    files = {name: str(path) for name, path in done.files.items()}
    span = {"from_s": done.span[0], "to_s": done.span[1]}
    return {"files": files, "rows": dict(done.rows), **span, "notes": list(done.notes)}


def _write(writer: Any, content: Content, files: Mapping[str, Path], out: Path) -> None:
    """Write files, each under a name of its own until all are whole; `out` appears last."""
    targets = {name: Path(os.path.realpath(path)) for name, path in files.items()}
    parts = {name: part_of(path) for name, path in targets.items()}
    try:
        writer.write(content, parts)
        for name in sorted(parts, key=lambda name: files[name] == out):
            parts[name].replace(targets[name])
    except OSError as error:
        raise BenchError(f"{out} cannot be written: {error.strerror or error}") from None
    finally:
        for part in parts.values():
            with suppress(OSError):
                part.unlink(missing_ok=True)


def _notes(content: Content, writer: Any, files: Mapping[str, Path], out: Path) -> tuple[str, ...]:
    """What is elsewhere, or not as one would think; damage."""
    run, notes = content.run, []
    if len(files) > 1:
        held = next(name for name, path in files.items() if path == out)
        others = ", ".join(f"{name} in {path.name}" for name, path in files.items() if path != out)
        notes.append(f"{out.name} has only {held}: {others}")
    if hasattr(writer, "notes"):
        notes += writer.notes(content)
    for table in content.tables:
        alike: dict[str, list[str]] = {}
        for column in table.columns:
            alike.setdefault(column.name.casefold(), []).append(column.name)
        notes += [
            f"{table.name}: {' and '.join(names)} differ by case only: a reader that ignores case, such as DuckDB, "
            "renames or loses one: choose one with --channels" for names in alike.values() if len(names) > 1
        ]  # fmt: skip
    for restarted in (restarted for restarts in run.restarts.values() for restarted in restarts):
        how = "has a clock that went back without a reboot" if restarted.tick in run.leaps else "rebooted"
        notes.append(f"the device {how} after {run.at(restarted.tick)}: its time restarts there")
    if not run.ended:
        notes.append(f"warning: {run.path} has no end: it was interrupted, or is still recording")
    return (*notes, *(f"warning: {words}" for words in run.damage))

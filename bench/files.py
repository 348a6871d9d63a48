"""Files that a command writes: whether one can be is known before the run, and it is written whole or not at all."""

from __future__ import annotations

import math
import os
import re
import stat
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

from bench.errors import BenchError, RecordingError
from protocol.text import printable

STANDARD_OUTPUT = Path("-")
RUN_LOG = "run.jsonl"
"""Of a recorded run: what makes a folder one."""
LONGEST = 100  # characters of the name of a file that is made of something else's name
_DEVICE = re.compile(r"^(CON|PRN|AUX|NUL|COM\d|LPT\d)(?=\.|$)", re.IGNORECASE)  # what Windows opens in a file's place
RUN, RRD = ".run", ".rrd"  # how names of recorded runs end, by custom, and of files for rerun's viewer


def found_above(name: str) -> Path | None:
    """The file `name` of the present directory, else of the nearest one above it that has one; None without any."""
    try:
        here = Path.cwd()
    except OSError:  # it was removed
        return None
    folders = (folder for folder in (here, *here.parents) if os.path.exists(folder / name))
    return next((Path(name) if folder == here else folder / name for folder in folders), None)


def check_output(path: Path, what: str, overwrite: bool, recording: bool = False) -> None:
    """Raise BenchError if `path` exists (unless `overwrite`) or cannot be written; changes nothing.

    `what` names it to the user, such as "--json a.json". A device or a pipe may be written without `overwrite`. A
    `recording` is a folder, which replaces nothing but a recorded run, and a RecordingError where it cannot be written;
    one that is asked for as an .rrd is the folder beside it, and that file.
    """
    if recording and path.suffix == RRD:
        check_output(path, what, overwrite)
        check_output(run_folder(path), f"{what}: {run_folder(path)}", overwrite, recording)
        return
    error = RecordingError if recording else BenchError
    try:
        found = path.stat()
    except FileNotFoundError:
        check_directory(_real(path).parent, what, error)
        return
    except OSError as reason:
        raise error(f"{what} cannot be written: {reason.strerror}") from None
    if recording and not is_run(path):
        raise BenchError(f"{what} exists: it is not a recorded run and is not replaced: choose another name")
    if stat.S_ISDIR(found.st_mode) and not recording:
        raise error(f"{what} cannot be written: it is a directory")
    if not overwrite and (recording or stat.S_ISREG(found.st_mode)):
        raise BenchError(
            f"{what} exists: choose another name, or --overwrite to replace it (in Python: overwrite=True)"
        )
    if not os.access(path, os.W_OK):
        raise error(f"{what} cannot be written: Permission denied")


def is_run(path: Path) -> bool:
    """Whether a folder is a recorded run."""
    return (path / RUN_LOG).is_file()


def run_folder(save: Path) -> Path:
    """The folder that is recorded to where `save` is asked for: a file for rerun's viewer comes beside it."""
    return save.with_suffix(RUN) if save.suffix == RRD else save


def check_directory(path: Path, what: str, error: type[BenchError] = BenchError, make: bool = False) -> None:
    """Raise `error` unless files can be made in the directory `path`, which is made first if `make`."""
    try:
        found = path.stat()
    except FileNotFoundError:
        if not make:
            raise error(f"{what} cannot be written: there is no directory {path}") from None
        check_directory(path.absolute().parent, what, error, make)
        return
    except OSError as reason:
        raise error(f"{what} cannot be written: {reason.strerror}") from None
    if not stat.S_ISDIR(found.st_mode):
        raise error(f"{what} cannot be written: {path} is not a directory")
    if not os.access(path, os.W_OK | os.X_OK):
        raise error(f"{what} cannot be written: Permission denied")


def write(path: Path, content: str | bytes, what: str) -> None:
    """Write bytes, or text as UTF-8, to a file or, for -, to standard output. Raises BenchError.

    A file appears, or replaces an earlier one, when it is whole; `what` is as in `check_output`.
    """
    if path == STANDARD_OUTPUT:
        out = sys.stdout if isinstance(content, str) else sys.stdout.buffer
        out.write(content)  # type: ignore[arg-type]
        out.flush()
        return
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    file = _real(path)
    try:
        if os.path.exists(file) and not (file.is_file() and os.access(file.parent, os.W_OK)):
            file.write_bytes(data)  # a device, a pipe, or a file in a directory that takes no other
            return
        part = part_of(file)
        try:
            part.write_bytes(data)
            if file.exists():
                part.chmod(stat.S_IMODE(file.stat().st_mode))
            part.replace(file)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    except OSError as reason:
        raise BenchError(f"{what} cannot be written: {reason.strerror}") from None


def file_name(name: str) -> str:
    """`name` without what a file system or a shell could mistake: one that Windows takes, too, and not too long."""
    import hashlib  # OpenSSL and others cost 10 ms: only those who need them pay

    made = re.sub(r"[^A-Za-z0-9._-]+", "_", name)
    if len(made) > LONGEST:
        made = f"{made[: LONGEST - 9]}-{hashlib.sha256(name.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"
    return _DEVICE.sub(r"\1_", re.sub(r"\.$", "_", made) or "_")


def part_of(path: Path) -> Path:
    """A new name beside `path`, for what is to replace it when it is whole."""
    return path.with_name(f".{uuid4().hex[:8]}.part")


def _real(path: Path) -> Path:
    """Behind all symbolic links, also where that file is not there yet; never raises, as `Path.resolve` does."""
    return Path(os.path.realpath(path))


def read_toml(path: Path, what: str = "file") -> dict[str, Any]:
    """Read a TOML file, in UTF-8 with or without its mark. BenchError, which calls it `what`, where it is none."""
    import tomllib

    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise BenchError(f"no {what} {path}") from None
    except RecursionError:
        raise BenchError(f"cannot read {path}: it is nested too deeply") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BenchError(f"cannot read {path}: {printable(getattr(error, 'strerror', None) or str(error))}") from None


def finite(value: Any, text: bool = False) -> Any:
    """Plain data as JSON needs it: in the place of every number that is not finite None, or its `text`, as "nan"."""
    if isinstance(value, Mapping):
        return {key: finite(item, text) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item, text) for item in value]
    return (str(value) if text else None) if isinstance(value, float) and not math.isfinite(value) else value


def leaves(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """What is no table in plain data, under its dotted name, as `error.std`."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value

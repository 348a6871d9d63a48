"""What runs at a worker: who it is, and batches of rows through a function that it is told once."""

from __future__ import annotations

import hashlib
import math
import os
import platform
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.errors import BenchError
from protocol import __version__

Work = Callable[[bytes, Sequence[int]], bytes]
"""Of a plan and numbers of rows, what came of them."""

_ROOT = Path(__file__).parents[2]
_SOURCES = (".py", ".toml", ".xz", "sources")  # ends of names of files that results depend on
_KEPT = 4  # plans that a worker remembers
_known: dict[str, tuple[bytes, Work]] = {}
_one = threading.Lock()


class Worker(NamedTuple):
    """How a worker answers when it is told what to do. Plain texts: it may be of another version."""

    name: str
    """host:pid"""
    identity: dict[str, str]
    why: str
    """Why it cannot do it; empty if it can."""


class Computed(NamedTuple):
    """What came of a batch."""

    result: bytes
    seconds: float
    """CPU time of the whole process meanwhile."""
    why: str
    """Empty, or where and how `work` failed."""


@cache
def identity() -> dict[str, str]:
    """What has to be the same wherever rows of one study are computed, by what it is called."""
    found = {"hallbench": __version__}
    found |= {f"sources of {package}": _checksum(_ROOT / package) for package in ("bench", "sim", "protocol")}
    found |= {package: _version(package) for package in ("numpy", "scipy", "numba", "llvmlite")}
    found["Python"] = "{}.{}".format(*sys.version_info)
    return found | {"processor": platform.machine().lower(), "mathematical functions": _mathematics()}


def _checksum(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*"), key=lambda path: path.relative_to(folder).as_posix()):
        if path.name.endswith(_SOURCES) and path.is_file():
            content = path.read_bytes()
            digest.update(f"{path.relative_to(folder).as_posix()} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()[:12]


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "none"


def _mathematics() -> str:
    """Checksum of what the C library and numpy make of some numbers: their last bits differ between machines."""
    x = np.linspace(0.01, 9.99, 997)
    found = [np.array([f(v) for v in x]) for f in (math.sin, math.cos, math.exp, math.log, math.atan)]
    found += [f(x) for f in (np.sin, np.cos, np.exp, np.log, np.arctan, np.tanh, np.cbrt)]
    return hashlib.sha256(np.concatenate([*found, np.arctan2(x, x[::-1]), np.hypot(x, x[::-1])]).tobytes()).hexdigest()[
        :12
    ]


def token_of(plan: bytes, work: str) -> str:
    """What a plan and the function for it are called at workers; the same for the same, of one identity only."""
    return hashlib.sha256(b"\n".join((repr(identity()).encode(), work.encode(), plan))).hexdigest()


def this_process() -> str:
    """host:pid"""
    return f"{socket.gethostname()}:{os.getpid()}"


def found(work: str) -> Work:
    """The function of this name, module:function."""
    module, _, name = work.partition(":")
    function: Work = getattr(import_module(module), name)
    return function


def introduce(token: str, plan: bytes, work: str) -> Worker:
    """Remember a plan and a function under a token; say who this is, and whether it is of the token's identity."""
    if token != token_of(plan, work):
        return Worker(this_process(), identity(), "it is not the same program")
    try:
        _known[token] = plan, found(work)
    except Exception as error:
        return Worker(this_process(), identity(), told(error))
    for old in [*_known][:-_KEPT]:
        del _known[old]
    return Worker(this_process(), identity(), "")


def compute(token: str, rows: tuple[int, ...]) -> Computed | None:
    """Rows through what the token stands for, one call at a time in a process. None where it stands for nothing."""
    with _one:
        return computed(*_known[token], rows) if token in _known else None


def computed(plan: bytes, work: Work, rows: tuple[int, ...]) -> Computed:
    """Rows through `work`, and which row fails where one does."""
    begun = time.process_time()
    try:
        return Computed(work(plan, rows), time.process_time() - begun, "")
    except (Exception, SystemExit) as error:
        return Computed(b"", 0.0, f"{_failing(plan, work, rows)}: {told(error)}")


def _failing(plan: bytes, work: Work, rows: tuple[int, ...]) -> str:
    for row in rows:
        try:
            work(plan, (row,))
        except (Exception, SystemExit):
            return f"row {row}"
    return f"rows {rows[0]} to {rows[-1]}"


def told(error: BaseException) -> str:
    """An error's first line."""
    words = (str(error).strip().splitlines() or [""])[0]
    return words if isinstance(error, BenchError) and words else f"{type(error).__name__}: {words}".rstrip(": ")

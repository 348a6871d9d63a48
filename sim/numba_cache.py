"""Where compiled kernels are kept, and the decorators that compile them.

Numba's own disk cache watches only the file of the cached function: an edited helper in another file leaves a
stale caller. So the kernels live in a directory whose name holds a hash of every source that kernels are made
of, together with the versions of Python and numba: any edit starts a fresh directory, and old ones are
pruned.

`$NUMBA_CACHE_DIR`, where set, takes the place of the user's cache directory. Other packages' numba caches are
never touched. Importing this module does not import numba; its decorators do.

Signals: numba is not made for handlers that raise, such as Python's own of Ctrl-C. A handler runs between any two
steps of Python code, and numba runs Python code where no exception may come out of it. Compiled code that returns a
NamedTuple calls the class and uses the result unchecked: NULL, and the process ends in a segmentation fault. Where LLVM
calls back while it compiles or loads, the exception is printed and lost. So signals wait (`sim.interrupts`): while a
function compiles until the next pass, and while one runs that returns a NamedTuple to Python until it has returned.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import threading
from collections.abc import Callable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar, cast

from sim.interrupts import Held

__all__ = ["cache_dir", "is_warm", "jit", "kernel", "settled", "source_hash"]

F = TypeVar("F", bound=Callable[..., Any])

KEPT = 6  # cache directories of other source states that are left alone: branches, two checkouts
_HERE = Path(__file__).parent

# Of `sim/drive` and `sim/ports` only the control tick and the lengths of CAN frames are kernels.
_PLAIN = ("config", "drive", "ports", "interrupts.py")
_KERNELS_AMONG = ("drive/tick*.py", "ports/can_bits.py")
_IN_PROTOCOL = (
    "codes.py",
    "messages.py",
    "signals.py",
    "streams.py",
    "canmap/frame.py",
)  # constants that kernels take in


def _kernel_sources() -> list[Path]:
    sources = [p for p in _HERE.rglob("*.py") if p.relative_to(_HERE).parts[0] not in _PLAIN]
    return [
        *sorted(sources),
        *sorted(path for pattern in _KERNELS_AMONG for path in _HERE.glob(pattern)),
        *(_HERE.parent / "protocol" / name for name in _IN_PROTOCOL),
    ]


@cache
def source_hash() -> str:
    """Hash of all kernel sources and of the versions of Python and numba: 16 hex digits."""
    digest = hashlib.sha256()
    for package in ("numba", "llvmlite", "numpy"):
        try:
            digest.update(f"{package} {version(package)}\n".encode())
        except PackageNotFoundError:
            digest.update(f"{package} none\n".encode())
    digest.update(f"{sys.implementation.cache_tag} {sys.platform}\n".encode())
    for path in _kernel_sources():
        content = path.read_bytes() if path.exists() else b""
        digest.update(f"{path.relative_to(_HERE.parent).as_posix()} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()[:16]


def _user_cache_dir() -> Path:
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(given)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = str(Path.home() / "Library" / "Caches")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base)


@cache
def cache_dir() -> Path:
    """The directory for the kernels of the present sources; it may not exist yet."""
    return _user_cache_dir() / "hallbench" / f"numba-{source_hash()}"


def is_warm(module: str = "tick", function: str = "advance") -> bool:
    """Whether a kernel is compiled and kept for the present sources (default: the drive's control tick).

    Cheap: it looks for a file and imports nothing. False means that the first use compiles, for some ten
    seconds.
    """
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return True
    return any(cache_dir().glob(f"*/{module}.{function}-*.nbc"))


@cache
def _prepare() -> str:
    """Make the cache directory, mark it as used now, drop the oldest others; "" if it cannot be written."""
    own = cache_dir()
    try:
        own.mkdir(parents=True, exist_ok=True)
        os.utime(own)
        others = sorted((p for p in own.parent.glob("numba-*") if p != own), key=lambda p: p.stat().st_mtime)
    except OSError:
        return ""
    for old in others[: max(0, len(others) - KEPT)]:
        shutil.rmtree(old, ignore_errors=True)
    return str(own)


def jit(function: F) -> F:
    """Compile a function: `numba.njit(cache=True, nogil=True)`, strict IEEE arithmetic, kept in `cache_dir()`.

    Arithmetic keeps to the order of the source (no fastmath, no contraction), so that the compiled and the
    plain function agree bit for bit. Division by zero raises, as in Python. Where no cache can be written, it
    compiles in every process.
    """
    return _compile(function)


def kernel(function: F) -> F:
    """`jit` for what runs within a period: put into its caller, without counting references to arrays.

    It must not make an array. Nearly a hundred nanoseconds a period are in it: a reference is counted with an
    atomic operation each time that an array is handed on.
    """
    return _compile(function, _nrt=False, forceinline=True, no_cfunc_wrapper=True)


def settled(function: F) -> F:
    """A compiled function that is always called with the same types: they are resolved at the first call only.

    For nested tuples numba takes 30 us a call to find their types. No handler of a signal runs before it has returned.
    """
    entry: Callable[..., Any] | None = None

    def call(*arguments: Any) -> Any:
        nonlocal entry
        with Held():
            if entry is not None:
                return entry(*arguments)
            result = function(*arguments)
            overloads = list(getattr(function, "overloads", {}).values())  # none with NUMBA_DISABLE_JIT
            if len(overloads) == 1:
                entry = overloads[0].entry_point
            return result

    return cast("F", call)


def _compile(function: F, **options: bool) -> F:
    import numba
    import numba.core.config

    config: Any = numba.core.config
    njit: Any = numba.njit
    directory = _prepare()
    before = config.CACHE_DIR
    config.CACHE_DIR = directory or before
    try:
        compiled = njit(cache=bool(directory), nogil=True, fastmath=False, **options)(function)
    except RuntimeError:  # numba: "no locator available", the directory became unwritable
        compiled = njit(nogil=True, fastmath=False, **options)(function)
    finally:
        config.CACHE_DIR = before
    if hasattr(compiled, "_compile_for_args"):  # not with NUMBA_DISABLE_JIT
        compiled._compile_for_args = _between_passes(compiled._compile_for_args)
    return cast("F", compiled)


def _between_passes(compile_: Callable[..., Any]) -> Callable[..., Any]:
    """`compile_`, with handlers of signals that run between two of its passes only: that may raise."""

    def call(*arguments: Any, **more: Any) -> Any:
        from numba.core import event

        class Between(event.Listener):
            def on_start(self, event: object) -> None:
                held = Held.active
                if held is not None and not held.undisturbed and threading.current_thread() is threading.main_thread():
                    held.deliver()

            def on_end(self, event: object) -> None:
                pass

        with Held(), event.install_listener("numba:run_pass", Between()):
            return compile_(*arguments, **more)

    return call

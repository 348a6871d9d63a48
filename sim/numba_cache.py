"""Where compiled kernels are kept, and the decorators that compile them.

Numba's own disk cache watches only the file of the cached function: an edited helper in another file leaves a
stale caller. So the kernels live in a directory whose name holds a hash of every source that kernels are made
of, together with the versions of Python and numba: any edit starts a fresh directory, and old ones are
pruned. Only what Python calls is kept (`sim.native`): the kernels that it is made of are in it.

`$NUMBA_CACHE_DIR`, where set, takes the place of the user's cache directory. Other packages' numba caches are
never touched. Importing this module does not import numba; its decorators do.

Signals: numba is not made for handlers that raise, such as Python's own of Ctrl-C. A handler runs between any two
steps of Python code, and LLVM calls Python back while it compiles or loads: there an exception is printed and lost. So
signals wait (`sim.interrupts`) while a function compiles, until the next pass.
"""

from __future__ import annotations

import hashlib
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, TypeVar, cast

from sim.interrupts import Held

__all__ = [
    "Locator",
    "cache_dir",
    "compiled_for_c",
    "is_kept",
    "kernel",
    "source_hash",
    "source_stamp",
    "tell_by",
]

F = TypeVar("F", bound=Callable[..., Any])

TELL_EVERY = 1.0  # s
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


@cache
def source_stamp(module: str) -> str:
    """Hash of a module's sources, if it is none of those that `source_hash` is made of; else empty.

    Of a package's module all that is in the package counts: kernels are made of one another.
    """
    top = module.partition(".")[0]
    if top in ("sim", "protocol"):
        return ""
    found = sys.modules.get(top) or sys.modules.get(module)
    folders = [Path(folder) for folder in getattr(found, "__path__", ())]
    file = getattr(sys.modules.get(module), "__file__", None)
    paths = sorted(path for folder in folders for path in folder.rglob("*.py")) or ([Path(file)] if file else [])
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
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


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether a function that was compiled for C is kept for the present sources: its next use compiles nothing.

    Cheap: it looks for a file and imports nothing.
    """
    folder = cache_dir() / function.__module__
    return any(folder.glob(f"*.{function.__qualname__}-*.nbc"))


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


def kernel(function: F) -> F:
    """A function that compiled code puts into itself: strict IEEE arithmetic, no references to arrays counted.

    Arithmetic keeps to the order of the source (no fastmath, no contraction), so that the compiled and the plain
    function agree bit for bit, but where something is divided by zero: compiled that gives an infinity or NaN. It must
    not make an array. Called from Python it runs as the plain function that it is: what a call from Python takes, for
    tuples within tuples, would be two fifths of all that is to be compiled.
    """
    import numba

    njit: Any = numba.njit
    made = njit(
        nogil=True,
        error_model="numpy",
        forceinline=True,
        no_cfunc_wrapper=True,
        no_cpython_wrapper=True,
        _nrt=False,
    )(function)
    if hasattr(made, "py_func"):  # not with NUMBA_DISABLE_JIT
        made.__class__ = _plainly_called(cast("Any", type(made)))
    return cast("F", made)


@cache
def _plainly_called(dispatcher: Any) -> type[Any]:
    class Kernel(dispatcher):  # type: ignore[misc]
        def __call__(self, *arguments: Any) -> Any:
            return self.py_func(*arguments)

    return Kernel


def compiled_for_c(function: Callable[..., None], arguments: Sequence[Any]) -> int:
    """The address of a function compiled for C's calls: `arguments` are numba's types, it returns nothing.

    Where no cache can be written, it compiles in every process. What it compiles is told (`tell_by`).
    """
    import numba

    cfunc: Any = numba.cfunc
    signature = numba.types.void(*arguments)
    with _kept_by_numba(), nullcontext() if is_kept(function) else _told(function):
        try:
            compile_ = cfunc(signature, cache=bool(_prepare()), error_model="numpy", _nrt=False)
            made = _between_passes(compile_)(function)
        except RuntimeError:  # numba: "no locator available", the directory became unwritable
            compile_ = cfunc(signature, error_model="numpy", _nrt=False)
            made = _between_passes(compile_)(function)
    _FUNCTIONS.append(made)
    address: int = made.address
    return address


_FUNCTIONS: list[Any] = []  # what is compiled for C, alive as long as the process


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Progress:
    """How much has been compiled in this process, and how that is told."""

    tell: ClassVar[Callable[[str], None]] = _print
    done: ClassVar[int] = 0
    of: ClassVar[int] = 0
    told: ClassVar[float] = -math.inf


def tell_by(tell: Callable[[str], None]) -> None:
    """From now on `tell` gets a line now and then while something compiles; before, standard error does."""
    Progress.tell = tell


@contextmanager
def _told(function: Callable[..., Any]) -> Iterator[None]:
    """Tell how far compiling has come."""
    from numba.core import event

    class Kernels(event.Listener):
        def on_start(self, event: object) -> None:
            _count(0)

        def on_end(self, event: object) -> None:
            _count(1)

    Progress.of += 1 + len([one for one in kernels_of(function) if not one.signatures])
    with event.install_listener("numba:compile", Kernels()):
        yield
    Progress.done = Progress.of


def _count(kernels: int) -> None:
    Progress.done = min(Progress.done + kernels, Progress.of)
    if time.monotonic() - Progress.told >= TELL_EVERY:
        Progress.told = time.monotonic()
        Progress.tell(f"compiling, once on this machine: {Progress.done} of {Progress.of} kernels")


def kernels_of(function: Any, found: set[Any] | None = None) -> set[Any]:
    """All kernels that a function is made of, by the names in its code."""
    found = set() if found is None else found
    named, known = function.__code__.co_names, function.__globals__
    values = [known.get(name) for name in named]
    values += [getattr(module, name, None) for module in values if isinstance(module, ModuleType) for name in named]
    for value in values:
        if hasattr(value, "py_func") and value not in found:
            found.add(value)
            kernels_of(value.py_func, found)
    return found


class Locator:
    """Where numba keeps a compiled function, and when that is stale: by the sources' hash, wherever they are installed.

    numba's interface of a cache locator (its option NUMBA_CACHE_LOCATOR_CLASSES).
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._line = function.__code__.co_firstlineno
        self._folder = cache_dir() / function.__module__
        self._py_file = function.__code__.co_filename  # numba names it in warnings
        self._stamp = source_stamp(function.__module__)

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> Locator | None:
        """The locator of a function; None where no cache can be written."""
        made = cls(function)
        try:
            made._folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return None
        return made

    def get_cache_path(self) -> str:
        """The folder, which exists."""
        return str(self._folder)

    ensure_cache_path = get_cache_path

    def get_source_stamp(self) -> str:
        """What changes with the sources that the folder's name does not stand for."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """What tells functions of one name in a module apart."""
        return str(self._line)


@contextmanager
def _kept_by_numba() -> Iterator[None]:
    """Let numba keep what is made within in `cache_dir()`."""
    import numba.core.config

    config: Any = numba.core.config
    before = config.CACHE_LOCATOR_CLASSES
    config.CACHE_LOCATOR_CLASSES = f"{__name__}.Locator"
    try:
        yield
    finally:
        config.CACHE_LOCATOR_CLASSES = before


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

"""Where compiled kernels are kept, and the decorators that compile them.

Numba's own disk cache watches only the file of the cached function: an edited helper in another file leaves a
stale caller. So the kernels live in a directory whose name holds a hash of every source that kernels are made
of, together with the versions of Python and numba: any edit starts a fresh directory, and old ones are
pruned. Only what Python calls is kept (`sim.native`): the kernels that it is made of are in it.

`$NUMBA_CACHE_DIR`, where set, takes the place of the user's cache directory; where that cannot be written, a temporary
one does, for this process and those that it starts. Other packages' numba caches are never touched. Importing this
module does not import numba; its decorators do.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar, cast

from platformdirs import user_cache_path

__all__ = [
    "Locator",
    "cache_dir",
    "compiled_for_c",
    "is_kept",
    "kernel",
    "source_hash",
    "source_stamp",
]

F = TypeVar("F", bound=Callable[..., Any])

KEPT = 6  # cache directories of other source states that are left alone: branches, two checkouts
_HERE = Path(__file__).parent

# Of `sim/drive` and `sim/ports` only the control tick and the lengths of CAN frames are kernels.
_PLAIN = ("config", "drive", "ports", "compile.py", "interrupts.py")
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


@cache
def cache_dir() -> Path:
    """The directory for the kernels of the present sources, marked as used now; the oldest others are dropped."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    base = Path(given) / "hallbench" if given else user_cache_path("hallbench", appauthor=False)
    own = base / f"numba-{source_hash()}"
    try:
        own.mkdir(parents=True, exist_ok=True)
        os.utime(own)
    except OSError:
        os.environ["NUMBA_CACHE_DIR"] = temporary = tempfile.mkdtemp(prefix="hallbench-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        return Path(temporary, "hallbench", own.name)
    with suppress(OSError):  # another process drops them too
        others = sorted((p for p in base.glob("numba-*") if p != own), key=lambda p: p.stat().st_mtime)
        for old in others[: max(0, len(others) - KEPT)]:
            shutil.rmtree(old, ignore_errors=True)
    return own


def is_kept(function: Callable[..., Any]) -> bool:
    """Whether a function that was compiled for C is kept for the present sources: its next use compiles nothing.

    Cheap: it looks for a file and imports nothing.
    """
    folder = cache_dir() / function.__module__
    return any(folder.glob(f"*.{function.__qualname__}-*.nbc"))


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

    No handler of a signal may raise in here (`sim.interrupts`): LLVM calls Python back, and drops what is raised there.
    """
    import numba

    cfunc: Any = numba.cfunc
    signature = numba.types.void(*arguments)
    with _kept_by_numba():
        try:
            made = cfunc(signature, cache=True, error_model="numpy", _nrt=False)(function)
        except RuntimeError:  # numba: "no locator available", nothing can be written
            made = cfunc(signature, error_model="numpy", _nrt=False)(function)
    _FUNCTIONS.append(made)
    address: int = made.address
    return address


_FUNCTIONS: list[Any] = []  # what is compiled for C, alive as long as the process


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

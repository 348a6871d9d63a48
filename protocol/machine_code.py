"""Kernels as machine code, made of LLVM IR once on a machine and then loaded without numba.

numba takes 40 s to make IR of all kernels, and LLVM 3 s to make machine code of that. So the IR comes with the sources,
`NAME.ll.xz` beside a file that says which sources it was made of. Where these were edited, where a kernel is a user's
own, or where LLVM here does not take the IR, numba makes it anew.

`$NUMBA_CACHE_DIR`, where set, takes the place of the user's cache directory; where that cannot be written, a temporary
one does, for this process and those that it starts.
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar

from platformdirs import user_cache_path

F = TypeVar("F", bound=Callable[..., Any])

SOURCES = "sources"  # file beside the IR: the hash of the sources that it was made of, and by which versions
PROCESSORS = ("x86_64", "amd64", "aarch64", "arm64")
"""Those for which LLVM puts nothing into machine code but calls of the functions of `MATHEMATICS`."""
MATHEMATICS = ("atan2", "cos", "exp", "floor", "hypot", "log", "rint", "sin", "sincos", "sqrt")
KEPT = 12  # folders of other sources that are left alone: branches, two checkouts
DIGEST = hashlib.sha256().digest_size


KERNELS: list[Callable[..., Any]] = []
"""All functions that `kernel` marked."""


def kernel(function: F) -> F:
    """A function that compiled code puts into itself: strict IEEE arithmetic, no references to arrays counted.

    Arithmetic keeps to the order of the source (no fastmath, no contraction), so that the compiled and the plain
    function agree bit for bit, but where something is divided by zero: compiled that gives an infinity or NaN. It must
    not make an array. Called from Python it is the plain function.
    """
    KERNELS.append(function)
    return function


def hashed(paths: Iterable[Path], root: Path) -> str:
    """Hash of these files, by their names below `root`: 16 hex digits."""
    digest = hashlib.sha256()
    for path in paths:
        content = path.read_bytes() if path.exists() else b""
        digest.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()[:16]


class Store:
    """Kernels of one set of sources.

    Args:
        shipped: folder of their IR.
        sources: hash of the sources that they are made of; without one nothing that is there is used or kept.
    """

    def __init__(self, shipped: Path, sources: str) -> None:
        self._shipped, self._sources = shipped, sources

    @cached_property
    def folder(self) -> Path:
        """Where machine code is kept, marked as used now; the oldest folders of other sources are dropped."""
        given = os.environ.get("NUMBA_CACHE_DIR")
        base = Path(given) / "hallbench" if given else user_cache_path("hallbench", appauthor=False)
        own = base / f"kernels-{self._sources}"
        try:
            own.mkdir(parents=True, exist_ok=True)
            os.utime(own)
        except OSError:
            os.environ["NUMBA_CACHE_DIR"] = temporary = tempfile.mkdtemp(prefix="hallbench-")
            atexit.register(shutil.rmtree, temporary, ignore_errors=True)
            own = Path(temporary, "hallbench", own.name)
            own.mkdir(parents=True)
        with suppress(OSError):  # another process drops them too
            others = sorted((p for p in base.glob("kernels-*") if p != own), key=lambda p: p.stat().st_mtime)
            for old in others[: max(0, len(others) - KEPT)]:
                shutil.rmtree(old, ignore_errors=True)
        return own

    def is_kept(self, name: str) -> bool:
        """Whether machine code for this machine is there."""
        return self._object(name).is_file()

    def is_shipped(self, name: str) -> bool:
        """Whether its IR came with just these sources, and is for such a processor."""
        return platform.machine().lower() in PROCESSORS and self._made_of_these and self._ir(name).is_file()

    @cached_property
    def _made_of_these(self) -> bool:
        try:
            return (self._shipped / SOURCES).read_text("ascii").split()[0] == self._sources
        except OSError:
            return False

    @property
    def made_by(self) -> str:
        """The versions that made what is shipped."""
        return (self._shipped / SOURCES).read_text("ascii").partition("\n")[2].strip()

    def _ir(self, name: str) -> Path:
        return self._shipped / f"{name}.ll.xz"

    def _object(self, name: str) -> Path:
        return self.folder / f"{name}-{_target().key}.o"

    def address(self, name: str, make: Callable[[], str]) -> int:
        """Where the kernel is, loaded; machine code is made where none is kept, of IR by `make` where none came."""
        if code := self._kept_code(name):
            return _loaded(code)
        if self.is_shipped(name):
            with suppress(Exception):  # another LLVM, no lzma: numba's own takes longer, and works
                return self._keep(name, _target().code(self.text(name)))
        return self._keep(name, _target().code(make()))

    def text(self, name: str) -> str:
        """The IR that came with the sources."""
        import lzma

        return lzma.decompress(self._ir(name).read_bytes()).decode()

    def _kept_code(self, name: str) -> bytes:
        """What is kept, or nothing if it is not all of it."""
        try:
            content = self._object(name).read_bytes()
        except OSError:
            return b""
        code = content[DIGEST:]
        return code if hashlib.sha256(code).digest() == content[:DIGEST] else b""

    def _keep(self, name: str, code: bytes) -> int:
        address = _loaded(code)
        with suppress(OSError), tempfile.TemporaryDirectory(dir=self.folder) as place:
            part = Path(place, "object")
            part.write_bytes(hashlib.sha256(code).digest() + code)
            part.replace(self._object(name))
        return address

    def ship(self, made: dict[str, str], by: str) -> None:
        """Write the IR of all kernels, by name, in place of what is there; `by`: the versions that made it."""
        import lzma

        shutil.rmtree(self._shipped, ignore_errors=True)
        self._shipped.mkdir()
        for name, text in made.items():
            self._ir(name).write_bytes(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))
        (self._shipped / SOURCES).write_text(f"{self._sources}\n{by}\n", "ascii")


ENTRY = "hallbench_entry"
"""The name of each kernel's function in its machine code."""


class _Target:
    """This machine's processor, as LLVM knows it."""

    def __init__(self) -> None:
        import llvmlite
        import llvmlite.binding as llvm

        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        library = None
        with suppress(OSError):
            library = ctypes.CDLL("ucrtbase" if os.name == "nt" else None)
        for name in MATHEMATICS:  # what it does not find by itself ends the process
            if not llvm.address_of_symbol(name) and (function := getattr(library, name, None)):
                llvm.add_symbol(name, ctypes.cast(function, ctypes.c_void_p).value)
        self._llvm, self._triple = llvm, llvm.get_process_triple()
        self._cpu, self._features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
        told = f"{llvmlite.__version__} {self._triple} {self._cpu} {self._features}"
        self.key = hashlib.sha256(told.encode()).hexdigest()[:16]

    @cached_property
    def machine(self) -> Any:
        """What makes machine code, with the settings that numba has."""
        reloc = "static" if self._triple.startswith(("x86", "i686", "i386")) else "default"
        return self._llvm.Target.from_triple(self._triple).create_target_machine(
            cpu=self._cpu, features=self._features, opt=3, reloc=reloc, codemodel="jitdefault", jit=True
        )

    def code(self, text: str) -> bytes:
        """Machine code of IR, as an object file."""
        module = self._llvm.parse_assembly(text)
        module.triple, module.data_layout = self._triple, str(self.machine.target_data)
        module.verify()
        code: bytes = self.machine.emit_object(module)
        return code


@cache
def _target() -> _Target:
    return _Target()


_ENGINES: list[Any] = []  # what is loaded, alive as long as the process


def _loaded(code: bytes) -> int:
    import llvmlite.binding as llvm

    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target().machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _ENGINES.append(engine)
    address: int = engine.get_function_address(ENTRY)
    return address

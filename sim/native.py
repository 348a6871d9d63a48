"""Kernels that are called as C calls them, over records in memory: nothing is made of Python's objects on the way.

A record is a NamedTuple of numbers, of records and of tuples of one kind of number, in the layout of a C structure.
`layout` gives it as a dtype, so that numpy makes room for records and reads them. A function marked `native` takes
`Pointer`s to such records, whole numbers and floats, as its annotations say, and returns nothing. It is called with
addresses; whoever calls keeps the memory. It is compiled in a child (`sim.compile`) and loaded when it is first called
or its address is asked for. Nothing that it does raises: a division by zero gives an infinity, as on a drive.

In kernels `record._replace(field=...)` works as in Python, and `with_item` gives a tuple with another item: records and
tuples are values, and nothing is assigned to a part of one. `zeroed` gives a record whose numbers are all zero.

With NUMBA_DISABLE_JIT it all runs as plain Python, on the same memory.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
from collections.abc import Callable
from functools import cache, cached_property
from importlib import import_module
from types import CodeType, FunctionType
from typing import Any, Generic, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from sim.compile import compile_apart
from sim.interrupts import Held
from sim.numba_cache import source_stamp, store

__all__ = [
    "Cells",
    "Native",
    "Pointer",
    "address",
    "invoke",
    "layout",
    "native",
    "specialised",
    "value",
    "with_item",
    "zeroed",
]

T = TypeVar("T")
Items = TypeVar("Items", bound=tuple[Any, ...])

PLAIN = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")
SCALARS: dict[Any, str] = {
    float: "f8",
    int: "i8",
    np.uint64: "u8",
    np.uint32: "u4",
    np.uint16: "u2",
    np.uint8: "u1",
}


class Pointer(Generic[T]):
    """Records, or numbers, one after the other from an address on. In compiled code it is that address."""

    def __init__(self, at: int, of: Any) -> None:
        self.at = at
        self._of, self._dtype = of, layout(of)

    def __getitem__(self, k: int) -> T:
        found: T = value(self._of, self._cell(k)[0])
        return found

    def __setitem__(self, k: int, record: T) -> None:
        self._cell(k)[0] = record

    def _cell(self, k: int) -> NDArray[Any]:
        size = self._dtype.itemsize
        memory: Any = (ctypes.c_char * size).from_address(self.at + k * size)
        return np.ndarray((1,), self._dtype, memory)


@cache
def layout(of: Any) -> np.dtype[Any]:
    """The dtype of a record's class, or of a number's: as C lays it out."""
    if of in SCALARS:
        return np.dtype(SCALARS[of])
    if get_origin(of) is tuple:
        kinds = get_args(of)
        return np.dtype((layout(kinds[0]), (len(kinds),)))
    return np.dtype([(name, layout(kind)) for name, kind in fields_of(of)], align=True)


class Cells:
    """Room for n records, all zero at first, that stays where it is: `array`, shape (n,), at the address `at`."""

    def __init__(self, of: Any, n: int = 1) -> None:
        self.of = of
        self.array = np.zeros(n, layout(of))
        self.at = address(self.array)

    def __len__(self) -> int:
        return len(self.array)

    @property
    def first(self) -> Any:
        """The first record."""
        return value(self.of, self.array[0])

    @first.setter
    def first(self, record: Any) -> None:
        self.array[0] = record


def value(of: Any, cell: Any) -> Any:
    """The record, or the number, that an element of an array holds."""
    if of is int or of is np.uint8 or of is np.uint16 or of is np.uint32:
        return int(cell)
    if of in SCALARS:
        return of(cell)
    if get_origin(of) is tuple:
        return tuple(value(kind, one) for kind, one in zip(get_args(of), cell, strict=True))
    return of(*(value(kind, cell[name]) for name, kind in fields_of(of)))


def address(array: NDArray[Any]) -> int:
    """Where an array's elements begin; they must be contiguous."""
    return array.ctypes.data


class Native:
    """A function of pointers and numbers, called with addresses and numbers; `name`: where another process finds it."""

    def __init__(self, function: Callable[..., None], name: str = "") -> None:
        self.name = name or f"{function.__module__}:{function.__qualname__}"
        self._function = function
        self._hints = {name: kind for name, kind in get_type_hints(function).items() if name != "return"}
        self._call: Callable[..., int | None] = self._first
        self._address = 0

    def __call__(self, *arguments: float) -> None:
        """Call it. Raises SystemError if it failed, which is a mistake in the kernel: an index beyond a tuple, say."""
        if self._call(*arguments):
            raise SystemError(f"the compiled kernel {self.name} failed")

    @property
    def address(self) -> int:
        """Where the compiled function is, for `invoke`."""
        self.load()
        return self._address

    @cached_property
    def key(self) -> str:
        """What it is kept under: its name, and for what is none of the sources that all are kept under, its own."""
        function = self._function
        name = re.sub(r"\W+", "_", f"{function.__module__}.{function.__qualname__}")
        stamp = source_stamp(function.__module__)
        if not stamp:
            return name
        code = function.__code__
        constants = [one for one in code.co_consts if not isinstance(one, CodeType)]
        own = repr((stamp, code.co_firstlineno, code.co_code, constants, code.co_names, list(self._hints.items())))
        return f"{name}-{hashlib.sha256(own.encode()).hexdigest()[:16]}"

    @property
    def kept(self) -> bool:
        """Whether to load it makes nothing."""
        return PLAIN or store().is_kept(self.key)

    def _first(self, *arguments: float) -> int | None:
        self.load()
        return self._call(*arguments)

    def load(self) -> None:
        """Load it, compiled by a child if it is not kept."""
        if self._address:
            return
        if PLAIN:
            self._address = id(self)
            _NATIVES[self._address] = self._call = self._plainly
            return
        if not self.kept and not store().is_shipped(self.key):
            compile_apart([self])
        self.make()

    def make(self) -> None:
        """Load it; compile it here, where no child could. Signals wait until that is done."""
        with Held():
            self._address = store().address(self.key, self.ir)
        kinds = [ctypes.c_double if kind is float else ctypes.c_int64 for kind in self._hints.values()]
        self._call = ctypes.CFUNCTYPE(ctypes.c_int32, *kinds)(self._address)

    def ir(self) -> str:
        """Its LLVM IR, by numba."""
        text: str = import_module("sim.by_numba").ir_of(self._function, list(self._hints.values()))
        return text

    def _plainly(self, *arguments: float) -> None:
        given = zip(arguments, self._hints.values(), strict=True)
        self._function(*(Pointer(int(x), get_args(kind)[0]) if get_origin(kind) is Pointer else x for x, kind in given))


_NATIVES: dict[int, Callable[..., None]] = {}  # by what stands for their addresses in plain Python


def native(function: Callable[..., None], name: str = "") -> Native:
    """A function of pointers and numbers, to be called from Python or by `invoke`."""
    return Native(function, name)


def specialised(function: Any, name: str, annotations: dict[str, Any], **names: Any) -> Any:
    """Another function of the same code, in which some global names mean something else."""
    made = FunctionType(function.__code__, {**function.__globals__, **names}, name)
    made.__qualname__ = name
    made.__module__ = function.__module__
    made.__annotations__ = annotations
    return made


def with_item(values: Items, k: int, item: object) -> Items:
    """The tuple `values`, all of one kind, with another k-th item."""
    return (*values[:k], item, *values[k + 1 :])  # type: ignore[return-value]


def zeroed(of: Callable[..., T]) -> T:
    """The record of this class whose numbers are all zero."""
    found: T = value(of, np.zeros(1, layout(of))[0])
    return found


def invoke(
    function: int,
    params: int,
    state: int,
    samples: Pointer[Any],
    reset: Pointer[Any],
    found: Pointer[Any],
    size: int,
    j: int,
) -> None:
    """An observer's function at `function` over the j-th sample only; `found`: its estimates, of `size` bytes."""
    here = samples.at + j * samples._dtype.itemsize
    _NATIVES[function](params, state, here, reset.at + j, 1, found.at + j * size)


def fields_of(of: Any) -> list[tuple[str, Any]]:
    hints = get_type_hints(of)
    return [(name, hints[name]) for name in of._fields]

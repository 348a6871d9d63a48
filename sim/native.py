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
import inspect
import os
from collections.abc import Callable
from functools import cache
from types import FunctionType
from typing import Any, Generic, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from sim.compile import compile_apart
from sim.interrupts import Held
from sim.numba_cache import compiled_for_c, is_kept

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
_SCALARS: dict[Any, str] = {
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
    if of in _SCALARS:
        return np.dtype(_SCALARS[of])
    if get_origin(of) is tuple:
        kinds = get_args(of)
        return np.dtype((layout(kinds[0]), (len(kinds),)))
    return np.dtype([(name, layout(kind)) for name, kind in _fields(of)], align=True)


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
    if of in _SCALARS:
        return of(cell)
    if get_origin(of) is tuple:
        return tuple(value(kind, one) for kind, one in zip(get_args(of), cell, strict=True))
    return of(*(value(kind, cell[name]) for name, kind in _fields(of)))


def address(array: NDArray[Any]) -> int:
    """Where an array's elements begin; they must be contiguous."""
    return array.ctypes.data


class Native:
    """A function of pointers and numbers, called with addresses and numbers; `name`: where another process finds it."""

    def __init__(self, function: Callable[..., None], name: str = "") -> None:
        self.name = name or f"{function.__module__}:{function.__qualname__}"
        self._function = function
        self._hints = {name: kind for name, kind in get_type_hints(function).items() if name != "return"}
        self._call: Callable[..., None] = self._first
        self._address = 0

    def __call__(self, *arguments: float) -> None:
        """Call it."""
        self._call(*arguments)

    @property
    def address(self) -> int:
        """Where the compiled function is, for `invoke`."""
        self.load()
        return self._address

    @property
    def kept(self) -> bool:
        """Whether to load it compiles nothing."""
        return PLAIN or is_kept(self._function)

    def _first(self, *arguments: float) -> None:
        self.load()
        self._call(*arguments)

    def load(self) -> None:
        """Load it, compiled by a child if it is not kept."""
        if self._address:
            return
        if PLAIN:
            self._address = id(self)
            _NATIVES[self._address] = self._call = self._plainly
            return
        if not self.kept:
            compile_apart([self])
        self.make()

    def make(self) -> None:
        """Load it, or compile it here, where no child could; signals wait until that is done."""
        with Held():
            self._address = compiled_for_c(self._function, [_numba_type(kind) for kind in self._hints.values()])
        kinds = [ctypes.c_double if kind is float else ctypes.c_int64 for kind in self._hints.values()]
        self._call = ctypes.CFUNCTYPE(None, *kinds)(self._address)

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


if PLAIN:

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

else:
    from llvmlite import ir
    from numba import types as numba_types
    from numba.core.typing import templates as numba_templates
    from numba.cpython.unsafe import tuple as numba_tuple
    from numba.extending import intrinsic, lower_builtin, overload, type_callable

    types: Any = numba_types
    templates: Any = numba_templates
    tuple_setitem: Any = numba_tuple.tuple_setitem

    @overload(with_item)
    def _with_item(values, k, item):  # type: ignore[no-untyped-def]
        return lambda values, k, item: tuple_setitem(values, k, item)

    @type_callable(zeroed)
    def _type_zeroed(context):  # type: ignore[no-untyped-def]
        return lambda of: _numba_type(of.instance_class)

    @lower_builtin(zeroed, types.NamedTupleClass)  # type: ignore[no-untyped-call]
    def _zeroed(context, builder, call, arguments):  # type: ignore[no-untyped-def]
        return context.get_constant_null(call.return_type)

    @templates.infer_getattr
    class _Replacing(templates.AttributeTemplate):  # type: ignore[misc]
        """Types `record._replace(field=...)`: the fields' places go along as a constant last argument."""

        key = types.BaseNamedTuple

        @templates.bound_function("namedtuple._replace")
        def resolve__replace(self, record, values, fields):  # type: ignore[no-untyped-def]
            if values or not set(fields) <= set(record.fields):
                return None
            places = tuple(record.fields.index(name) for name in fields)
            kinds = *(record[k] for k in places), types.Omitted(places)
            anywhere = inspect.Parameter.POSITIONAL_OR_KEYWORD
            names = [inspect.Parameter(name, anywhere) for name in fields]
            named = inspect.Signature([*names, inspect.Parameter("_places", anywhere, default=None)])
            return templates.signature(record, *kinds, recvr=record).replace(pysig=named)

    @lower_builtin("namedtuple._replace", types.BaseTuple, types.VarArg(types.Any))  # type: ignore[no-untyped-call]
    def _replaced(context, builder, call, arguments):  # type: ignore[no-untyped-def]
        record, *values, _ = arguments
        for place, value in zip(call.args[-1].value, values, strict=True):
            record = builder.insert_value(record, value, place)
        return record

    @intrinsic
    def invoke(typing, function, params, state, samples, reset, found, size, j):  # type: ignore[no-untyped-def]
        """An observer's function at `function` over the j-th sample only; `found`: its estimates, of `size` bytes."""

        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            function, params, state, samples, reset, found, size, j = arguments
            word = ir.IntType(64)
            called = builder.inttoptr(function, ir.FunctionType(ir.VoidType(), [word] * 6).as_pointer())
            here = builder.ptrtoint(builder.gep(samples, [j]), word)
            flag = builder.ptrtoint(builder.gep(reset, [j]), word)
            there = builder.add(builder.ptrtoint(found, word), builder.mul(size, j))
            builder.call(called, [params, state, here, flag, ir.Constant(word, 1), there])
            return context.get_dummy_value()

        whole = types.int64
        return types.void(whole, whole, whole, samples, reset, found, whole, whole), generate


def _fields(of: Any) -> list[tuple[str, Any]]:
    hints = get_type_hints(of)
    return [(name, hints[name]) for name in of._fields]


@cache
def _numba_type(of: Any) -> Any:
    from numba import types as numba_types

    types: Any = numba_types
    if get_origin(of) is Pointer:
        return types.CPointer(_numba_type(get_args(of)[0]))
    if of in _SCALARS:
        return getattr(types, np.dtype(_SCALARS[of]).name)
    if get_origin(of) is tuple:
        return types.UniTuple(_numba_type(get_args(of)[0]), len(get_args(of)))
    kinds = [_numba_type(kind) for _, kind in _fields(of)]
    if kinds and all(kind == kinds[0] for kind in kinds):
        return types.NamedUniTuple(kinds[0], len(kinds), of)
    return types.NamedTuple(kinds, of)

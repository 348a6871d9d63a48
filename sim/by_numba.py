"""What numba makes of kernels (`sim.numba_cache`) and of what `sim.native` puts into them: LLVM IR.

Importing this module imports numba; nothing does that needs no kernel compiled.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache
from typing import Any, get_args, get_origin

import numpy as np
from llvmlite import ir
from numba import types as numba_types
from numba.core.typing import templates as numba_templates
from numba.cpython.unsafe import tuple as numba_tuple
from numba.extending import intrinsic, lower_builtin, overload, type_callable

from protocol.ir_by_numba import ir_by_numba
from sim.hints import ahead, apart, seldom
from sim.native import SCALARS, Pointer, fields_of, invoke, with_item, zeroed

LINE = 64  # bytes of memory that are fetched together
types: Any = numba_types
templates: Any = numba_templates
tuple_setitem: Any = numba_tuple.tuple_setitem


def ir_of(function: Callable[..., None], kinds: list[Any]) -> str:
    """The IR of a function whose arguments are of these kinds, as annotations name them."""
    return ir_by_numba(function, [_numba_type(kind) for kind in kinds])


@overload(with_item)
def _with_item(values, k, item):  # type: ignore[no-untyped-def]
    return lambda values, k, item: tuple_setitem(values, k, item)


@type_callable(zeroed)
def _type_zeroed(context):  # type: ignore[no-untyped-def]
    return lambda of: _numba_type(of.instance_class)


@lower_builtin(zeroed, types.NamedTupleClass)  # type: ignore[no-untyped-call]
def _zeroed(context, builder, call, arguments):  # type: ignore[no-untyped-def]
    return context.get_constant_null(call.return_type)


@type_callable(seldom)
def _type_seldom(context):  # type: ignore[no-untyped-def]
    return lambda condition: types.boolean if condition == types.boolean else None


@lower_builtin(seldom, types.boolean)  # type: ignore[no-untyped-call]
def _seldom(context, builder, call, arguments):  # type: ignore[no-untyped-def]
    bit = ir.IntType(1)
    expect = builder.module.declare_intrinsic("llvm.expect", [bit], ir.FunctionType(bit, [bit, bit]))
    return builder.call(expect, [arguments[0], ir.Constant(bit, 0)])


@type_callable(ahead)
def _type_ahead(context):  # type: ignore[no-untyped-def]
    return lambda of, k: types.none


@lower_builtin(ahead, types.CPointer, types.Integer)  # type: ignore[no-untyped-call]
def _ahead(context, builder, call, arguments):  # type: ignore[no-untyped-def]
    byte, word = ir.IntType(8).as_pointer(), ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [byte, word, word, word])
    prefetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
    at = builder.bitcast(builder.gep(arguments[0], [arguments[1]]), byte)
    for begin in range(0, context.get_abi_sizeof(context.get_data_type(call.args[0].dtype)), LINE):
        line = builder.gep(at, [ir.Constant(word, begin)])
        builder.call(prefetch, [line, *(ir.Constant(word, x) for x in (1, 3, 1))])  # to write, to keep, data
    return context.get_dummy_value()


@type_callable(apart)
def _type_apart(context):  # type: ignore[no-untyped-def]
    return lambda: types.none


@lower_builtin(apart)  # type: ignore[no-untyped-call]
def _apart(context, builder, call, arguments):  # type: ignore[no-untyped-def]
    builder.function.attributes.discard("alwaysinline")
    builder.function.attributes.add("noinline")
    return context.get_dummy_value()


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
def _invoke(typing, function, params, state, samples, reset, found, size, j):  # type: ignore[no-untyped-def]
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


@overload(invoke)
def _invoked(function, params, state, samples, reset, found, size, j):  # type: ignore[no-untyped-def]
    def through(function, params, state, samples, reset, found, size, j):  # type: ignore[no-untyped-def]
        _invoke(function, params, state, samples, reset, found, size, j)  # type: ignore[call-arg]

    return through


@cache
def _numba_type(of: Any) -> Any:
    if get_origin(of) is Pointer:
        return types.CPointer(_numba_type(get_args(of)[0]))
    if of in SCALARS:
        return getattr(types, np.dtype(SCALARS[of]).name)
    if get_origin(of) is tuple:
        return types.UniTuple(_numba_type(get_args(of)[0]), len(get_args(of)))
    kinds = [_numba_type(kind) for _, kind in fields_of(of)]
    if kinds and all(kind == kinds[0] for kind in kinds):
        return types.NamedUniTuple(kinds[0], len(kinds), of)
    return types.NamedTuple(kinds, of)

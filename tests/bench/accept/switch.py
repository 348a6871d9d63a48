"""Which fault a drive has and how large it is, for sources in which faults are chosen at run time (`switched`).

It becomes `sim/switch.py` of the copy. The environment says which: HALLBENCH_FAULT="NUMBER SIZE". Compiled code asks by
a symbol, so that what is kept of it serves all faults.
"""

from __future__ import annotations

import ctypes
import os

from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic, overload

_number, _size = [*os.environ.get("HALLBENCH_FAULT", "0 0").split()]
CHOSEN, SIZE = ctypes.c_int64(int(_number)), ctypes.c_double(float(_size))
binding.add_symbol("hallbench_chosen", ctypes.addressof(CHOSEN))
binding.add_symbol("hallbench_size", ctypes.addressof(SIZE))


def fault_number() -> int:
    """The number of the fault that is there; 0: none."""
    return CHOSEN.value


def fault_size() -> float:
    """How large it is, in its own unit."""
    return SIZE.value


def _loads(name, kind, word):
    @intrinsic
    def load(context):
        def generate(context, builder, signature, arguments):
            module = builder.module
            where = module.globals.get(name) or ir.GlobalVariable(module, word, name)
            return builder.load(where)

        return kind(), generate

    return load


_load_chosen = _loads("hallbench_chosen", types.int64, ir.IntType(64))
_load_size = _loads("hallbench_size", types.float64, ir.DoubleType())


@overload(fault_number)
def _chosen():
    return lambda: _load_chosen()


@overload(fault_size)
def _size_of_it():
    return lambda: _load_size()

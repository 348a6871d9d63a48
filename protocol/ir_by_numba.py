"""LLVM IR of a kernel, made by numba: for `protocol.machine_code`. Importing this module imports numba."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import llvmlite
import numba
from numba.extending import overload

from protocol.machine_code import ENTRY, KERNELS

OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
    "no_cpython_wrapper": True,
    "_nrt": False,
}
"""Strict IEEE arithmetic in the order of the source (no fastmath, no contraction), no references to arrays counted."""
_INLINE: Any = {**OPTIONS, "forceinline": True}
_known: set[Callable[..., Any]] = set()

VERSIONS = f"numba {numba.__version__}, llvmlite {llvmlite.__version__}"
_NOT_FOR_ANY_MACHINE = ("; ModuleID", "source_filename", "target ", "@_ZN08NumbaEnv")


def ir_by_numba(function: Callable[..., None], arguments: list[Any]) -> str:
    """The IR of a function of arguments of numba's types, numbers and pointers, that returns nothing.

    Its name there is `ENTRY`. It takes addresses as int64, and returns 0 if nothing went wrong.

    No handler of a signal may raise in here: LLVM calls Python back, and drops what is raised there.
    """
    for kernel in KERNELS:
        if kernel not in _known:
            _known.add(kernel)
            overload(kernel, jit_options=_INLINE, strict=False)(_itself(kernel))
    njit: Any = numba.njit
    types: Any = numba.types
    made = njit(**OPTIONS)(function)
    signature = types.void(*arguments)
    made.compile(signature)
    compiled = made.overloads[signature.args]
    text: str = compiled.library.get_llvm_str()
    name = re.escape(compiled.fndesc.llvm_func_name)
    text = re.sub(rf'@"?{name}"?(?=\()', "@kernel", text)
    for k, other in enumerate(re.findall(r'^define linkonce_odr [^@]*(@"[^"]+"|@[\w.$]+)\(', text, re.MULTILINE)):
        text = text.replace(f"{other}(", f"@apart{k}(")  # its own name goes by what was compiled before
    text = text.replace("define linkonce_odr ", "define internal ")
    lines = [line for line in text.splitlines() if not line.startswith(_NOT_FOR_ANY_MACHINE)]
    text = "\n".join([*lines, *_entry(arguments), ""])
    text = re.sub(r'!"_Z[^"]*"', '!""', text)  # descriptions
    numbers: dict[str, str] = {}  # of functions, which go by what was compiled before: now in the order of the text
    text = re.sub(r"B\d+v(\d+)(?=B)", lambda found: numbers.setdefault(found[1], f"v{len(numbers)}"), text)
    return text.replace(" captures(none)", "")  # LLVM before 21 does not know it


def _itself(kernel: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *arguments, **named: kernel


def _entry(arguments: list[Any]) -> list[str]:
    """A function that calls numba's, which has two more arguments: where its result and its exception go."""
    words, casts, passed = [], [], ["ptr %result", "ptr %error"]
    for k, kind in enumerate(arguments):
        word = "double" if kind == numba.types.float64 else "i64"
        words.append(f"{word} %given{k}")
        if isinstance(kind, numba.types.CPointer):
            casts.append(f"  %at{k} = inttoptr i64 %given{k} to ptr")
            passed.append(f"ptr %at{k}")
        else:
            passed.append(words[-1])
    return [
        f"define i32 @{ENTRY}({', '.join(words)}) {{",
        "  %result = alloca ptr",
        "  %error = alloca ptr",
        *casts,
        f"  %status = call i32 @kernel({', '.join(passed)})",
        "  ret i32 %status",
        "}",
    ]

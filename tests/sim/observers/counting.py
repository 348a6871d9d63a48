"""What a step of an observer costs in float32 on a Cortex-M4F: its operations counted, times the cycles of each.

The kernels run as the plain Python that they are, on numbers that count what is done with them. So what is counted is
what a step really does, branch by branch, and its results are those of the compiled kernel bit for bit.

Counted as of a C function that keeps Params and State in place, everything inline, intermediate results in registers:

- A function reads a field or a constant once, however often it uses it; `step` writes each field that is another than
  before, and its estimate. Other copies are free, and so is what is done with whole numbers that tables hold.
- Cycles are those of Arm DDI 0439, Cortex-M4 Technical Reference Manual, instruction set tables of processor and FPU
  (the latter also as table 3-27 of TI SWCU192), memory without wait states. Nothing is fused: VFMA takes longer than
  VMUL and VADD.
- sinf and cosf are taken to be like a C library's cosine that was measured there, 146 cycles in the mean: J. Ganssle's
  figure in D. Penning, "Trig Function Performance Surprises", 2020.

Never measures a time, and counts no front end: what `sample` does for all observers is in none of them.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from sim.native import value
from sim.observers.entry import Entry
from sim.observers.sample import Sample

BRANCH = 2  # 1, or if it is taken 2 to 4; or IT and an instruction under it
COMPARE = 2 + BRANCH  # VCMP, VMRS
CYCLES = {
    "add": 1,
    "multiply": 1,
    "divide": 14,
    "root": 14,
    "compare": COMPARE,
    "absolute": 1,
    "negate": 1,
    "convert": 3,  # VMOV, VCVT
    "floor": 3 + COMPARE,  # VCVT there and back, VSUB
    "sine": 146,
    "cosine": 146,
    "load": 2,  # and 1 after another, which is left out
    "store": 2,
    "integer": 1,
    "integer compare": 1 + BRANCH,
    "integer divide": 10,  # 2 to 12, and for the remainder MLS
}
"""Of one operation."""
ARITHMETIC = dict.fromkeys(CYCLES, 0) | {"add": 1, "multiply": 1, "divide": 1, "root": 1}
"""The same where only arithmetic counts, each operation alike."""

COPIES = {"with_item"}  # functions that put one element in its place
FUNCTIONS = {"sin": "sine", "cos": "cosine", "sqrt": "root"}

Tally = Counter[tuple[str, str]]
"""How often, by function and kind of operation."""

_tally: Tally = Counter()
_read: set[tuple[str, float]] = set()  # what a function has in a register


@cache
def _name(code: CodeType) -> str:
    return f"{Path(code.co_filename).stem}.{code.co_name}"


def _count(kind: str, *operands: Any) -> None:
    """One more, done by the kernel that called the operator, and what it takes to have its operands in registers."""
    code = sys._getframe(2).f_code
    if code.co_name in COPIES:
        return
    name = _name(code)
    _tally[name, kind] += 1
    if kind.startswith("integer"):
        return
    for operand in operands:
        if type(operand) is Int:
            _tally[name, "convert"] += 1
        elif type(operand) is not Number and not (kind == "compare" and type(operand) is not Stored and operand == 0):
            at = name, id(operand) if type(operand) is Stored else float(operand)
            if at not in _read:
                _read.add(at)
                _tally[name, "load"] += 1


class Number(float):
    """A float in a register, that counts."""

    __hash__ = float.__hash__

    def __pow__(self, exponent: int) -> Number:
        assert exponent == 2
        _count("multiply", self)
        return Number(float(self) ** 2)

    def __neg__(self) -> Number:
        _count("negate", self)
        return Number(float.__neg__(self))

    def __abs__(self) -> Number:
        _count("absolute", self)
        return Number(float.__abs__(self))

    def __floor__(self) -> Number:
        _count("floor", self)
        return Number(float.__floor__(self))


class Stored(Number):
    """One in memory."""


class Int(int):
    """A whole number that counts."""

    __hash__ = int.__hash__


def _of_floats(name: str, kind: str) -> Callable[[Any, Any], Any]:
    plain = getattr(float, name)

    def operator(self: Any, other: Any) -> Any:
        _count(kind, self, other)
        found = plain(self, other)
        return found if kind == "compare" else Number(found)

    return operator


def _of_ints(name: str, kind: str) -> Callable[[Any, Any], Any]:
    plain, mixed = getattr(int, name), getattr(float, name, None)

    def operator(self: Any, other: Any) -> Any:
        if isinstance(other, Number):
            return NotImplemented
        if isinstance(other, float):
            _count(FLOATS[name], self, other)
            found = mixed(float(self), other)
            return found if FLOATS[name] == "compare" else Number(found)
        _count(kind)
        found = plain(self, other)
        return found if kind == "integer compare" else Int(found)

    return operator


COMPARED = ("__lt__", "__le__", "__gt__", "__ge__", "__eq__", "__ne__")
KINDS = {"add": "add", "sub": "add", "mul": "multiply", "truediv": "divide"}
FLOATS = dict.fromkeys(COMPARED, "compare")
FLOATS |= {f"__{way}{name}__": kind for name, kind in KINDS.items() for way in ("", "r")}
INTS = dict.fromkeys(COMPARED, "integer compare")
for _each in ("add", "sub", "mul", "and", "or", "xor", "lshift", "rshift", "mod"):
    for _way in ("", "r"):
        INTS[f"__{_way}{_each}__"] = "integer divide" if _each == "mod" else "integer"
for _each, _kind in FLOATS.items():
    setattr(Number, _each, _of_floats(_each, _kind))
for _each, _kind in INTS.items():
    setattr(Int, _each, _of_ints(_each, _kind))


def _function(name: str, kind: str) -> Callable[..., Any]:
    plain = getattr(math, name)

    def function(*arguments: float) -> Any:
        if not any(isinstance(argument, Number) for argument in arguments):
            return plain(*arguments)
        _count(kind, *arguments)
        return Number(plain(*arguments))

    return function


@contextmanager
def counting() -> Iterator[Tally]:
    """Count what is done with `Number`s and `Int`s in the block."""
    functions = {name: _function(name, kind) for name, kind in FUNCTIONS.items()}
    _tally.clear()
    _read.clear()
    with patch.multiple(math, **functions):
        yield _tally


def stored(record: Any) -> Any:
    """A record, or a number, as it lies in memory."""
    if isinstance(record, tuple):
        parts = map(stored, record)
        return type(record)(*parts) if hasattr(record, "_fields") else tuple(parts)
    return Stored(record) if isinstance(record, float) else Int(record)


def numbers(record: Any) -> Iterator[Any]:
    """The numbers of nested tuples, in order."""
    if isinstance(record, tuple):
        for part in record:
            yield from numbers(part)
    else:
        yield record


class Counted(NamedTuple):
    """Steps over samples."""

    tallies: list[Tally]  # of each
    estimates: list[Any]

    def costs(self, by: Mapping[str, int] = CYCLES) -> np.ndarray:
        """(n,) what each costs, cycles."""
        return np.array([cost(tally, by) for tally in self.tallies], float)


def cost(tally: Tally, by: Mapping[str, int] = CYCLES) -> int:
    """What so many operations cost, cycles."""
    return sum(n * by[kind] for (_, kind), n in tally.items())


def counted(entry: Entry, params: Any, state: Any, samples: np.ndarray) -> Counted:
    """Steps of an observer from a state over records of `Sample`; of `math` it may use sin, cos, sqrt and floor."""
    found = Counted([], [])
    params, state = stored(params), stored(state)
    for record in samples:
        sample = stored(value(Sample, record))
        with counting() as tally:
            after, estimate = entry.step(params, state, sample)
        written = sum(new is not old for new, old in zip(numbers(after), numbers(state), strict=True))
        tally["state and estimate", "store"] += written + len(list(numbers(estimate)))
        found.tallies.append(Counter(tally))
        found.estimates.append(estimate)
        state = stored(after)
    return found

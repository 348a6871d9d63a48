"""edge_kalman compiled once with constants that can be set afterwards: a trial of others costs no compilation.

Its modules are made anew from their sources. In the kernels each number that a module assigns to a name is a load from
memory; functions that run in Python see the name set. With the numbers as they are the estimates agree bit for bit.
"""

from __future__ import annotations

import ast
import ctypes
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from protocol.machine_code import _loaded, _target
from sim.observers.catalogue import CATALOGUE
from sim.observers.entry import Entry, Observing

PACKAGE = "sim.observers"
MODULES = ("edge_scales", "hall_places", "edge_lessons", "edge_kalman")
"""In the order in which one imports another."""
FIXED = ("DEG", "UNIFORM", "AT_HALF", "FULL_SCALE", "TINY", "LEAST", "FURTHEST")
"""Mathematics, and what follows from other figures."""
LOADED = "_constant"


class Constants:
    """`values`: by MODULE.NAME as they are now; `entry`: the observer, which takes them from there."""

    def __init__(self) -> None:
        self._trees = {name: ast.parse(Path(import_module(f"{PACKAGE}.{name}").__file__ or "").read_text())
                       for name in MODULES}  # fmt: skip
        self.as_they_are = dict(self._found())
        self._cells = np.array(list(self.as_they_are.values()))
        self._places = {name: k for k, name in enumerate(self.as_they_are)}
        self._modules: dict[str, ModuleType] = {}
        for name in MODULES:
            self._modules[name] = self._made(name)
        known = CATALOGUE["edge_kalman"]
        self.entry = Entry.of(
            self._modules["edge_kalman"], known.short, "trial", known.name, known.needs, **known.results
        )
        native = self.entry.function
        native.make = self._make  # type: ignore[method-assign]

    def _make(self) -> None:
        """Load it; nothing of it is kept."""
        native = self.entry.function
        native._address = _loaded(_target().code(native.ir()))
        native._call = ctypes.CFUNCTYPE(ctypes.c_int32, *[ctypes.c_int64] * 6)(native._address)

    def _found(self) -> Any:
        for module, tree in self._trees.items():
            home = import_module(f"{PACKAGE}.{module}")
            for node in tree.body:
                if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                    name = node.targets[0].id
                    if name.isupper() and name not in FIXED and isinstance(getattr(home, name), float):
                        yield f"{module}.{name}", getattr(home, name)

    def _made(self, name: str) -> ModuleType:
        tree = _Loads(name, self._places).visit(self._trees[name])
        made = ModuleType(f"trial_{name}")
        sys.modules[made.__name__] = made
        made.__dict__[LOADED] = loader(self._cells.ctypes.data)
        exec(compile(ast.fix_missing_locations(tree), f"<{made.__name__}>", "exec"), made.__dict__)
        return made

    def set(self, values: Mapping[str, float]) -> None:
        """From now on these, and all others as they are in the sources. Only observers made afterwards have them."""
        for name, value in {**self.as_they_are, **values}.items():
            module, _, constant = name.partition(".")
            self._cells[self._places[name]] = value
            setattr(self._modules[module], constant, value)

    def start(self, pwm_hz: float, drive: Mapping[str, float]) -> Observing:
        """The observer at work with the constants of now; run it before others are set."""
        return self.entry.start(self.entry.make_params(pwm_hz, drive))


class _Loads(ast.NodeTransformer):
    """Imports of a trial's own modules, and loads in kernels in the place of constants."""

    def __init__(self, module: str, places: Mapping[str, int]) -> None:
        self._places = places
        self._names = {name.partition(".")[2]: k for name, k in places.items() if name.startswith(f"{module}.")}
        self._in_kernel = False

    def visit_ImportFrom(self, node: ast.ImportFrom) -> Any:
        module = (node.module or "").removeprefix(f"{PACKAGE}.")
        if module in MODULES:
            self._names |= {
                alias.name: self._places[f"{module}.{alias.name}"]
                for alias in node.names
                if f"{module}.{alias.name}" in self._places
            }
            return ast.ImportFrom(f"trial_{module}", node.names, 0)
        if node.module != PACKAGE:
            return node
        own = [alias for alias in node.names if alias.name in MODULES]
        others = [alias for alias in node.names if alias.name not in MODULES]
        kept: list[ast.stmt] = [ast.ImportFrom(PACKAGE, others, 0)] if others else []
        return kept + [ast.Import([ast.alias(f"trial_{alias.name}", alias.name)]) for alias in own]

    def visit_FunctionDef(self, node: ast.FunctionDef) -> Any:
        if any(isinstance(one, ast.Name) and one.id == "kernel" for one in node.decorator_list):
            self._in_kernel = True
            self.generic_visit(node)
            self._in_kernel = False
        return node

    def visit_Name(self, node: ast.Name) -> Any:
        return self._load(self._names.get(node.id), node)

    def visit_Attribute(self, node: ast.Attribute) -> Any:
        if isinstance(node.value, ast.Name) and node.value.id in MODULES:
            return self._load(self._places.get(f"{node.value.id}.{node.attr}"), node)
        self.generic_visit(node)
        return node

    def _load(self, place: int | None, node: ast.expr) -> ast.expr:
        if place is None or not self._in_kernel:
            return node
        return ast.Call(ast.Name(LOADED, ast.Load()), [ast.Constant(place)], [])


def loader(base: int) -> Any:
    """In kernels a function of k: the k-th of the numbers that are in memory from `base` on."""

    @intrinsic
    def load(typing: Any, k: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            word = ir.IntType(64)
            at = builder.add(ir.Constant(word, base), builder.mul(arguments[0], ir.Constant(word, 8)))
            return builder.load(builder.inttoptr(at, ir.DoubleType().as_pointer()))

        return types.float64(types.int64), generate

    return load

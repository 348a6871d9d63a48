"""A copy of `sim` in which faults are chosen at run time: many of them, and the kernels are compiled once.

A change puts another expression in the place of one: `old` becomes `new if fault_number() == number else old`. Number
and size come from the environment (`switch`), to every process that runs in the copy. Without a number the copy does
what the original does, bit for bit.
"""

from __future__ import annotations

import ast
import hashlib
import math
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[3]
KEPT = ROOT / ".sabotage"
SWITCH = Path(__file__).with_name("switch.py")


class Change(NamedTuple):
    """In a module of `sim` ("control/current_loop"): the expression `old`, which is there once, becomes `new`.

    SIZE in `new` is the fault's size, DEG one degree in rad. `within`: the function that has it, where others have it,
    too.
    """

    module: str
    old: str
    new: str
    within: str = ""


class Place(NamedTuple):
    """An expression of a module's text, by line and column of its begin and end."""

    lineno: int
    col_offset: int
    end_lineno: int
    end_col_offset: int

    @classmethod
    def of(cls, node: ast.expr) -> Place:
        return cls(node.lineno, node.col_offset, node.end_lineno or 0, node.end_col_offset or 0)


class _Switching(ast.NodeTransformer):
    """Puts the choice among the expressions at each place."""

    def __init__(self, by_place: Mapping[Place, Sequence[tuple[int, ast.expr]]]) -> None:
        self.by_place = by_place

    def visit(self, node: ast.AST) -> ast.AST:
        here = self.by_place.get(Place.of(node), ()) if isinstance(node, ast.expr) else ()
        made = self.generic_visit(node)
        for number, new in here:
            test = ast.parse(f"fault_number() == {number}", mode="eval").body
            assert isinstance(made, ast.expr)
            made = ast.IfExp(test, new, made)
        return made


class _Size(ast.NodeTransformer):
    def visit_Name(self, node: ast.Name) -> ast.expr:
        meant = {"SIZE": "fault_size()", "DEG": repr(math.pi / 180.0)}.get(node.id)
        return ast.parse(meant, mode="eval").body if meant else node


def expressions(module: ast.Module, within: str = "") -> Iterable[ast.expr]:
    """All that have a value, in all functions or in the one of that name; the outer ones first."""
    for function in ast.walk(module):
        if isinstance(function, ast.FunctionDef) and within in ("", function.name):
            for statement in function.body:
                for node in ast.walk(statement):
                    if isinstance(node, ast.expr) and isinstance(getattr(node, "ctx", ast.Load()), ast.Load):
                        yield node


def place_of(change: Change, text: str) -> Place:
    """Where a change is; ValueError that says how often its expression is there, if not once."""
    wanted = ast.unparse(ast.parse(change.old, mode="eval"))
    places = {Place.of(node) for node in expressions(ast.parse(text), change.within) if ast.unparse(node) == wanted}
    if len(places) != 1:
        where = f"sim/{change.module}.py" + (f", {change.within}" if change.within else "")
        raise ValueError(f"{where} has changed: '{change.old}' is in it {len(places)} times, must be once")
    return places.pop()


def switched(text: str, changes: Iterable[tuple[int, Place, str]]) -> str:
    """A module's text with those changes to choose from: number, where, and what it becomes."""
    by_place: defaultdict[Place, list[tuple[int, ast.expr]]] = defaultdict(list)
    for number, place, new in changes:
        by_place[place].append((number, _Size().visit(ast.parse(new, mode="eval").body)))
    module: ast.Module = ast.parse(text)
    _Switching(by_place).visit(module)
    after = next(k for k, node in enumerate(module.body) if isinstance(node, ast.ImportFrom)) + 1
    module.body.insert(after, ast.parse("from sim.switch import fault_number, fault_size").body[0])
    return ast.unparse(ast.fix_missing_locations(module)) + "\n"


class Tree:
    """The copy with these changes, numbered from 1 on, each with its place."""

    def __init__(self, changes: Sequence[tuple[str, Place, str]]) -> None:
        by_module: defaultdict[str, list[tuple[int, Place, str]]] = defaultdict(list)
        for number, (module, place, new) in enumerate(changes, 1):
            by_module[module].append((number, place, new))
        sources = {
            module: switched((ROOT / "sim" / f"{module}.py").read_text(), made) for module, made in by_module.items()
        }
        digest = hashlib.sha256(SWITCH.read_bytes() + repr(sorted(sources.items())).encode())
        for file in sorted((ROOT / "sim").rglob("*.py")):
            digest.update(file.read_bytes())
        self.folder = KEPT / f"tree-{digest.hexdigest()[:12]}"
        if not self.folder.exists():
            making = self.folder.with_suffix(f".{os.getpid()}")
            shutil.copytree(ROOT / "sim", making / "sim", ignore=shutil.ignore_patterns("__pycache__"))
            shutil.copy(SWITCH, making / "sim" / "switch.py")
            for module, source in sources.items():
                (making / "sim" / f"{module}.py").write_text(source)
            with suppress(OSError):  # another process has made it
                making.rename(self.folder)

    @classmethod
    def of(cls, changes: Sequence[Change]) -> Tree:
        """The copy with these changes."""
        return cls([(c.module, place_of(c, (ROOT / "sim" / f"{c.module}.py").read_text()), c.new) for c in changes])

    def run(
        self, *words: object, number: int = 0, size: float = 0.0, seconds: float = 600.0
    ) -> subprocess.CompletedProcess[str]:
        """`python -m WORDS` in the copy with one fault. Raises subprocess.TimeoutExpired."""
        own = {
            "PYTHONPATH": os.pathsep.join([str(self.folder), str(ROOT)]),
            "NUMBA_CACHE_DIR": str(self.folder / "cache"),
            "HALLBENCH_FAULT": f"{number} {size!r}",
        }
        command = [sys.executable, "-m", *map(str, words)]
        return subprocess.run(
            command, cwd=self.folder, env=os.environ | own, capture_output=True, text=True, timeout=seconds
        )

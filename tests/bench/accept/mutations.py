"""Mutants of the drive's code, drawn by a seed, and how many of them `bench accept --spec` catches.

    python -m tests.bench.accept.mutations [--count 50] [--seed 1]

A mutant is one expression of `sim/control`, `sim/observers` or `sim/drive/tick_*`: another sign, operator, comparison
or constant, a term less, two arguments exchanged. One whose fixed short run records the same as the original's, sample
by sample, may be none, and does not count. All of a draw are compiled together (`switched`). What was run is kept.
"""

from __future__ import annotations

import argparse
import ast
import copy
import hashlib
import json
import random
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from bench.accept.spec import read_spec
from tests.bench.accept.power import accepted, judged, stamp
from tests.bench.accept.switched import KEPT, ROOT, Place, Tree

SIM = ROOT / "sim"
PLACES = ("control/*.py", "observers/*.py", "drive/tick_*.py")
NOT_DRIVEN = {"observers/entry", "observers/catalogue", "drive/tick_record"}  # no part of what a drive computes
SIGN = {ast.Add: ast.Sub, ast.Sub: ast.Add}
FACTOR = {ast.Mult: ast.Div, ast.Div: ast.Mult}
COMPARED = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq}
REVERSED = {ast.Lt: ast.Gt, ast.LtE: ast.GtE, ast.Gt: ast.Lt, ast.GtE: ast.LtE}
WHOLE = ("observers/vector_tracking_q15",)  # works on whole numbers: a quotient has no place there


class Mutant(NamedTuple):
    """What becomes of an expression."""

    module: str
    place: Place
    kind: str
    old: str
    new: str

    @property
    def about(self) -> str:
        return f"{self.module} line {self.place.lineno}: {self.old} -> {self.new}"


def modules() -> list[str]:
    """Of the drive's code, by path without its end."""
    found = (file.relative_to(SIM).with_suffix("").as_posix() for place in PLACES for file in SIM.glob(place))
    return sorted(name for name in found if not name.endswith("__init__") and name not in NOT_DRIVEN)


@cache
def _parameters() -> dict[str, list[str]]:
    """The types of each function's parameters, by its name, where one of that name is in the drive's code."""
    found: dict[str, list[list[str]]] = {}
    for module in modules():
        for node in ast.walk(ast.parse((SIM / f"{module}.py").read_text())):
            if isinstance(node, ast.FunctionDef):
                kinds = [ast.unparse(a.annotation) if a.annotation else "" for a in node.args.args]
                found.setdefault(node.name, []).append(kinds)
    return {name: kinds[0] for name, kinds in found.items() if len(kinds) == 1}


def _changed(node: ast.expr, module: str) -> Iterator[tuple[str, ast.expr]]:
    """What can become of an expression, itself without its parts."""
    new = copy.deepcopy(node)
    if isinstance(new, ast.BinOp) and isinstance(node, ast.BinOp):
        if type(node.op) in SIGN:
            new.op = SIGN[type(node.op)]()
            yield "sign", new
            yield "term dropped", copy.deepcopy(node.left)
        elif type(node.op) in FACTOR and module not in WHOLE:
            new.op = FACTOR[type(node.op)]()
            yield "operator", new
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "sign", copy.deepcopy(node.operand)
    elif isinstance(new, ast.Compare) and isinstance(node, ast.Compare) and len(node.ops) == 1:
        for table in (COMPARED, REVERSED):
            if other := table.get(type(node.ops[0])):
                again = copy.deepcopy(new)
                again.ops = [other()]
                yield "comparison", again
    elif isinstance(node, ast.Constant) and type(node.value) is float and node.value:
        for share in (1.1, 0.9):
            yield "constant", ast.Constant(share * node.value)
    elif isinstance(node, ast.Constant) and type(node.value) is int:
        for more in (1, -1):
            yield "off by one", ast.Constant(node.value + more)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        kinds = _parameters().get(node.func.id, [])
        for k in range(min(len(node.args), len(kinds)) - 1):
            if kinds[k] == kinds[k + 1] != "" and ast.dump(node.args[k]) != ast.dump(node.args[k + 1]):
                again_ = copy.deepcopy(node)
                again_.args[k], again_.args[k + 1] = again_.args[k + 1], again_.args[k]
                yield "arguments exchanged", again_


def _values(function: ast.FunctionDef) -> Iterator[ast.expr]:
    """The expressions of a function that have a value when it runs; no index, which compiled code must know."""

    def below(node: ast.AST) -> Iterator[ast.expr]:
        for name, part in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "args") and not isinstance(node, ast.Call):
                continue
            if (isinstance(node, ast.Subscript) and name == "slice") or isinstance(node, ast.JoinedStr):
                continue
            for child in part if isinstance(part, list) else [part]:
                if isinstance(child, ast.expr) and isinstance(getattr(child, "ctx", ast.Load()), ast.Load):
                    yield child
                if isinstance(child, ast.AST):
                    yield from below(child)

    yield from below(function)


def mutants_of(module: str) -> list[Mutant]:
    """All of a module."""
    text = (SIM / f"{module}.py").read_text()
    return [
        Mutant(module, Place.of(node), kind, ast.unparse(node), ast.unparse(ast.fix_missing_locations(new)))
        for function in ast.parse(text).body
        if isinstance(function, ast.FunctionDef)
        for node in _values(function)
        for kind, new in _changed(node, module)
    ]


def drawn(seed: int, count: int) -> list[Mutant]:
    """A module at random, then one of its mutants; each once."""
    draw = random.Random(seed)
    every = {module: found for module in modules() if (found := mutants_of(module))}
    chosen: dict[Mutant, None] = {}
    while len(chosen) < count:
        chosen[draw.choice(every[draw.choice(sorted(every))])] = None
    return list(chosen)


def compiled(mutants: list[Mutant]) -> tuple[Tree, list[Mutant]]:
    """A copy with these, less those that cannot be compiled; numbers are places in the list, from 1 on."""
    made = Tree([(m.module, m.place, m.new) for m in mutants])
    if made.run("tests.bench.accept.effects", "recorded", "{}").returncode == 0:
        return made, mutants
    if len(mutants) == 1:
        print(f"not compiled: {mutants[0].about}", flush=True)
        return made, []
    middle = len(mutants) // 2
    sound = [m for half in (mutants[:middle], mutants[middle:]) for m in compiled(half)[1]]
    return Tree([(m.module, m.place, m.new) for m in sound]), sound


def recorded(made: Tree, number: int) -> str:
    """What the fixed short run records, as a digest; what went wrong, if something did."""
    ran = made.run("tests.bench.accept.effects", "recorded", "{}", number=number)
    return ran.stdout.strip() if ran.returncode == 0 else f"ended with {ran.returncode}"


def tried(made: Tree, number: int, mutant: Mutant, original: str) -> dict[str, Any]:
    """What the suite measured on a mutant, from what is kept or from a run."""
    name = hashlib.sha256(repr(mutant).encode()).hexdigest()[:12]
    file = KEPT / stamp() / f"mutant-{name}.json"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        entry: dict[str, Any] = {"differs": recorded(made, number) != original, "run": None}
        if entry["differs"]:
            run = file.with_name(f"run-{file.name}")
            code = accepted(made, number, 0.0, {}, run)
            entry["run"] = json.loads(run.read_text()) if code is not None else None
            run.unlink(missing_ok=True)
        file.write_text(json.dumps(entry))
    found: dict[str, Any] = json.loads(file.read_text())
    return found


def trial(seed: int, count: int) -> list[dict[str, Any]]:
    """A line for each of a draw: what it is, whether it counts, and which tests caught it."""
    made, mutants = compiled(drawn(seed, count))
    original, spec, lines = recorded(made, 0), read_spec("sim"), []
    for number, mutant in enumerate(mutants, 1):
        entry = tried(made, number, mutant, original)
        line: dict[str, Any] = {**mutant._asdict(), "place": mutant.place.lineno, "differs": entry["differs"]}
        if entry["differs"]:
            caught = judged(entry, spec)
            line |= {"limits": list(caught.limits), "specified": list(caught.specified)}
        word = "same" if not entry["differs"] else "caught" if caught.limits or caught.specified else "MISSED"
        print(f"{number} of {len(mutants)} {word} {mutant.kind}: {mutant.about}", flush=True)
        lines.append(line)
    return lines


def main() -> int:
    """Draw, run, and say what share was caught."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--json", type=Path, help="write a line for each to it")
    options = parser.parse_args()
    lines = trial(options.seed, options.count)
    if options.json:
        options.json.write_text(json.dumps(lines, indent=1) + "\n")
    count = [line for line in lines if line["differs"]]
    limits = sum(bool(line["limits"]) for line in count)
    both = sum(bool(line["limits"] or line["specified"]) for line in count)
    print(f"{len(count)} of {len(lines)} mutants record something else; {limits} caught by limits, {both} with --spec")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""How many small mistakes in the code the suite catches: mutants of cosmic-ray, chosen by a seed.

    pip install 'hallbench[mutants]'
    python -m tests.mutants choose TREE OTHER > FILE   mutants whose line and function both checkouts have
    python -m tests.mutants reach TREE FILE            runs the suite of this checkout: which test comes to which mutant
    python -m tests.mutants try TREE FILE              how many of them the suite of this checkout catches

A checkout has its own `.venv`. `choose` takes --seed and --count. `try` gives a mutant to the tests that come to its
line, the quick ones first, for --most seconds; a test that fails without the mutant too has caught nothing. What was
tried is kept in TREE/.mutants: a trial goes on where it was, and one with more seconds tries what was missed again.
"""

from __future__ import annotations

import argparse
import ast
import json
import random
import re
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any

FOLDER = ".mutants"
PLACES = ("bench/**/*.py", "protocol/**/*.py", "sim/config/*.py", "sim/ports/*.py", "sim/drive/*.py", "sim/*.py")
COMPILED = (
    *("sim/native.py", "sim/numba_cache.py", "sim/by_numba.py"),
    *("protocol/compiled_framing.py", "protocol/machine_code.py", "protocol/ir_by_numba.py"),
)
UNUSED = ("RemoveDecorator", "VariableReplacer", "VariableInserter")  # operators whose mutants say little
RUN = [".venv/bin/python", "-m", "pytest", "-q", "-p", "no:cacheprovider"]

Mutant = dict[str, str]  # function, before, after; file: where choose found it, other: in the other checkout


# -- reach ------------------------------------------------------------------------------------------------------------

PROBE = '''"""Writes down which test comes to which mutant, and how long a test takes."""
import json, os

seen = set()

def at(mutant):
    test = os.environ.get("PYTEST_CURRENT_TEST", "")
    if (mutant, test) not in seen:
        seen.add((mutant, test))
        write([mutant, test])

def write(row):
    with open(NAME, "a") as file:
        file.write(json.dumps(row) + "\\n")

def pytest_runtest_logreport(report):
    if "PYTEST_XDIST_WORKER" not in os.environ:
        write([report.nodeid, report.duration])
'''


def copied(tree: Path, name: str) -> Path:
    """A copy of the checkout, what is installed in its `.venv` among it."""
    copy = tree / FOLDER / name
    shutil.rmtree(copy, ignore_errors=True)
    ignored = shutil.ignore_patterns(FOLDER, ".git", ".*_cache", "wt")
    shutil.copytree(tree, copy, symlinks=True, ignore=ignored)
    for script in (copy / ".venv/lib").glob("python*/site-packages/*hallbench*"):
        _point(script, str(tree), str(copy))
    return copy


def reach(tree: Path, mutants: list[Mutant], workers: str) -> None:
    """Run the suite of `tree` with a probe before each mutant's statement; the rows are in TREE/.mutants/reached."""
    copy, rows = copied(tree, "reach"), tree / FOLDER / "reached"
    rows.unlink(missing_ok=True)
    for file in {_file(tree, mutant) for mutant in mutants}:
        source = (tree / file).read_text()
        lines = source.splitlines()
        at = {k: _line(source, mutant) for k, mutant in enumerate(mutants) if _file(tree, mutant) == file}
        probes = [(_statement(source, line), k) for k, line in at.items() if line]
        for before, mutant in sorted(probes, reverse=True):
            indent = re.match(" *", lines[before - 1])[0]  # type: ignore[index]
            lines.insert(before - 1, f'{indent}__import__("mutant_probe").at({mutant})')
        (copy / file).write_text("\n".join(lines) + "\n")
    packages = next((copy / ".venv/lib").glob("python*")) / "site-packages"
    (packages / "mutant_probe.py").write_text(PROBE.replace("NAME", repr(str(rows))))
    subprocess.run([*RUN, "-n", workers, "-p", "mutant_probe"], cwd=copy)


def _file(tree: Path, mutant: Mutant) -> str:
    """Where this checkout has the mutant's function."""
    return next(name for name in (mutant["file"], mutant["other"]) if (tree / name).exists())


def _line(source: str, mutant: Mutant) -> int:
    """The mutant's line, 0 if it is not there any more."""
    lines = source.splitlines()
    inside = [span for name, *span in _functions(source) if name == mutant["function"]]
    rows = [row for first, last in inside for row in range(first, last + 1)]
    return next((row for row in rows if lines[row - 1].strip() == mutant["before"]), 0)


def _statement(source: str, line: int) -> int:
    """The line at which the statement round a line begins; 0 if a probe cannot stand there."""
    lines = source.splitlines()
    found = 0
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or node.lineno):
            head = (
                lines[node.lineno - 1].lstrip().startswith(("elif", "else"))
                or lines[node.lineno - 1][: node.col_offset].strip()
            )
            if not head and node.lineno > found:
                found = 0 if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) else node.lineno
    return found


# -- choose -----------------------------------------------------------------------------------------------------------


def _functions(source: str) -> Iterator[tuple[str, int, int]]:
    """Name, first and last line of each function, inner ones last."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node.name, node.lineno, node.end_lineno or node.lineno


def _mutated(file: Path, rng: random.Random) -> tuple[int, str] | None:
    """A line of the file, counted from 1, and what becomes of it: any place, then any operator that has one there."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names

    source = file.read_text()
    nodes = list(ast_nodes(get_ast(source)))
    sites: defaultdict[tuple[int, int], list[tuple[Any, int]]] = defaultdict(list)
    for name in operator_names():
        if not name.endswith(UNUSED):
            operator, count = get_operator(name)(), 0
            for node in nodes:
                for begin, _ in operator.mutation_positions(node):
                    sites[begin].append((operator, count))
                    count += 1
    if not sites:
        return None
    operator, occurrence = rng.choice(sites[rng.choice(sorted(sites))])
    mutated = mutate_code(source, operator, occurrence)
    before, after = source.splitlines(), (mutated or "").splitlines()
    changed = [k for k, (a, b) in enumerate(zip(before, after, strict=False)) if a != b]
    if len(before) != len(after) or len(changed) != 1 or _plain(mutated) in ("", _plain(source)):
        return None
    return changed[0] + 1, after[changed[0]]


def _plain(source: str) -> str:
    """What of a module is run, without annotations and docstrings; "" if it is no Python."""
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return ""
    for node in ast.walk(tree):
        for field in ("annotation", "returns"):
            if hasattr(node, field):
                setattr(node, field, None)
    return ast.dump(tree)


def choose(tree: Path, other: Path, seed: int, count: int) -> list[Mutant]:
    """`count` mutants: function, its line and what becomes of it, and the file in each checkout."""
    rng = random.Random(seed)
    files = [file for place in PLACES for file in sorted(tree.glob(place))]
    files = [file for file in files if str(file.relative_to(tree)) not in COMPILED]
    files = [file for file in files if "import kernel" not in file.read_text()]
    weights = [len(file.read_text().splitlines()) for file in files]
    there: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    for file in (found for place in PLACES for found in other.glob(place)):
        text = file.read_text()
        for name, first, last in _functions(text):
            for line in text.splitlines()[first - 1 : last]:
                there[name, line.strip()].add(str(file.relative_to(other)))
    found: list[Mutant] = []
    while len(found) < count:
        file = rng.choices(files, weights)[0]
        mutant = _mutated(file, rng)
        if mutant is None:
            continue
        at, after = mutant
        text = file.read_text()
        before = text.splitlines()[at - 1].strip()
        inside = [name for name, first, last in _functions(text) if first <= at <= last]
        elsewhere = there.get((inside[-1], before), set()) if inside else set()
        if len(elsewhere) == 1 and _statement(text, at):
            found.append({"function": inside[-1], "before": before, "after": after.strip(),
                          "file": str(file.relative_to(tree)), "other": elsewhere.pop()})  # fmt: skip
    return found


# -- try --------------------------------------------------------------------------------------------------------------


class Trial:
    """Gives mutants to the tests of a checkout; two at a time, each in a copy of its own."""

    def __init__(self, tree: Path, most: float) -> None:
        self.tree, self.most = tree, most
        self.times = Counter[str]()
        self.reached: defaultdict[int, set[str]] = defaultdict(set)
        prepared: defaultdict[int, set[str]] = defaultdict(set)  # files of tests whose fixtures come to the mutant
        for line in (tree / FOLDER / "reached").read_text().splitlines():
            what, value = json.loads(line)
            if isinstance(what, str):
                self.times[what] += value
            elif value.endswith("(setup)"):
                prepared[what].add(value.split("::")[0])
            else:
                self.reached[what].add(value.removesuffix(" (call)").removesuffix(" (teardown)"))
        for mutant, files in prepared.items():
            self.reached[mutant] |= {test for test in self.times if test.split("::")[0] in files}
        self.copies: SimpleQueue[Path] = SimpleQueue()
        for name in ("one", "two"):
            self.copies.put(copied(tree, name))

    def tests(self, number: int) -> list[str]:
        """Which tests to run, the quickest first, while their times fit."""
        chosen, seconds = [], 0.0
        for test in sorted(self.reached[number] & self.times.keys(), key=lambda test: self.times[test]):
            seconds += self.times[test]
            if seconds > self.most:
                break
            chosen.append(test)
        return chosen

    def outcome(self, number: int, mutant: Mutant) -> str:
        """What caught it: a test, "timeout", or "" if nothing did."""
        copy, file = self.copies.get(), _file(self.tree, mutant)
        original = (self.tree / file).read_text()
        lines = original.splitlines()
        at = _line(original, mutant) - 1
        lines[at] = lines[at].replace(mutant["before"], mutant["after"])
        tests = self.tests(number)
        try:
            while tests:
                (copy / file).write_text("\n".join(lines) + "\n")
                failed = self._failed(copy, tests)
                (copy / file).write_text(original)
                if failed in ("", "timeout") or not self._failed(copy, [failed]):
                    return failed
                tests.remove(failed)  # it fails without the mutant, too
            return ""
        finally:
            (copy / file).write_text(original)
            self.copies.put(copy)

    def _failed(self, copy: Path, tests: list[str]) -> str:
        """The first test that fails, "timeout", or ""."""
        names = copy / FOLDER
        names.write_text("\n".join(tests))
        limit = 120.0 + 5.0 * sum(self.times[test] for test in tests)
        command = [*RUN, "-x", "-p", "no:xdist", f"@{names}"]
        try:
            ended = subprocess.run(command, cwd=copy, capture_output=True, text=True, timeout=limit)
        except subprocess.TimeoutExpired:
            return "timeout"
        if ended.returncode == 0:
            return ""
        found = re.search(r"^(?:FAILED|ERROR) (\S+?)(?: - |$)", ended.stdout, re.MULTILINE)
        return found[1] if found else tests[0]


def _point(path: Path, old: str, new: str) -> None:
    """Have what an editable install left name another folder."""
    for file in [path] if path.is_file() else (found for found in path.rglob("*") if found.is_file()):
        text = file.read_text()
        if old in text:
            file.write_text(text.replace(old, new))


def try_all(tree: Path, mutants: list[Mutant], most: float) -> None:
    """Try them, and say how many were caught."""
    kept = tree / FOLDER / "tried"
    done = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    known = {number: caught for number, caught, seconds in done if caught or seconds >= most}
    trial = Trial(tree, most)

    def one(numbered: tuple[int, Mutant]) -> str:
        number, mutant = numbered
        here = _line((tree / _file(tree, mutant)).read_text(), mutant)
        if here and number not in known:
            known[number] = trial.outcome(number, mutant)
            with kept.open("a") as file:
                file.write(json.dumps([number, known[number], most]) + "\n")
        word = "gone" if not here else "caught" if known[number] else "MISSED"
        what = f"{mutant['file']} {mutant['function']}: {mutant['before']} -> {mutant['after']}"
        print(number, word, what, known.get(number, ""), flush=True)
        return word

    with ThreadPoolExecutor(2) as pool:
        words = Counter(pool.map(one, enumerate(mutants)))
    print(f"{words['caught']} of {len(mutants) - words['gone']} caught; {words['gone']} have no line here any more")


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("choose", "reach", "try"))
    parser.add_argument("tree", type=Path)
    parser.add_argument("second", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--most", type=float, default=30.0, help="s of tests that a mutant is given to")
    parser.add_argument("--workers", default="3", help="of the suite that `reach` runs")
    given = parser.parse_args()
    tree, second = given.tree.resolve(), given.second.resolve()
    if given.what == "choose":
        json.dump(choose(tree, second, given.seed, given.count), sys.stdout, indent=1)
        return
    mutants = json.loads(second.read_text())
    if given.what == "reach":
        reach(tree, mutants, given.workers)
    else:
        try_all(tree, mutants, given.most)


if __name__ == "__main__":
    main()

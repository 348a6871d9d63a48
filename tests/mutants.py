"""How many small mistakes in the code the suite catches: mutants of cosmic-ray, chosen by a seed.

    pip install 'hallbench[mutants]'
    python -m tests.mutants map TREE                   runs the suite of this checkout: which test runs which line
    python -m tests.mutants choose TREE OTHER > FILE   mutants whose line and function both checkouts have
    python -m tests.mutants try TREE FILE              how many of them the suite of this checkout catches

A checkout has its own `.venv`. `choose` takes --seed and --count. `try` gives a mutant to the tests that run its line,
the quick ones first, for some minutes at most; a test that fails without the mutant too has caught nothing. What was
tried is kept beside the map in TREE/.mutants: a trial that was interrupted goes on where it was.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pytest

FOLDER = ".mutants"
PLACES = ("bench/**/*.py", "protocol/**/*.py", "sim/config/*.py", "sim/ports/*.py", "sim/drive/*.py", "sim/*.py")
COMPILED = ("sim/native.py", "sim/numba_cache.py", "sim/drive/tick.py", "protocol/compiled_framing.py")
UNUSED = ("RemoveDecorator", "VariableReplacer", "VariableInserter")  # operators whose mutants say little
MOST = 240.0  # s of tests, by the times of the map, that a mutant is given to
RUN = [".venv/bin/python", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist"]


# -- map: as a plug-in of pytest in the checkout -----------------------------------------------------------------------


def pytest_configure(config: pytest.Config) -> None:
    """Measure which lines each test runs, in this process and in those that it starts."""
    import coverage

    folder = Path(config.rootpath, FOLDER)
    if os.environ.get("PYTEST_XDIST_WORKER") or not getattr(config.option, "numprocesses", None):
        here = [str(config.rootpath)]
        measured = coverage.Coverage(folder / "data", data_suffix=True, source=here, config_file=False)
        config.pluginmanager.register(_Measured(measured))
    if not os.environ.get("PYTEST_XDIST_WORKER"):
        config.pluginmanager.register(_Times(folder / "times.jsonl"))


class _Measured:
    """Coverage with a context for each test."""

    def __init__(self, measured: Any) -> None:
        self._measured = measured
        measured.start()
        os.environ["COVERAGE_PROCESS_START"] = f"{measured.config.data_file}.rc"  # for processes that tests start

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        self._measured.switch_context(item.nodeid)
        return (yield)

    def pytest_unconfigure(self) -> None:
        self._measured.stop()
        self._measured.save()


class _Times:
    """A line of JSON for each phase of each test."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        with self._file.open("a") as file:
            file.write(json.dumps([report.nodeid, report.duration]) + "\n")


def make_map(tree: Path) -> None:
    """Run the suite of `tree`, and keep which tests run which line."""
    import coverage

    folder = tree / FOLDER
    folder.mkdir(exist_ok=True)
    (folder / "data.rc").write_text(
        f"[run]\ndata_file = {folder}/data\nparallel = true\nsigterm = true\nsource = {tree}\n"
        "context = ${PYTEST_CURRENT_TEST-}\n"
    )
    packages = next((tree / ".venv/lib").glob("python*")) / "site-packages"
    (packages / "coverage_of_children.pth").write_text("import coverage; coverage.process_startup()\n")
    plugin = folder / "plugin"
    plugin.mkdir(exist_ok=True)
    shutil.copy(__file__, plugin / "mutants.py")  # `tests` itself has folders named as the packages
    here = {**os.environ, "PYTHONPATH": str(plugin)}
    subprocess.run([*RUN[:4], "-n", "2", "-p", "mutants"], cwd=tree, env=here)
    (packages / "coverage_of_children.pth").unlink()
    every = coverage.Coverage(data_file=folder / "data", config_file=False)
    every.combine([str(folder)])
    data, lines = every.get_data(), {}
    for file in data.measured_files():
        tests = {
            line: sorted({context.split(" (")[0].lstrip("|") for context in contexts} - {""})
            for line, contexts in data.contexts_by_lineno(file).items()
        }
        lines[str(Path(file).relative_to(tree))] = tests
    (folder / "lines.json").write_text(json.dumps(lines))


# -- choose -----------------------------------------------------------------------------------------------------------


def _functions(source: str) -> Iterator[tuple[str, int, int]]:
    """Name, first and last line of each function, inner ones last."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node.name, node.lineno, node.end_lineno or node.lineno


def _mutant(file: Path, rng: random.Random) -> tuple[int, str] | None:
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


def choose(tree: Path, other: Path, seed: int, count: int) -> list[dict[str, str]]:
    """`count` mutants: function, its line and what becomes of it, and the file in each checkout."""
    rng = random.Random(seed)
    files = [file for place in PLACES for file in sorted(tree.glob(place))]
    files = [file for file in files if str(file.relative_to(tree)) not in COMPILED]
    weights = [len(file.read_text().splitlines()) for file in files]
    there: defaultdict[tuple[str, str], set[str]] = defaultdict(set)
    for file in (found for place in PLACES for found in other.glob(place)):
        text = file.read_text()
        for name, first, last in _functions(text):
            for line in text.splitlines()[first - 1 : last]:
                there[name, line.strip()].add(str(file.relative_to(other)))
    found: list[dict[str, str]] = []
    while len(found) < count:
        file = rng.choices(files, weights)[0]
        mutant = _mutant(file, rng)
        if mutant is None:
            continue
        at, after = mutant
        text = file.read_text()
        before = text.splitlines()[at - 1].strip()
        inside = [name for name, first, last in _functions(text) if first <= at <= last]
        elsewhere = there.get((inside[-1], before), set()) if inside else set()
        if len(elsewhere) == 1:
            found.append({"function": inside[-1], "before": before, "after": after.strip(),
                          "file": str(file.relative_to(tree)), "other": elsewhere.pop()})  # fmt: skip
    return found


# -- try --------------------------------------------------------------------------------------------------------------


class Trial:
    """Gives mutants to the tests of a checkout; two at a time, each in a copy of its own."""

    def __init__(self, tree: Path) -> None:
        self.tree = tree
        self.lines = json.loads((tree / FOLDER / "lines.json").read_text())
        self.times = Counter[str]()
        for line in (tree / FOLDER / "times.jsonl").read_text().splitlines():
            test, seconds = json.loads(line)
            self.times[test] += seconds
        self.copies: SimpleQueue[Path] = SimpleQueue()
        for name in ("one", "two"):
            copy = tree / FOLDER / name
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(tree, copy, symlinks=True, ignore=shutil.ignore_patterns(FOLDER, ".git", ".*_cache", "wt"))
            for script in (copy / ".venv/lib").glob("python*/site-packages/*hallbench*"):
                _point(script, str(tree), str(copy))
            self.copies.put(copy)

    def tests(self, file: str, line: int) -> list[str]:
        """Which tests to run, the quickest first, while their times fit."""
        runs = [test for test in self.lines.get(file, {}).get(str(line), []) if test in self.times]
        chosen, seconds = [], 0.0
        for test in sorted(runs, key=lambda test: self.times[test]):
            seconds += self.times[test]
            if seconds > MOST:
                break
            chosen.append(test)
        return chosen

    def outcome(self, mutant: dict[str, str]) -> str:
        """What caught it: a test, "timeout", or "" if nothing did."""
        copy = self.copies.get()
        file = next(name for name in (mutant["file"], mutant["other"]) if (self.tree / name).exists())
        original = (self.tree / file).read_text()
        try:
            lines = original.splitlines()
            inside = [span for name, *span in _functions(original) if name == mutant["function"]]
            rows = [row for first, last in inside for row in range(first, last + 1)]
            at = next(row for row in rows if lines[row - 1].strip() == mutant["before"])
            indent = lines[at - 1][: len(lines[at - 1]) - len(lines[at - 1].lstrip())]
            lines[at - 1] = indent + mutant["after"]
            tests = self.tests(file, at)
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
        try:
            ended = subprocess.run([*RUN, f"@{names}"], cwd=copy, capture_output=True, text=True, timeout=limit)
        except subprocess.TimeoutExpired:
            return "timeout"
        if ended.returncode == 0:
            return ""
        found = re.search(r"^(?:FAILED|ERROR) (\S+?)(?: - |$)", ended.stdout, re.MULTILINE)
        return found[1] if found else tests[0]


def _point(path: Path, old: str, new: str) -> None:
    """Have what an editable install left name another folder."""
    for file in [path] if path.is_file() else path.glob("*"):
        text = file.read_text()
        if old in text:
            file.write_text(text.replace(old, new))


def try_all(tree: Path, mutants: list[dict[str, str]]) -> None:
    """Try them, and say how many were caught."""
    kept = tree / FOLDER / "tried.jsonl"
    done = [json.loads(line) for line in kept.read_text().splitlines()] if kept.exists() else []
    known = {json.dumps(mutant): caught for mutant, caught in done}
    trial = Trial(tree)

    def one(mutant: dict[str, str]) -> str:
        if (caught := known.get(json.dumps(mutant))) is None:
            caught = trial.outcome(mutant)
            with kept.open("a") as file:
                file.write(json.dumps([mutant, caught]) + "\n")
        print(f"{'caught' if caught else 'MISSED'} {mutant['file']} {mutant['function']}: "
              f"{mutant['before']} -> {mutant['after']}  {caught}", flush=True)  # fmt: skip
        return caught

    with ThreadPoolExecutor(2) as pool:
        caught = list(pool.map(one, mutants))
    print(f"{sum(map(bool, caught))} of {len(caught)} caught")


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("map", "choose", "try"))
    parser.add_argument("tree", type=Path)
    parser.add_argument("second", type=Path, nargs="?")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=200)
    given = parser.parse_args()
    tree = given.tree.resolve()
    if given.what == "map":
        make_map(tree)
    elif given.what == "choose":
        json.dump(choose(tree, given.second.resolve(), given.seed, given.count), sys.stdout, indent=1)
    else:
        try_all(tree, json.loads(given.second.read_text()))


if __name__ == "__main__":
    main()

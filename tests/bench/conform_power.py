"""What `bench conform` finds of devices that break a sentence of SPEC: `python -m tests.bench.conform_power [NAME …]`.

Each violation runs in a process of its own, in virtual time, on each of its links, at the level that has its checks,
and at the highest where none of them fails: the device side in C with a change (tables/conform_mutants.toml) behind the
simulated drive, the device side in Python and that drive with one (tables/conform_python_mutants.toml), and the device
of tests/devices with one fault (tables/conform_faults.toml). The figures go to docs/conform/found.json, of which
docs/make_conform.py makes the page; results are kept below .violations, so that a run that was interrupted goes on
where it was.
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import importlib
import json
import multiprocessing
import re
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any
from unittest.mock import patch

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path[:0] = [str(HERE), str(ROOT)]

from conforming import ended, on_device, on_simulated  # noqa: E402 - a script's own folder
from virtual_run import simulated  # noqa: E402

from bench.conform.checks import TABLE  # noqa: E402
from bench.conform.levels import CAN  # noqa: E402
from bench.conform.run import Run  # noqa: E402
from bench.signal.verdict import Verdict  # noqa: E402
from protocol.device import compiled  # noqa: E402

TABLES = HERE / "tables"
KEPT = ROOT / ".violations"
FOUND = ROOT / "docs" / "conform" / "found.json"
SECONDS = 120.0  # that a violation may take
SOURCES = (
    "bench/conform/*.py",
    "protocol/c/*.[ch]",
    "protocol/device/*.py",
    "sim/drive/*.py",
    "tests/devices/*.py",
    "tests/bench/conforming.py",
)


@dataclass(frozen=True)
class Violation:
    """A device that breaks a sentence of a chapter: texts replaced in `file`, in C or Python, or a fault by name."""

    name: str
    chapter: int
    checks: tuple[str, ...]
    """Of which one at least must fail."""
    link: str
    file: str = ""
    changes: tuple[tuple[str, str], ...] = ()

    @property
    def level(self) -> int:
        """The lowest one that has its checks."""
        return max(TABLE[check].needs for check in self.checks)

    @property
    def in_python(self) -> bool:
        """Whether it is a change of a module."""
        return self.file.endswith(".py")

    @property
    def source(self) -> Path:
        """What is changed."""
        return ROOT / self.file if self.in_python else compiled.SOURCE / self.file

    @property
    def number(self) -> str:
        """For a file."""
        made = hashlib.sha256(repr(self).encode()).hexdigest()[:8]
        return f"{re.sub(r'[^a-z0-9]+', '-', self.name.lower())[:40]}-{made}"


def violations(both: bool = False) -> list[Violation]:
    """All of them, those in C first; see `in_c`."""
    return [*in_c(both), *in_python(both), *_by_faults()]


def in_c(both: bool = False) -> Iterator[Violation]:
    """Those of the device side in C; what is the same on all links is tried on bytes and CAN by turns, or on `both`."""
    yield from _changes("conform_mutants.toml", both)


def in_python(both: bool = False) -> Iterator[Violation]:
    """Those of the device side in Python and of the simulated drive behind it; as `in_c`."""
    yield from _changes("conform_python_mutants.toml", both)


def _changes(table: str, both: bool) -> Iterator[Violation]:
    links, turns = ("bytes", "CAN"), 0
    for chapter, rows in tomllib.loads((TABLES / table).read_text()).items():
        for row in rows:
            checks = (row["check"],) if isinstance(row["check"], str) else tuple(row["check"])
            for each in row.get("each", ("",)):
                changes = tuple((old, new.replace("{}", each) if each else new)
                                for old, new in ((row["old"], row["new"]), *row.get("also", ())))  # fmt: skip
                turns += 1
                for link in row.get("on", links if both else (links[turns % 2],)):
                    name = row["name"].replace("{}", each)
                    yield Violation(name, int(chapter), checks, link, row.get("file", "hbp.c"), changes)


def _by_faults() -> Iterator[Violation]:
    for kind, rows in tomllib.loads((TABLES / "conform_faults.toml").read_text()).items():
        for name, check in rows.items():
            chapter = int(TABLE[check].cites[0].partition(".")[0])
            yield Violation(name, chapter, (check,), "CAN" if kind == "on_can" else "bytes")


@cache
def stamp() -> str:
    """What results are of."""
    digest = hashlib.sha256()
    for file in sorted(file for place in SOURCES for file in ROOT.glob(place)):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def changed(violation: Violation) -> str:
    """The text of its file with the changes. ValueError where what is changed does not stand there once."""
    text = violation.source.read_text()
    for old, new in violation.changes:
        if text.count(old) != 1:
            raise ValueError(f"{violation.name}: stands {text.count(old)} times in {violation.file}: {old}")
        text = text.replace(old, new)
    return text


def run_on(violation: Violation, level: int) -> Run:
    """The run of a level's checks on the device that breaks this. NoCompiler where it cannot be compiled."""
    if not violation.changes:
        return on_device(level, [violation.name], carrier=violation.link)[0]
    if violation.in_python:
        with changed_functions(violation):
            return on_simulated(level, simulated(network=violation.link))
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "c")
        shutil.copytree(compiled.SOURCE, source)
        (source / violation.file).write_text(changed(violation))
        with (
            patch.object(compiled, "SOURCE", source),
            patch.object(compiled, "FLAGS", compiled.FLAGS.replace("-O2", "-O0")),
            patch.object(compiled, "user_cache_path", lambda *_, **__: Path(folder)),
            patch.object(compiled, "library", cache(compiled.library.__wrapped__)),
            patch("protocol.canmap.compiled.library", cache(compiled.library.__wrapped__)),
        ):
            return on_simulated(level, simulated(network=violation.link, compiled=True))


@contextmanager
def changed_functions(violation: Violation) -> Iterator[None]:
    """Inside, functions and methods of a module are as its changed text has them, whoever has imported them."""
    module = importlib.import_module(violation.file.removesuffix(".py").replace("/", "."))
    before = {}
    try:
        for name, code in _codes(compile(changed(violation), str(violation.source), "exec")):
            live: Any = module
            for part in name.split("."):
                live = getattr(live, part, None)
            live = live.fget if isinstance(live, property) else getattr(live, "__func__", live)
            if isinstance(live, FunctionType) and live.__code__.co_freevars == code.co_freevars:
                before[live] = live.__code__
                live.__code__ = code
        yield
    finally:
        for function, code in before.items():
            function.__code__ = code


def _codes(code: CodeType) -> Iterator[tuple[str, CodeType]]:
    """What is defined in a module and in its classes, with its name there."""
    for each in code.co_consts:
        if isinstance(each, CodeType) and "<" not in each.co_qualname:
            yield each.co_qualname, each
            yield from _codes(each)


def result_of(violation: Violation) -> dict[str, Any]:
    """What `bench conform` said, from what is kept or from a run in a process of its own."""
    file = KEPT / stamp() / f"{violation.number}.json"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        child = multiprocessing.get_context("fork").Process(target=_write, args=(violation, file))
        child.start()
        child.join(SECONDS)
        if child.is_alive():
            child.kill()
            child.join()
        if not file.exists():
            file.write_text(json.dumps({"failed": {}, "ended": f"exit code {child.exitcode}"}))
    known: dict[str, Any] = json.loads(file.read_text())
    return known


def _write(violation: Violation, file: Path) -> None:
    ctypes.CDLL(None).alarm(int(SECONDS))
    try:
        for level in (violation.level, CAN):
            run = run_on(violation, level)
            failed = {r.check.id: r.evidence for r in run.results if r.verdict is Verdict.FAIL}
            found = {"failed": failed, "unknown": ended(run, Verdict.INVALID), "ended": run.ended or run.unsafe}
            if set(violation.checks) & set(failed):
                break
    except Exception as error:
        found = {"failed": {}, "ended": f"{type(error).__name__}: {error}"}
    file.write_text(json.dumps(found))


def word(violation: Violation, result: dict[str, Any]) -> str:
    """How a violation ended: found, found by another check, or missed."""
    if set(violation.checks) & set(result["failed"]):
        return "found"
    return "elsewhere" if result["failed"] else "missed"


def main() -> int:
    """Run what has no result yet, and write the figures where all have one; 1 if less than 95 % are found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="violations whose names have this in them")
    parser.add_argument("--both", action="store_true", help="on a serial link and on CAN, where it is the same on both")
    options = parser.parse_args()
    names, every = options.names, violations(options.both)
    chosen = [each for each in every if not names or any(name in each.name for name in names)]
    rows = []
    for k, each in enumerate(chosen, 1):
        result = result_of(each)
        how = word(each, result)
        rows.append({"name": each.name, "chapter": each.chapter, "link": each.link,
                     "in_c": bool(each.changes) and not each.in_python, "in_python": each.in_python,
                     "checks": each.checks, "how": how, "by": list(result["failed"])[:3]})  # fmt: skip
        if how != "found":
            others = "; ".join(f"{check}: {words[:150]}" for check, words in list(result["failed"].items())[:3])
            print(f"{k} of {len(chosen)} {how}: {each.name} on {each.link}, chapter {each.chapter}, "
                  f"by {' or '.join(each.checks)}; {others or result['ended']}", flush=True)  # fmt: skip
    found = sum(row["how"] == "found" for row in rows)
    print(f"{found} of {len(rows)} found ({100 * found / len(rows):.1f} %)")
    if not names:
        FOUND.write_text("[\n" + ",\n".join(map(json.dumps, rows)) + "\n]\n")
    return int(found < 0.95 * len(rows))


if __name__ == "__main__":
    sys.exit(main())

"""The present tree and another commit, measured turn about by the same probes: `python -m tests.benchmarks --against`.

A probe (`probes/probe_*.py`) is a script that runs in either tree and prints costs. Each tree has a virtual environment
of its own, which finds the tree's packages first and then what is installed here, and a cache of kernels of its own.
"""

from __future__ import annotations

import compileall
import json
import os
import shutil
import subprocess
import sysconfig
import tempfile
import tomllib
import traceback
import venv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import NamedTuple

from tests.benchmarks.last import Comparison
from tests.benchmarks.parts import machine
from tests.benchmarks.ratio import WITHIN, WORSE, Pair, paired

ROOT = Path(__file__).parents[2]
PROBES = Path(__file__).parent / "probes"
ROUNDS = {"start": 3, "sim": 7, "plant": 7, "decode": 7, "replay": 5, "hall": 5, "live": 3, "accept": 1}
"""The parts, and how many rounds each takes."""
SHORT = {"start": 1, "sim": 3, "decode": 3}
AGAIN = 3
"""The parts of the short form; a part in which a row fails is measured again, with so many times the rounds."""
PACKAGES = ("bench", "protocol", "sim")
LIMIT = 1800.0  # s a probe may take

TICK = 1 / 1.6
AGAINST = {
    "c9185aa": {
        "first start of bench live sim, nothing compiled: CPU": 1.3,
        "simulation alone, calls of 1 s, a simulated second": TICK,
        "through the protocol, 26 channels and edges, a simulated second": TICK,
    },
    "b35aadf": {"acceptance suite with report, one process: CPU": 20 / 27},
}
"""What is asked of the ratio to the commits whose figures are kept; of other rows `WORSE`, but to `STRANGE`."""
STRANGE = {"c9185aa"}
"""Commits that did less, so that only what is named is asked for."""
LIMITS = {
    "first start of bench live sim, nothing compiled: until its first sample": 10.0,  # s
    "bench --help: CPU, in starts of Python": 6.0,
    "bench live sim, compiled: until its first sample, in starts of Python": 48.0,
    "decode, reads of 8 KiB over reads of 64": 1.1,
    "plant alone, over a bare RK4 loop in C": 1.5,
    "sample to sink, p99": 60.0,  # ms
}
"""What is asked of a row by itself: within one run, or on an idle machine."""


class UnknownCommit(Exception):
    """There is no such commit here."""


class Tree(NamedTuple):
    """A commit's files, and a folder for all that comes of them."""

    path: Path
    home: Path

    def told(self, part: str, short: bool) -> dict[str, float]:
        """What a probe measures in this tree. Raises RuntimeError, with what was said, if it fails."""
        folder = self.home / "probed"
        folder.mkdir(exist_ok=True)
        python, probe = self.home / "venv" / "bin" / "python", PROBES / f"probe_{part}.py"
        command = [python, probe, self.path, folder, *["--short"] * short]
        done = subprocess.run(
            command, cwd=folder, env=self._environment(), capture_output=True, text=True, timeout=LIMIT, check=False
        )
        if done.returncode:
            raise RuntimeError(f"{part} in {self.path}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
        costs: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
        return costs

    def _environment(self) -> dict[str, str]:
        out = ("PYTHONDONTWRITEBYTECODE", "PYTHONPATH", "DISPLAY", "WAYLAND_DISPLAY")
        given = {name: value for name, value in os.environ.items() if name not in out}
        return given | {"NUMBA_CACHE_DIR": str(self.home / "kernels"), "XDG_CACHE_HOME": str(self.home / "cache")}

    def make(self) -> None:
        """Make the virtual environment: the tree as if installed, before what is installed here."""
        for name in ("kernels", "cache"):
            (self.home / name).mkdir(parents=True)
        venv.create(self.home / "venv", symlinks=True, with_pip=False)
        (packages,) = (self.home / "venv").glob("lib/python*/site-packages")
        here = dict.fromkeys(sysconfig.get_path(which) for which in ("purelib", "platlib"))
        (packages / "tree.pth").write_text("\n".join((str(self.path), *here)), "utf-8")
        project = tomllib.loads((self.path / "pyproject.toml").read_text("utf-8"))["project"]
        name = project["name"]
        info = packages / f"{name}-0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0\n", "utf-8")
        groups = {"console_scripts": project.get("scripts", {}), **project.get("entry-points", {})}
        lines = [line for name, of in groups.items() for line in (f"[{name}]", *(f"{k} = {v}" for k, v in of.items()))]
        (info / "entry_points.txt").write_text("\n".join(lines), "utf-8")
        for package in PACKAGES:  # as pip does
            compileall.compile_dir(self.path / package, quiet=2)


def git(*arguments: str) -> str:
    """What git says of this repository. Raises CalledProcessError."""
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def commit(rev: str) -> str:
    """A commit's name, in seven digits where that is unique. Raises UnknownCommit."""
    try:
        return git("rev-parse", "--verify", "--quiet", "--short=7", "--end-of-options", f"{rev}^{{commit}}")
    except (subprocess.CalledProcessError, FileNotFoundError) as error:
        shallow = (ROOT / ".git" / "shallow").exists()
        more = "; this clone is shallow: git fetch --unshallow" if shallow else ""
        raise UnknownCommit(f"--against {rev}: no such commit in {ROOT}{more}") from error


def present() -> str:
    """The commit of the present tree, with a plus where files differ from it."""
    return commit("HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")


@contextmanager
def trees(rev: str) -> Iterator[tuple[Tree, Tree]]:
    """The present tree and a fresh checkout of `rev`, until the end of the block."""
    with tempfile.TemporaryDirectory(prefix="hallbench-") as name:
        folder = Path(name)
        made = Tree(ROOT, folder / "now"), Tree(folder / "then" / "tree", folder / "then")
        made[1].path.mkdir(parents=True)
        archive = folder / "then.tar"
        git("archive", "--format=tar", f"--output={archive}", rev)
        shutil.unpack_archive(archive, made[1].path, filter="data")
        archive.unlink()
        for tree in made:
            tree.make()
        yield made


def measured(part: str, pair: tuple[Tree, Tree], rounds: int, short: bool) -> list[Pair]:
    """A part's rows, the trees in turn; which one is first alternates. One round does where a tree has none of them."""
    told: tuple[list[dict[str, float]], list[dict[str, float]]] = ([], [])
    for k in range(rounds):
        for side in (0, 1) if k % 2 == 0 else (1, 0):
            told[side].append(pair[side].told(part, short))
        if not (told[0][0] and told[1][0]):
            break
    return paired(*told)


def asked(row: Pair, rev: str) -> Pair:
    """The row with what is asked of it against this commit."""
    at_most = AGAINST.get(rev, {}).get(row.what)
    rather = at_most is None and rev not in STRANGE and row.unit != WITHIN
    return replace(row, at_most=WORSE if rather else at_most, beyond=rather, limit=LIMITS.get(row.what))


def look(part: str, pair: tuple[Tree, Tree], rounds: int) -> list[Pair]:
    """A part in short form; where a row is slow, all of them once more with more rounds, and those count."""
    rows = measured(part, pair, rounds, short=True)
    if slow := [row for row in rows if row.slow]:
        print(f"  once more: {', '.join(f'{row.what} {row.least:.2f}' for row in slow)}", flush=True)
        rows = measured(part, pair, AGAIN * rounds, short=True)
    return rows


def show(rows: Sequence[Pair], rev: str) -> None:
    """Print rows."""
    cells = [row.cells(rev) for row in rows] or [("neither has it", *[""] * 5)]
    widths = [max(len(row[k]) for row in cells) for k in range(5)]
    for *row, verdict in cells:
        words = [f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)]
        print("  " + "  ".join([*words, verdict]).rstrip())


def run(rev: str, parts: Sequence[str], short: bool) -> tuple[dict[str, Comparison], list[str]]:
    """Measure, print; the comparisons of a commit that is kept, and what keeps the exit code from being 0.

    Raises UnknownCommit.
    """
    rev, now, rounds = commit(rev), present(), SHORT if short else ROUNDS
    kept: dict[str, Comparison] = {}
    found: list[str] = []
    with trees(rev) as pair:
        for part in [part for part in rounds if part in (parts or rounds)]:
            print(f"\n{part}: {now} over {rev}", flush=True)
            try:
                if short:
                    rows: Sequence[Pair] = look(part, pair, rounds[part])
                    found += [f"SLOWER: {part}: {row.what}: {row.least:.2f} x" for row in rows if row.slow]
                else:
                    rows = [asked(row, rev) for row in measured(part, pair, rounds[part], short=False)]
                    kept[f"{rev} {part}"] = Comparison(date.today().isoformat(), machine(), now, tuple(rows))
                    found += [f"MISSED: {part}: {', '.join(row.cells(rev)[:5])}" for row in rows if row.missed]
            except (RuntimeError, ValueError, OSError, subprocess.SubprocessError):
                traceback.print_exc()
                found.append(f"BROKEN: {part}")
            else:
                show(rows, rev)
    return (kept if rev in AGAINST else {}), found

"""Start-up: `bench --help`, and the time from the start of `bench live sim` to its first sample.

python -m tests.benchmarks start

The first start is that of a user: a wheel made from this tree, freshly installed, nothing compiled yet. Its
dependencies are those that are installed here.
"""

from __future__ import annotations

import json
import shutil
import statistics
import sys
import sysconfig
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.benchmarks.commands import output
from tests.benchmarks.table import Row, cost

TREE = Path(__file__).parents[2]
IN_A_WHEEL = ("bench", "protocol", "sim", "pyproject.toml", "README.md", "LICENSE")
RUNS = 5


def _seconds(*arguments: str) -> float:
    started = time.perf_counter()
    output([sys.executable, "-m", *arguments])
    return time.perf_counter() - started


def _first_sample(bench: Sequence[str], cache: Path | None = None) -> float:
    """Seconds from the start of the process until its first sample, by its own note of the wall clock.

    With kernels in `cache`, or else where they are.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [*bench, "live", "sim", "--viewer", "none", "--save", str(folder / "x.run")]
        started = time.time()
        summary = output(
            [*command, "--duration", "0.5", "--json", "-"], folder, {"NUMBA_CACHE_DIR": str(cache)} if cache else None
        )
        return float(json.loads(summary)["first_sample_unix_s"]) - started


def installed(folder: Path) -> Path:
    """Make a wheel of this tree and install it into a virtual environment in `folder`; its `bench`."""
    source, place = folder / "source", folder / "venv"
    source.mkdir()
    for name in IN_A_WHEEL:  # a build leaves traces where it builds
        copy = shutil.copytree if (TREE / name).is_dir() else shutil.copy
        copy(TREE / name, source / name)
    pip = [sys.executable, "-m", "pip", "-q"]
    output([*pip, "wheel", "--no-deps", "--wheel-dir", str(folder), str(source)])
    output([sys.executable, "-m", "venv", "--without-pip", str(place)])
    (wheel,) = folder.glob("*.whl")
    output([*pip, "--python", str(place), "install", "--no-deps", str(wheel)])
    (packages,) = place.glob("lib/python*/site-packages")
    here = {sysconfig.get_path(which) for which in ("purelib", "platlib")}
    (packages / "dependencies.pth").write_text("\n".join(here))
    return place / "bin" / "bench"


def rows(short: bool) -> list[Row]:
    """Medians of some runs after a warm-up; the first start as it is."""
    runs = 1 if short else RUNS
    python_m = (sys.executable, "-m", "bench")
    _seconds("bench", "--help")
    _first_sample(python_m)
    python = statistics.median(_seconds("keyword") for _ in range(runs))
    shown = statistics.median(_seconds("bench", "--help") for _ in range(runs))
    warm = statistics.median(_first_sample(python_m) for _ in range(runs))
    with tempfile.TemporaryDirectory() as name:
        first = _first_sample([str(installed(Path(name)))], Path(name, "cache"))
    return [
        cost("bench --help", shown, "s"),
        Row("bench --help, in starts of bare Python", shown / python, "x", at_most=True),
        cost("bench live sim until its first sample, kernels compiled", warm, "s"),
        cost("bench live sim until its first sample, from a fresh wheel, nothing compiled", first, "s"),
    ]

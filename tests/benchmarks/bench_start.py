"""Start-up: `bench --help`, and the time from the start of `bench live sim` to its first sample.

python -m tests.benchmarks start
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from tests.benchmarks.commands import output
from tests.benchmarks.table import Row, cost

RUNS = 5


def _seconds(*arguments: str) -> float:
    started = time.perf_counter()
    output([sys.executable, "-m", *arguments])
    return time.perf_counter() - started


def _first_sample(bench: Sequence[str]) -> float:
    """Seconds from the start of the process until its first sample, by its own note of the wall clock."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [*bench, "live", "sim", "--viewer", "none", "--save", str(folder / "x.rrd")]
        started = time.time()
        summary = output([*command, "--duration", "0.5", "--json", "-"], folder)
        return float(json.loads(summary)["first_sample_unix_s"]) - started


def rows(short: bool) -> list[Row]:
    """Medians of some runs after a warm-up."""
    runs = 1 if short else RUNS
    python_m = (sys.executable, "-m", "bench")
    _seconds("bench", "--help")
    _first_sample(python_m)
    python = statistics.median(_seconds("keyword") for _ in range(runs))
    shown = statistics.median(_seconds("bench", "--help") for _ in range(runs))
    warm = statistics.median(_first_sample(python_m) for _ in range(runs))
    return [
        cost("bench --help", shown, "s", 0.3),
        Row("bench --help, in starts of bare Python", shown / python, "x", at_most=True),
        cost("bench live sim until its first sample, kernels compiled", warm, "s", 1.5),
    ]

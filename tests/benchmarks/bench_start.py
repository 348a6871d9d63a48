"""Start-up: `bench --help`, and the time from the start of `bench live sim` to its first sample, numba's cache warm.

python -m tests.benchmarks start
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.table import Row

RUNS = 5


def _seconds(arguments: list[str]) -> float:
    started = time.perf_counter()
    subprocess.run([sys.executable, "-m", *arguments], capture_output=True, check=True)
    return time.perf_counter() - started


def _first_sample() -> float:
    """Seconds from the start of the process until its first sample, by its own note of the wall clock."""
    with tempfile.TemporaryDirectory() as folder:
        command = ["bench", "live", "sim", "--viewer", "none", "--save", str(Path(folder, "x.rrd"))]
        started = time.time()
        run = subprocess.run(
            [sys.executable, "-m", *command, "--duration", "0.5", "--json", "-"], capture_output=True, check=True
        )
        return float(json.loads(run.stdout)["first_sample_unix_s"]) - started


def rows() -> list[Row]:
    """Medians of some runs after a warm-up."""
    _seconds(["bench", "--help"])
    _first_sample()
    python = statistics.median(_seconds(["keyword"]) for _ in range(RUNS))
    shown = statistics.median(_seconds(["bench", "--help"]) for _ in range(RUNS))
    return [
        Row("bench --help", shown, "s", 0.3, at_most=True),
        Row("bench --help, in starts of bare Python", shown / python, "x"),
        Row("bench live sim: first sample", statistics.median(_first_sample() for _ in range(RUNS)), "s", 3.0, True),
    ]

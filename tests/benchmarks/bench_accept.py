"""The whole acceptance suite on the simulated drive, in virtual time, by one process and by two; kernels compiled.

python -m tests.benchmarks accept
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.table import Row


def _run(*more: str) -> tuple[float, dict[str, object]]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "run.json")
        command = ["bench", "accept", "sim", "--json", str(out), *more]
        started = time.perf_counter()
        subprocess.run([sys.executable, "-m", *command], capture_output=True, check=True, cwd=folder)
        return time.perf_counter() - started, json.loads(out.read_text())


def rows() -> list[Row]:
    """Wall-clock seconds of whole processes, and what they measured."""
    _run("-k", "fig08")
    with tempfile.TemporaryDirectory() as folder:
        reported, result = _run("--report", str(Path(folder, "one")))
        shared, _ = _run("--report", str(Path(folder, "two")), "--jobs", "2")
    bare, _ = _run()
    bare_shared, _ = _run("--jobs", "2")
    tests = result["tests"]
    assert isinstance(tests, list)
    signal = sum(test["quality"]["seconds"] for test in tests)
    return [
        Row("measurements", sum(len(test["measurements"]) for test in tests)),
        Row("device time of all tests", signal, "s"),
        Row("with report, figures and recordings", reported, "s"),
        Row("the same, --jobs 2", shared, "s", 60.0, at_most=True),
        Row("  one process against two", reported / shared, "x"),
        Row("without report", bare, "s"),
        Row("the same, --jobs 2", bare_shared, "s"),
        Row("  device time against wall-clock time", signal / bare_shared, "x"),
    ]

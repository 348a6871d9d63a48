"""The whole acceptance suite on the simulated drive, in virtual time, by one process and by two; kernels compiled.

python -m tests.benchmarks accept
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.benchmarks.commands import output
from tests.benchmarks.table import Row, cost

ONE_TEST = ("-k", "fig08")


def _run(*more: str) -> tuple[float, dict[str, Any]]:
    with tempfile.TemporaryDirectory() as name:
        folder, out = Path(name), Path(name, "run.json")
        started = time.perf_counter()
        output([sys.executable, "-m", "bench", "accept", "sim", "--json", str(out), *more], folder)
        return time.perf_counter() - started, json.loads(out.read_text())


def rows(short: bool) -> list[Row]:
    """Wall-clock seconds of whole processes, and what they measured."""
    _run(*ONE_TEST)
    which = ONE_TEST if short else ()
    with tempfile.TemporaryDirectory() as folder:
        reported, result = _run(*which, "--report", str(Path(folder, "one")))
        shared, _ = _run(*which, "--report", str(Path(folder, "two")), "--jobs", "2")
    bare, _ = _run(*which)
    bare_shared, _ = _run(*which, "--jobs", "2")
    tests = result["tests"]
    signal = sum(test["quality"]["seconds"] for test in tests)
    return [
        Row("tests", len(tests)),
        Row("measurements", sum(len(test["measurements"]) for test in tests)),
        Row("device time of all tests", signal, "s"),
        cost("with report, figures and recordings, one process", reported, "s"),
        cost("with report, figures and recordings, --jobs 2", shared, "s"),
        Row("one process against two", reported / shared, "x"),
        cost("without report, one process", bare, "s"),
        cost("without report, --jobs 2", bare_shared, "s"),
        Row("device time against wall-clock time, --jobs 2", signal / bare_shared, "x"),
    ]

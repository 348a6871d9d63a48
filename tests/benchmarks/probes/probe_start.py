"""Starts of `bench`: of nothing compiled, and of what is. CPU time counts that of all children.

In short form the first start compiles into the cache that the tree keeps, so that the other probes find it.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import probe

RUNS = 3 if probe.SHORT else 7


def spent(*arguments: str) -> tuple[float, float]:
    """s of waiting and of CPU time, of `python -m …` and all its children; those that outlive it are waited for."""
    wall, cpu = time.perf_counter(), probe.children_cpu()
    subprocess.run([sys.executable, "-m", *arguments], capture_output=True, check=True)
    wall = time.perf_counter() - wall
    with suppress(ChildProcessError):
        while True:
            os.wait()
    return wall, probe.children_cpu() - cpu


def live(cache: str | None = None) -> tuple[float, float]:
    """s from the start of `bench live sim` to its first sample, and CPU time of all of it."""
    kept = os.environ["NUMBA_CACHE_DIR"]
    os.environ["NUMBA_CACHE_DIR"] = cache or kept
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "summary.json")
        begun = time.time()
        arguments = ("live", "sim", "--viewer", "none", "--save", str(Path(folder, probe.RUN)), "--duration", "0.5")
        _, cpu = spent("bench", *arguments, "--json", str(out))
        first = float(json.loads(out.read_text("utf-8"))["first_sample_unix_s"]) - begun
    os.environ["NUMBA_CACHE_DIR"] = kept
    return first, cpu


if __name__ == "__main__":
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER: orphans come here
    spent("bench", "--help")  # writes .pyc files
    with tempfile.TemporaryDirectory(dir=probe.FOLDER) as fresh:
        again = any(Path(os.environ["NUMBA_CACHE_DIR"]).glob("*"))
        first, first_cpu = live(fresh if again or not probe.SHORT else None)
    costs = {"first start of bench live sim, nothing compiled: CPU, s": first_cpu}
    live()
    python = shown = warm = warm_cpu = math.inf
    for _ in range(RUNS):
        python = min(python, spent("keyword")[1])
        shown = min(shown, spent("bench", "--help")[1])
    for _ in range(RUNS):
        until, cpu = live()
        warm, warm_cpu = min(warm, until), min(warm_cpu, cpu)
    wall = min(spent("keyword")[0] for _ in range(RUNS))
    costs["bench --help: CPU, in starts of Python, x"] = shown / python
    costs["bench live sim for 0.5 s, compiled: CPU, in starts of Python, x"] = warm_cpu / python
    if not probe.SHORT:
        costs["first start of bench live sim, nothing compiled: until its first sample, s"] = first
        costs["bench live sim, compiled: until its first sample, in starts of Python, x"] = warm / wall
    probe.tell(costs)

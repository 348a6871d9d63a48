"""Live: the simulated drive behind a pty, all channels at 16 kHz, recorded. Losses, CPU of both ends, latency.

python -m tests.benchmarks live [--seconds 60]
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil

Row = tuple[str, float, str, float]  # what, measured, unit, limit (a negative one: at least)


@contextmanager
def simulated_drive(*arguments: str) -> Iterator[tuple[str, psutil.Process]]:
    """The simulated drive in a process of its own: target and process."""
    command = [sys.executable, "-m", "sim", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        target = next(line for line in process.stdout if line.startswith("target: ")).split()[1]
        yield target, psutil.Process(process.pid)
    finally:
        process.terminate()
        process.wait()


def measure(seconds: float) -> list[Row]:
    """Run it for `seconds`."""
    with tempfile.TemporaryDirectory() as folder, simulated_drive("--pty") as (target, drive):
        command = [sys.executable, "-m", "bench", "live", target, "--speed", "1000", "--yes", "--viewer", "none"]
        command += ["--duration", f"{seconds:g}", "--save", str(Path(folder, "run.rrd")), "--json", "-"]
        before = drive.cpu_times()
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        after = drive.cpu_times()
        if run.returncode:
            raise SystemExit(f"bench live failed: {run.stderr.strip()}")
        summary: dict[str, Any] = json.loads(run.stdout)
    drive_cpu = 100 * (after.user + after.system - before.user - before.system) / summary["duration_s"]
    lost = summary["lost"]
    return [
        ("samples", summary["samples"], "", -0.99 * seconds * 16000),
        ("samples recorded", summary["recording"]["samples"], "", -float(summary["samples"])),
        ("lost samples, by index", lost["samples_by_index"], "", 0),
        ("lost edges, by index", lost["edges_by_index"], "", 0),
        ("lost frames, by sequence", lost["frames_by_sequence"], "", 0),
        ("lost frames, by the drive", lost["frames_by_device"], "", 0),
        ("host, recording", summary["cpu_percent"], "% of a core", 15),
        ("simulated drive", drive_cpu, "% of a core", 15),
        ("sample to sink, median", summary["latency_ms"]["p50"], "ms", 100),
        ("sample to sink, p99", summary["latency_ms"]["p99"], "ms", 100),
    ]

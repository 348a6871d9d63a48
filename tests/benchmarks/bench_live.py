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

from tests.benchmarks.table import Row


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


def rows(seconds: float) -> list[Row]:
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
        Row("samples", summary["samples"], "", round(0.99 * seconds * 16000)),
        Row("samples in the recording", summary["recording"]["samples"], "", summary["samples"]),
        Row("edges in the recording", summary["recording"]["edges"], "", summary["edges"]),
        Row("lost samples, by index", lost["samples_by_index"], "", 0, at_most=True),
        Row("lost edges, by index", lost["edges_by_index"], "", 0, at_most=True),
        Row("lost frames, by sequence", lost["frames_by_sequence"], "", 0, at_most=True),
        Row("lost frames, by the drive", lost["frames_by_device"], "", 0, at_most=True),
        Row("host with recording", summary["cpu_percent"], "% of a core", 15, at_most=True),
        Row("simulated drive", drive_cpu, "% of a core", 15, at_most=True),
        Row("sample to sink, median", summary["latency_ms"]["p50"], "ms"),
        Row("sample to sink, p99", summary["latency_ms"]["p99"], "ms", 100, at_most=True),
    ]

"""Live: the simulated drive behind a pty, all channels at 16 kHz, recorded. Losses, CPU of both ends, latency.

python -m tests.benchmarks live [--seconds 60]
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import psutil

from tests.bench.processes import Sim
from tests.benchmarks.table import Row


def run(seconds: float, where: Sequence[str], options: Sequence[str]) -> tuple[dict[str, Any], float]:
    """Record the simulated drive behind `where` for `seconds`: the summary, and the drive's CPU in % of a core."""
    with tempfile.TemporaryDirectory() as folder, closing(Sim(*where)) as sim:
        drive = psutil.Process(sim.process.pid)
        command = [sys.executable, "-m", "bench", "live", sim.target, "--yes", "--viewer", "none", *options]
        command += ["--duration", f"{seconds:g}", "--save", str(Path(folder, "run.rrd")), "--json", "-"]
        before = drive.cpu_times()
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        after = drive.cpu_times()
        if done.returncode:
            raise SystemExit(f"bench live failed: {done.stderr.strip()}")
        summary: dict[str, Any] = json.loads(done.stdout)
    cpu = 100 * (after.user + after.system - before.user - before.system) / summary["duration_s"]
    return summary, cpu


def account(summary: dict[str, Any]) -> list[Row]:
    """The rows that say whether anything was lost."""
    lost = summary["lost"]
    return [
        Row("samples in the recording", summary["recording"]["samples"], "", summary["samples"]),
        Row("edges in the recording", summary["recording"]["edges"], "", summary["edges"]),
        Row("lost samples, by index", lost["samples_by_index"], "", 0, at_most=True),
        Row("lost edges, by index", lost["edges_by_index"], "", 0, at_most=True),
        Row("lost frames, by sequence", lost["frames_by_sequence"], "", 0, at_most=True),
        Row("lost frames, by the drive", lost["frames_by_device"], "", 0, at_most=True),
    ]


def rows(seconds: float) -> list[Row]:
    """Run it for `seconds`."""
    summary, drive_cpu = run(seconds, ["--pty"], ["--speed", "1000"])
    return [
        Row("samples", summary["samples"], "", round(0.99 * seconds * 16000)),
        *account(summary),
        Row("host with recording", summary["cpu_percent"], "% of a core", 15, at_most=True),
        Row("simulated drive", drive_cpu, "% of a core", 15, at_most=True),
        Row("sample to sink, median", summary["latency_ms"]["p50"], "ms"),
        Row("sample to sink, p99", summary["latency_ms"]["p99"], "ms", 100, at_most=True),
    ]

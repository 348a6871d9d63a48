"""Live: the simulated drive behind a pty, at 16 kHz, recorded. Losses, CPU of both ends, latency.

python -m tests.benchmarks live
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from bench.record.reader import Run
from protocol.signals import DRIVE_CHANNELS
from tests.bench.processes import Sim
from tests.benchmarks.memory import Memory
from tests.benchmarks.table import Row, cost


class Live(NamedTuple):
    """What came of a run of `bench live`."""

    summary: dict[str, Any]
    streamed: str  # channels and rate, as the recording has them
    drive_cpu: float  # of the simulated drive's process, % of a core
    reader_cpu: float  # of the process that reads the port for the host, % of a core
    memory: Memory  # of the host, meanwhile


def run(seconds: float, where: Sequence[str], options: Sequence[str]) -> Live:
    """Record the simulated drive behind `where` for `seconds`. RuntimeError, with what was said, if that fails."""
    with tempfile.TemporaryDirectory() as folder, closing(Sim(*where)) as sim:
        drive, file = psutil.Process(sim.process.pid), Path(folder, "run.run")
        command = [sys.executable, "-m", "bench", "live", sim.target, "--yes", "--viewer", "none", *options]
        command += ["--duration", f"{seconds:g}", "--save", str(file), "--json", "-"]
        before = drive.cpu_times()
        host = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        with closing(Memory(host.pid)) as memory:
            printed, said = host.communicate()
        if host.returncode:  # also where the motor did not turn for all of it
            raise RuntimeError(f"bench live: exit code {host.returncode}\n{said}")
        summary, after = json.loads(printed), drive.cpu_times()
        streamed = streamed_in(Run(file))
    cpu = 100 * (after.user + after.system - before.user - before.system) / summary["duration_s"]
    return Live(summary, streamed, cpu, 100 * memory.children_cpu / summary["duration_s"], memory)


def streamed_in(run: Run) -> str:
    """Channels and rate of a recording, without all of it."""
    config = run.drive_streams[0]
    return f"{len(config.channels)} channels at {run.info.pwm_hz / config.decimation / 1000:g} kHz"


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


def rows(short: bool) -> list[Row]:
    """Run it for a minute; and a third of one with all channels, of which a pty just holds what comes in 7 ms."""
    seconds = 2.0 if short else 60.0
    summary, streamed, drive_cpu, reader_cpu, _ = run(seconds, ["--pty"], ["--speed", "1000"])
    every = ",".join(channel.name for channel in DRIVE_CHANNELS)
    whole = run(seconds / 3.0, ["--pty"], ["--speed", "1000", "--channels", every])
    lost = whole.summary["lost"]["samples_by_index"]
    return [
        Row(f"samples in {seconds:g} s, {streamed}", summary["samples"], "", round(0.99 * seconds * 16000)),
        *account(summary),
        cost(f"host with recording, {streamed} and edges", summary["cpu_percent"], "% of a core"),
        cost(f"process that reads the port, {streamed} and edges", reader_cpu, "% of a core"),
        cost(f"simulated drive in real time, {streamed} and edges", drive_cpu, "% of a core"),
        Row("sample to sink, median", summary["latency_ms"]["p50"], "ms", at_most=True),
        Row("sample to sink, p99", summary["latency_ms"]["p99"], "ms", 60, at_most=True),
        Row(f"lost samples, {whole.streamed}", lost, "", 0, at_most=True),
        cost(f"host with recording, {whole.streamed} and edges", whole.summary["cpu_percent"], "% of a core"),
    ]

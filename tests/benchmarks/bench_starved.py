"""Live on a machine that is busy with something else: the host shares its cores with two busy loops for each.

python -m tests.benchmarks starved
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from tests.bench.processes import Program, Sim
from tests.benchmarks.table import Row

LOOPS = 2  # for each core
WATCHDOG = 0.5  # s
NAMED = ("this host sent", "nothing came of it")
"""What a result says of a watchdog that ran out, where the reason is not the drive."""


@contextmanager
def busy(loops: int) -> Iterator[None]:
    """Keep the cores busy with so many programs."""
    command = [sys.executable, "-S", "-c", "while True: pass"]
    programs = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for _ in range(loops)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def run(seconds: float, loops: int) -> dict[str, Any]:
    """The summary of `bench live` that records for so long, beside the loops. RuntimeError if it makes none."""
    settings = (word for node in ("firmware", "load") for word in ("--set", f"{node}.watchdog={WATCHDOG}"))
    apart = os.setsid  # a real drive wants no core of this machine: Linux gives each session its share
    with tempfile.TemporaryDirectory() as folder, closing(Sim("--pty", *settings, limit_resources=apart)) as sim:
        file = Path(folder, "run.run")
        arguments = [sim.target, "--yes", "--viewer", "none", "--speed", "1000", "--duration", f"{seconds:g}"]
        with busy(loops), closing(Program("bench", "live", *arguments, "--save", str(file), "--json", "-")) as host:
            code = host.end(10.0 * seconds + 120.0)
    if code not in (0, 1):
        raise RuntimeError(f"bench live: exit code {code}: {host.err}")
    summary: dict[str, Any] = json.loads("\n".join(host.out))
    return summary


def rows(short: bool) -> list[Row]:
    """A minute. What the drive drops before its port is lost as well, though it may be the drive that was starved."""
    loops = LOOPS * (os.cpu_count() or 1)
    summary = run(2.0 if short else 60.0, loops)
    lost, result = summary["lost"], summary["result"]
    unnamed = "WATCHDOG" in result and not any(words in result for words in NAMED)
    return [
        Row(f"lost samples, beside {loops} busy loops", lost["samples_by_index"], "", 0, at_most=True),
        Row("lost frames: dropped by the drive, whose port was full", lost["frames_by_device"], "", at_most=True),
        Row(
            "lost frames: on the way, or here",
            lost["frames_by_sequence"] - lost["frames_by_device"],
            "",
            0,
            at_most=True,
        ),
        Row("watchdog tripped, and the cause not named", float(unnamed), "", 0, at_most=True),
        Row("longest time without a turn of the host", 1000 * summary["longest_pause_s"], "ms", at_most=True),
        Row("sample to sink, p99", summary["latency_ms"]["p99"], "ms", at_most=True),
    ]

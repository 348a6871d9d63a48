"""An hour, recorded live, and any minute of it read back.

`python -m tests.benchmarks hour`. It is recorded over TCP: a pty holds but 4 kB, which is 6 ms of what comes.
"""

from __future__ import annotations

import json
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

from bench.recording.reader import Run
from tests.bench.processes import Sim
from tests.benchmarks.bench_live import account
from tests.benchmarks.commands import output
from tests.benchmarks.memory import FLAT, MB, Memory
from tests.benchmarks.table import Row, cost

DISK = 0.25  # MB/s
CPU = 10.0  # % of a core
MINUTE, MEMORY = 1.0, 300.0  # s and MB to read any minute
WARM = 120.0  # s after which memory is looked at: everything has been imported, two segments have ended
READ = """
import sys, time
from pathlib import Path
import bench
started = time.perf_counter()
found = bench.read(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]))
took = time.perf_counter() - started
peak = Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]  # getrusage has the parent's too
print(took, 1024 * int(peak), len(found.samples))
"""


def hour(seconds: float, warm: float, folder: Path) -> Iterator[Row]:
    """The hour, live; what is recorded stays in `folder`."""
    file = folder / "hour.run"
    with closing(Sim("--tcp", "127.0.0.1:0")) as sim:
        command = [
            sys.executable, "-m", "bench", "live", sim.target, "--yes", "--viewer", "none", "--speed", "1000",
            "--duration", f"{seconds:g}", "--save", str(file), "--json", "-",
        ]  # fmt: skip
        live = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        with closing(Memory(live.pid)) as memory:
            summary = json.loads(live.communicate()[0])
    streamed = streamed_in_part(file)
    most, flat, slope = memory.after(warm)
    rate = summary["recording"]["bytes"] / summary["duration_s"]
    what = f"{seconds / 60:g} min live, {streamed} and edges"
    yield Row(f"{what}: samples", summary["samples"], "", round(0.999 * seconds * 16000))
    yield from account(summary)
    yield cost("host, recording", summary["cpu_percent"], "% of a core", CPU)
    yield Row(f"memory of the host from {warm:g} s on, most less least", flat, "MB", FLAT, at_most=True)
    yield Row("memory of the host, most", most, "MB", at_most=True)
    yield Row("memory of the host, growth by a straight line", slope, "MB/h", at_most=True)
    yield Row("disk", rate / MB, "MB/s", DISK, at_most=True)
    yield Row("a day on the disk, by arithmetic", rate * 86400 / 1e9, "GB", DISK * 86400 / 1e3, at_most=True)
    yield Row("sample to sink, p99", summary["latency_ms"]["p99"], "ms", at_most=True)


def streamed_in_part(file: Path) -> str:
    """Channels and rate of a recording, without all of it."""
    run = Run(file)
    config = run.drive_streams[0]
    return f"{len(config.channels)} channels at {run.info.pwm_hz / config.decimation / 1000:g} kHz"


def minutes(file: Path, seconds: float, times: int) -> Iterator[Row]:
    """Any minute of it, read in a process of its own."""
    dice, length = random.Random(5), min(60.0, seconds / 2)
    begin, end = (tick / Run(file).info.tick_hz for tick in Run(file).span)
    found = []
    for _ in range(times):
        first = dice.uniform(begin, end - length)
        words = output([sys.executable, "-c", READ, str(file), repr(first), repr(first + length)]).split()
        assert int(words[2]) > 0.99 * length * 16000
        found.append((float(words[0]), float(words[1])))
    yield cost(f"any {length:g} s of it read, worst of {times}", max(took for took, _ in found), "s", MINUTE)
    yield Row("memory of the process that reads it", max(size for _, size in found) / MB, "MB", MEMORY, at_most=True)


def rows(short: bool) -> Sequence[Row]:
    """The hour, then ten minutes of it."""
    with tempfile.TemporaryDirectory() as name:
        folder, seconds = Path(name), 4.0 if short else 3600.0
        live = list(hour(seconds, 1.0 if short else WARM, folder))
        return [*live, *minutes(folder / "hour.run", seconds, 1 if short else 10)]

"""Ten times real time for ten minutes, on a virtual link, and any minute of it: python -m tests.benchmarks ten_times

In this process, drive and host: the part runs first, because memory that others have left would be let go meanwhile.
"""

from __future__ import annotations

import os
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.record.reader import Run
from bench.record.sink import RunSink
from sim.config.params import load_params
from sim.ports.virtual import VirtualLink
from tests.bench.collect import Bench
from tests.benchmarks.bench_sim import run_against
from tests.benchmarks.commands import output
from tests.benchmarks.memory import FLAT, MB, Memory
from tests.benchmarks.table import Row, cost

FASTER = 10.0  # x real time
MINUTE, MEMORY = 1.0, 300.0  # s and MB to read any minute
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


def faster(seconds: float, warm: float, folder: Path) -> Iterator[Row]:
    """Ten times real time for `seconds` of the wall's clock, in this process, the simulated drive with it."""
    rig = Bench(VirtualLink.of(load_params()))
    rig.client.sinks = []
    file = folder / "faster.run"
    channels = run_against(rig, 0.1, None)
    sink = RunSink(file, rig.info())  # it fails where the disk does not keep up
    rig.client.sinks = [sink]
    rig.drive.speed(100.0)
    began, device, wall = rig.client.now(), 0.0, 0.0
    memory = Memory(os.getpid())
    started = time.monotonic()
    while wall < seconds:
        rig.client.run_for(0.1)
        sink.check()
        device, wall = rig.client.now() - began, time.monotonic() - started
        if device / FASTER > wall:
            time.sleep(device / FASTER - wall)
            wall = time.monotonic() - started
    rig.rest()
    sink.close()
    memory.close()
    run = Run(file)
    _, flat, _ = memory.after(warm)
    rows = sum(part[2] for segment in run.segments for part in segment.files["samples"][0].groups)
    yield Row(f"{seconds / 60:g} min through a virtual link, {channels} channels: x real time", device / wall, "", 9.5)
    yield Row("its samples, of those that the drive made", rows / (device * 16000), "", 0.9999)
    yield Row("its losses", sum((run.lost or {"unknown": 1}).values()), "", 0, at_most=True)
    yield Row(f"memory of drive and host from {warm:g} s on, most less least", flat, "MB", FLAT, at_most=True)


def minutes(file: Path, seconds: float, times: int) -> Iterator[Row]:
    """Any minute of it, read in a process of its own."""
    os.sync()  # the disk is not to be busy with what was just written
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
    """The run, then ten minutes of it."""
    with tempfile.TemporaryDirectory() as name:
        seconds, folder = 2.0 if short else 600.0, Path(name)
        made = list(faster(seconds, 1.0 if short else 60.0, folder))
        return [*made, *minutes(folder / "faster.run", FASTER * seconds, 1 if short else 10)]

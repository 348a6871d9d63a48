"""Ten times real time for ten minutes, through a virtual link: python -m tests.benchmarks ten_times

In this process, drive and host: the part runs first, because memory that others have left would be let go meanwhile.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.recording.reader import Run
from bench.recording.sink import RunSink
from sim.config.params import load_params
from sim.ports.virtual import VirtualLink
from tests.bench.collect import Bench
from tests.benchmarks.bench_sim import run_against
from tests.benchmarks.memory import FLAT, Memory
from tests.benchmarks.table import Row

FASTER = 10.0  # x real time


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


def rows(short: bool) -> Sequence[Row]:
    """The run."""
    with tempfile.TemporaryDirectory() as name:
        return list(faster(2.0 if short else 600.0, 1.0 if short else 60.0, Path(name)))

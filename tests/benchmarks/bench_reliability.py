"""What a recording stands: an hour live, ten times real time, kill -9, damage, and any minute of it read back.

`python -m tests.benchmarks reliability` takes two hours and writes docs/reliability.md. The hour is recorded from the
simulated drive, over TCP: a pty holds but 4 kB, which is 6 ms of what comes.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import psutil

from bench.recording.reader import Run
from bench.recording.sink import RunSink
from sim.config.params import load_params
from sim.ports.virtual import VirtualLink
from tests.bench.collect import Bench
from tests.bench.damage import Whole, unfinished
from tests.bench.processes import Sim
from tests.benchmarks.bench_kills import LATEST, SHORT, drive, kill
from tests.benchmarks.bench_live import account
from tests.benchmarks.bench_sim import run_against
from tests.benchmarks.commands import output
from tests.benchmarks.table import Row, cost

FLAT = 20.0  # MB
DISK = 0.25  # MB/s
CPU = 10.0  # % of a core
MINUTE, MEMORY = 1.0, 300.0  # s and MB to read any minute
FASTER = 10.0  # x real time
WARM = 120.0  # s after which memory is looked at: everything has been imported, two segments have ended
MB = 1e6
READ = """
import sys, time, resource
import bench
started = time.perf_counter()
found = bench.read(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]))
print(time.perf_counter() - started, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024, len(found.samples))
"""


class Memory:
    """Resident memory of a process, looked at every half a second: times in s and bytes."""

    def __init__(self, pid: int) -> None:
        self._process = psutil.Process(pid)
        self._found: list[tuple[float, int]] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        started = time.monotonic()
        while not self._end.wait(0.5):
            try:
                self._found.append((time.monotonic() - started, self._process.memory_info().rss))
            except psutil.NoSuchProcess:
                return

    def close(self) -> None:
        """End."""
        self._end.set()
        self._thread.join()

    def after(self, warm: float) -> tuple[float, float, float]:
        """The most, most less least, in MB, and MB/h by a straight line, from `warm` s on; without the last second."""
        t, size = np.array(self._found[:-2]).T
        t, size = t[t >= warm], size[t >= warm] / MB
        return float(size.max()), float(np.ptp(size)), float(np.polyfit(t / 3600.0, size, 1)[0])


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


RECORD = """
import sys, time
sys.path[:0] = [{tests!r}]
import synthetic
from bench.recording import sink, writer
writer.ROW_GROUP, writer.SEGMENT, writer.PIECE = 0.2, 0.5, 0.05
made = synthetic.SyntheticRun(20.0)
file = sink.RunSink(sys.argv[1], synthetic.run_info())
started = time.monotonic()
for chunk in made.chunks(160):
    (file.samples if hasattr(chunk, "raw") else file.edges)(chunk)
    if hasattr(chunk, "raw"):
        print(int(chunk.tick[-1]), flush=True)
        time.sleep(max(0.0, (chunk.tick[-1] - made.tick[0]) / 2e7 - (time.monotonic() - started)))
"""


def killed(times: int, folder: Path) -> Iterator[Row]:
    """kill -9 of `bench live`, and of a recorder whose files end twice a second, so that it comes in their midst."""
    dice = random.Random(11)
    lacks, unopened = [], 0
    with drive() as (sim, proxy):
        for n in range(times):
            each = kill(signal.SIGKILL, dice.uniform(0.0, LATEST), sim, proxy, folder / f"live{n}.run")
            lacks.append(each.short)
    yield Row(f"kill -9 of bench live, {times} times: most that a recording lacks", max(lacks), "s", SHORT, True)
    lacks.clear()
    code = RECORD.format(tests=str(Path(__file__).parents[1] / "bench" / "rerunio"))
    for n in range(times):
        file = folder / f"short{n}.run"
        recorder = subprocess.Popen([sys.executable, "-c", code, str(file)], stdout=subprocess.PIPE, text=True)
        assert recorder.stdout is not None
        recorder.stdout.readline()
        timer = threading.Timer(dice.uniform(0.0, LATEST), recorder.kill)
        timer.start()
        ticks = [int(line) for line in recorder.stdout if line.strip().isdigit()]
        recorder.wait()
        run = Run(file)
        samples = run.samples
        unopened += bool(run.damage) or run.ended
        lacks.append(((ticks or [int(samples.tick[-1])])[-1] - int(samples.tick[-1])) / run.info.tick_hz)
    yield Row("kill -9 of a recorder with files of half a second: most that is missing", max(lacks), "s", SHORT, True)
    yield Row("runs of it that are damaged, or say that they came to their end", unopened, "", 0, at_most=True)


def damaged(times: int, folder: Path) -> Iterator[Row]:
    """Bits flipped and files cut, of a run that has ended and of one that was killed, both with a minute in files."""
    seconds = 2.0 if times < 100 else 75.0
    rig = Bench(VirtualLink.of(load_params()))
    file = folder / "ended.run"
    sink = RunSink(file, rig.info(), wait=True)
    rig.client.sinks = [sink]
    run_against(rig, 0.1, None)
    rig.drive.speed(100.0)
    rig.client.run_for(seconds)
    rig.rest()
    sink.close()
    for whole, kind in (
        (Whole(file), "ended"),
        (Whole(unfinished(Run(file), folder / "killed.run")), "was killed"),
    ):
        dice = random.Random(17)
        trials = [whole.trial(dice, folder) for _ in range(times)]
        for trial in trials:
            if not (trial.told and trial.same):
                print(f"  {trial}")
        missed = sum(not trial.told for trial in trials)
        yield Row(f"bit flips and cuts of a run that {kind}, of {times}: not told", missed, "", 0, at_most=True)
        silent = sum(not trial.same for trial in trials)
        yield Row(f"bit flips and cuts of a run that {kind}, of {times}: read differently", silent, "", 0, at_most=True)


def rows(short: bool) -> Sequence[Row]:
    """All of it."""
    found: list[Row] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        times = 2 if short else 100
        for made in (
            damaged(times, folder),
            killed(times, folder),
            faster(2.0 if short else 600.0, 1.0 if short else 60.0, folder),
            hour(4.0 if short else 3600.0, 1.0 if short else WARM, folder),
            minutes(folder / "hour.run", 4.0 if short else 3600.0, 1 if short else 10),
        ):
            for row in made:
                found.append(row)
                print(f"  {' | '.join(row.cells())}", flush=True)
    return found

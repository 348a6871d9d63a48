"""How much faster than real time observers run again on a recording: alone, from file to file, and with all figures.

`python -m tests.benchmarks replay`. The simulated drive records a minute, all channels at 16 kHz; nothing of that is
timed. Kernels are compiled and modules imported before the clock starts.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from bench.observers.estimators import Estimators
from bench.observers.replay import WINDOW, part, replay
from bench.rerunio.recording import Run, read_run
from bench.rerunio.schema import RunInfo
from bench.rerunio.sinks import FileSink
from bench.scoring.board import score
from sim.config.params import load_params
from sim.observers.catalogue import CATALOGUE
from sim.ports.virtual import VirtualLink
from tests.bench.collect import Bench
from tests.benchmarks.bench_sim import run_against
from tests.benchmarks.table import Quickest, Row

SPEEDS = (10.0, 50.0, 100.0, 200.0, 300.0, -100.0)  # mechanical rad/s, ten seconds each
GOAL_ALONE = 500.0  # x real time, each observer on one core
GOAL_FILES = 50.0
GOAL_SCORE = 20.0  # s for a minute
REPEAT = 3  # runs, of which the best counts
PIECE = 1 << 17  # samples at a time


def record(path: Path) -> None:
    """A minute of the simulated drive, at several speeds, by its vector-tracking observer."""
    rig = Bench(VirtualLink.of(load_params()))
    hello, drive = rig.hello, rig.drive
    info = RunInfo(hello.tick_hz, hello.pwm_hz, drive.descriptor.channels, drive.parameters(), node=hello.node)
    sink = FileSink(path, info, wait=True)
    rig.client.sinks = [sink]
    run_against(rig, 0.1)
    for omega_m in SPEEDS:
        drive.speed(omega_m)
        rig.client.run_for(60.0 / len(SPEEDS))
    rig.rest()
    sink.close()


def alone(run: Run) -> dict[str, float]:
    """Seconds of each observer's kernel for the whole recording, and of the front end."""
    names = list(CATALOGUE)
    best: dict[str, float] = {}
    for _ in range(REPEAT):
        estimators = Estimators(names, run.info.parameters, run.samples.config)
        estimators.edges(run.edges)
        n = len(run.samples)
        for k in range(0, n, PIECE):
            estimators.samples(part(run.samples, k, min(k + PIECE, n)))
        for name, seconds in {"front end": estimators.front_seconds, **estimators.seconds}.items():
            best[name] = min(best.get(name, seconds), seconds)
    return {name: seconds for name, seconds in best.items() if name != "average_speed"}  # the front end is all of it


def best_of(action: Callable[[], object]) -> float:
    """Seconds of the quickest of `REPEAT` runs."""
    best = Quickest()
    for _ in range(REPEAT):
        with best.timed():
            action()
    return best[""]


def write(run: Run, path: Path) -> None:
    """Write the samples as they are, as a replay does."""
    sink = FileSink(path, run.info, overwrite=True, wait=True)
    step = round(WINDOW * run.info.pwm_hz)
    for k in range(0, len(run.samples), step):
        sink.samples(part(run.samples, k, min(k + step, len(run.samples))))
    sink.close()


def rows() -> Iterator[Row]:
    """The figures, as multiples of real time and in seconds for the minute."""
    with tempfile.TemporaryDirectory(prefix="hallbench-") as folder:
        path, out = Path(folder) / "run.rrd", Path(folder) / "out.rrd"
        record(path)
        run = read_run(path)
        minute = len(run.samples) / run.info.pwm_hz
        for name, seconds in alone(run).items():
            yield Row(f"{name}, alone", minute / seconds, "x real time", GOAL_ALONE)
        seconds = best_of(lambda: replay(path, out=out, overwrite=True))
        yield Row(f"replay of {len(CATALOGUE)} observers, file to file", minute / seconds, "x real time", GOAL_FILES)
        yield Row("  of that, reading alone", best_of(lambda: read_run(path)), "s")
        yield Row("  of that, writing alone", best_of(lambda: write(run, out)), "s")
        yield Row(
            f"score of {2 * len(CATALOGUE)} estimates", best_of(lambda: score([path])), "s", GOAL_SCORE, at_most=True
        )

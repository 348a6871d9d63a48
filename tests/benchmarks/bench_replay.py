"""How much faster than real time observers run again on a recording: alone, from file to file, and with all figures.

`python -m tests.benchmarks replay`. The simulated drive records a minute of all its channels at 16 kHz; nothing of that
is timed. Kernels are compiled and modules imported before the clock starts.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from bench.record.info import RunInfo
from bench.record.reader import Run
from bench.record.sink import RunSink
from bench.replay.estimators import Estimators
from bench.replay.replay import replay
from bench.score.board import score
from bench.signal.chunks import part
from sim.config.params import load_params
from sim.observers.catalogue import CATALOGUE
from sim.ports.virtual import VirtualLink
from tests.bench.collect import Bench
from tests.benchmarks.bench_live import streamed_in
from tests.benchmarks.bench_sim import all_channels, run_against
from tests.benchmarks.table import Quickest, Row, cost, speed

SPEEDS = (10.0, 50.0, 100.0, 200.0, 300.0, -100.0)  # mechanical rad/s, in turn
GOAL_ALONE = 1000.0  # x real time, each observer on one core
PIECE = 3200  # samples at a time, as a replay has them


def record(path: Path, seconds: float) -> None:
    """So much of the simulated drive, at several speeds, by its vector-tracking observer."""
    rig = Bench(VirtualLink.of(load_params()))
    hello, drive = rig.hello, rig.drive
    info = RunInfo(hello.tick_hz, hello.pwm_hz, drive.descriptor.channels, drive.parameters(), node=hello.node)
    sink = RunSink(path, info, wait=True)
    rig.client.sinks = [sink]
    run_against(rig, 0.1, all_channels(rig))
    for omega_m in SPEEDS:
        drive.speed(omega_m)
        rig.client.run_for(seconds / len(SPEEDS))
    rig.rest()
    sink.close()


def alone(run: Run, repeat: int) -> dict[str, float]:
    """Seconds of each observer's kernel for the whole recording, and of the front end."""
    names = list(CATALOGUE)
    best: dict[str, float] = {}
    for _ in range(repeat):
        estimators = Estimators(names, run.info.parameters, run.samples.config)
        estimators.edges(run.edges)
        n = len(run.samples)
        for k in range(0, n, PIECE):
            estimators.samples(part(run.samples, k, min(k + PIECE, n)))
        for name, seconds in {"front end": estimators.kernels.front_seconds, **estimators.kernels.seconds}.items():
            best[name] = min(best.get(name, seconds), seconds)
    return {name: seconds for name, seconds in best.items() if name != "average_speed"}  # the front end is all of it


def best_of(repeat: int, action: Callable[[], object]) -> float:
    """Seconds of the quickest of so many runs."""
    best = Quickest()
    for _ in range(repeat):
        with best.timed():
            action()
    return best[""]


def rows(short: bool) -> Iterator[Row]:
    """The figures, as multiples of real time and in seconds for the recording."""
    seconds, repeat = (1.5, 1) if short else (60.0, 3)
    with tempfile.TemporaryDirectory(prefix="hallbench-") as folder:
        path, out = Path(folder) / "run.run", Path(folder) / "out.run"
        record(path, seconds)
        run = Run(path)
        length = len(run.samples) / run.info.pwm_hz
        what = f"{length:.0f} s of {streamed_in(run)}"
        for name, took in alone(run, repeat).items():
            yield speed(f"{name}, over recorded columns", length / took, "x real time", GOAL_ALONE)
        took = best_of(repeat, lambda: replay(path, out=out, overwrite=True))
        many = f"replay of {len(CATALOGUE)} observers, {what}"
        yield speed(f"{many}, file to file", length / took, "x real time")
        yield cost(f"{many}: reading alone", best_of(repeat, lambda: Run(path).samples), "s")
        board = best_of(repeat, lambda: score([path]))
        yield cost(f"score of {2 * len(CATALOGUE)} estimates, {what}", board, "s")

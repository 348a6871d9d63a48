"""How near a study comes to the bare simulation, on one core and on two, and what memory it takes.

`python -m tests.benchmarks study`. 1000 drives run 2 s of closed loop each, with two observers and their statistics.
Simulation alone is `SimulatedBench.advance` of the same drives for the same time with the same observers running, and
nothing else: no drive is made, nothing is looked at. Both take turns, in CPU time of one process.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import psutil

from bench.study.cluster import Cluster
from bench.study.experiments import compute
from bench.study.store import Store
from bench.study.study import Study, read_study
from bench.study.worker import identity
from protocol.messages import DriveState, SetpointMode
from sim.drive.machine import SimulatedBench
from tests.benchmarks.table import Row, cost, speed

STUDY = """
samples = 1000
[vary]
"motor.R_s" = { normal = [1.0, 0.05], relative = true }
"motor.psi_f" = { normal = [1.0, 0.03], relative = true }
"hall.delta_deg" = { uniform = [-4, 4] }
[experiments.turn]
speed = [200, 1000]
load = 0.1
settle = 0.3
control = "vector_tracking"
observers = ["vector_tracking", "edge_kalman"]
limits = { "edge_kalman.rms" = { hi = 1.0 } }
"""
RPM = 0.10471975511965977  # rad/s
WORK = "bench.study.experiments:compute"
SHARE = 0.6
"""Of the simulation's speed, at least."""
TWO = 1.9
"""Times as fast with two workers, at least."""
AT_ONCE = 50


def alone(study: Study, rows: range) -> float:
    """CPU time of the simulation of these drives, s."""
    spent = 0.0
    for row, values in zip(rows, study.inputs(rows).tolist(), strict=True):
        bench = SimulatedBench(study.drive(row, values), study.noise(row))
        bench.set_param("observer", 2)
        bench.watch(frozenset({"theta_vt", "theta_ek"}))
        for state in (DriveState.ARMED, DriveState.RUNNING):
            bench.enter_state(state)
            bench.load_enter_state(state)
            bench.advance(1)
        bench.load_setpoint(SetpointMode.TORQUE, 0.1)
        for rpm in (200.0, 1000.0):
            bench.setpoint(SetpointMode.SPEED, rpm * RPM)
            begun = time.process_time()
            for _ in range(4):  # a quarter of a second at once is quickest: what it records stays in the caches
                bench.advance(4000)
            spent += time.process_time() - begun
    return spent


class Spread(NamedTuple):
    """Of rows over workers."""

    rate: float
    """Rows a second, stored, once each worker has loaded its kernels."""
    client: float
    """CPU time of the client a row, s."""
    memory: float
    """Of client, scheduler and workers at the end, MB."""


def spread(study: Study, workers: int, folder: Path) -> Spread:
    """All rows of a study over so many workers."""
    with Store(folder, study, identity()) as store, Cluster(workers, None, lambda text: None) as engine:
        begun, first, n, spent, memory = 0.0, 0, 0, 0.0, 0.0
        came = Counter[str]()
        for done in engine.run(study.text, WORK, store.missing()):
            store.add(done.result, done.worker)
            n += len(done.rows)
            came[done.worker] += len(done.rows)
            if not begun and len(came) == workers and min(came.values()) >= AT_ONCE:  # kernels are loaded everywhere
                begun, first, spent = time.perf_counter(), n, time.process_time()
            if n == len(study):
                rate = (n - first) / (time.perf_counter() - begun)
                spent = (time.process_time() - spent) / (n - first)
                family = [psutil.Process(), *psutil.Process().children(recursive=True)]
                memory = sum(one.memory_info().rss for one in family) / 1e6
    return Spread(rate, spent, memory)


def rows(short: bool) -> Iterator[Row]:
    """Shares and ratios; speeds for orientation."""
    n = 100 if short else 1000
    with tempfile.TemporaryDirectory(prefix="hallbench-") as made:
        folder = Path(made)
        (folder / "study.toml").write_text(STUDY)
        study = read_study(folder / "study.toml", samples=n)
        compute(study.text, range(3))
        alone(study, range(3))
        simulated = studied = 0.0
        for begin in range(0, n, AT_ONCE):
            some = range(begin, begin + AT_ONCE)
            simulated += alone(study, some)
            begun = time.process_time()
            compute(study.text, some)
            studied += time.process_time() - begun
        yield cost("simulation alone, 2 s of a drive", 1e3 * simulated / n, "ms")
        yield cost("a row of a study of it, CPU time", 1e3 * studied / n, "ms")
        yield Row("share of the simulation's speed", simulated / studied, "x", SHARE)
        if not short:
            study = read_study(folder / "study.toml", samples=2 * n)
            one, two = (spread(study, workers, folder / f"{workers}.study") for workers in (1, 2))
            more = spread(read_study(folder / "study.toml", samples=5 * n), 2, folder / "more.study")
            yield speed("rows with one worker", one.rate, "1/s")
            yield Row("two workers over one", two.rate / one.rate, "x", TWO)
            yield cost("client, CPU a row", 1e3 * more.client, "ms")
            yield Row("workers that one client can feed", 1.0 / (one.rate * more.client), "")
            yield Row("memory of client, scheduler and two workers after 2000 rows", two.memory, "MB", at_most=True)
            yield Row("after 5000 rows, by it", more.memory / two.memory, "x", 1.1, at_most=True)
            size = sum(file.stat().st_size for file in (folder / "more.study").glob("rows-*")) / (5 * n)
            yield Row("on disk, a row", size, "bytes", at_most=True)

"""The dead time that the drive learns at run time: each observer as angle source, without and with it.

`python -m tests.benchmarks dead_time`. Figures are the worst of all speeds and currents.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sim.config.params import load_params
from sim.drive.machine import SOURCES
from tests.benchmarks.table import Row
from tests.sim.observers.proving import BENCH_24V, Proving, steps, thd, worst

SEED = 200
SEEDS = range(200, 206)
SPEEDS = (100, 200, 300)  # r/min, where the dead time counts beside the back-EMF
AMPS = (1, 4, 8)
MORE = 1.1  # times what it is without, that it may be at most
BENCHES = {"kind": None, "bench24v": BENCH_24V}
LESSONS = ((100, 4, 1.5), (150, 8, 1.5), (200, 2, 1.5))  # r/min, A, s


def rows(short: bool) -> Iterator[Row]:
    """What is learned, and what that does to angles and currents."""
    yield from _learned(short)
    for name in BENCHES:
        for source in ("edge_kalman",) if short else ("encoder", *(entry.name for entry in SOURCES.values())):
            yield from _source(name, source, short)
    if not short:
        yield from _steps()


def _learned(short: bool) -> Iterator[Row]:
    """A drive that was told none, on a plant that has 1 us: what it learns, less that."""
    for source in ("encoder",) if short else ("encoder", "vector_tracking", "edge_kalman"):
        bench = Proving(source, load_params(None), SEED, {"dead_time_comp": 0.0})
        bench.set_param("dead_time_learn", 1)
        for lesson in LESSONS[:1] if short else LESSONS:
            run = bench.forced(*lesson)
        off = 1e9 * abs(run["dead_time_left"][-1] - bench.params.inverter.dead_time)
        yield Row(f"told none, {source}: what is learned is off by", off, "ns", 150.0, at_most=True)


def _source(name: str, source: str, short: bool) -> Iterator[Row]:
    found, distorted = [], []
    for learn in (0, 1):
        bench = Proving(source, load_params(BENCHES[name]), SEED)
        bench.set_param("dead_time_learn", learn)
        bench.teach()
        points = [(rpm, i_q) for rpm in (SPEEDS[-1:] if short else SPEEDS) for i_q in AMPS]
        seen = "vector_tracking" if source == "encoder" else source
        found.append(worst([bench.figures(bench.at(*point), seen) for point in points]).std)
        distorted.append(thd(bench.at(500, 4)))
    title = "vector_tracking beside the encoder" if source == "encoder" else source
    yield Row(f"{name}, {title}: std without", found[0], "deg")
    yield Row(f"{name}, {title}: std with", found[1], "deg", MORE * found[0], at_most=True)
    yield Row(f"{name}, {source} in control: THD at 500 r/min, 4 A, without", distorted[0], "%")
    yield Row(f"{name}, {source} in control: THD at 500 r/min, 4 A, with", distorted[1], "%")


def _steps() -> Iterator[Row]:
    for learn, word in enumerate(("without", "with")):
        found: dict[str, list[float]] = {}
        for seed in SEEDS:
            bench = Proving("edge_kalman", load_params(BENCH_24V), seed)
            bench.set_param("dead_time_learn", learn)
            bench.teach()
            for step, both in steps(bench).items():
                found.setdefault(step, []).append(both.own.largest)
        for step, errors in found.items():
            yield Row(f"bench24v, edge_kalman, {step}: median of the largest, {word}", float(np.median(errors)), "deg")

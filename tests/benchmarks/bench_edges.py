"""The observer that learns the Hall edges, on benches unlike the one that it was designed on, beside vector tracking.

`python -m tests.benchmarks edges`. The control uses its own angle. Where it says so, figures of several runs are the
worst of them. `OBSERVER` puts another one in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from bench.device.simulator import motors
from protocol.signals import AngleSource
from tests.benchmarks.replay import PWM_HZ, Run
from tests.benchmarks.table import Row, cost
from tests.sim.observers.counting import ARITHMETIC, Counted
from tests.sim.observers.proving import (
    ALTERED,
    SLOW,
    SPEEDS,
    Compared,
    Proving,
    altered,
    bench_24v,
    left_of_emf,
    of_motor,
    steps,
    sweep,
    thd,
    worst,
)

OBSERVER = "edge_kalman"
SEEDS = range(100, 120)
FEW = range(100, 106)
SHARES = (0.03, 0.1, 0.33, 0.66, 1.0)  # of the largest speed
LOADS = (0.125, 0.5, 1.0)  # of the largest current
REACH = {"reversal": 5.0, "start": 8.0}
"""deg. None for 3 A more at 100 r/min: they stop the shaft between two edges, where nothing shows its angle."""
SLICE = 8000  # samples of a timed run: so short that other load on the machine misses some
REPEAT = 500  # of it
COUNTED = (100, 1000, 3000)  # r/min: where operations are counted


def rows(short: bool) -> Iterator[Row]:
    """Every table of docs/edge-kalman.md."""
    yield from _all_at_once(short)
    yield from _one_by_one(short)
    yield from _steps(short)
    yield from _known(short)
    yield from _constant(short)
    yield from _distortion(short)
    yield from _motors(short)
    yield from _cost(short)
    yield from _count(short)


def _pair(what: str, found: Mapping[object, Compared], std: float | None, largest: float | None) -> Iterator[Row]:
    """Deviation and largest error of all points, and vector tracking's."""
    own = worst(point.own for point in found.values())
    other = worst(point.other for point in found.values())
    yield Row(f"{what}: std", own.std, "deg", std, at_most=True)
    yield Row(f"{what}: largest", own.largest, "deg", largest, at_most=True)
    yield Row(f"{what}: vector tracking, std", other.std, "deg")
    yield Row(f"{what}: vector tracking, largest", other.largest, "deg")


def _all_at_once(short: bool) -> Iterator[Row]:
    found: dict[object, Compared] = {}
    slow: dict[object, Compared] = {}
    for seed in SEEDS[:1] if short else SEEDS:
        bench = bench_24v(OBSERVER, seed)
        bench.teach()
        found |= {(seed, *point): figures for point, figures in sweep(bench, SPEEDS[-1:] if short else SPEEDS).items()}
        if seed in FEW and not short:
            slow |= {(seed, *point): figures for point, figures in sweep(bench, SLOW).items()}
    yield from _pair("bench24v, 100 to 3000 r/min", found, 0.3, 1.5)
    for name, least, most, std, largest in (("20 and 35", 0, 50, 1.2, 5.0), ("50 and 75", 50, 100, 0.5, 2.0)):
        part = {point: figures for point, figures in slow.items() if least <= point[1] < most}  # type: ignore[index]
        if part:
            yield from _pair(f"bench24v, {name} r/min", part, std, largest)


def _one_by_one(short: bool) -> Iterator[Row]:
    for what in list(ALTERED)[:1] if short else ALTERED:
        bench = altered(OBSERVER, what, SEEDS[0])
        bench.teach()
        found = sweep(bench, SPEEDS[-1:] if short else SPEEDS)
        yield from _pair(what, found, 0.5, 1.5)
        worse = max(point.own.std - point.other.std for point in found.values())
        yield Row(f"{what}: std above vector tracking's, at worst", worse, "deg", 0.0, at_most=True)


def _steps(short: bool) -> Iterator[Row]:
    if short:
        return
    for bench_of, name in ((lambda seed: altered(OBSERVER, "nothing", seed), "kind"), (_24v, "bench24v")):
        found: dict[str, list[Compared]] = {}
        for seed in SEEDS:
            bench = bench_of(seed)
            bench.teach()
            for step, both in steps(bench).items():
                found.setdefault(step, []).append(both)
        for step, runs in found.items():
            goal = next((goal for begin, goal in REACH.items() if step.startswith(begin)), None)
            own, other = ([getattr(run, which).largest for run in runs] for which in ("own", "other"))
            yield Row(f"{name}, {step}: median of the largest", float(np.median(own)), "deg", goal, at_most=True)
            yield Row(f"{name}, {step}: largest of all", max(own), "deg", goal, at_most=True)
            yield Row(f"{name}, {step}: vector tracking, median of the largest", float(np.median(other)), "deg")


def _24v(seed: int) -> Proving:
    return bench_24v(OBSERVER, seed)


def _known(short: bool) -> Iterator[Row]:
    """What the back-EMF is wrong by on an unkind bench, before and after what was learned of it."""
    bench = bench_24v(OBSERVER, SEEDS[0])
    bench.teach()
    for rpm, i_q in ((100.0, 4.0),) if short else ((100.0, 1.0), (100.0, 4.0), (500.0, 0.25), (500.0, 4.0)):
        left = left_of_emf(bench, bench.at(rpm, i_q))
        for axis, part in (("e_d", np.real), ("e_q", np.imag)):
            smoothed = [np.convolve(part(of), np.full(16, 1 / 16), "valid") for of in left]
            before, after = (1e3 * float(np.sqrt(np.mean(np.square(of)))) for of in smoothed)
            yield Row(f"bench24v, {rpm:g} r/min, {i_q:g} A: {axis} wrong by, rms of 1 ms means", before, "mV")
            yield Row(f"bench24v, {rpm:g} r/min, {i_q:g} A: {axis}, less what was learned", after, "mV")


def _constant(short: bool) -> Iterator[Row]:
    """Nothing learned before, one speed and one load; then as in `bench live`, with another observer in control."""
    seconds = 1.0 if short else 60.0
    bench = bench_24v(OBSERVER, SEEDS[0])
    bench.forced(500, 4, 5.0)
    early = bench.figures(bench.forced(500, 4, 1.0))
    bench.forced(500, 4, seconds)
    late = bench.figures(bench.forced(500, 4, 1.0))
    yield Row("constant 500 r/min, 4 A, nothing learned before: mean after 60 s", abs(late.mean), "deg", 0.5, True)
    yield Row("the same: its drift in that time", abs(late.mean - early.mean), "deg", 0.1, at_most=True)


def _distortion(short: bool) -> Iterator[Row]:
    for rpm in (1000,) if short else (500, 1000, 3000):
        found = []
        for observer in (OBSERVER, "encoder"):
            bench = altered(observer, "nothing", SEEDS[0])
            bench.teach()
            found.append(thd(bench.at(rpm, 4)))
        yield Row(f"THD at {rpm} r/min, 4 A: what its angle adds", found[0] - found[1], "%", 0.3, at_most=True)


def _motors(short: bool) -> Iterator[Row]:
    names: Sequence[str] = list(motors())[:1] if short else list(motors())
    for name in names:
        for kind, std, largest in ((True, 0.3, 1.0), (False, 0.5, 2.0)):
            bench = of_motor(OBSERVER, name, kind, SEEDS[0])
            bench.teach()
            speeds = [share * bench.top for share in (SHARES[-1:] if short else SHARES)]
            found = sweep(bench, speeds, [load * bench.i_max for load in LOADS])
            yield from _pair(f"{name}, {'kind' if kind else 'unkind'}", found, std, largest)


def _cost(short: bool) -> Iterator[Row]:
    run = Run(AngleSource.VECTOR_TRACKING)
    run.forced(1000, 4, SLICE / PWM_HZ)
    telemetry = run.telemetry()
    repeat = 5 if short else REPEAT
    own = telemetry.nanoseconds(OBSERVER, repeat)
    other = telemetry.nanoseconds("vector_tracking", repeat)
    yield cost(f"a step of {OBSERVER}", own, "ns")
    yield Row("a step by one of vector tracking", own / other, "x", 3.0, at_most=True)


def _count(short: bool) -> Iterator[Row]:
    """By operations, in float32 on a Cortex-M4, at 4 A and with lessons: the worst of the speeds."""
    run = Run(AngleSource.VECTOR_TRACKING)
    for rpm in COUNTED[-1:] if short else COUNTED:
        run.forced(rpm, 4, 0.3 + 100.0 / rpm)
        run.forced(rpm, 4, (200 if short else 2000) / PWM_HZ, str(rpm))
    telemetry = run.telemetry()
    own, other = (
        [telemetry.counted(name, part) for part in run.marks.values()] for name in (OBSERVER, "vector_tracking")
    )

    def ratio(figure: Callable[[Counted], float]) -> float:
        return float(max(figure(a) / figure(b) for a, b in zip(own, other, strict=True)))

    what = "a step on a Cortex-M4, by count"
    yield Row(f"{what}: mean, by vector tracking's", ratio(lambda steps: steps.costs().mean()), "x", 3.0, at_most=True)
    bare = ratio(lambda steps: steps.costs(ARITHMETIC).mean())
    yield Row(f"{what}: mean of arithmetic operations alone, by vector tracking's", bare, "x")
    yield Row(f"{what}: largest, by vector tracking's largest", ratio(lambda steps: steps.costs().max()), "x")
    for whose, found in (("", own), ("vector tracking, ", other)):
        yield Row(f"{what}: {whose}mean", float(max(steps.costs().mean() for steps in found)), "cycles")
        yield Row(f"{what}: {whose}largest", float(max(steps.costs().max() for steps in found)), "cycles")

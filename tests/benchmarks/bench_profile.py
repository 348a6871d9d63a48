"""Where a period of the simulated drive goes, alone and through the protocol: its parts timed by themselves.

`python -m tests.benchmarks profile`. The plant runs on its own, the front end and the observer on what a run recorded,
the protocol's two ends on random samples. The rest is what is left of the whole.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from protocol.signals import DRIVE_CHANNELS
from tests.benchmarks import against
from tests.benchmarks.bench_decode import measure
from tests.benchmarks.bench_sim import RPM, TORQUE, through_protocol
from tests.benchmarks.replay import telemetry
from tests.benchmarks.table import Quickest, Row, cost
from tests.sim.drive.rig import PWM_HZ, Rig, made_front_end, measured_of

PERIODS = 1200  # a call of the session in virtual time
USUAL = DRIVE_CHANNELS[:26]  # those that are streamed unasked


def rows(short: bool) -> Iterator[Row]:
    """ns a period of the whole, and of its parts."""
    repeat, n, seconds = (3, 5_000, 0.5) if short else (300, 100_000, 4.0)
    bench = Rig()
    bench.start()
    bench.spin(RPM, 1.0, TORQUE)
    whole = nanoseconds(lambda: bench.advance(PERIODS), repeat)
    recorded, none = bench.advance(PERIODS), np.zeros(PERIODS, bool)
    front, measured = made_front_end(bench), measured_of(bench, [recorded])
    with tempfile.TemporaryDirectory(prefix="hallbench-") as folder:
        tree = against.Tree(against.ROOT, Path(folder, "tree"))
        tree.make()
        plant = tree.told("plant", short)["plant alone, a period, ns"]
    parts = {
        "the plant": plant,
        "the Hall front end": nanoseconds(lambda: front.run(measured, recorded.captured[:0], none), repeat),
        "vector tracking": telemetry(bench, [recorded]).nanoseconds("vector_tracking", repeat),
    }
    yield from told("simulation alone, calls of 75 ms", whole, parts, "sensing, control, protection and record")
    raw = nanoseconds(lambda: recorded.raw(USUAL), repeat)
    took = measure(USUAL, 65_536, n, 2 if short else 5)
    parts = {
        "simulation": whole,
        "raw samples": raw,
        "frames of them": 1e9 * took["encode"] / n,
        "frames to columns": 1e9 * took["decode"] / n,
    }
    speed, channels = max(through_protocol(seconds, False) for _ in range(2 if short else 5))
    assert channels == len(USUAL)
    what = f"through the protocol, {channels} channels and edges"
    yield from told(what, 1e9 / PWM_HZ / speed, parts, "sessions, edges, client")


def told(what: str, whole: float, parts: dict[str, float], rest: str) -> Iterator[Row]:
    """The whole, its parts, and what is left."""
    yield cost(f"{what}: a period", whole, "ns")
    for part, took in {**parts, rest: whole - sum(parts.values())}.items():
        yield Row(f"{what}: {part}", took, "ns", at_most=True)


def nanoseconds(action: Callable[[], object], repeat: int) -> float:
    """ns a period of something that does `PERIODS`; the best of so many runs."""
    best = Quickest()
    for _ in range(repeat):
        with best.timed():
            action()
    return 1e9 * best[""] / PERIODS

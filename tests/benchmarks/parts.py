"""The parts of the benchmark, and how one is measured: `rows(short)` of the module `bench_<part>`."""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Iterable
from dataclasses import replace
from datetime import date
from importlib import import_module

from tests.benchmarks import reference
from tests.benchmarks.last import Measured
from tests.benchmarks.table import Row

PARTS = {
    "accuracy": "Accuracy: plant against solve_ivp, position errors against the plant",
    "edges": "Kalman filter on Hall edges: position errors on benches unlike the one it was designed on",
    "disturbed": "Kalman filter on Hall edges: pulses, bounces and dead sensors",
    "dead_time": "Dead time learned at run time: each observer without and with it",
    "fixed_point": "Fixed point: 16 bits beside floating point, same telemetry",
    "decode": "Decode: bytes to numpy columns, CRC checked, one core",
    "sim": "Simulated drive in virtual time, one core",
    "profile": "Where a period goes: parts timed by themselves, one core",
    "live": "Live: the simulated drive behind a pty, recorded",
    "starved": "Live beside busy loops, two for each core",
    "can": "CAN: stream frames to numpy columns, and a run over slcan, recorded",
    "slcan": "slcan: its text, and reading a full CAN FD bus",
    "replay": "Replay and score of a recording",
    "study": "Studies: a drive's row beside its bare simulation, workers, memory",
    "import": "Import of a million rows, and a check of a long recording",
    "accept": "Acceptance: the whole suite in virtual time, of whole processes",
    "kills": "Killed, stopped or told to end at a random moment",
    "start": "Start-up",
    "ten_times": "Recorded at ten times real time",
    "damage": "Recordings killed and damaged",
    "hour": "An hour recorded live",
    "day": "Eight hours recorded live, beside other load of 5 % of a core",
}
LONG = ("ten_times", "damage", "hour", "day")
"""Parts that take long: run in full where they are named only."""


def measure(part: str, short: bool) -> Measured:
    """Run a part, and the reference kernel before and after: a machine's speed drifts. In short form without goals."""
    module = import_module(f"tests.benchmarks.bench_{part}")
    repeat = 1 if short else 25
    before = reference.seconds(repeat)
    rows = _sane(module.rows(short))
    took = min(before, reference.seconds(repeat))
    if short:
        rows = [replace(row, goal=None) for row in rows]
    return Measured(date.today().isoformat(), machine(), took, tuple(row.beside(took) for row in rows))


def machine() -> str:
    """What this runs on, for people."""
    return f"Python {platform.python_version()}, {os.cpu_count()} cores, {platform.machine()}"


def _sane(rows: Iterable[Row]) -> list[Row]:
    """The rows. Raises ValueError if there is none, or one of them cannot be."""
    rows = list(rows)
    if not rows:
        raise ValueError("no figures")
    if twice := {row.what for row in rows if [other.what for other in rows].count(row.what) > 1}:
        raise ValueError(f"several figures of one name: {', '.join(sorted(twice))}")
    for row in rows:
        if not math.isfinite(row.measured) or (row.timed and row.measured <= 0):
            raise ValueError(f"{row.what}: {row.measured}")
    return rows

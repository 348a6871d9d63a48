"""The reference kernel: a fixed piece of work that figures are put beside, so that machines and days can be compared.

It has nothing of the product in it and resembles its load: scalar floating point compiled by numba, numpy columns, and
Python objects, about a third of its time each. Who changes it makes the ratios of last.json worthless: all parts have
to be run again.
"""

from __future__ import annotations

import math
import struct

import numpy as np
from numba import njit

from tests.benchmarks.table import Quickest

STEPS = 350_000  # of the compiled loop
COLUMNS = 8
LENGTH = 16_000  # of a column
RECORDS = 750
TIMES = 100  # over columns and records


@njit
def _loop(steps: int) -> float:
    """A tracking loop over a turning vector: what drive and observers do, in other numbers."""
    theta = omega = x = y = 0.0
    for k in range(steps):
        a = 0.001 * k
        x += 0.3 * (math.cos(a) - x)
        y += 0.3 * (math.sin(a) - y)
        error = (y * math.cos(theta) - x * math.sin(theta)) / math.sqrt(x * x + y * y + 1e-9)
        omega += 0.0025 * error
        theta += omega + 0.07 * error
    return theta


def _columns(raw: np.ndarray) -> float:
    """Columns of a structured array, as floats, over and over."""
    return sum(float((raw[name] * 0.25 + 1.0).sum()) for _ in range(TIMES) for name in raw.dtype.names)


def _objects(data: bytes) -> int:
    """Records of bytes into tuples in a dictionary, over and over; few at a time, so that there is little garbage."""
    n = 0
    for _ in range(TIMES):
        seen: dict[int, list[tuple[int, ...]]] = {}
        for record in struct.iter_unpack("<IHHi", data):
            seen.setdefault(record[1] & 15, []).append(record)
        n += len(seen)
    return n


def seconds(repeat: int) -> float:
    """How long the reference kernel takes now; the best of so many runs: other load on the machine only slows them."""
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 256, LENGTH * 2 * COLUMNS, np.uint8).view([(f"x{k}", "<i2") for k in range(COLUMNS)])
    data = rng.bytes(12 * RECORDS)
    _loop(1)  # compiled by now
    best = Quickest()
    for _ in range(repeat):
        with best.timed():
            _loop(STEPS)
            _columns(raw)
            _objects(data)
    return best[""]

"""The drives that are nearest to a limit, or furthest beyond it, and what is extreme in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.signal.limits import Limits
from bench.study.drives import Drives
from bench.study.rows import F64

SHOWN = 3
"""Drives by test, and inputs by drive."""
UNUSUAL = 1.0
"""How many sd of the input from its mean is worth telling."""


@dataclass(frozen=True)
class Worst:
    """One of the drives with the smallest margin in a test, in its worst repetition."""

    test: str
    design: str
    row: int
    sample: int
    verdict: str
    measurement: str
    """The one with the smallest margin; empty where none has one."""
    value: float
    limits: str
    share: float
    """Its margin as a share of the width between the limits, or of the limit where there is one; negative outside."""
    unusual: tuple[tuple[str, float, float], ...]
    """Inputs that are furthest from the mean: name, value, distance in sd."""
    replay: str


def worst(drives: Drives, replay: Callable[[int], str]) -> list[Worst]:
    """By test the drives that failed or passed with the smallest margin."""
    return [each for test in drives.tests for each in _of_test(drives, test, replay)]


def margin_share(limits: Limits, values: F64) -> F64:
    """As `bench.accept.results.Measurement.share`; infinite where that is None, NaN where nothing is to be told.

    That is so of a value that is missing, and of a count that stands at its limit.
    """
    lo, hi = limits.lo, limits.hi
    sides = [values - lo] if lo is not None else []
    sides += [hi - values] if hi is not None else []
    if not sides:
        return np.full(len(values), np.nan)
    margin: F64 = np.minimum.reduce(sides)
    known: F64 = margin / width if (width := limits.width) else np.copysign(np.inf, margin)
    return np.where(margin == 0.0, np.nan, known)


def _of_test(drives: Drives, test: str, replay: Callable[[int], str]) -> list[Worst]:
    rows = drives.rows
    at = drives.place[drives.place >= 0]
    at = np.sort(at[rows.judged(test)[at]])
    mine = [name for name in rows.limits if name.startswith(f"{test}.") and name in rows.measured]
    table = [margin_share(rows.limits[name], rows.measured[name][at]) for name in mine]
    least = np.fmin.reduce([*table, np.full(len(at), np.inf)])
    passed: NDArray[np.bool_] = rows.passed(test)[at]
    order = np.lexsort((rows.row[at], least, passed))
    found: list[Worst] = []
    for k in order:
        if len(found) == SHOWN or (passed[k] and np.isinf(least[k])):
            break
        row = int(at[k])
        if int(rows.sample[row]) in {worst.sample for worst in found}:
            continue
        which = next((name for name, column in zip(mine, table, strict=True) if column[k] == least[k]), "")
        found.append(Worst(
            test, rows.designs[drives.design], int(rows.row[row]), int(rows.sample[row]), str(rows.verdicts[test][row]),
            which, float(rows.measured[which][row]) if which else np.nan, str(rows.limits[which]) if which else "",
            float(least[k]) if which else np.nan, _unusual(drives, int(rows.sample[row])),
            replay(int(rows.row[row])),
        ))  # fmt: skip
    return found


def _unusual(drives: Drives, sample: int) -> tuple[tuple[str, float, float], ...]:
    at = int(np.searchsorted(drives.sample, sample))
    inputs = drives.inputs.told.items()
    found = [(name, float(x[at]), float((x[at] - x.mean()) / x.std())) for name, x in inputs]
    found.sort(key=lambda each: -abs(each[2]))
    return tuple(each for each in found[:SHOWN] if abs(each[2]) >= UNUSUAL)

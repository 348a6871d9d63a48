"""What share of the drives passes: by test, and all tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.study.drives import Drives
from bench.study.statistics import Estimate, share

ALL = "all tests"


@dataclass(frozen=True)
class Yield:
    """Of one test, or of `ALL`, in one design. A drive passes that passed in every repetition."""

    test: str
    design: str
    passed: int
    failed: int
    unknown: int
    """Drives with neither a FAIL nor a PASS in every repetition: INVALID, ERROR, SKIPPED, or missing."""
    share: Estimate | None
    """Of those that passed or failed; None where there is none."""
    bounds: tuple[float, float]
    """The share were all unknown ones to fail, and were they to pass."""


def yields(designs: Sequence[Drives]) -> list[Yield]:
    """By test and design, all tests first; tests that a design does not have are left out."""
    found = []
    for drives in designs:
        tests = [test for test in drives.rows.verdicts if drives.tried(test)]
        every, some = np.ones(len(drives), bool), np.zeros(len(drives), bool)
        for test in tests:
            passed, failed = drives.outcome(test)
            every, some = every & passed, some | failed
            found.append(_yield(test, drives, int(passed.sum()), int(failed.sum())))
        if len(tests) > 1:
            found.append(_yield(ALL, drives, int(every.sum()), int(some.sum())))
    order = [ALL, *(designs[0].rows.verdicts if designs else ())]
    return sorted(found, key=lambda each: order.index(each.test))


def _yield(test: str, drives: Drives, passed: int, failed: int) -> Yield:
    n, judged = len(drives), passed + failed
    known, bounds = share(passed, judged) if judged else None, (passed / n, (n - failed) / n)
    return Yield(test, drives.rows.designs[drives.design], passed, failed, n - judged, known, bounds)

"""What share of the drives passes: by test, and all tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bench.study.drives import ALL, Drives
from bench.study.statistics import Estimate, share


@dataclass(frozen=True)
class Yield:
    """Of one test, or of `ALL`, in one design. A drive passes that passed in every repetition."""

    test: str
    design: str
    passed: int
    failed: int
    unknown: int
    """Drives with neither a FAIL nor a PASS in every repetition: INVALID, ERROR, SKIPPED, or missing."""
    unknown_row: int | None
    """The first of theirs that neither passed nor failed; None where there is none, and of `ALL`."""
    share: Estimate | None
    """Of those that passed or failed; None where there is none."""
    bounds: tuple[float, float]
    """The share were all unknown ones to fail, and were they to pass."""


def yields(designs: Sequence[Drives]) -> list[Yield]:
    """By test and design, all tests first; tests that a design does not have are left out."""
    found = []
    for drives in designs:
        for test, (passed, failed) in drives.outcomes(drives.tests).items():
            row = None if test == ALL else drives.first_without(test, ~(passed | failed))
            found.append(_yield(test, drives, int(passed.sum()), int(failed.sum()), row))
    order = [ALL, *(designs[0].rows.verdicts if designs else ())]
    return sorted(found, key=lambda each: order.index(each.test))


def _yield(test: str, drives: Drives, passed: int, failed: int, row: int | None) -> Yield:
    n, judged = len(drives), passed + failed
    known, bounds = share(passed, judged) if judged else None, (passed / n, (n - failed) / n)
    return Yield(test, drives.rows.designs[drives.design], passed, failed, n - judged, row, known, bounds)

"""The drives of one design, a row for each, and its repetitions beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bench.study.inputs import Inputs, varied
from bench.study.rows import F64, I64, Rows
from bench.study.variation import AT

Bools = NDArray[np.bool_]
ALL = "all tests"


@dataclass(frozen=True)
class Drives:
    """Of n samples: all, or of a Saltelli design with `groups` of D + 2 those that were drawn independently.

    These are the first and the last of each group: all between are made of the two.
    """

    rows: Rows
    design: int
    groups: int = 0

    @cached_property
    def place(self) -> I64:
        """(n, repetitions) index into the rows, -1 where there is none."""
        rows = self.rows
        at = np.flatnonzero(rows.of(self.design))
        if self.groups:
            at = at[np.isin(rows.sample[at] % self.groups, (0, self.groups - 1))]
        samples, where = np.unique(rows.sample[at], return_inverse=True)
        repetitions = int(rows.repetition.max(initial=0)) + 1
        place = np.full((len(samples), repetitions), -1, np.int64)
        place[where, rows.repetition[at]] = at
        return place

    @cached_property
    def sample(self) -> I64:
        """(n,) in order."""
        found: I64 = self.rows.sample[self.place.max(axis=1, initial=-1)]
        return found

    def __len__(self) -> int:
        return len(self.place)

    def values(self, name: str) -> F64:
        """(n, repetitions) of a measurement, NaN where there is no finite value."""
        found = np.where(self.place >= 0, self.rows.measured[name][self.place], np.nan)
        return np.where(np.isfinite(found), found, np.nan)

    def each(self, name: str) -> F64:
        """(n,) mean of a measurement over the repetitions, NaN where one is missing."""
        found: F64 = self.values(name).mean(axis=1)
        return found

    @cached_property
    def tests(self) -> list[str]:
        """Those that the design has at all."""
        at = self.place[self.place >= 0]
        return [test for test, verdicts in self.rows.verdicts.items() if (verdicts[at] != "").any()]

    def outcomes(self, tests: Sequence[str]) -> dict[str, tuple[Bools, Bools]]:
        """(n,) each: which drives passed in every repetition, and which failed in one; others are unknown.

        Of all tests, if they are several, and then of each.
        """
        there, found = self.place >= 0, {}
        for test in tests:
            yes, judged = (of(test)[self.place] for of in (self.rows.passed, self.rows.judged))
            found[test] = (np.all(there & yes, axis=1), np.any(there & judged & ~yes, axis=1))
        if len(tests) < 2:
            return found
        passed, failed = (np.array(each) for each in zip(*found.values(), strict=True))
        return {ALL: (passed.all(axis=0), failed.any(axis=0)), **found}

    def first_without(self, test: str, drives: Bools) -> int | None:
        """The number of the first row of these drives, (n,), that neither passed nor failed a test."""
        at = self.place[drives]
        at = at[at >= 0]
        return min(self.rows.row[at[~self.rows.judged(test)[at]]].tolist(), default=None)

    @cached_property
    def inputs(self) -> Inputs:
        """What was varied in this design: KEY@DESIGN is of that design only, and in the place of KEY."""
        at, design = self.place.max(axis=1, initial=-1), self.rows.designs[self.design]
        mine = {name for name in self.rows.inputs if name.partition(AT)[2] in ("", design)}
        mine -= {name.partition(AT)[0] for name in mine if AT in name}
        return varied({name: column[at] for name, column in self.rows.inputs.items() if name in mine})

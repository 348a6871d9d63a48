"""The drives of one design, a row for each, and its repetitions beside each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bench.study.rows import F64, I64, Rows


@dataclass(frozen=True)
class Drives:
    """Of n samples: only those that were drawn independently of each other, unless `all_of`.

    Of `groups` samples of a Saltelli design (D + 2) only the first and the last are: all between are of these two.
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
        return self._table(self.rows.measured[name])

    def _table(self, column: F64) -> F64:
        found = np.where(self.place >= 0, column[self.place], np.nan)
        return np.where(np.isfinite(found), found, np.nan)

    def each(self, name: str) -> F64:
        """(n,) mean of a measurement over the repetitions, NaN where one is missing."""
        found: F64 = self.values(name).mean(axis=1)
        return found

    def outcome(self, test: str) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(n,) each: which drives passed a test in every repetition, and which failed it in one; others are unknown."""
        there = self.place >= 0
        yes, judged = (of(test)[self.place] for of in (self.rows.passed, self.rows.judged))
        passed: NDArray[np.bool_] = np.all(there & yes, axis=1)
        failed: NDArray[np.bool_] = np.any(there & judged & ~yes, axis=1)
        return passed, failed

    def tried(self, test: str) -> bool:
        """Whether the design has the test at all."""
        return bool((self.rows.verdicts[test][self.place[self.place >= 0]] != "").any())

    @cached_property
    def inputs(self) -> Mapping[str, F64]:
        """(n,) each of what was varied."""
        at = self.place.max(axis=1, initial=-1)
        return {name: column[at] for name, column in self.rows.inputs.items()}

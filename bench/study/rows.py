"""The rows of a study as columns: what was varied, what was measured, which tests passed.

A row is one drive in one repetition, in one design: the same `sample` has the same drive in every design, and the same
`sample` and `repetition` the same noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.signal.limits import Limits
from bench.signal.verdict import Verdict

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Rows:
    """What there is of a study, n rows in order of their number; every array is (n,)."""

    row: I64
    """Number, from 0: (sample * repetitions + repetition) * designs + design."""
    sample: I64
    repetition: I64
    design: I64
    """Index in `designs`."""
    designs: tuple[str, ...]
    inputs: Mapping[str, F64]
    """What was varied, by its key in the drive's configuration; of a list each number, as hall.delta_deg_1."""
    measured: Mapping[str, F64]
    """By TEST.MEASUREMENT; NaN where a row does not have it."""
    verdicts: Mapping[str, NDArray[np.str_]]
    """By test: of `bench.signal.verdict.Verdict`; empty where a row does not have it."""
    limits: Mapping[str, Limits]
    """By TEST.MEASUREMENT; those without ends say the unit and nothing else."""
    seconds: F64
    """CPU time that each took."""

    def __len__(self) -> int:
        return len(self.row)

    def of(self, design: int) -> NDArray[np.bool_]:
        """(n,) which rows are of a design."""
        found: NDArray[np.bool_] = self.design == design
        return found

    def passed(self, test: str) -> NDArray[np.bool_]:
        """(n,) where a test passed."""
        found: NDArray[np.bool_] = self.verdicts[test] == Verdict.PASS.value
        return found

    def judged(self, test: str) -> NDArray[np.bool_]:
        """(n,) where it passed or failed: all others tell nothing."""
        failed: NDArray[np.bool_] = self.verdicts[test] == Verdict.FAIL.value
        return self.passed(test) | failed

"""Which inputs make a measurement vary: first-order and total Sobol indices, each with its interval.

Of a Saltelli design both come from SALib. Of any other sampling the first-order index is the share of the variance
that a smooth curve of one input explains, corrected for what a curve explains of noise. Its interval is that of the
efficient estimator (S. Da Veiga, F. Gamboa, J. Nonparametr. Stat. 25 (2013), 573), and it begins at 0 unless an F-test
finds the curve, at 5 % over all inputs together. On Ishigami's function, a linear and a noisy additive one such
intervals covered 91 to 97 % at 100 to 1000 drives, those of SALib's `delta` 0 to 95 %; those of `rbd_fast` covered
95 to 100 %, but are twice as wide at 100 drives and 1.4 times at 1000.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from bench.study.drives import Drives
from bench.study.inputs import MOST
from bench.study.rows import F64
from bench.study.statistics import Estimate, Z, around, varies

LEAST, ENOUGH = 50, 100
"""Drives below which no index is told, and from which on a curve has all its terms."""
FEW_TERMS, TERMS = 4, 8
"""Of a curve: the input, its square, and waves over its rank. Eight see four hills, as Ishigami's function has."""
SHAPE = 0.0025
"""Standard error of an index that comes from the curve's shape, which is not quite that of the function."""
LEAST_GROUPS = 32
RESAMPLES = 200
NEEDED = "Sobol indices of a Saltelli design need SALib: pip install 'hallbench[study]'"


@dataclass(frozen=True)
class Index:
    """Of an input: the share of the variance that it makes alone, and with all that it acts together with."""

    input: str
    first: Estimate
    total: Estimate | None
    """Of Saltelli designs."""
    matters: bool
    """Whether there is evidence that it does, at 5 % over all inputs together; noise is none."""

    @property
    def size(self) -> float:
        """What inputs are ordered by."""
        return max(self.first.value, self.total.value if self.total else -math.inf)


@dataclass(frozen=True)
class Sensitivity:
    """Of a measurement in one design: the mean over the repetitions of each drive."""

    name: str
    design: str
    n: int
    """Drives, or groups of a Saltelli design, that had all values."""
    indices: tuple[Index, ...]
    """The largest first."""
    noise: Estimate | None
    """The share of the variance of one repetition that is not the drive's; None without repetitions."""
    why: str
    """Why there are no indices."""

    @property
    def strongest(self) -> Index | None:
        """The most influential input; None where there is no evidence of any."""
        return next((index for index in self.indices if index.matters), None)


def sensitivities(drives: Drives, names: Sequence[str], saltelli: Sequence[str]) -> list[Sensitivity]:
    """Of these measurements; `saltelli` are the factors of such a design, in their order, else empty.

    `drives` are those drawn independently, which noise is told of, and of any other sampling the indices.
    """
    rows = drives.rows
    full = Drives(rows, drives.design) if saltelli else drives
    curves = Curves(drives.inputs.told)
    found = []
    for name in names:
        n, indices, why = _by_saltelli(full, name, saltelli) if saltelli else curves.indices(drives.each(name))
        ordered = tuple(sorted(indices, key=lambda index: -index.size))
        found.append(Sensitivity(name, rows.designs[drives.design], n, ordered, noise(drives.values(name)), why))
    return found


class Curves:
    """Smooth curves over each input, made once for all measurements."""

    def __init__(self, inputs: Mapping[str, F64]) -> None:
        self._inputs = inputs
        self._made: dict[bytes, dict[str, F64]] = {}

    def indices(self, y: F64) -> tuple[int, list[Index], str]:
        """How many drives had a value, the index of each input, and why there are none. `y` may have NaN."""
        known = np.isfinite(y)
        known[np.flatnonzero(known)[MOST:]] = False
        y, n = y[known], int(known.sum())
        if n < LEAST:
            return n, [], f"{n} drives have a value, and indices take {LEAST}"
        if not varies(y):
            return n, [], "it does not vary"
        y = (y - y.mean()) / y.std()
        bases = self._bases(known)
        if not bases:
            return n, [], "no input varies"
        return n, [_first(name, basis, y, len(bases)) for name, basis in bases.items()], ""

    def _bases(self, known: np.ndarray) -> dict[str, F64]:
        key = known.tobytes()
        if key not in self._made:
            at = {name: values[known] for name, values in self._inputs.items()}
            self._made = {key: {name: _basis(values) for name, values in at.items() if varies(values)}}
        return self._made[key]


def _basis(x: F64) -> F64:
    """(n, terms) orthonormal, without the mean; fewer terms where `x` has few values."""
    n = len(x)
    terms = TERMS if n >= ENOUGH else FEW_TERMS
    z, u = (x - x.mean()) / x.std(), (stats.rankdata(x) - 0.5) / n
    columns = np.column_stack([z, z * z, np.cos(np.pi * np.outer(u, np.arange(1, terms - 1)))])
    columns -= columns.mean(axis=0)
    left, sizes, _ = np.linalg.svd(columns / np.linalg.norm(columns, axis=0).clip(1e-12), full_matrices=False)
    basis: F64 = left[:, sizes > 1e-6]
    return basis


def _first(name: str, basis: F64, y: F64, inputs: int) -> Index:
    """Of `y` with mean 0 and variance 1."""
    n, terms = basis.shape
    curve = basis @ (basis.T @ y)
    explained, free = float(curve @ curve) / n, n - terms - 1
    index = 1.0 - (1.0 - explained) * (n - 1) / free
    influence = 2.0 * curve * (y - curve) + curve * curve - index * y * y
    variance = float(influence.var()) / free + SHAPE**2
    found = around(index, Z * math.sqrt(variance))
    f = explained / terms / max((1.0 - explained) / free, 1e-300)
    by_chance = float(special.fdtrc(terms, free, f)) > 0.05 / inputs
    lo, hi = 0.0 if by_chance else max(found.lo, 0.0), min(max(found.hi, 0.0), 1.0)
    return Index(name, Estimate(max(index, 0.0), lo, hi), None, lo > 0.0)


def _by_saltelli(drives: Drives, name: str, factors: Sequence[str]) -> tuple[int, list[Index], str]:
    """By SALib, of the groups of D + 2 drives that have all their values.

    A total index holds the share of noise, since no two drives have the same; where no repetitions tell how much that
    is, it is at most the smallest total index.
    """
    wide, r = len(factors) + 2, int(drives.place.shape[1])
    table = np.full(((int(drives.rows.sample.max(initial=0)) // wide + 1), wide), np.nan)
    table.flat[drives.sample] = drives.each(name)
    table = table[np.isfinite(table).all(axis=1)]
    n = len(table)
    if n < LEAST_GROUPS:
        return n, [], f"{n} groups of {wide} drives have all values, and indices take {LEAST_GROUPS}"
    if not (varies(table[:, 0]) and varies(table[:, -1])):
        return n, [], "it does not vary"
    try:
        from SALib.analyze import sobol
    except ImportError:
        return n, [], NEEDED
    problem = {"num_vars": len(factors), "names": list(factors), "bounds": [[0.0, 1.0]] * len(factors)}
    made = sobol.analyze(problem, table.ravel(), calc_second_order=False, num_resamples=RESAMPLES, seed=1)
    first, total, off_first, off_total = (np.array(made[key]) for key in ("S1", "ST", "S1_conf", "ST_conf"))
    heard = noise(drives.values(name))
    rest = float((total + off_total).min()) if heard is None else heard.hi / (r - (r - 1) * heard.hi)
    sure = float(special.ndtri(1.0 - 0.025 / len(factors))) / Z
    matters = (first > np.maximum(off_first, Z * SHAPE) * sure) | (total - off_total * sure > rest)
    moving = [k for k, factor in enumerate(factors) if f"{factor} does not vary" not in drives.inputs.notes]
    ones = [np.clip([it, it - off, it + off], 0.0, 1.0).T for it, off in ((first, off_first), (total, off_total))]
    alone, others = ([Estimate(*map(float, each)) for each in one] for one in ones)
    return n, [Index(factors[k], alone[k], others[k], bool(matters[k])) for k in moving], ""


def noise(table: F64) -> Estimate | None:
    """The share of the variance of a value that is within drives, (n, repetitions), by analysis of variance.

    Its interval is exact for normal effects (S. R. Searle, Linear Models, 9.9).
    """
    table = table[np.isfinite(table).all(axis=1)]
    n, r = table.shape
    if n < 2 or r < 2 or not varies(table.ravel()):
        return None
    between = r * float(table.mean(axis=1).var(ddof=1))
    within = float(table.var(axis=1, ddof=1).mean())
    if within == 0.0:
        return Estimate(0.0, 0.0, 0.0)
    f, outer, inner = between / within, n - 1, n * (r - 1)
    ends = (f, f / float(stats.f.ppf(0.025, outer, inner)), f / float(stats.f.ppf(0.975, outer, inner)))
    return Estimate(*(min(max(r / (end + r - 1.0), 0.0), 1.0) for end in ends))

"""Which inputs answers tell of: those that vary, each apart from what it goes with."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.study.rows import F64
from bench.study.statistics import varies

MOST = 20_000
"""Drives that are looked at."""
TOGETHER, MOSTLY, ONE = 0.3, 0.8, 1.0 - 1e-9
"""The least correlation of two inputs that is told, of two that are told apart from each other, and of two that are
one.
"""
OWN = "own part"
"""Of an input that mostly follows another: what it adds to that."""
SEVERAL = 3
"""How often each value of an input comes, where it may be a set that others are drawn with."""


class Inputs(NamedTuple):
    """What varies, (n,) each by its name, and in words what is left out and what cannot be told apart."""

    told: Mapping[str, F64]
    notes: tuple[str, ...]


def varied(inputs: Mapping[str, F64]) -> Inputs:
    """Left out is what does not vary, or follows wholly from another. What mostly follows is told by what it adds.

    A firmware that was told where its Hall sensors stand, with an error, is so told by the error.
    """
    moving = [name for name, values in inputs.items() if np.isfinite(values).all() and varies(values[:MOST])]
    notes = [f"{name} does not vary" for name in inputs if name not in moving]
    columns = np.array([inputs[name][:MOST] for name in moving])
    r = np.atleast_2d(np.corrcoef(columns)) if moving else np.eye(0)
    kinds = [np.unique(column, return_inverse=True)[1] for column in columns]
    pairs = permutations(range(len(moving)), 2)
    follows = {(b, a) for b, a in pairs if abs(r[a, b]) > ONE or _follows(kinds[b], kinds[a])}
    kept: list[int] = []
    for b, name in enumerate(moving):
        of = [a for a in range(len(moving)) if (b, a) in follows and (a < b or (a, b) not in follows)]
        if of:
            notes.append(f"{name} follows from {moving[of[0]]}, which stands for both")
        else:
            kept.append(b)
    chance = 4.0 / math.sqrt(columns.shape[-1] or 1)
    least, mostly = max(TOGETHER, chance), max(MOSTLY, chance)
    told: dict[str, F64] = {}
    for b in kept:
        name, x = moving[b], inputs[moving[b]]
        a = max((a for a in kept if a < b), key=lambda a: abs(r[a, b]), default=b)
        if a != b and abs(r[a, b]) > mostly:
            by = inputs[moving[a]] - inputs[moving[a]].mean()
            notes.append(
                f"{name} mostly follows {moving[a]} (correlation {r[a, b]:.3g}): its {OWN} is what it adds to that"
            )
            name, x = f"{OWN} of {name}", x - x.mean() - by * float(by @ x / (by @ by))
        told[name] = x
    together = [(a, b) for a, b in combinations(kept, 2) if least < abs(r[a, b]) <= mostly]
    for a, b in sorted(together, key=lambda pair: -abs(r[pair]))[:3]:
        both = f"{moving[a]} and {moving[b]} vary together (correlation {r[a, b]:.2g})"
        notes.append(f"{both}: what they share counts for both")
    return Inputs(told, tuple(notes))


def _follows(b: NDArray[np.int64], a: NDArray[np.int64]) -> bool:
    """Whether each value of `a`, which come several times, has one of `b`: both are numbers of values, from 0."""
    values = int(a.max()) + 1
    return SEVERAL * values <= len(a) and len(np.unique(a * (int(b.max()) + 1) + b)) == values

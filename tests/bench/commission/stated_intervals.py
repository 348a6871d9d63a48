"""Whether stated intervals hold: how many of many draws have the truth inside, and by how much they may be off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import binom

from bench.commission.quantity import Quantity


def inside(found: Sequence[Quantity], truth: Sequence[float], alike: int = 1) -> None:
    """At least as many of the 95 % intervals hold as would in all but one of 10 000 such tests.

    `alike`: how many that follow each other have one error in common, such as the edges of a bench its delay.
    """
    held = sum(each.covers(value) for each, value in zip(found, truth, strict=True))
    least = alike * int(binom.ppf(1e-4, len(found) // alike, 0.95))
    worst = max(zip(found, truth, strict=True), key=lambda pair: abs(pair[0].value - pair[1]) / pair[0].sd)
    assert held >= least, f"{held} of {len(found)} intervals of {found[0].name} hold; at worst {worst}"


def relative_errors(found: Sequence[Quantity], truth: Sequence[float]) -> np.ndarray:
    """Of each, against its truth."""
    return np.array([each.value / value - 1.0 for each, value in zip(found, truth, strict=True)])


def scores(found: Sequence[Quantity], truth: Sequence[float], part: str) -> np.ndarray:
    """Errors in standard deviations of one part of the interval."""
    return np.array([(each.value - value) / each.parts[part] for each, value in zip(found, truth, strict=True)])

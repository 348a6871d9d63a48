"""Least squares that know what the data do not tell: directions without information keep the value they began with.

Unknowns are counted in units of a `scale`, by which each is worth knowing. The equations tell a direction if its
standard deviation is less than that; along every other one the start stays as it is, and the direction is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.commission.least_squares import Fit
from bench.commission.window import Floats

PART = 0.4
"""Share from which an unknown is named as part of a direction."""
LEAST_SIGNAL = 0.2
"""Of the square that noise gives a direction, that what is none must have for the direction to be told."""
KEPT = 0.5
"""Share of an unknown's square that lies in directions that nothing tells, from which on it is not told itself."""


@dataclass(frozen=True)
class Told:
    """What equations tell of unknowns, shape (k,)."""

    x: Floats
    sd: Floats
    """By the scatter of what is left, neighbours that resemble each other counted; 0 of what is not told at all."""
    known: tuple[bool, ...]
    """Whether each was told, and not kept."""
    untold: tuple[tuple[str, ...], ...]
    """Directions that nothing tells: the unknowns that are in each, the largest share first."""
    residuals: Floats
    """y - A x, shape (n,)."""


def solved(
    A: Floats,
    y: Floats,
    start: Floats,
    scale: Floats,
    names: Sequence[str],
    each: int = 1,
    weights: Floats | None = None,
    noise: Floats | None = None,
) -> Told:
    """Minimise the squares of weights (y - A x), A of shape (n, k), from `start`; `scale`: see the module.

    `each`: so many rows belong together and follow each other in the order of time. `noise`, shape (k, k): covariance
    of what noise adds to a row of A, which would make its coefficients too small, and is no information. Fewer rows
    than unknowns: all is kept.
    """
    n, k = A.shape
    w = np.ones(n) if weights is None else weights
    if n <= k:
        return Told(start, np.zeros(k), (False,) * k, tuple((name,) for name in names), y - A @ start)
    scaled, target = A * scale * w[:, None], (y - A @ start) * w
    of_noise = np.zeros((k, k)) if noise is None else n * noise * np.outer(scale, scale)
    square, V = np.linalg.eigh(scaled.T @ scaled - of_noise)
    along = V.T @ (scaled.T @ target + of_noise @ (start / scale))  # what noise times the start has taken from it
    blind = LEAST_SIGNAL * np.einsum("ij,ij->j", V, of_noise @ V)
    tiny = 1e-12 * float(square.max())
    rest = target - scaled @ (V @ (along * (square > np.maximum(blind, tiny)) / np.maximum(square, tiny)))
    sigma = float(np.sqrt(rest @ rest / (n - k)))
    own = sigma * max(Fit(start, np.zeros((k, k)), rest[part::each]).inflation() for part in range(each))
    told = square > np.maximum(np.maximum(blind, tiny), own**2)
    inverse = np.where(told, 1.0 / np.where(told, square, 1.0), 0.0)
    x = start + scale * (V @ (inverse * along))
    sd = scale * np.sqrt(V**2 @ inverse) * own
    lost = (V[:, ~told] ** 2).sum(axis=1)
    untold = tuple(_named(column, names) for column in V[:, ~told].T)
    known = lost < KEPT
    return Told(x, np.where(known, sd, 0.0), tuple(known.tolist()), untold, y - A @ x)


def spread(
    A: Floats,
    y: Floats,
    told: Told,
    scale: Floats,
    names: Sequence[str],
    by: Sequence[Floats],
    each: int = 1,
    weights: Floats | None = None,
    noise: Floats | None = None,
) -> Floats:
    """What the unknowns differ by, sd, shape (k,), where a model does not have the shape of what it is fitted to.

    Half of what those of the smaller half and of the larger half of each of `by`, shape (n,), differ by, beyond noise.
    """
    total = np.zeros(len(scale))
    for size in by:
        halves = []
        for half in (size <= np.median(size), size > np.median(size)):
            own = None if weights is None else weights[half]
            halves.append(solved(A[half], y[half], told.x, scale, names, each, own, noise))
        differ = 0.5 * np.abs(halves[1].x - halves[0].x)
        scatter = 0.5 * np.hypot(halves[0].sd, halves[1].sd)
        both = np.array(halves[0].known) & np.array(halves[1].known) & np.array(told.known)
        total += np.where(both, np.maximum(differ**2 - scatter**2, 0.0), 0.0)
    return np.sqrt(total)


def _named(direction: Floats, names: Sequence[str]) -> tuple[str, ...]:
    order = np.argsort(-np.abs(direction))
    return tuple(names[k] for k in order if abs(direction[k]) > PART)

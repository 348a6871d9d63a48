"""Least squares that know what the data do not tell: directions without information keep the value they began with.

Unknowns are counted in units of a `scale`, by which each is worth knowing. The equations tell a direction if its
standard deviation is less than that; along every other one the start stays as it is, and the direction is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.commission.least_squares import Fit
from bench.commission.window import Booleans, Floats

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


@dataclass(frozen=True)
class Equations:
    """y = A x: A of shape (n, k), y of shape (n,), in the order of time."""

    A: Floats
    y: Floats
    scale: Floats
    """(k,): see the module."""
    names: Sequence[str]
    each: int = 1
    """So many rows belong together and follow each other."""
    weights: Floats | None = None
    """(n,)"""
    noise: Floats | None = None
    """(k, k): covariance of what noise adds to a row of A: it would make coefficients too small, and tells nothing."""

    def of(self, which: Booleans) -> Equations:
        """Some of them."""
        weights = None if self.weights is None else self.weights[which]
        return replace(self, A=self.A[which], y=self.y[which], weights=weights)


def solved(equations: Equations, start: Floats) -> Told:
    """Minimise the squares of weights (y - A x) from `start`. Fewer rows than unknowns: all is kept."""
    A, y, scale, names, each = equations.A, equations.y, equations.scale, equations.names, equations.each
    n, k = A.shape
    w = np.ones(n) if equations.weights is None else equations.weights
    if n <= k:
        return Told(start, np.zeros(k), (False,) * k, tuple((name,) for name in names), y - A @ start)
    scaled, target = A * scale * w[:, None], (y - A @ start) * w
    noise = np.zeros((k, k)) if equations.noise is None else n * equations.noise * np.outer(scale, scale)
    square, V = np.linalg.eigh(scaled.T @ scaled - noise)
    along = V.T @ (scaled.T @ target + noise @ (start / scale))  # what noise times the start has taken from it
    least = np.maximum(LEAST_SIGNAL * np.einsum("ij,ij->j", V, noise @ V), 1e-12 * float(square.max()))
    rest = target - scaled @ (V @ np.where(square > least, along / np.maximum(square, least), 0.0))
    sigma = float(np.sqrt(rest @ rest / (n - k)))
    own = sigma * max(Fit(start, np.zeros((k, k)), rest[part::each]).inflation() for part in range(each))
    told = square > np.maximum(least, own**2)
    inverse = np.where(told, 1.0 / np.where(told, square, 1.0), 0.0)
    x = start + scale * (V @ (inverse * along))
    sd = scale * np.sqrt(V**2 @ inverse) * own
    known = (V[:, ~told] ** 2).sum(axis=1) < KEPT
    untold = tuple(_named(column, names) for column in V[:, ~told].T)
    return Told(x, np.where(known, sd, 0.0), tuple(known.tolist()), untold, y - A @ x)


def spread(equations: Equations, told: Told, by: Sequence[Floats]) -> Floats:
    """What the unknowns differ by, sd, shape (k,), where a model does not have the shape of what it is fitted to.

    Half of what those of the smaller half and of the larger half of each of `by`, shape (n,), differ by, beyond noise.
    """
    total = np.zeros(len(told.x))
    for size in by:
        small, large = (
            solved(equations.of(half), told.x) for half in (size <= np.median(size), size > np.median(size))
        )
        differ, scatter = 0.5 * np.abs(large.x - small.x), 0.5 * np.hypot(small.sd, large.sd)
        both = np.array(small.known) & np.array(large.known) & np.array(told.known)
        total += np.where(both, np.maximum(differ**2 - scatter**2, 0.0), 0.0)
    return np.sqrt(total)


def _named(direction: Floats, names: Sequence[str]) -> tuple[str, ...]:
    order = np.argsort(-np.abs(direction))
    return tuple(names[k] for k in order if abs(direction[k]) > PART)

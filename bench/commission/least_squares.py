"""Least squares with covariance: linear ones, and curves; and what correlated residuals do to an interval."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from bench.commission.window import Floats


@dataclass(frozen=True)
class Fit:
    """A fitted x, shape (k,), its covariance (k, k) by the scatter of the residuals, and these, shape (n,).

    `residuals` are y - f(x), each times its weight.
    """

    x: Floats
    covariance: Floats
    residuals: Floats

    @property
    def sd(self) -> Floats:
        """Standard deviation of each of x, shape (k,), of residuals that are independent."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def inflation(self, most: int | None = None) -> float:
        """By how much each sd grows because residuals, in the order of time, resemble the ones before; at least 1.

        It is the root of 1 + 2 times the sum of their correlations, up to the first that is within its own noise, and
        `most` lags at most (None: a tenth of them).
        """
        r = self.residuals - self.residuals.mean()
        n, power = len(r), float(r @ r)
        if n < 8 or power == 0.0:
            return 1.0
        total = 1.0
        for lag in range(1, (max(1, n // 10) if most is None else most) + 1):
            correlation = float(r[lag:] @ r[:-lag]) / power
            if correlation < 2.0 / math.sqrt(n):
                break
            total += 2.0 * correlation
        return math.sqrt(total)

    def informed(self, k: int, value: float, sd: float) -> Fit:
        """With what else is known of coefficient k: `value`, give or take `sd`. The residuals are those of before."""
        inflated = self.inflation() ** 2
        share = self.covariance[:, k] / (self.covariance[k, k] + sd**2 / inflated)
        x = self.x + share * (value - self.x[k])
        return Fit(x, self.covariance - np.outer(share, self.covariance[k]), self.residuals)


def fit(A: Floats, y: Floats, weights: Floats | None = None) -> Fit:
    """Minimise the squares of weights (y - A x): A of shape (n, k), y and weights of shape (n,).

    Columns may be of any size. ValueError where there are no more rows than columns, or columns depend on each other.
    """
    n, k = A.shape
    if n <= k:
        raise ValueError(f"{n} equations for {k} unknowns leave no residual to tell the scatter by")
    w = np.ones(n) if weights is None else weights
    weighted, target = A * w[:, None], y * w
    scale = np.linalg.norm(weighted, axis=0)
    if not np.all(scale > 0.0):
        raise ValueError("a column is 0: its coefficient cannot be told")
    x, _, rank, _ = np.linalg.lstsq(weighted / scale, target, rcond=1e-10)
    if rank < k:
        raise ValueError(f"{k} unknowns, and the equations tell {rank} of them apart")
    x = x / scale
    residuals = target - weighted @ x
    inverse = np.linalg.inv((weighted / scale).T @ (weighted / scale)) / np.outer(scale, scale)
    return Fit(x, inverse * float(residuals @ residuals) / (n - k), residuals)


def fit_curve(curve: Callable[[Floats], Floats], start: Floats, y: Floats, sd: Floats) -> Fit:
    """Minimise the squares of (y - curve(x)) / sd from `start`, shape (k,); y, sd and the curve of shape (n,).

    The sd of y counts as they are, and more where the residuals are larger than they say; never less.
    """
    scale = np.maximum(np.abs(start), 1e-12)
    found = least_squares(lambda x: (y - curve(x)) / sd, start, x_scale=scale)
    inverse = np.linalg.pinv((found.jac * scale).T @ (found.jac * scale)) * np.outer(scale, scale)
    excess = max(1.0, 2.0 * found.cost / max(len(y) - len(start), 1))
    return Fit(found.x, inverse * excess, found.fun)

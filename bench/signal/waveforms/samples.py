"""What every measurement does first: look whether the samples are fit, and fit columns to them.

Never repairs anything: no interpolation over gaps, no removal of outliers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

JITTER = 0.1
"""How far an interval may be from the mean one, as a share of it: a rounded timer tick is less, a lost sample more."""


def checked(**arrays: ArrayLike) -> list[Floats]:
    """`arrays` as float64 of one shape (n,), n >= 2, in the order given.

    Raises ValueError, with the keyword as the name, for another shape, for fewer than 2 samples and for NaN or inf.
    """
    values = {name: np.asarray(array, dtype=np.float64) for name, array in arrays.items()}
    (first, shape), *_ = ((name, array.shape) for name, array in values.items())
    for name, array in values.items():
        if array.ndim != 1 or len(array) < 2:
            raise ValueError(f"{name}: needs the shape (n,) with n >= 2, got {array.shape}")
        if array.shape != shape:
            raise ValueError(f"{name}: {len(array)} samples, but {first} has {shape[0]}")
        if bad := int(np.count_nonzero(~np.isfinite(array))):
            raise ValueError(f"{name}: {bad} of {len(array)} samples are NaN or infinite: leave that stretch out")
    return list(values.values())


def sample_period(t: Floats) -> float:
    """Mean interval in s of the times `t` (n,). Raises ValueError where they do not rise uniformly, to within 10 %."""
    intervals = np.diff(t)
    mean = float(t[-1] - t[0]) / len(intervals)
    worst = int(np.argmax(np.abs(intervals - mean)))
    if not mean > 0 or abs(intervals[worst] - mean) > JITTER * mean:
        raise ValueError(
            f"t is not uniform: {intervals[worst]:.4g} s after t = {t[worst]:.6g} s, {mean:.4g} s in the mean: "
            "take a stretch without a gap"
        )
    return mean


def least_squares(columns: Floats, y: Floats) -> Floats:
    """Coefficients (k,) with which `columns` (n, k), of norms alike, come nearest to `y` (n,); normal equations."""
    return np.asarray(np.linalg.lstsq(columns.T @ columns, columns.T @ y, rcond=None)[0], dtype=np.float64)

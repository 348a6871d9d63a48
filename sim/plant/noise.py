"""Repeatable noise: a 64-bit xorshift generator and a table of normal quantiles.

A draw picks one of `SIZE` equally likely quantiles of the standard normal distribution: exact in its moments to
1e-3, nothing beyond 3.7 sigma, and a few nanoseconds a draw. The same seed gives the same noise on every machine.

Not for statistics of rare events, and not for cryptography.
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from sim.native import Pointer
from sim.numba_cache import kernel

BITS = 12
SIZE = 1 << BITS
_MASK = np.uint64(SIZE - 1)
_13, _7, _17 = np.uint64(13), np.uint64(7), np.uint64(17)
_FIRST, _SECOND, _THIRD = np.uint64(52), np.uint64(40), np.uint64(28)
_ELEVEN = np.uint64(11)


@cache
def table() -> NDArray[np.float64]:
    """The quantiles at (k + 1/2) / SIZE, scaled to variance 1; shape (SIZE,), not to be written to."""
    normal = NormalDist()
    half = np.array([normal.inv_cdf((k + 0.5) / SIZE) for k in range(SIZE // 2)])
    quantiles: NDArray[np.float64] = np.concatenate([half, -half[::-1]])
    quantiles /= quantiles.std()
    quantiles.flags.writeable = False
    return quantiles


def seeded(seed: int) -> np.uint64:
    """The generator's state for a seed: any integer, near ones give unlike states (splitmix64)."""
    x = (seed + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
    x = ((x ^ (x >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
    x = ((x ^ (x >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
    return np.uint64((x ^ (x >> 31)) or 1)


@kernel
def advance(state: np.uint64) -> np.uint64:
    """The generator's next state (xorshift64, Marsaglia 2003, DOI 10.18637/jss.v008.i14)."""
    state ^= state << _13
    state ^= state >> _7
    state ^= state << _17
    return state


@kernel
def first(quantiles: Pointer[float], state: np.uint64) -> float:
    """A standard normal number from a state."""
    return float(quantiles[int(state >> _FIRST)])


@kernel
def second(quantiles: Pointer[float], state: np.uint64) -> float:
    """A second one from other bits of the same state."""
    return float(quantiles[int((state >> _SECOND) & _MASK)])


@kernel
def third(quantiles: Pointer[float], state: np.uint64) -> float:
    """A third one."""
    return float(quantiles[int((state >> _THIRD) & _MASK)])


@kernel
def uniform(state: np.uint64) -> float:
    """A number from [0, 1) from a state; not together with normal ones from the same state."""
    return float(state >> _ELEVEN) * 2.0**-53

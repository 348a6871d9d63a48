"""Uniform numbers for the drives of a study: any drive's can be had by itself, the same whenever they are asked for."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError

F64 = NDArray[np.float64]

SOBOL, LATIN, RANDOM, SALTELLI = "sobol", "latin hypercube", "random", "saltelli"
SAMPLINGS = (SOBOL, LATIN, RANDOM, SALTELLI)
BLOCK = 4096
"""Drives whose numbers are made at once, where they can be made in pieces."""
MOST_WHOLE = 1 << 20  # drives of a plan that can only be made as a whole


class Points:
    """`of(samples)`: numbers (n, dimensions) between 0 and 1 for the drives with these numbers.

    Sobol's sequence and random numbers go on where more drives are asked for: those before stay what they were.

    Args:
        sampling: of `SAMPLINGS`.
        drives: how many there are. For Saltelli's estimates at most: there are N (dimensions + 2), N a power of 2.
        dimensions: numbers of each.
        seed: any whole number from 0.
    """

    def __init__(self, sampling: str, drives: int, dimensions: int, seed: int) -> None:
        self.sampling, self._dimensions, self._seed = sampling, dimensions, seed
        self.drives = drives
        self._block: tuple[int, F64] = -1, np.empty((0, dimensions))
        if sampling in (LATIN, SALTELLI) and drives > MOST_WHOLE:
            raise BenchError(f"{sampling} takes at most {MOST_WHOLE} drives, got {drives}: take {SOBOL}")
        if sampling == SALTELLI:
            each = dimensions + 2
            if drives < 2 * each:
                raise BenchError(f"{SALTELLI} needs at least {2 * each} drives for {dimensions} figures, got {drives}")
            self.drives = each * 2 ** math.floor(math.log2(drives / each))

    def of(self, samples: Sequence[int]) -> F64:
        """See the class."""
        if self.sampling in (LATIN, SALTELLI) or not self._dimensions:
            found: F64 = self._whole[np.asarray(samples, int)]
            return found
        return np.array([self._in_block(*divmod(sample, BLOCK)) for sample in samples]).reshape(-1, self._dimensions)

    def _in_block(self, block: int, at: int) -> F64:
        if self._block[0] != block:
            self._block = block, self._made(block)
        found: F64 = self._block[1][at]
        return found

    def _made(self, block: int) -> F64:
        if self.sampling == RANDOM:
            return np.random.default_rng([self._seed, block]).random((BLOCK, self._dimensions))
        from scipy.stats import qmc

        sequence = qmc.Sobol(self._dimensions, rng=np.random.default_rng(self._seed))
        if block:  # by nothing it cannot
            sequence.fast_forward(block * BLOCK)
        found: F64 = sequence.random(BLOCK)
        return found

    @cached_property
    def _whole(self) -> F64:
        if not self._dimensions:
            return np.empty((self.drives, 0))
        if self.sampling == LATIN:
            from scipy.stats import qmc

            cube = qmc.LatinHypercube(self._dimensions, rng=np.random.default_rng(self._seed))
            latin: F64 = cube.random(self.drives)
            return latin
        try:
            from SALib.sample import sobol
        except ImportError:
            raise BenchError(f"{SALTELLI} needs SALib: pip install 'hallbench[study]'") from None
        n = self._dimensions
        problem = {"num_vars": n, "names": [str(k) for k in range(n)], "bounds": [[0.0, 1.0]] * n}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found: F64 = sobol.sample(problem, self.drives // (n + 2), calc_second_order=False, seed=self._seed)
        return found


def noise_seed(seed: int, sample: int, repetition: int) -> int:
    """The seed of a drive's noise: its own for each repetition, the same in every design."""
    return int(np.random.SeedSequence([seed, sample, repetition]).generate_state(1)[0])

"""Uniform numbers: those of a drive are the same whenever they are asked for, and spread as promised."""

from __future__ import annotations

import numpy as np
import pytest

from bench.errors import BenchError
from bench.study.sampling import BLOCK, SAMPLINGS, Points, noise_seed


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_drive_has_its_numbers_by_itself(sampling: str) -> None:
    n = Points(sampling, 200, 3, 7).drives
    together = Points(sampling, 200, 3, 7).of(range(n))
    alone = Points(sampling, 200, 3, 7)
    order = np.random.default_rng(1).permutation(n)[:50]
    assert np.array_equal(np.array([alone.of([k])[0] for k in order]), together[order])
    assert ((together >= 0.0) & (together <= 1.0)).all()
    assert not np.array_equal(together, Points(sampling, 200, 3, 8).of(range(n)))


@pytest.mark.parametrize("sampling", ["sobol", "random"])
def test_more_drives_leave_those_before_as_they_were(sampling: str) -> None:
    few, many = (Points(sampling, n, 2, 3) for n in (10, 3 * BLOCK))
    assert np.array_equal(few.of(range(10)), many.of(range(10)))
    across = many.of([BLOCK - 1, BLOCK, 2 * BLOCK + 5])
    assert np.array_equal(across, many.of(range(3 * BLOCK))[[BLOCK - 1, BLOCK, 2 * BLOCK + 5]])


def test_sobol_goes_on_over_blocks_as_one_sequence() -> None:
    from scipy.stats import qmc

    whole = qmc.Sobol(2, rng=np.random.default_rng(3)).random(2 * BLOCK)
    assert np.array_equal(Points("sobol", 2 * BLOCK, 2, 3).of(range(2 * BLOCK)), whole)


def test_latin_hypercubes_have_one_drive_in_each_stratum() -> None:
    got = Points("latin hypercube", 50, 4, 1).of(range(50))
    assert np.array_equal(np.sort((got * 50).astype(int), 0), np.repeat(np.arange(50)[:, None], 4, 1))


def test_saltelli_changes_one_figure_at_a_time() -> None:
    points = Points("saltelli", 100, 3, 1)
    assert points.drives == 80  # 16 x (3 + 2)
    got = points.of(range(80)).reshape(16, 5, 3)
    for a, *mixed, b in got:
        for k, one in enumerate(mixed):
            assert [one[j] == (b if j == k else a)[j] for j in range(3)] == [True] * 3


def test_too_few_and_too_many_drives_are_refused() -> None:
    with pytest.raises(BenchError, match="at least 10 drives for 3 figures, got 9"):
        Points("saltelli", 9, 3, 1)
    with pytest.raises(BenchError, match="at most 1048576 drives"):
        Points("latin hypercube", 2_000_000, 3, 1)


def test_each_drive_and_repetition_has_a_noise_of_its_own() -> None:
    seeds = {noise_seed(1, sample, repetition) for sample in range(300) for repetition in range(3)}
    assert len(seeds) == 900
    assert noise_seed(1, 5, 0) == noise_seed(1, 5, 0) != noise_seed(2, 5, 0)


def test_a_study_that_varies_nothing_has_drives_all_the_same() -> None:
    assert Points("sobol", 5, 0, 1).of([0, 4]).shape == (2, 0)

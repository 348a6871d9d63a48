"""The covariance kept as its upper half, against numpy's full matrices."""

import numpy as np
import pytest

from sim.observers import covariance

UPPER = np.triu_indices(5)


def packed(matrix):
    return tuple(matrix[UPPER].tolist())


def full(values):
    matrix = np.zeros((5, 5))
    matrix[UPPER] = values
    return matrix + np.triu(matrix, 1).T


@pytest.fixture
def P():
    root = np.random.default_rng(1).normal(size=(5, 5))
    return root @ root.T


def test_a_correction_is_that_of_a_kalman_filter(P):
    rng = np.random.default_rng(2)
    h, r, x, z = rng.normal(size=5), 0.7, rng.normal(size=5), 1.3
    g = covariance.across(packed(P), tuple(h))
    s = 1.0 / (h @ g + r)
    gain = P @ h / (h @ P @ h + r)
    assert np.allclose(covariance.times(s, g), gain)
    assert np.allclose(covariance.added(tuple(x), g, s * z), x + gain * z)
    assert np.allclose(full(covariance.less(packed(P), g, s)), (np.eye(5) - np.outer(gain, h)) @ P)


def test_a_diagonal_and_what_is_added_to_one(P):
    assert np.array_equal(full(covariance.diagonal(1.0, 2.0, 3.0, 4.0, 5.0)), np.diag([1.0, 2.0, 3.0, 4.0, 5.0]))
    more = full(covariance.plus(packed(P), (1.0, 2.0, 3.0, 4.0, 5.0)))
    assert np.allclose(more, P + np.diag([1.0, 2.0, 3.0, 4.0, 5.0]))

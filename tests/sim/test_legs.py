"""The loss of three legs, beside numpy's."""

import numpy as np
import pytest

from sim import legs

TURN = np.exp(2j * np.pi / 3)


def by_phases(i, at):
    """The vector of the phase currents' signs, each fading below `at`, from its definition."""
    return 2 / 3 * sum(np.clip((i * TURN**-k).real / at, -1, 1) * TURN**k for k in range(3))


@pytest.mark.parametrize("size", [0.05, 0.29, 0.31, 0.6, 2.0, 9.0])
def test_a_shape_and_its_fundamental(size):
    at, n = 0.3, 3600
    i = size * np.exp(2j * np.pi * np.arange(n) / n)
    shapes = [legs.shape(v.real, v.imag, size, 1 / at) for v in i]
    assert [complex(s.alpha, s.beta) for s in shapes] == pytest.approx(by_phases(i, at), abs=1e-12)
    fundamental = np.mean(by_phases(i, at) * np.conj(i)) / size**2
    assert [s.by for s in shapes] == pytest.approx(np.full(n, fundamental.real), rel=8e-3)
    rest = [complex(*legs.harmonics(s, v.real, v.imag)) for s, v in zip(shapes, i, strict=True)]
    assert np.mean(rest * np.conj(i)) / size == pytest.approx(0.0, abs=0.01)


def test_the_ripple_goes_with_the_voltage_and_is_never_nothing():
    assert legs.per_ripple(2.0, 2.8, 1 / 0.3) == pytest.approx(2.8 / (0.18 * 2.0))
    assert legs.per_ripple(0.0, 2.8, 1 / 0.3) == pytest.approx(1 / (0.03 * 0.3))


def test_how_much_there_is_of_each_is_what_least_squares_say():
    """A turn after another, each with noise; beside one solution of all of them with the first covariance as prior."""
    rng = np.random.default_rng(3)
    per_turn, prior, weight = 60, 0.2, 1 / 0.05**2
    known, found = (prior, 0.0, prior), np.zeros(2)
    rows, volts = [], []
    for _ in range(5):
        shapes = rng.normal(size=(per_turn, 2, 2))  # sample, shape, alpha or beta
        v = np.einsum("ksa,s->ka", shapes, [0.13, -0.3]) + rng.normal(scale=0.05, size=(per_turn, 2))
        rows.append(shapes.transpose(0, 2, 1).reshape(-1, 2))
        volts.append(v.ravel())
        sums = legs.none()
        for shape, seen in zip(shapes, v - np.einsum("ksa,s->ka", shapes, found), strict=True):
            sums = legs.along(sums, *seen, tuple(shape[0]), tuple(shape[1]))
        full, near, known = legs.solved(known, sums, prior, 0.0, weight)
        found += (full, near)
    A, y = np.concatenate(rows), np.concatenate(volts)
    information = weight * A.T @ A + np.eye(2) / prior
    assert found == pytest.approx(np.linalg.solve(information, weight * A.T @ y))
    covariance = np.linalg.inv(information)
    assert known == pytest.approx((covariance[0, 0], covariance[0, 1], covariance[1, 1]))


def test_what_is_known_grows_old_but_no_older_than_unknown():
    known = legs.solved((1e-4, 0.0, 1e-4), legs.none(), 0.2, 0.1, 1.0)[2]
    assert known == pytest.approx((0.1001, 0.0, 0.1001))
    assert legs.solved(known, legs.none(), 0.2, 0.15, 1.0)[2] == pytest.approx((0.2, 0.0, 0.2))

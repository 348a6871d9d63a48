"""Intervals of quantities, against drawn gains; least squares, against numpy's polynomials and known correlations."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bench.commission.least_squares import fit, fit_curve
from bench.commission.quantity import Converters, Quantity


@pytest.mark.parametrize(("volts", "amperes"), [(1.0, -1.0), (1.0, 0.0), (1.0, 1.0), (0.0, 0.0), (0.0, 1.0)])
def test_the_absolute_interval_is_that_of_drives_with_drawn_gains(volts: float, amperes: float) -> None:
    """The gain of the currents is the mean of three phases', each drawn."""
    rng, n, truth = np.random.default_rng(4), 200_000, 0.2
    converters = Converters(volts=0.004, amperes=0.006)
    g_u, g_i = 1 + rng.normal(0, 0.004, n), 1 + rng.normal(0, 0.006, (n, 3)).mean(axis=1)
    values = truth * g_u**volts * g_i**amperes + rng.normal(0, 5e-4, n)
    quantity = Quantity("R_s", "Ω", truth, {"noise": 3e-4, "method": 4e-4}, volts, amperes)
    assert quantity.sd == pytest.approx(5e-4)
    assert quantity.absolute(converters) == pytest.approx(values.std(), rel=0.02)
    inside = np.mean(np.abs(values - truth) < quantity.absolute_half_width(converters))
    assert inside == pytest.approx(0.95, abs=0.005)


def test_the_largest_part_is_named() -> None:
    quantity = Quantity("psi_f", "V s", 0.01, {"noise": 1e-6, "method": 3e-5}, volts=1.0)
    assert quantity.dominated_by == "method"
    assert quantity.absolutely_dominated_by(Converters()) == "gain of the DC link voltage"
    assert quantity.absolutely_dominated_by(Converters(volts=1e-4)) == "method"
    assert Quantity("n_p", "1", 6.0).dominated_by == ""
    assert Quantity("n_p", "1", 6.0).covers(6.0)


def test_a_linear_fit_is_that_of_a_polynomial() -> None:
    rng = np.random.default_rng(1)
    x = np.linspace(2.0, 9.0, 40)
    sd = rng.uniform(0.1, 2.0, 40)
    y = 3.0 - 0.5 * x + 0.1 * x**2 + rng.normal(0, sd)
    found = fit(np.vander(x, 3), y, 1.0 / sd)
    expected, covariance = np.polyfit(x, y, 2, w=1.0 / sd, cov=True)
    assert found.x == pytest.approx(expected, rel=1e-9)
    assert found.covariance == pytest.approx(covariance, rel=1e-6)


def test_columns_of_any_size_are_told_apart() -> None:
    """A resistance times amperes, volts, and a warming times thousands of A2 s: ten powers of ten between them."""
    rng = np.random.default_rng(2)
    A = rng.normal(0, 1, (60, 3)) * np.array([1e-4, 1.0, 1e6])
    truth = np.array([2e3, 0.3, 4e-8])
    found = fit(A, A @ truth + rng.normal(0, 1e-3, 60))
    assert np.all(np.abs(found.x - truth) < 4 * found.sd)


@pytest.mark.parametrize("columns", [np.ones((8, 2)), np.zeros((8, 2)), np.ones((2, 2))])
def test_equations_that_do_not_tell_are_refused(columns: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"unknowns|column"):
        fit(columns, np.arange(len(columns), dtype=float))


@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6, 0.8])
def test_residuals_that_go_together_widen_as_an_autoregression_does(rho: float) -> None:
    """The mean of n samples of one has the variance (1 + rho) / (1 - rho) / n, times that of a sample."""
    rng, widths = np.random.default_rng(3), []
    for _ in range(40):
        x = np.zeros(600)
        for k in range(1, 600):
            x[k] = rho * x[k - 1] + rng.normal()
        widths.append(fit(np.ones((600, 1)), x).inflation())
    assert np.mean(widths) == pytest.approx(math.sqrt((1 + rho) / (1 - rho)), rel=0.12)


def test_a_curve_covers_the_truth_as_often_as_it_says() -> None:
    rng, x = np.random.default_rng(5), np.linspace(0.1, 0.7, 8)
    sd = np.full(8, 2e-3)
    inside = 0
    for _ in range(300):
        y = 1.0 / (1.0 + 0.4 * x**2) + rng.normal(0, sd)
        found = fit_curve(lambda q: q[0] / (1.0 + q[1] * x**2), np.array([0.9, 0.1]), y, sd)
        inside += abs(found.x[0] - 1.0) < 1.96 * found.sd[0]
    assert 275 <= inside <= 300  # 95 %, and more where the residuals are larger than their sd


def test_a_curve_whose_residuals_are_larger_than_their_sd_is_less_sure() -> None:
    rng, x = np.random.default_rng(6), np.linspace(0.0, 1.0, 50)
    y = 2.0 * x + 1.0 + rng.normal(0, 0.1, 50)
    line = lambda q: q[0] * x + q[1]  # noqa: E731
    sure, unsure = (fit_curve(line, np.ones(2), y, np.full(50, sd)) for sd in (0.1, 0.01))
    assert unsure.sd == pytest.approx(sure.sd, rel=0.4)

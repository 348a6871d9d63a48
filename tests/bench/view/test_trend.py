from __future__ import annotations

import numpy as np
import pytest

from bench.view.trend import TrendBinner


@pytest.mark.parametrize("cut", [1, 7, 160, 800])
def test_bands_hold_every_peak_and_means_the_mean_however_the_run_is_cut(cut: int) -> None:
    rng = np.random.default_rng(3)
    n, bin_ns = 4321, 10_000_000
    t = 1_234_567 + np.arange(n, dtype=np.int64) * 62_500
    values = rng.normal(size=(3, n)).astype(np.float32)
    binner = TrendBinner(bin_ns, bands=2, lot=10)
    parts = [binner.add(t[i : i + cut], values[:, i : i + cut]) for i in range(0, n, cut)] + [binner.rest()]
    found = [part for part in parts if part is not None]
    times = np.concatenate([part[0] for part in found])
    rows = np.concatenate([part[1] for part in found], axis=1)
    bins = t // bin_ns
    assert (times[::2] == np.unique(bins) * bin_ns).all()
    assert (times[1::2] == times[::2] + bin_ns // 2).all()
    for k, number in enumerate(np.unique(bins)):
        inside = values[:, bins == number]
        assert (rows[:2, 2 * k] == inside[:2].min(axis=1)).all()
        assert (rows[:2, 2 * k + 1] == inside[:2].max(axis=1)).all()
        np.testing.assert_allclose(rows[2, 2 * k : 2 * k + 2], inside[2].mean(), atol=1e-5)


def test_an_empty_binner_has_nothing_left() -> None:
    assert TrendBinner(10, 1, 10).rest() is None

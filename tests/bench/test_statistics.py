"""Running statistics against numpy on the whole data."""

import math

import numpy as np
import pytest

from bench.device.counters import DeviceCounters
from bench.signal.percentiles import Percentiles
from bench.signal.position import Moments, wrap
from tests.bench.view.synthetic import heartbeat


def test_moments_merged_in_chunks_are_those_of_the_whole() -> None:
    values = np.random.default_rng(1).normal(3.0, 0.5, 10_001) * 1e-3
    moments = Moments()
    for part in np.array_split(values, [0, 1, 17, 4000, 4000, 9999]):
        moments.add(part)
    assert moments.n == len(values)
    assert moments.mean == pytest.approx(values.mean(), rel=1e-12)
    assert moments.std == pytest.approx(values.std(), rel=1e-9)
    assert moments.peak == np.abs(values).max()


def test_moments_of_nothing_are_not_a_number() -> None:
    assert math.isnan(Moments().std)


def test_percentiles_of_numbers_that_come_one_by_one_are_within_a_fifth_of_a_percent() -> None:
    values = np.random.default_rng(2).lognormal(-3, 1, 20_000)
    percentiles = Percentiles()
    for value in values:
        percentiles.add(value)
    for percent in (1, 50, 95, 99, 100):
        assert percentiles.at(percent) == pytest.approx(np.percentile(values, percent), rel=2e-3 + 1e-3)


def test_percentiles_weigh_by_count() -> None:
    percentiles = Percentiles()
    percentiles.add(0.010, 99)
    percentiles.add(0.5, 1)
    assert percentiles.n == 100
    assert percentiles.at(98.9) == pytest.approx(0.010, rel=1e-12)
    assert percentiles.at(100) == pytest.approx(0.5, rel=1e-12)


def test_wrap_covers_the_half_open_turn() -> None:
    assert wrap(np.array([0.0, math.pi, -math.pi, 3 * math.pi, 7.0])) == pytest.approx(
        [0.0, -math.pi, -math.pi, -math.pi, 7.0 - 2 * math.pi]
    )


def test_a_devices_counts_are_those_since_the_first_heartbeat_and_go_on_over_a_reboot() -> None:
    device = DeviceCounters()
    assert not device.seen
    for boot_id, dropped, bad, rejected in ((1, 900, 5, 0), (1, 900, 6, 0), (1, 912, 6, 0), (2, 3, 0, 1)):
        device.add(heartbeat(0, boot_id=boot_id, tx_dropped=dropped, rx_bad=bad, setpoints_rejected=rejected))
    assert device.seen
    assert device.risen == {"tx_dropped": 12 + 3, "rx_bad": 1, "setpoints_rejected": 1}

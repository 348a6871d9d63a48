import math

import numpy as np
import pytest

from sim.observers.transforms import clarke, wrap


@pytest.mark.parametrize("turns", [-1000, -20, -3, -1, 0, 1, 2, 19, 1000])
def test_wrap_keeps_the_direction_and_the_range(turns):
    for angle in (*np.linspace(-np.pi, np.pi, 51), -math.pi - 1e-15, math.pi + 1e-15):
        wrapped = wrap(angle + 2 * math.pi * turns)
        assert -math.pi <= wrapped < math.pi
        assert abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-11


def test_clarke_is_as_long_as_the_phase_peaks_and_drops_a_common_part():
    for angle in np.linspace(0, 6, 13):
        phases = [5.0 * math.cos(angle - 2 * math.pi / 3 * k) for k in range(3)]
        expected = pytest.approx((5.0 * math.cos(angle), 5.0 * math.sin(angle)), abs=1e-12)
        assert clarke(*phases) == expected
        assert clarke(*(p + 0.7 for p in phases)) == expected

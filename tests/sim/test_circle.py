"""Cosine and sine in one, beside those of the C library; compiled code makes the same bits (test_tick)."""

import math

import numpy as np
import pytest

from sim.circle import FAR, cos_sin

RNG = np.random.default_rng(5)


@pytest.mark.parametrize("largest", [1e-9, 0.1, math.pi, 40.0, 0.99 * FAR, 1e9])
def test_agrees_with_the_c_library(largest):
    for angle in [*RNG.uniform(-largest, largest, 3000), -largest, largest]:
        cos, sin = cos_sin(float(angle))
        assert abs(cos - math.cos(angle)) < 2.3e-16
        assert abs(sin - math.sin(angle)) < 2.3e-16


def test_every_quarter_and_its_borders():
    for eighth in range(-32, 33):
        for off in (-1e-12, 0.0, 1e-12):
            angle = eighth * math.pi / 4.0 + off
            assert cos_sin(angle) == pytest.approx((math.cos(angle), math.sin(angle)), abs=2.3e-16)


def test_no_angle_has_no_cosine():
    assert np.isnan(cos_sin(math.nan)).all()

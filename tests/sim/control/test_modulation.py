import math

import numpy as np
import pytest

from sim.control import modulation
from sim.observers.transforms import clarke

ANGLES = np.linspace(0, 2 * np.pi, 241)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.0])
@pytest.mark.parametrize("u_dc", [12.0, 24.0])
def test_duties_make_the_voltage_over_the_whole_linear_range(share, u_dc):
    """No harmonics: what the duties give is the reference, at every angle, up to u_dc / sqrt(3)."""
    u = share * u_dc / math.sqrt(3)
    for angle in ANGLES:
        d = modulation.duties(u * math.cos(angle), u * math.sin(angle), u_dc)
        assert min(d) >= 0
        assert max(d) <= 1
        made = clarke(*(u_dc * x for x in d))
        assert made == pytest.approx((u * math.cos(angle), u * math.sin(angle)), abs=1e-12 * u_dc)
        assert max(d) + min(d) == pytest.approx(1.0)  # centred


def test_the_linear_limit_is_the_circle_in_the_hexagon():
    limit = modulation.linear_limit(24.0)
    assert limit == pytest.approx(13.856, abs=1e-3)
    tightest = max(max(modulation.duties(limit * math.cos(a), limit * math.sin(a), 24.0)) for a in ANGLES)
    assert tightest == pytest.approx(1.0, abs=1e-9)


def test_past_the_hexagon_duties_are_clipped():
    d = modulation.duties(0.0, 40.0, 24.0)
    assert max(d) == 1.0
    assert min(d) == 0.0


@pytest.mark.parametrize("u_dc", [0.0, -1.0])
def test_without_a_link_voltage_all_phases_are_alike(u_dc):
    assert modulation.duties(3.0, 4.0, u_dc) == (0.5, 0.5, 0.5)

import numpy as np
import pytest
from ideal_motor import (
    PAPER_EDGES,
    T_S,
    TABLE_I,
    TICK_HZ,
    constant,
    error_deg,
    estimate,
    rpm,
    samples,
    signals,
    table,
)

from sim.observers import lookup_table

WIDTH = np.diff(np.r_[PAPER_EDGES, 360 + PAPER_EDGES[0]])  # deg, of sector 0..5


def passed_edges(s):
    """How many edges each sample has seen."""
    return np.searchsorted(s.edge_tick, s.tick, side="right")


def test_each_way_has_its_own_boundaries():
    """Hysteresis: the edges lie elsewhere downwards. A table for upwards alone errs by the shift."""
    hysteresis = 2.0
    s = signals(constant(rpm(-500)), 0.3, edges_deg=PAPER_EDGES - hysteresis)
    settled = passed_edges(s) >= 2
    right = error_deg(s.theta, estimate(lookup_table, s, **table(TABLE_I, TABLE_I + hysteresis)).theta)[settled]
    assert np.abs(right).max() < 0.01
    wrong = error_deg(s.theta, estimate(lookup_table, s, **table()).theta)[settled]
    np.testing.assert_allclose(wrong, -hysteresis, atol=0.01)


WAYS = {
    "forwards": constant(rpm(500)),
    "backwards": constant(rpm(-500)),
    "a stop": lambda t: rpm(200) * np.minimum(t, 0.1),
    "a start": lambda t: 2.0 + 3500.0 * np.maximum(t - 0.02, 0) ** 2,
    "a start backwards": lambda t: 2.0 - 3500.0 * np.maximum(t - 0.02, 0) ** 2,
}


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_an_empty_table_is_the_average_speed(way):
    """So what is proved here of a standstill, an edge that is overdue and the two bounds is true of that, too."""
    s = signals(way, 0.4, edges_deg=PAPER_EDGES, fine=10)
    seen = samples(s)
    out = estimate(lookup_table, s)
    np.testing.assert_allclose(error_deg(seen.theta_avg, out.theta), 0, atol=1e-9)
    np.testing.assert_allclose(out.omega, seen.hall.omega, rtol=1e-12)


@pytest.mark.parametrize("sector", [2, 1], ids=["wide", "narrow"])
def test_an_overdue_edge_and_standstill(sector):
    """A stop in a sector's middle: the far boundary where it truly is, width by age for a speed; then the centre."""
    omega = rpm(200)
    stop = (PAPER_EDGES[sector] + 360 + WIDTH[sector] / 2 - np.degrees(0.3)) / np.degrees(omega)
    s = signals(lambda t: 0.3 + omega * np.minimum(t, stop), stop + 0.3, edges_deg=PAPER_EDGES, fine=10)
    out = estimate(lookup_table, s, **table())
    age = (s.tick - s.edge_tick[-1]) / TICK_HZ
    waiting = (age > np.radians(WIDTH[sector]) / omega + T_S) & (age < 0.2)
    over = age > 0.2 + T_S
    assert over.sum() > 100
    far = np.radians(PAPER_EDGES[(sector + 1) % 6])
    np.testing.assert_allclose(error_deg(far, out.theta[waiting]), 0, atol=1e-9)
    np.testing.assert_allclose(out.omega[waiting], np.radians(WIDTH[sector]) / age[waiting], rtol=1e-9)
    centre = np.radians(PAPER_EDGES[sector] + WIDTH[sector] / 2)
    np.testing.assert_allclose(error_deg(centre, out.theta[over]), 0, atol=1e-9)
    assert set(out.omega[over]) == {0.0}


def test_a_table_that_leaves_a_sector_no_width():
    """Boundaries on top of each other, and even crossed: the speed of such a sector is zero, and nothing divides."""
    for offset in (30.0, 60.0):
        s = signals(constant(rpm(500)), 0.1)
        out = estimate(lookup_table, s, **table(np.array([offset, -offset, offset, 0, 0, 0])))
        assert np.isfinite(out.theta).all()
        settled = passed_edges(s) >= 2
        assert out.omega[settled].min() == 0.0
        # the sector after that one is wider by the offset
        assert out.omega[settled].max() == pytest.approx(rpm(500) * (60 + offset) / 60, rel=1e-3)

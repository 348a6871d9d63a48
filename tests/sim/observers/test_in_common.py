"""What several observers do alike on the ideal motor's signals: each by the same formula."""

import math

import numpy as np
import pytest
from ideal_motor import (
    IDEAL_EDGES,
    L_S,
    PAPER_EDGES,
    PSI_F,
    PWM_HZ,
    R_S,
    TICK_HZ,
    TICKS,
    constant,
    error_deg,
    estimate,
    quantised,
    ramp,
    rpm,
    samples,
    signals,
    table,
    turning_back,
)

from sim.observers import (
    by_front_end,
    edge_kalman,
    hall_vector,
    hall_vector_decoupled,
    load_angle,
    lookup_table,
    programmable_filter,
    sector_centre,
    vector_tracking,
    vector_tracking_q15,
)
from tests.choice import chosen

SPEEDS = (50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 3000.0)  # r/min
CHOSEN = chosen("constant speed", [way * speed for speed in SPEEDS for way in (1, -1)], 4)
EXACT = {  # where the edges are, deg, and told; of the angle, ticks and deg; of the speed, ticks in a sector and share
    by_front_end: (IDEAL_EDGES, {}, 3.0, 0.0, 1.1, 0.0),
    lookup_table: (PAPER_EDGES, table(), 4.0, 0.0, 2.3, 0.0),
    programmable_filter: (IDEAL_EDGES, {}, 1.0, 1e-6, 1.1, 0.0),
    vector_tracking: (IDEAL_EDGES, {}, 0.0, 0.02, 0.0, 1e-3),
    vector_tracking_q15: (IDEAL_EDGES, {}, 0.0, 0.1, 0.0, 1e-2),
    edge_kalman: (PAPER_EDGES, table(), 0.0, 0.2, 0.0, 1e-3),
}


BY_BACK_EMF = (vector_tracking, programmable_filter, vector_tracking_q15)


def observed(observer, s, **drive):
    """Estimates over the signals, which a drive's telemetry has rounded for the observer in integers."""
    return estimate(observer, quantised(s) if observer is vector_tracking_q15 else s, **drive)


def named(module):
    return module.__name__.rpartition(".")[2]


by_back_emf = pytest.mark.parametrize("observer", BY_BACK_EMF, ids=named)


@pytest.mark.parametrize("speed", CHOSEN)
@pytest.mark.parametrize("observer", EXACT, ids=named)
def test_exact_on_ideal_signals(observer, speed):
    edges_deg, told, ticks, deg, omega_ticks, share = EXACT[observer]
    omega = rpm(speed)
    s = signals(constant(omega), 0.2 + 5 * 2 * np.pi / abs(omega), edges_deg=edges_deg, i_q=4.0)
    out = observed(observer, s, **told)
    settled = s.tick > TICK_HZ // 10 + 2 * 2 * np.pi / abs(omega) * TICK_HZ
    tick_deg = np.degrees(abs(omega)) / TICK_HZ
    assert np.abs(error_deg(s.theta, out.theta))[settled].max() < ticks * tick_deg + deg
    np.testing.assert_allclose(out.omega[settled], omega, rtol=omega_ticks * tick_deg / 60.0 + share)


@pytest.mark.parametrize("speed", [way * speed for speed in (500.0, 2000.0) for way in (1, -1)])
@pytest.mark.parametrize("factor", [0.92, 1.08])
@by_back_emf
def test_a_wrong_inductance_is_a_load_angle_and_a_wrong_resistance_is_none(observer, factor, speed):
    """E + error of the model = omega (psi + j (L - L_hat) i_q): an angle of atan((L_hat - L) i_q / psi)."""
    s = signals(constant(rpm(speed)), 0.4, i_q=8.0)
    expected = np.degrees(math.atan((factor - 1) * L_S * 8.0 / PSI_F))
    assert abs(expected) > 0.9
    for wrong, shift in (({"L_s_hat": factor * L_S}, expected), ({"R_s_hat": (3 * factor - 2) * R_S}, 0.0)):
        out = observed(observer, s, **wrong)
        assert out.on[-800:].all()
        assert error_deg(s.theta, out.theta)[-800:].mean() == pytest.approx(shift, abs=0.03)


@by_back_emf
def test_back_emf_is_used_from_one_speed_on_and_until_another(observer):
    """Slowly up through omega_on and down through omega_off; what it does before and after stays inside the sector."""
    s = signals(ramp((0, 0), (3, 30), (6, 0)), 5.9, i_q=1.0)
    out, seen = observed(observer, s), samples(s)
    started, stopped = np.flatnonzero(np.diff(out.on)) + 1
    assert seen.hall.omega[started] >= 20.0 > seen.hall.omega[started - 2]
    assert s.tick[started] - s.edge_tick[np.searchsorted(s.edge_tick, s.tick[started]) - 1] <= 2 * TICKS
    assert seen.hall.omega[stopped] < 12.0 <= seen.hall.omega[stopped - 2]
    assert np.abs(error_deg(s.theta, out.theta))[started + 800 : stopped].max() < 3
    centre = np.radians(60 * seen.hall.sector + 30)
    assert np.abs(error_deg(centre, out.theta))[out.on == 0].max() <= 30 + 0.01


@by_back_emf
def test_without_a_reference_voltage_the_edges_lead(observer):
    """Outputs off, the rotor coasting: no current, and a voltage at the motor that nobody commanded."""
    s = signals(constant(rpm(500)), 0.6, i_q=0.0, edges_deg=PAPER_EDGES, noise=0.02)
    off = s.tick > 0.3 * TICK_HZ
    out = observed(observer, s._replace(u_alpha=np.where(off, 0, s.u_alpha), u_beta=np.where(off, 0, s.u_beta)))
    assert out.on[4000:].tolist() == (~off[4000:]).tolist()
    later = s.tick > 0.35 * TICK_HZ
    assert np.abs(error_deg(samples(s).theta_avg, out.theta))[later].max() < 0.01
    assert out.omega[-1] == pytest.approx(rpm(500), rel=0.15)


@pytest.mark.parametrize("speed", CHOSEN)
@pytest.mark.parametrize("edges_deg", [IDEAL_EDGES, PAPER_EDGES], ids=["ideal", "table I"])
def test_the_centre_of_the_sector_leaves_a_sawtooth_over_each(edges_deg, speed):
    """Mean, std and largest error over a turn, of sectors held at 60 s + 30 deg: exact."""
    begin = edges_deg - (60.0 * np.arange(6) + 30.0)
    end = np.r_[edges_deg[1:], 360.0 + edges_deg[0]] - (60.0 * np.arange(6) + 30.0)
    mean, square = np.sum(end**2 - begin**2) / 2 / 360, np.sum(end**3 - begin**3) / 3 / 360
    largest = max(np.abs(begin).max(), np.abs(end).max())
    turn = 2 * np.pi / abs(rpm(speed))
    s = signals(constant(rpm(speed)), 10.7 * turn, edges_deg=edges_deg)
    out = estimate(sector_centre, s)
    error = error_deg(s.theta, out.theta)[s.tick < 10 * turn * TICK_HZ]
    a_period = np.degrees(abs(rpm(speed))) / PWM_HZ
    assert error.mean() == pytest.approx(mean, abs=0.02 + 0.2 * a_period)
    assert error.std() == pytest.approx(np.sqrt(square - mean**2), abs=0.02 + 0.05 * a_period)
    assert largest - 1.01 * a_period < np.abs(error).max() < largest + 1e-6
    assert np.array_equal(out.omega, samples(s).hall.omega)


def test_no_angle_before_a_legal_code_and_none_lost_by_a_gap():
    s = signals(constant(rpm(50), np.radians(70)), 0.02)
    hall, reset = s.hall.copy(), np.arange(s.hall.size) == 100
    hall[:3] = 7
    seen = s._replace(hall=hall)
    out = estimate(sector_centre, seen, reset)
    assert set(out.theta[:3]) == {0.0}
    np.testing.assert_allclose(out.theta[3:], np.pi / 2, rtol=1e-12)


ALL = (*EXACT, sector_centre, load_angle, hall_vector, hall_vector_decoupled)
RINGS = chosen("how the ring is turned", [30.0, 17.0, -75.0, 180.0, -180.0, 90.0, -123.4, 59.0, -1.0], 2)


@pytest.mark.parametrize("ring_deg", RINGS)
@pytest.mark.parametrize("observer", ALL, ids=named)
def test_a_ring_that_is_turned_with_the_rotor_leaves_the_same_errors(observer, ring_deg):
    """Stator and ring have no preferred direction: all turned alike, errors are what they were, from start to reversal.

    But for rounding to integers, and for the legs of the inverter, which stay where they are: the Kalman filter's.
    """
    alike = {vector_tracking_q15: 1.0, edge_kalman: 0.05}.get(observer, 0.01)  # deg; a tick is worth 0.001
    turn = np.radians(ring_deg)

    def errors(by):
        way = turning_back(rpm(400), 0.4, 2000.0, 0.6)
        s = signals(lambda t: way(t) + by, 1.2, i_q=3.0, edges_deg=PAPER_EDGES + np.degrees(by), fine=10)
        return error_deg(s.theta, observed(observer, s, **table(), hall_offset=by).theta)

    assert np.abs((errors(turn) - errors(0.0) + 180.0) % 360.0 - 180.0).max() < alike

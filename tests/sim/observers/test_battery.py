"""Every observer of the catalogue in the same scenarios, within limits on both sides: better than known is news too."""

from pathlib import Path

import numpy as np
import pytest
from battery import HALF_HYSTERESIS, INSIDE, MISPLACED, SCENARIOS, STANDSTILL, Tape, limits
from ideal_motor import N_P, PWM_HZ, TABLE_I, error_deg

from sim.observers.catalogue import CATALOGUE
from tests.sim.drive.rig import RPM

LIMITS = limits((Path(__file__).parents[2] / "data" / "battery.txt").read_text())
"""What was measured, means over five seeds: std and largest size of the error, deg; of the sudden stop the time, ms, in
which it is seen, and the largest error. `python tests/sim/observers/battery.py` prints such a table. The lap taught
`ek` where the edges lie, which it does not know before a start or after a gap; `lut` is told. "-": nothing claimed."""
FLOORS = 0.15, 0.6  # what the figures may differ by however small they are
CENTRES = np.array([np.nan, 30.0, 150.0, 90.0, 270.0, 330.0, 210.0, np.nan])  # deg, of the sectors, by Hall code


@pytest.fixture(scope="module", params=SCENARIOS)
def recorded(request):
    """The scenario's name and its recordings, shared by all observers."""
    return request.param, SCENARIOS[request.param].record()


@pytest.fixture(scope="module")
def at_rest():
    (recording,) = STANDSTILL.record()
    return recording


@pytest.mark.parametrize("name", CATALOGUE)
def test_errors_are_within_limits(name, recorded):
    label, recordings = recorded
    scenario = SCENARIOS[label]
    estimates = [one.estimates(name, scenario.believed) for one in recordings]
    for out in estimates:
        assert np.isfinite(out.omega).all()
        assert ((out.theta >= -np.pi) & (out.theta < np.pi)).all()
    if (known := LIMITS.get((label, CATALOGUE[name].short))) is not None:
        found = scenario.figures(recordings, estimates)
        margins = np.maximum(np.multiply(scenario.tolerance, known), FLOORS)
        assert np.all(np.abs(np.subtract(found, known)) <= margins), f"{name}, {label}: {found}, known are {known}"
    if label.startswith("steady"):
        (one,), (out,) = recordings, estimates
        # the sectors' mean width by time lies 0.8 to 1.2 % above 60 deg with the sensors of Table I
        assert out.omega[one.scored].mean() == pytest.approx(float(label.split()[1]) * RPM * N_P, rel=0.015)


@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize("recorded", ["start 400", "start -400"], indirect=True)
def test_before_the_second_edge_a_start_knows_the_sector(name, recorded):
    """At first its middle; then no more than half a sector and the misplacement of an edge away, wherever it goes."""
    for one in recorded[1]:
        error = one.error(one.estimates(name))
        assert abs(error[0]) == pytest.approx(30.0 - INSIDE, abs=MISPLACED)
        assert np.abs(error[: one.edge_samples[1]]).max() <= 30.0 + MISPLACED


@pytest.mark.parametrize("name", CATALOGUE)
def test_at_standstill_nothing_drifts(name, at_rest):
    """One second at 4 A: the angle stays where it is, inside the sector that the sensors show, and nothing turns."""
    out = at_rest.estimates(name)
    theta, omega = out.theta[at_rest.scored], out.omega[at_rest.scored]
    assert np.ptp(at_rest.theta[at_rest.scored]) == 0.0
    assert np.degrees(np.ptp(theta)) <= 0.15
    assert np.abs(omega).max() <= 0.01
    centre = np.radians(CENTRES[at_rest.samples.code[at_rest.scored]])
    assert np.abs(error_deg(centre, theta)).max() <= MISPLACED  # of the ideal sector: the true one's middle is nearer
    assert np.abs(at_rest.error(out)[at_rest.scored]).max() <= 30.0 + MISPLACED


@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize("recorded", ["sudden stop"], indirect=True)
def test_a_blocked_rotor_stands_once_edges_are_long_overdue(name, recorded):
    """After the time-out: no speed, and an angle in the sector. How long the speed takes to fall is in the table."""
    ((one,), drive) = recorded[1], recorded[1][0].drive
    out = one.estimates(name)
    stopped = int(np.argmax(one.scored))
    assert abs(one.omega[stopped - 1]) == pytest.approx(1000 * RPM * N_P, rel=1e-3)
    assert np.all(one.omega[stopped:] == 0.0)
    late = stopped + round((drive["hall_timeout"] + 0.05) * PWM_HZ)
    assert np.abs(out.omega[late:]).max() <= 0.01
    assert np.abs(one.error(out)[late + PWM_HZ // 10 :]).max() <= 30.0 + MISPLACED


@pytest.mark.parametrize("recorded", ["steady 500", "reversal", "glitches"], indirect=True)
def test_a_host_repeats_the_drive_bit_for_bit_from_telemetry(recorded):
    """Raw samples and edges in, float64 estimates equal to the last bit."""
    for one in recorded[1]:
        assert np.array_equal(one.estimates("vector_tracking").theta, one.theta_vt)


@pytest.mark.parametrize("believed", [{}, {"R_s_hat": 1.3, "L_s_hat": 1.2, "psi_f_hat": 0.9}], ids=["true", "wrong"])
def test_what_is_learned_is_where_the_edges_lie_each_way(believed):
    """Forwards an edge is met half the hysteresis later than backwards."""
    tape = Tape(3)
    for rpm in (1000, -700):
        tape.forced(rpm, 2.0, 1.5)
        tape.forced(rpm, 6.0, 0.5)
        tape.forced(rpm / 10, 4.0, 0.5)
    state, out = tape.recording().run("edge_kalman", believed)
    up, down = -np.degrees(state.lessons.places.actual).reshape(2, 6)
    assert up == pytest.approx(TABLE_I - HALF_HYSTERESIS, abs=0.4)
    assert up - down == pytest.approx(-2 * HALF_HYSTERESIS, abs=0.35)
    assert (np.count_nonzero(state.lessons.places.visits), out.sensors[-1]) == (12, 0)


@pytest.mark.parametrize("recorded", ["glitches", "gaps"], indirect=True)
def test_there_are_glitches_and_gaps(recorded):
    """Were there none, the limits would not show it, as they would for a reversal, a load, a harder braking."""
    label, (one,) = recorded
    edges = one.scored[one.edge_samples].sum()
    turned = np.abs(np.diff(one.theta))[one.scored[1:]].sum() / (np.pi / 3)
    if label == "glitches":
        assert (edges - turned) / 2 == pytest.approx(0.6 * 50.0, rel=0.5)
    else:
        assert one.reset.sum() == 7
        assert np.ptp(one.theta[one.reset][1:] % (2 * np.pi)) > np.pi


def test_every_observer_has_its_column_and_every_scenario_its_row():
    """Otherwise: print the table, as said there, and add them."""
    assert set(LIMITS) == {(label, entry.short) for label in SCENARIOS for entry in CATALOGUE.values()}

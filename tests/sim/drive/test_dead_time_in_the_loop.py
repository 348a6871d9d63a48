"""The dead time that the firmware learns, against the one that the plant has."""

import numpy as np
import pytest

from sim.config.params import load_params
from tests.bench.accept.benches import drawn
from tests.sim.observers.proving import BENCH_24V, Proving, thd, worst

LESSONS = ((100, 4, 1.5), (150, 8, 1.5), (200, 2, 1.0), (120, 6, 1.5))
"""r/min, A, s."""


def taught(source, overrides=None, factors=None, seed=31):
    bench = Proving(source, load_params(None, overrides or {}), seed, factors)
    bench.set_param("dead_time_learn", 1)
    for lesson in LESSONS:
        run = bench.forced(*lesson)
    return bench, run


@pytest.mark.parametrize("source", ["encoder", "vector_tracking", "edge_kalman"])
def test_a_dead_time_that_nobody_told_is_learned_under_any_angle(source):
    bench, run = taught(source, factors={"dead_time_comp": 0.0})
    assert run["dead_time_left"][-1] == pytest.approx(1e-6, rel=0.15)
    learned = thd(bench.at(300, 4))
    bench.set_param("dead_time_learn", 0)
    assert learned < 0.5 * thd(bench.at(300, 4))


@pytest.mark.parametrize("told", [0.5, 1.0, 1.5])
def test_what_was_told_and_what_was_learned_make_up_the_plants(told):
    bench, run = taught("encoder", {"inverter.dead_time": 2e-6}, {"dead_time_comp": told})
    whole = bench.parameters["dead_time_hat"] * bench.parameters["dead_time_comp"] + run["dead_time_left"][-1]
    assert whole == pytest.approx(2e-6, rel=0.1)


def test_an_error_by_the_current_at_each_edge_becomes_smaller_though_it_has_neither_shape():
    overrides = {"inverter.dead_time_by_edges": 1}
    bench, _ = taught("encoder", overrides)
    learned = [thd(bench.at(rpm, 4)) for rpm in (200, 300, 500)]
    bench.set_param("dead_time_learn", 0)
    plain = [thd(bench.at(rpm, 4)) for rpm in (200, 300, 500)]
    assert np.all(np.array(learned) < np.array(plain))


@pytest.mark.parametrize("number", [61, 62, 63])
def test_of_a_motor_that_nobody_looked_at_it_makes_vector_tracking_no_worse(number):
    def found(learn):
        bench = Proving("vector_tracking", load_params(None, drawn(number)), 31)
        bench.set_param("dead_time_learn", learn)
        bench.teach()
        points = [(speed * bench.top, load * bench.i_max) for speed in (0.05, 0.1, 0.3) for load in (0.25, 1.0)]
        return worst([bench.figures(bench.at(*point)) for point in points]).std

    assert found(1) < 1.02 * found(0)


@pytest.mark.parametrize("source", ["average_speed", "lookup_table", "hall_vector", "programmable_filter"])
def test_a_coarse_angle_does_not_lead_it_astray(source):
    _, run = taught(source, factors={"dead_time_comp": 0.0})
    assert run["dead_time_left"][-1] == pytest.approx(1e-6, rel=0.2)
    assert abs(run["dead_time_near"][-1]) < 0.2e-6


def test_a_current_that_jumps_from_sector_to_sector_teaches_nothing():
    _, run = taught("sector_centre", factors={"dead_time_comp": 0.0})
    assert not run["dead_time_left"].any()
    assert not run["dead_time_near"].any()


@pytest.mark.parametrize("seed", [51, 52])
def test_on_an_unkind_bench_what_was_learned_at_one_speed_and_current_holds_at_another(seed):
    bench = Proving("encoder", load_params(BENCH_24V), seed)
    bench.set_param("dead_time_learn", 1)
    found = []
    for point in ((100, 4), (150, 8), (200, 2), (300, 5), (120, 3)):
        run = bench.at(*point)
        found.append((run["dead_time_left"][-1], run["dead_time_near"][-1]))
    later = np.array(found[1:])
    assert np.ptp(later, axis=0).max() < 0.25e-6
    assert later[:, 1].min() > 0.6e-6


def test_switched_off_it_learns_nothing():
    bench = Proving("encoder", load_params(None, {}), 31, {"dead_time_comp": 0.0})
    run = bench.forced(100, 4, 2.0)
    assert not run["dead_time_left"].any()
    assert not run["dead_time_near"].any()


def test_it_keeps_what_it_learned_while_the_outputs_are_off():
    bench, run = taught("encoder", factors={"dead_time_comp": 0.0})
    from protocol.messages import DriveState

    bench.enter_state(DriveState.IDLE)
    assert bench.run(0.2)["dead_time_left"][-1] == run["dead_time_left"][-1]

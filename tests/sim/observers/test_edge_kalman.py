"""The observer on signals straight from the motor's equations."""

from itertools import product

import numpy as np
import pytest
from ideal_motor import (
    L_S,
    PAPER_EDGES,
    PSI_F,
    PWM_HZ,
    R_S,
    T_S,
    TABLE_I,
    TICKS,
    constant,
    error_deg,
    own,
    ramp,
    rpm,
    run,
    samples,
    signals,
    table,
)

from sim.observers import edge_kalman, edge_lessons
from tests.choice import chosen


def make(**drive):
    return edge_kalman.make_params(PWM_HZ, own(edge_kalman, **drive))


def estimate(s, **drive):
    """Last state and all estimates."""
    return run(edge_kalman, make(**drive), samples(s))


def errors(s, out, settled=0.5):
    """Errors in degrees over the last part of a run, from the share `settled` on."""
    return error_deg(s.theta, out.theta)[int(settled * s.tick.size) :]


def deltas(state, way=1):
    return -np.degrees(state.lessons.places.actual[:6] if way > 0 else state.lessons.places.actual[6:])


@pytest.mark.parametrize("speed", chosen("learned", (500.0, 1000.0, 3000.0, -500.0, -1000.0, -3000.0), 2))
def test_edges_that_nobody_told_are_learned_and_leave_no_error(speed):
    s = signals(constant(rpm(speed)), 1.0, edges_deg=PAPER_EDGES)
    state, out = estimate(s)
    # one speed and one load: a seventh of the edges' mean misplacement of 1 deg may as well be L_s, saturation, delay
    assert np.abs(errors(s, out)).max() < 0.25
    assert out.omega[-1] == pytest.approx(rpm(speed), rel=1e-3)
    assert (out.unused[-1], out.sensors[-1]) == (0, 0)
    assert deltas(state, int(np.sign(speed))) == pytest.approx(TABLE_I, abs=0.25)
    assert np.count_nonzero(state.lessons.places.visits) == 6


@pytest.mark.parametrize("seed", chosen("edges to learn", range(20), 2))
def test_learned_with_noise_at_speed_and_used_at_low_speed(seed):
    """20 mA of noise: learn at 1000 r/min, then 60 r/min, where the learned edges lead."""
    edges_deg = np.arange(6) * 60.0 - np.random.default_rng(seed).uniform(-15, 15, 6)
    fast, slow = rpm(1000), rpm(60)
    s = signals(ramp((0, fast), (2, fast), (2.1, slow), (4, slow)), 3.9, edges_deg=edges_deg, noise=0.02)
    state, out = estimate(s)
    assert deltas(state) == pytest.approx(np.arange(6) * 60.0 - edges_deg, abs=1.0)  # the ring as a whole
    assert np.count_nonzero(state.lessons.places.visits) == 6
    late = error_deg(s.theta, out.theta)[int(2.6 / T_S) :]
    assert 0.01 < late.std() < 0.1
    assert np.abs(late).max() < 1.1


def test_given_edges_are_used_at_once_and_held():
    s = signals(constant(rpm(40)), 0.5, edges_deg=PAPER_EDGES)
    _, unknown = estimate(s, learn_edges=0.0)
    state, known = estimate(s, learn_edges=0.0, **table())
    assert np.abs(errors(s, unknown)).max() > 1.0
    assert np.abs(errors(s, known)).max() < 0.2
    assert deltas(state) == pytest.approx(TABLE_I, abs=1e-9)


def test_edges_that_are_told_are_kept_by_how_sure_they_are():
    """A back-EMF that lies 2 deg off, by a wrong inductance at one load, does not turn edges that are surely known."""
    s = signals(constant(rpm(700)), 1.0, i_q=6.0, edges_deg=PAPER_EDGES)
    off = {
        sd: deltas(estimate(s, L_s_hat=1.25 * L_S, edge_sd=np.radians(sd), **table())[0]).mean() - TABLE_I.mean()
        for sd in (0.1, 1.0, 5.0)
    }
    assert abs(off[0.1]) < 0.05
    assert abs(off[0.1]) < abs(off[1.0]) < abs(off[5.0])
    assert abs(off[5.0]) > 0.5


def lessons(out, every=1):
    """What came last of each, of a stream of every n-th sample."""
    return {
        edge_lessons.LESSONS[k]: (v, sd)
        for k, v, sd in zip(out.lesson[::every], out.learned[::every], out.learned_sd[::every], strict=True)
    }


@pytest.mark.parametrize("every", chosen("every", (1, 2, 3, 5, 8, 10, 16, 20, 32, 50, 64, 100), 4))
def test_all_lessons_are_told_in_a_stream_of_every_nth_sample(every):
    s = signals(constant(rpm(1000)), 1.5, i_q=4.0, edges_deg=PAPER_EDGES)
    state, out = estimate(s, R_s_hat=1.2 * R_S)
    told = lessons(out, every)
    assert tuple(sorted(told)) == tuple(sorted(edge_lessons.LESSONS))
    assert np.degrees([told[name][0] for name in edge_lessons.EDGES[:6]]) == pytest.approx(deltas(state), abs=0.05)


def test_what_is_told_is_as_sure_as_it_is_true():
    """Of all that the ideal motor is told wrongly, after two loads, each is within three deviations."""
    n = round(4.0 * PWM_HZ)
    i_q = np.where(np.arange(n) // 8000 % 2 == 0, 1.0, 6.0)
    s = signals(constant(rpm(700)), 4.0, i_q=i_q, edges_deg=PAPER_EDGES, noise=0.02)
    _, out = estimate(s, L_s_hat=1.2 * L_S, R_s_hat=1.3 * R_S, psi_f_hat=0.95 * PSI_F)
    truth = dict(zip(edge_lessons.LESSONS, [*np.radians(TABLE_I), *np.radians(TABLE_I), PSI_F, R_S, L_S], strict=True))
    at_first, told = lessons(out[:64]), lessons(out)
    for name, (value, sd) in told.items():
        assert abs(value - truth[name]) < 3.0 * sd, name
        assert sd > 0.0
    assert np.degrees(at_first["edge_up_1"][1]) == pytest.approx(6.0)
    assert np.degrees(told["edge_up_1"][1]) < 1.5
    assert told["psi_f_hat"][1] < 0.1 * PSI_F  # at one speed a voltage drop is not told from it
    assert told["R_s_hat"][1] < 0.05 * R_S
    assert told["L_s_hat"][1] < 0.25 * L_S


def test_learning_held_learns_nothing():
    s = signals(constant(rpm(1000)), 1.0, edges_deg=PAPER_EDGES)
    state, _ = estimate(s, learn_edges=0.0, R_s_hat=1.3 * R_S)
    before, _ = run(edge_kalman, make(learn_edges=0.0, R_s_hat=1.3 * R_S), samples(s)[:1])
    assert np.count_nonzero(state.lessons.places.visits) == 0
    assert state.lessons == before.lessons._replace(places=state.lessons.places)
    assert state.lessons.places == before.lessons.places._replace(pair=state.lessons.places.pair)


def test_a_current_that_steps_turns_no_shaft_whose_inertia_is_not_known():
    """And does where it is: a speed that stays is then the surprise."""
    n = round(4.0 * PWM_HZ)
    i_q = np.where(np.arange(n) // 8000 % 2 == 0, 2.0, 8.0)
    s = signals(constant(rpm(150)), 4.0, i_q=i_q, noise=0.02)
    assert np.abs(errors(s, estimate(s, J_hat=0.0)[1])).max() < 0.5


@pytest.mark.parametrize(("speed", "broken"), chosen("broken", product((100.0, -1000.0), (1, 2, 4, 3, 6)), 4))
def test_runs_on_with_two_sensors_and_with_one(broken, speed):
    """Wires open from 1.5 s on: the inputs read 1."""
    s = signals(constant(rpm(speed)), 3.0, edges_deg=PAPER_EDGES, noise=0.02)
    k = int(1.5 / T_S)
    hall = s.hall | np.uint8(broken) * (s.tick >= s.tick[k])
    edge_hall = s.edge_hall | np.uint8(broken) * (s.edge_tick >= s.tick[k])
    real = np.r_[True, edge_hall[1:] != edge_hall[:-1]]
    s = s._replace(hall=hall, edge_tick=s.edge_tick[real], edge_hall=edge_hall[real])
    _, out = estimate(s)
    four_turns = round(4 * 2 * np.pi / abs(rpm(speed)) / T_S)
    assert out.sensors[[k, k + four_turns, -1]].tolist() == [0, broken, broken]
    assert np.abs(error_deg(s.theta, out.theta)[int(1.0 / T_S) :]).max() < 0.5


def test_a_sensor_that_moves_is_flagged_followed_and_harms_nothing():
    """Sensor a by 9 deg at 1.5 s."""
    moved = PAPER_EDGES + 9.0 * np.array([0, 0, 1, 0, 0, 1])
    before = signals(constant(rpm(800)), 3.0, edges_deg=PAPER_EDGES, noise=0.02)
    after = signals(constant(rpm(800)), 3.0, edges_deg=moved, noise=0.02)
    cut = int(1.5 / T_S)
    late = before.edge_tick <= before.tick[cut]
    late_2 = after.edge_tick > before.tick[cut]
    s = before._replace(
        hall=np.r_[before.hall[: cut + 1], after.hall[cut + 1 :]],
        edge_tick=np.r_[before.edge_tick[late], after.edge_tick[late_2]],
        edge_hall=np.r_[before.edge_hall[late], after.edge_hall[late_2]],
    )
    state, out = estimate(s)
    assert out.sensors[cut] == 0
    assert out.sensors[-1] == 8
    assert deltas(state) == pytest.approx(np.arange(6) * 60.0 - moved, abs=1.0)
    assert np.abs(error_deg(s.theta, out.theta)[cut - 1000 :]).max() < 2.0


def test_pulses_within_a_period_change_next_to_nothing_and_are_counted():
    s = signals(constant(rpm(300)), 1.0, edges_deg=PAPER_EDGES, noise=0.02)
    rng = np.random.default_rng(1)
    periods = rng.choice(np.arange(10, s.tick.size - 10), 300, replace=False)
    begin = periods * TICKS + 300
    near = np.searchsorted(s.edge_tick, begin - 2 * TICKS) != np.searchsorted(s.edge_tick, begin + 2 * TICKS)
    begin = np.sort(begin[~near])
    codes = s.hall[begin // TICKS]
    tick = np.r_[s.edge_tick, begin, begin + 60]
    hall = np.r_[s.edge_hall, codes ^ (1 << rng.integers(0, 3, begin.size)).astype(np.uint8), codes]
    order = np.argsort(tick, kind="stable")
    _, plain = estimate(s)
    _, disturbed = estimate(s._replace(edge_tick=tick[order], edge_hall=hall[order]))
    off = np.abs(error_deg(plain.theta, disturbed.theta))  # one may pass for the begin of a bounce
    assert np.all(off < np.maximum(0.1, 0.1 * np.degrees(plain.sigma)))
    assert plain.unused[-1] == 0
    assert disturbed.unused[-1] == 2 * begin.size > 400


def test_a_level_that_is_wrong_for_two_samples_is_an_edge_far_off():
    s = signals(constant(rpm(1000)), 1.0, edges_deg=PAPER_EDGES)
    k = next(k for k in range(8000, 9000) if np.ptp(s.hall[k - 4 : k + 9].astype(int)) == 0 and s.hall[k] == 2)
    codes = s.hall.copy()
    codes[k : k + 3] ^= 4  # sensor c is 90 deg from its boundaries in the middle of sector 2
    at = np.searchsorted(s.edge_tick, s.tick[k])
    edge_tick = np.insert(s.edge_tick, at, [s.tick[k] - 100, s.tick[k + 3] - 100])
    edge_hall = np.insert(s.edge_hall, at, [codes[k], s.hall[k]])
    _, out = estimate(s._replace(hall=codes, edge_tick=edge_tick, edge_hall=edge_hall))
    assert out.unused[-1] == 2
    assert np.abs(errors(s, out)).max() < 0.3


def test_without_voltage_the_edges_lead():
    """Outputs off: nothing of a back-EMF in u and i, but d current that dies away. 500 r/min, edges learned before."""
    s = signals(constant(rpm(500)), 2.0, edges_deg=PAPER_EDGES)
    off = s.tick >= TICKS * PWM_HZ
    dying = np.zeros(s.tick.size)
    dying[PWM_HZ : PWM_HZ + 4] = 8.0, 6.0, 4.0, 2.0
    phases = {name: dying * np.cos(s.theta - 2 * np.pi / 3 * k) for k, name in enumerate(("i_a", "i_b", "i_c"))}
    left = {"u_alpha": 0.0, "u_beta": 0.0, **phases}
    s = s._replace(**{name: np.where(off, value, getattr(s, name)) for name, value in left.items()})
    for J_hat, most in ((0.0, 1.0), (2e-4, 4.0)):  # kg m2; a free shaft would slow down
        _, out = estimate(s, J_hat=J_hat)
        assert np.abs(error_deg(s.theta, out.theta)[PWM_HZ - 100 :]).max() < most


@pytest.mark.parametrize("speed", chosen("half a turn off", (60.0, 100.0, -400.0, 800.0, -1500.0, 3000.0), 2))
def test_an_observer_that_is_half_a_turn_off_finds_back_within_an_electrical_revolution(speed):
    s = signals(constant(rpm(speed)), 1.5, edges_deg=PAPER_EDGES, noise=0.02)
    seen = samples(s)
    cut = PWM_HZ // 2
    state, _ = run(edge_kalman, make(), seen[:cut])
    theta, *rest = state.filter.x
    away = float((theta + 2 * np.pi) % (2 * np.pi) - np.pi)
    turned = state._replace(filter=state.filter._replace(x=(away, *rest)))
    _, out = run(edge_kalman, make(), seen[cut:], state=turned)
    error = error_deg(s.theta[cut:], out.theta)
    assert np.abs(error[0]) > 170
    assert np.abs(error[round(2 * np.pi / abs(rpm(speed)) / T_S) :]).max() < 3.0
    assert np.abs(error[-1600:]).max() < 1.0

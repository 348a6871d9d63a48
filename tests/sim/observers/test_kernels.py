"""What all observers have in common: the same bits by step, by run and uncompiled, parameters that are zero."""

import hashlib
from functools import cache
from importlib import import_module
from itertools import pairwise

import numpy as np
import pytest
from ideal_motor import (
    PAPER_EDGES,
    PWM_HZ,
    TICK_HZ,
    changed,
    constant,
    own,
    quantised,
    rpm,
    run,
    samples,
    signals,
    table,
)

from sim.native import value
from sim.observers import edge_kalman, sample
from sim.observers.catalogue import CATALOGUE
from sim.observers.entry import DEFAULTS, names
from sim.observers.hall_edges import EDGES
from sim.observers.sample import FrontEnd, Sample
from tests.choice import also_in, chosen

MODULES = [name for name in CATALOGUE if name != "average_speed"]  # which is the front end's
OBSERVERS = [import_module(f"sim.observers.{name}") for name in MODULES]
EACH = pytest.mark.parametrize("observer", OBSERVERS, ids=MODULES)
OPTIONAL = {*EDGES, "inject", "inject_amplitude", "inject_hz", "learn_edges", "edge_sd", "i_range", "hall_offset"}
WINDOW = 100  # samples
TOLD = {"k_ic": 11.0, **table()}


def busy():
    """Standstill, start, 400 r/min, back through zero, a stop; misplaced sensors, noise, glitches, lost edges."""
    a, omega = 5000.0, rpm(400)
    up = omega / a

    def angle(t):
        speed_up = np.clip(t - 0.05, 0, up)
        steady = np.clip(t - 0.05 - up, 0, 0.1)
        turning = np.clip(t - 0.15 - up, 0, 2 * up)
        back = np.clip(t - 0.15 - 3 * up, 0, 0.1)
        return 0.4 + a * (speed_up**2 - turning**2) / 2 + omega * (steady + turning - back)

    s = signals(angle, 0.6, i_q=5.0, edges_deg=PAPER_EDGES, fine=10, noise=0.02, seed=7)
    rng = np.random.default_rng(3)
    keep = np.ones(s.edge_tick.size, bool)
    keep[20] = False
    tick = np.r_[s.edge_tick[keep], s.edge_tick[8] + 100, s.edge_tick[8] + 140]
    code = np.r_[s.edge_hall[keep], np.uint8(7), s.edge_hall[8]]
    order = np.argsort(tick, kind="stable")
    hall = s.hall.copy()
    hall[4000] = 0
    i_q_err = rng.standard_normal(s.tick.size) * 0.05
    return quantised(s._replace(hall=hall, i_q_err=i_q_err, edge_tick=tick[order], edge_hall=code[order]))


def learning():
    """1500 r/min, 200, then 1500 with a wire broken, too short for a reset: places, R_s and doubts are learned."""
    fast, slow = rpm(1500), rpm(200)

    def angle(t):
        return 0.3 + fast * t - (fast - slow) * np.clip(t - 0.08, 0, 0.04)

    s = signals(angle, 0.156, i_q=5.0, edges_deg=PAPER_EDGES, noise=0.02, seed=7)
    broken = 0.125 * TICK_HZ
    return s._replace(hall=s.hall | (s.tick > broken), edge_hall=s.edge_hall | (s.edge_tick > broken))


def resets(n):
    return np.isin(np.arange(n), (0, 2500, 2501, 5200))


def bits(estimates, state):
    """Every bit of a run's result."""
    digest = hashlib.sha256(np.array([list(estimate) for estimate in estimates], np.float64).tobytes())
    digest.update(np.array(list(numbers(state))).tobytes())
    return digest.hexdigest()


def numbers(value):
    """The numbers of nested tuples, in order."""
    if isinstance(value, tuple):
        for part in value:
            yield from numbers(part)
    else:
        yield float(value)


@cache
def heard(make):
    """Samples and resets, one of them of the observer alone."""
    s = make()
    reset = resets(s.tick.size)
    return samples(s, reset), reset | (np.arange(reset.size) == 3000)


def run_whole(observer, make):
    """State and estimates."""
    return run(observer, observer.make_params(PWM_HZ, own(observer, **TOLD)), *heard(make))


@also_in(campaign="kernels")
@EACH
def test_step_and_run_agree_bit_for_bit(observer):
    """What is compiled and plain Python: some windows, from the state on in which the compiled kernel is by then."""
    params = observer.make_params(PWM_HZ, own(observer, **TOLD))
    every = [(make, start) for make in (busy, learning) for start in range(0, len(heard(make)[0]), WINDOW)]
    for make, start in chosen(f"windows {observer.__name__}", every, 6):
        seen, reset = heard(make)
        state = run(observer, params, seen[:start], reset[:start])[0] if start else observer.init()
        window = slice(start, start + WINDOW)
        last, out = run(observer, params, seen[window], reset[window], state)
        estimates = []
        for one, again in zip(seen[window], reset[window], strict=True):
            state, estimate = observer.step(params, observer.init() if again else state, value(Sample, one))
            estimates.append(estimate)
        assert bits(estimates, state) == bits(out, last)


@EACH
def test_a_run_in_portions_gives_the_same_bits(observer):
    seen, reset = heard(busy)
    params, cuts = observer.make_params(PWM_HZ, own(observer, **TOLD)), (0, 1, 2, 700, 701, 5200, len(reset))
    state, parts = None, []
    for begin, end in pairwise(cuts):
        state, out = run(observer, params, seen[begin:end], reset[begin:end], state)
        parts.append(out)
    assert bits(np.concatenate(parts), state) == bits(*reversed(run_whole(observer, busy)))


@pytest.mark.parametrize("seed", range(5))
def test_the_front_end_gives_the_same_bits_in_portions_with_edges_to_come(seed):
    """As a live stream has them: more edges than the samples so far can use, given again with the next."""
    s, rng = busy(), np.random.default_rng(seed)
    measured, edges, reset = s.measured, s.edges, resets(s.tick.size)
    end = FrontEnd(sample.make_params(TICK_HZ, own(sample)))
    parts, used = [], 0
    for first, last in pairwise(np.unique(np.r_[0, rng.integers(0, len(reset), rng.integers(1, 400)), len(reset)])):
        parts.append(end.run(measured[first:last], edges[used : used + 50], reset[first:last]))
        used += int(np.searchsorted(s.edge_tick[used : used + 50], s.tick[last - 1], side="right"))
    assert np.array_equal(np.concatenate(parts), samples(s, reset))


def test_what_can_be_learned_is_learned_where_the_bits_are_compared():
    params = edge_kalman.make_params(PWM_HZ, own(edge_kalman))
    state, out = run(edge_kalman, params, *heard(learning))
    assert np.count_nonzero(state.lessons.places.visits) == 6
    lessons = state.lessons
    for learned in (lessons.common[0], lessons.common[2], *lessons.drop, *lessons.offset, *lessons.gain, *lessons.six):
        assert learned != 0.0
    assert out.sensors[-1] & 1


@EACH
@pytest.mark.parametrize("speed", [0.0, 500.0, -3000.0])
def test_parameters_that_are_zero_divide_by_nothing(observer, speed):
    """All of them, and each alone: finite estimates, standing and turning, with and without voltage."""
    zeros = [name for name in names(observer.Settings) if name not in ("n_p", "hall_timeout") and name not in OPTIONAL]
    s = signals(constant(rpm(speed)), 0.05, i_q=8.0)
    driven = samples(s)
    still = changed(driven, u_alpha=0.0, u_beta=0.0)
    for zero in [zeros, *([name] for name in zeros)]:
        params = observer.make_params(PWM_HZ, own(observer, **dict.fromkeys(zero, 0.0)))
        for seen in (driven, still):
            estimates = run(observer, params, seen)[1]
            assert all(np.isfinite(estimates[name]).all() for name in estimates.dtype.names), zero


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_parameter_that_is_missing_is_named(name):
    """An edge that is not given is an ideal one, a test sine that is not asked for is none."""
    entry = CATALOGUE[name]
    optional = OPTIONAL | ({"J_hat", "u_dc_min"} if name == "edge_kalman" else set())
    needed = [parameter for parameter in entry.parameters if parameter not in optional]
    assert entry.missing({}) == tuple(parameter for parameter in needed if parameter not in DEFAULTS)
    for parameter in needed:
        with pytest.raises(TypeError, match=parameter):
            entry.settings(**{other: 1.0 for other in entry.parameters if other != parameter})

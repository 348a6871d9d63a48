"""Operations counted, against counts by hand."""

from collections import Counter

import numpy as np
import pytest
from ideal_motor import PAPER_EDGES, PWM_HZ, constant, own, rpm, run, samples, signals

from sim.native import with_item
from sim.observers import back_emf, covariance, edge_kalman, hall_levels, hall_places, transforms, vector_tracking
from sim.observers.catalogue import CATALOGUE
from tests.sim.observers.counting import CYCLES, Int, Number, counted, counting, stored

FIVE = tuple(map(Number, range(5)))
FIFTEEN = tuple(map(Number, range(15)))
PLACES = stored(hall_places.start((0.1,) * 12, 0.01))


def kinds(function, *arguments):
    """Operations by kind."""
    with counting() as tally:
        function(*arguments)
    found = Counter()
    for (_, kind), n in tally.items():
        found[kind] += n
    return dict(found)


@pytest.mark.parametrize(
    ("function", "arguments", "by_hand"),
    [
        (covariance.times, (Number(2.0), FIVE), {"multiply": 5}),
        (covariance.added, (FIVE, FIVE, Number(2.0)), {"multiply": 5, "add": 5}),
        (covariance.less, (FIFTEEN, FIVE, Number(2.0)), {"multiply": 5 + 15, "add": 15}),
        (covariance.less, (stored(FIFTEEN), stored(FIVE), Number(2.0)), {"multiply": 20, "add": 15, "load": 20}),
        (covariance.across, (FIFTEEN, FIVE), {"multiply": 25, "add": 20}),
        # 2, 3 and 1 / sqrt 3 are read; then a, b and c as well, b and c once
        (transforms.clarke, (Number(1.0),) * 3, {"add": 3, "multiply": 2, "divide": 1, "load": 3}),
        (transforms.clarke, tuple(stored((1.0, 2.0, 3.0))), {"add": 3, "multiply": 2, "divide": 1, "load": 6}),
        (transforms.clip, (Number(1.0), 2.0), {"compare": 2, "load": 2}),
        (transforms.clip, (Number(1.0), Number(2.0)), {"negate": 1, "compare": 2}),
        (transforms.wrap, (Number(3.0),), {"compare": 2, "load": 2}),
        (transforms.wrap, (Number(4.0),), {"compare": 4, "add": 2, "floor": 1, "multiply": 2, "load": 4}),
        # T_s, and 1, 1/2, 1/24, 720, 1/6, 120
        (
            back_emf._undo_filter,
            (stored(back_emf.Params(6e-5, 0.3, 20.0, 0.1)), Number(0.5), Number(100.0)),
            {"add": 7, "multiply": 8, "divide": 4, "load": 7},
        ),
        (edge_kalman._across, (stored(FIFTEEN), Number(2.0)), {"multiply": 5, "load": 5}),
        (edge_kalman._along, (FIFTEEN, Number(1.0)), {"multiply": 5, "add": 10}),
        (hall_levels.rising, (Int(1), Int(2)), {"integer": 2, "integer compare": 1}),
        # 60 deg and the place are read
        (hall_places.angle, (PLACES, Int(3), 1), {"convert": 1, "multiply": 1, "add": 1, "load": 2}),
        (with_item, (PLACES.actual, Int(3), Number(1.0)), {}),
    ],
)
def test_a_kernel_counts_as_by_hand(function, arguments, by_hand):
    assert kinds(function, *arguments) == by_hand


@pytest.mark.parametrize("observer", [edge_kalman, vector_tracking])
def test_what_is_counted_is_what_the_compiled_kernel_does(observer):
    """Bit for bit, over edges and lessons; the first step asks two flags and writes the state."""
    seen = samples(signals(constant(rpm(1500)), 0.1, i_q=5.0, edges_deg=PAPER_EDGES, noise=0.02, seed=7))
    params = observer.make_params(PWM_HZ, own(observer))
    state, _ = run(observer, params, seen[:-300])
    found = counted(CATALOGUE[observer.__name__.rpartition(".")[2]], params, state, seen[-300:])
    _, expected = run(observer, params, seen[-300:], state=state)
    for name in expected.dtype.names:
        assert np.array_equal([getattr(each, name) for each in found.estimates], expected[name])
    assert {kind for tally in found.tallies for _, kind in tally} <= set(CYCLES)

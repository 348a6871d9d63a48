"""The Kalman filter on edges near standstill and with parameters that are told wrongly: it stays where the codes are.

`lost.py` draws the cases; the seeds here are others than those that it was designed on, which are below 400.
"""

from collections import Counter

import pytest
from lost import drawn, held

from tests.choice import sampled

HUNDREDS = range(10, 20)
MOST = {"outside": 2, "trip": 0, "sigma": 8, "worse": 34}
"""Of a hundred cases, that miss a goal. "worse" asks to be as good as whichever of three was the best, by hindsight."""


@pytest.mark.slow
@pytest.mark.parametrize("seed", sampled("lost", range(1000, 2000), 2, campaign="lost"))
def test_it_does_not_trip_and_knows_its_error_within_ten_per_cent_of_the_time(seed):
    found = held(drawn(seed))
    assert found.faults == 0, found
    assert found.outside < 0.1, found
    assert found.beyond < 0.1, found


@pytest.mark.campaign("lost")
@pytest.mark.parametrize("hundred", HUNDREDS)
def test_of_a_hundred_cases_few_miss_a_goal(hundred):
    found = [held(drawn(seed)) for seed in range(100 * hundred, 100 * hundred + 100)]
    misses = "\n".join(f"{one} | {one.case}" for one in found if one.misses)
    count = Counter(miss for one in found for miss in one.misses)
    print(f"{misses}\n{hundred}: {sum(bool(one.misses) for one in found)} of 100 miss a goal: {dict(count)}")
    assert all(count[goal] <= most for goal, most in MOST.items()), f"{count}\n{misses}"

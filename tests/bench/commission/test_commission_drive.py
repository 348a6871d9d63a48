"""The steps at standstill on simulated drives in virtual time: against the configuration that nobody has told them."""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager

import numpy as np
import pytest
from drawn_benches import NAMES, PAPER, MadeBench, drawn, made

import bench
from bench.commission.outcome import Outcome
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.sequence import STEPS
from bench.commission.stand import CHANNELS, Stand
from bench.rig.envelope import Envelope

WITHIN = {"R_s": 5e-3, "L_d": 15e-3, "L_q": 15e-3, "L_d_half": 15e-3, "L_q_half": 15e-3}
"""What is asked for, relative, in the drive's units."""
MOTORS = [PAPER, *(pytest.param(name, marks=pytest.mark.slow)
                   for name in ("gimbal-4310", "maxon-ec60-flat", "teknic-m-2310p"))]  # fmt: skip


@contextmanager
def standing(of: MadeBench, seed: int = 1):
    with bench.connect("sim", channels=[*CHANNELS], limits=Envelope(0.0, of.i_max), config=of.config, seed=seed) as rig:
        yield Stand(rig, of.i_max)


def all_of(of: MadeBench, seed: int = 1) -> dict[str, Outcome]:
    with standing(of, seed) as stand:
        return {step.name: step.perform(stand) for step in STEPS}


def found(outcomes: dict[str, Outcome]) -> dict[str, Quantity]:
    return {quantity.name: quantity for outcome in outcomes.values() for quantity in outcome.quantities}


def errors(of: MadeBench, outcomes: dict[str, Outcome]) -> dict[str, float]:
    values = found(outcomes)
    return {name: values[name].value / truth - 1.0 for name, truth in of.truth.items()}


@pytest.mark.parametrize("hard", [False, True], ids=["kind", "unkind"])
@pytest.mark.parametrize("name", MOTORS)
def test_what_is_found_is_what_the_bench_has(name: str, hard: bool) -> None:
    of = made(name, hard)
    outcomes = all_of(of)
    values = found(outcomes)
    for key, error in errors(of, outcomes).items():
        assert abs(error) < WITHIN.get(key, 15e-3), key
        assert values[key].covers(of.truth[key]), key
        assert values[key].half_width < 0.03 * values[key].value, key


@pytest.mark.slow
@pytest.mark.long("two benches")
def test_an_oversized_drive_is_less_sure_and_says_so() -> None:
    large = made(PAPER, True, current_sensor__range=160.0, current_sensor__noise_rms=0.16)
    small = made(PAPER, True)
    wide, narrow = found(all_of(large)), found(all_of(small))
    for key, truth in large.truth.items():
        assert wide[key].covers(truth), key
        if key != "U_dead":
            assert wide[key].half_width > 1.2 * narrow[key].half_width, key


def test_an_unconnected_motor_is_named_and_nothing_flows() -> None:
    """A winding that lets next to nothing through stands for one that is not there."""
    coils = {"motor__R_s": 99.0, "motor__L_d": 0.01, "motor__L_q": 0.01, "motor__i_max": 0.12}
    of = made(PAPER, False, **coils, firmware__i_max=8.0, current_sensor__range=16.0)
    with standing(of) as stand:
        STEPS[0].perform(stand)
        with pytest.raises(Refused, match=r"no current at any angle up to .* V: no motor is connected"):
            STEPS[1].perform(stand)
        assert not stand.rig.drive.on


def test_a_supply_that_limits_is_named() -> None:
    of = made(PAPER, False, dc_link__R_source=5.0, dc_link__C=1e-4, firmware__protection__u_dc_min=22.5)
    with standing(of) as stand:
        for step in STEPS[:2]:
            step.perform(stand)
        with pytest.raises(Refused, match=r"tripped: UNDERVOLTAGE.*the supply limits its current"):
            STEPS[2].perform(stand)


@pytest.mark.parametrize("name", [PAPER, "robodrive-ilm50x08"])
def test_no_current_is_beyond_what_was_agreed_to(name: str) -> None:
    """The phase currents themselves, of all samples that came, also between the windows."""
    of = made(name, True)
    share = 0.6
    with bench.connect("sim", channels=[*CHANNELS], limits=Envelope(0.0, share * of.i_max), config=of.config) as rig:
        stand = Stand(rig, share * of.i_max)
        for step in STEPS:
            step.perform(stand)
        whole = rig.between(0, rig.recorder.newest)
        after = rig.drive.node.parameters()
    largest = max(float(np.abs(whole[f"i_{phase}"]).max()) for phase in "abc")
    assert 0.4 * share * of.i_max < largest < 1.02 * share * of.i_max
    assert after["forced"] == after["test"] == 0.0


def test_without_an_encoder_all_is_found_too() -> None:
    of = made(PAPER, True, encoder__present=0)
    for key, error in errors(of, all_of(of)).items():
        assert abs(error) < WITHIN.get(key, 15e-3), key


@pytest.mark.campaign("commission")
@pytest.mark.long("a hundred benches")
def test_a_hundred_drawn_benches_are_inside_their_intervals() -> None:
    """Nine benches of each motor, and one more of the first: coverage of each quantity, and the worst error."""
    benches = [(name, 1000 + seed) for seed in range(10) for name in NAMES][:100]
    inside: Counter[str] = Counter()
    worst: dict[str, float] = {}
    for name, seed in benches:
        of = drawn(name, seed)
        outcomes = all_of(of, seed)
        values = found(outcomes)
        for key, error in errors(of, outcomes).items():
            inside[key] += values[key].covers(of.truth[key])
            worst[key] = max(worst.get(key, 0.0), abs(error))
    told = {key: (inside[key], round(100 * worst[key], 2)) for key in worst}
    assert all(count >= 90 for count in inside.values()), told
    assert all(worst[key] < limit for key, limit in WITHIN.items()), told

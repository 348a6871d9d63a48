"""A commissioning of simulated drives that have no encoder: pole pairs by a person, the shaft on its Hall sensors."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawn_benches import NAMES, PAPER, MadeBench, made
from test_commission_drive import (
    LONGEST,
    UNSEEN,
    WITHIN,
    coverage,
    edge_errors,
    errors,
    fastest_of,
    found,
    standing,
    steps_of,
)

from bench.commission.outcome import Outcome
from bench.commission.refusal import Refused
from bench.commission.sequence import STEPS
from bench.commission.stand import Stand
from bench.commission.steps import without_encoder

EDGES, WORST_EDGES = math.radians(0.31), math.radians(0.5)
"""rad, of Hall edges by the back-EMF, and of those of motors that are slow and have many pole pairs."""
FIRST = UNSEEN + 100
"""The first seed of benches that nothing here was set on: 3000 and 3001 were looked at."""
TURN, SPIN = 5, 6
MOTORS = [PAPER, *(pytest.param(name, marks=pytest.mark.slow)
                   for name in ("gimbal-4310", "maxon-ec60-flat", "teknic-m-2310p"))]  # fmt: skip
MECHANICAL = {"J", "b", "tau_c"}


def blind(name: str, hard: bool = True, **settings: Any) -> MadeBench:
    return made(name, hard, encoder__present=0, **settings)


@pytest.mark.long("a commissioning from the beginning to the end")
@pytest.mark.parametrize("hard", [False, True], ids=["kind", "unkind"])
@pytest.mark.parametrize("name", MOTORS)
def test_what_is_found_is_what_the_bench_has(name: str, hard: bool) -> None:
    of = blind(name, hard)
    with standing(of) as stand:
        stand.pole_pairs = of.n_p
        outcomes, said = steps_of(stand)
        assert stand.rig.recorder.seconds < LONGEST
    assert not said
    values, truth = found(outcomes), {**of.truth, **of.turning}
    assert {*truth} <= {*values}
    for key, error in errors(of, outcomes).items():
        assert abs(error) < WITHIN.get(key, 15e-3), key
        assert values[key].covers(truth[key]), key
        assert values[key].half_width < (0.1 if key == "b" else 0.05) * values[key].value, key
    for key, error in edge_errors(of, outcomes).items():
        assert abs(error) < min(EDGES, values[key].half_width), key
    latency = of.config["hall"]["latency"] if hard else 0.0
    assert values["hall_delay"].covers(latency)
    assert outcomes["turn"].settings == {"n_p": of.n_p, "hall_swap_hat": 0.0, "hall_invert_hat": 0.0}
    assert not {"encoder_zero", "encoder_delay", "L_d_run"} & values.keys()
    assert outcomes["check"].settings["k_p_speed"] > 0.0
    assert values["step_misfit"].value < 0.03


@pytest.mark.long("a commissioning from the beginning to the end")
@pytest.mark.parametrize("name", [PAPER, pytest.param("maxon-ec60-flat", marks=pytest.mark.slow)])
def test_what_needs_no_pole_pairs_is_told_without_them_and_the_shaft_turns_the_slower(name: str) -> None:
    """With one pole pair, which it may have, it would be as fast as was agreed to."""
    of = blind(name)
    with standing(of, more=["omega_true"]) as stand:
        outcomes, said = steps_of(stand)
        fastest = fastest_of(of, stand) * of.n_p
    assert fastest < of.rpm
    assert len(said) == 2
    assert "pole pairs are not claimed: without an encoder name them with --pole-pairs N" in said[0]
    assert "inertia and friction are not claimed: they need the pole pairs" in said[1]
    values, truth = found(outcomes), {**of.truth, **of.turning}
    assert not (MECHANICAL | {"n_p", "tau_up"}) & values.keys()
    assert {*truth} - MECHANICAL <= {*values}
    for key, error in errors(of, outcomes).items():
        assert abs(error) < WITHIN.get(key, 15e-3), key
        assert values[key].covers(truth[key]), key
    for key, error in edge_errors(of, outcomes).items():
        assert abs(error) < values[key].half_width, key
    settings = {name: value for outcome in outcomes.values() for name, value in outcome.settings.items()}
    assert {"k_p_vt", "omega_on", "hall_timeout"} <= settings.keys()
    assert not {"n_p", "omega_m_max", "k_p_speed"} & settings.keys()


# -- pole pairs by hand ---------------------------------------------------------------------------------------------


def turned_by(stand: Stand, *turns: float) -> list[str]:
    """A person who turns the shaft by so many turns when asked, the last ones again and again; what they were told.

    A load machine is their hand.
    """
    asked: list[str] = []

    @contextmanager
    def ask(words: str) -> Iterator[Callable[[float], bool]]:
        asked.append(words)
        this = turns[min(len(asked), len(turns)) - 1]
        yield lambda timeout: hand(this)

    def hand(this: float) -> bool:
        assert not stand.rig.drive.on
        stand.rig.load.speed(rpm=math.copysign(10.0, this))
        stand.rig.wait(6.0 * abs(this) - 0.1)  # and what it takes to start and to stop
        stand.rig.load.speed(rpm=0.0)
        stand.rig.wait(0.3)
        stand.rig.load.off()
        return True

    stand.by_hand = True
    stand.rig.plan = replace(stand.rig.plan, ask=ask)
    return asked


@pytest.mark.long("the steps up to it")
@pytest.mark.parametrize("name", [PAPER, *(pytest.param(name, marks=pytest.mark.slow) for name in NAMES[1:])])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_one_turn_by_hand_tells_the_pole_pairs(name: str, way: float) -> None:
    of = blind(name)
    with standing(of) as stand:
        asked = turned_by(stand, way)
        outcomes, said = steps_of(stand, TURN)
        assert stand.rig.drive.parameters["n_p"] == of.n_p
    assert [words for words in said if "ring" not in words] == []
    assert len(asked) == 1
    assert "turn the shaft by hand by exactly one turn" in asked[0]
    assert outcomes["turn"].settings["n_p"] == of.n_p
    assert outcomes["turn"]["n_p"].value == pytest.approx(of.n_p, abs=without_encoder.NEAR)


@pytest.mark.long("the steps up to it")
def test_a_turn_that_is_no_whole_number_is_asked_for_again_and_then_refused() -> None:
    of = blind(PAPER)
    with standing(of) as stand:
        asked = turned_by(stand, 1.4, 1.0)
        outcomes, said = steps_of(stand, TURN)
    assert not said
    assert [words.partition(" electrical")[0] for words in asked][1] in ("8.33", "8.50")
    assert outcomes["turn"].settings["n_p"] == of.n_p
    with standing(of) as stand:
        asked = turned_by(stand, 1.4)
        outcomes, said = steps_of(stand, TURN)
    assert len(asked) == without_encoder.TRIES
    assert any("electrical turns, none a whole number: name them with --pole-pairs N" in words for words in said)
    assert "n_p" not in outcomes["turn"].settings


@pytest.mark.long("the steps up to it")
def test_nobody_is_asked_to_turn_a_shaft_whose_pole_pairs_are_told() -> None:
    with standing(blind(PAPER)) as stand:
        asked, stand.pole_pairs = turned_by(stand, 1.0), 6
        steps_of(stand, TURN)
    assert not asked


@pytest.mark.long("the steps up to it")
def test_told_pole_pairs_that_the_encoder_contradicts_are_named_and_the_shaft_is_not_spun() -> None:
    of = made(PAPER, True)
    with standing(of) as stand:
        stand.pole_pairs = 4
        outcomes, said = steps_of(stand)
    assert "the encoder shows 6 pole pairs, and 4 were told: the number is wrong, or the encoder's lines" in said[0]
    assert said[1].startswith("spin: not spun, because the encoder shows 6 pole pairs")
    assert outcomes["turn"].settings["n_p"] == 6


# -- Hall sensors ---------------------------------------------------------------------------------------------------

UNUSABLE: list[tuple[dict[str, Any], str]] = [
    ({"wiring__hall_open": 7}, "no Hall edge came while the rotor was dragged"),
    ({"wiring__hall_open": 1}, r"sensor a open \(always 1\)"),
    ({"wiring__hall_short": 4}, r"sensor c .*\(always 0\)"),
]


@pytest.mark.long("the steps up to it")
@pytest.mark.parametrize(("settings", "words"), UNUSABLE)
def test_without_any_sensor_of_the_shaft_what_stands_still_is_told(settings: dict[str, Any], words: str) -> None:
    of = blind(PAPER, **settings)
    with standing(of) as stand:
        stand.pole_pairs = of.n_p
        outcomes, said = steps_of(stand)
        assert not stand.rig.drive.on
    assert any(re.search(words, each) for each in said), said
    assert said[-1].startswith("spin: there are neither an encoder nor Hall sensors that the drive could run on")
    assert {*of.truth} <= {*found(outcomes)}
    assert all(abs(error) < WITHIN.get(key, 15e-3) for key, error in errors(of, outcomes).items())


WIRED = [*({"wiring__hall_swap": each} for each in range(1, 6)), {"wiring__hall_invert": 2}, {"wiring__hall_invert": 7}]


@pytest.mark.slow
@pytest.mark.long("a commissioning from the beginning to the end")
@pytest.mark.parametrize("settings", WIRED)
def test_however_the_hall_sensors_are_wired_the_shaft_is_spun_on_them(settings: dict[str, Any]) -> None:
    of = blind(PAPER, **settings)
    swap, inverted = settings.get("wiring__hall_swap", 0), settings.get("wiring__hall_invert", 0)
    with standing(of) as stand:
        stand.pole_pairs = of.n_p
        outcomes, said = steps_of(stand)
    named = ["two Hall wires are exchanged, or two motor phases"] * (swap in (1, 2, 3)) + ["sensor b inverted"] * (
        inverted == 2
    )
    assert all(any(words in each for each in said) for words in named), said
    values = found(outcomes)
    assert values["psi_f"].covers(of.turning["psi_f"])
    assert values["J"].covers(of.turning["J"])
    hats = outcomes["turn"].settings["hall_swap_hat"], outcomes["turn"].settings["hall_invert_hat"]
    if hats == (swap, inverted):  # else the same, with the ring elsewhere
        for key, error in edge_errors(of, outcomes).items():
            assert abs(error) < min(EDGES, values[key].half_width), key


@pytest.mark.slow
@pytest.mark.long("a commissioning until the shaft is spun")
@pytest.mark.parametrize("phases", [1, 2, 3])
def test_exchanged_motor_phases_are_named_and_the_motor_is_found(phases: int) -> None:
    of = blind(PAPER, faults__motor__swap=phases)
    with standing(of) as stand:
        stand.pole_pairs = of.n_p
        outcomes, said = steps_of(stand)
    assert any("two Hall wires are exchanged, or two motor phases" in each for each in said), said
    assert found(outcomes)["psi_f"].covers(of.turning["psi_f"])


# -- safety ---------------------------------------------------------------------------------------------------------


@pytest.mark.long("a commissioning from the beginning to the end")
@pytest.mark.parametrize(
    ("name", "share", "fast"),
    [(PAPER, 0.6, 0.6), pytest.param(PAPER, 1.0, 0.2, marks=pytest.mark.slow),
     pytest.param("robodrive-ilm50x08", 0.6, 0.4, marks=pytest.mark.slow)],
)  # fmt: skip
def test_neither_current_nor_speed_is_beyond_what_was_agreed_to(name: str, share: float, fast: float) -> None:
    of = blind(name)
    with standing(of, share=share, fast=fast, more=["omega_true"]) as stand:
        stand.pole_pairs = of.n_p
        outcomes, _ = steps_of(stand)
        whole, fastest = stand.rig.between(0, stand.rig.recorder.newest), fastest_of(of, stand)
    assert "check" in outcomes
    largest = max(float(np.abs(whole[f"i_{phase}"]).max()) for phase in "abc")
    assert 0.4 * share * of.i_max < largest < 1.02 * share * of.i_max
    assert 0.4 * fast * of.rpm < fastest < fast * of.rpm


@contextmanager
def turned_stand(of: MadeBench, fast: float = 1.0) -> Iterator[Stand]:
    """That is about to spin the shaft."""
    with standing(of, fast=fast, more=["omega_true"]) as stand:
        stand.pole_pairs = of.n_p
        steps_of(stand, TURN)
        yield stand


def accelerate(stand: Stand, i_q: float) -> None:
    with stand.naming("spin"), stand.running(None):
        stand.current(0.0, i_q)
        stand.wait(3.0)


@pytest.mark.long("the steps up to it")
@pytest.mark.parametrize("name", MOTORS)
def test_a_shaft_that_turns_against_its_torque_is_stopped(name: str) -> None:
    """The ring is taken for one that sits on the other side: torque and current have opposite signs."""
    of = blind(name)
    with turned_stand(of) as stand:
        ring = stand.rig.drive.parameters["hall_offset"]
        stand.set(hall_offset=math.remainder(ring + math.pi, math.tau))
        with pytest.raises(Refused, match=r"against its torque: the Hall sensors are wrong|tripped: HALL"):
            STEPS[SPIN - 1].perform(stand)
        assert not stand.rig.drive.on
        assert fastest_of(of, stand) < 0.5 * of.rpm


@pytest.mark.long("the steps up to it")
@pytest.mark.parametrize("name", MOTORS)
@pytest.mark.parametrize("look", [8, 25])
def test_a_drive_whose_edges_stop_is_switched_off(name: str, look: int) -> None:
    """All three inputs stay where they are, at a code that is one."""
    of = blind(name)
    words = r"no Hall edge came any more|tripped: (HALL|OVERCURRENT)|does not reach|does not turn|A were agreed to"
    with turned_stand(of) as stand:
        load, looks, own = stand.rig.load, iter(range(10_000)), stand.look

        def frozen(seconds: float) -> Any:
            if next(looks) == look:
                code = int(stand.recent_edges(1.0).new[-1]) & 7
                load.set("hall_open", code)
                load.set("hall_short", 7 ^ code)
            return own(seconds)

        stand.look = frozen  # type: ignore[method-assign]
        with pytest.raises(Refused, match=words):
            STEPS[SPIN - 1].perform(stand)
        assert not stand.rig.drive.on
        assert fastest_of(of, stand) < of.rpm


@pytest.mark.long("the steps up to it")
def test_a_motor_that_runs_away_is_switched_off_by_its_hall_edges() -> None:
    """What foresees the end of an acceleration is taken away: the guard is left."""
    of = blind(PAPER)
    with turned_stand(of, fast=0.2) as stand:
        words = r"run away: at most 6\d+(\.\d+)? r/min asked for, \d+ r/min by the Hall sensors"
        with pytest.raises(Refused, match=words):
            accelerate(stand, 0.3 * stand.i_max)
        assert not stand.rig.drive.on
        assert fastest_of(of, stand) < 1.3 * 0.2 * of.rpm


# -- many benches ---------------------------------------------------------------------------------------------------


@pytest.mark.campaign("commission")
@pytest.mark.long("forty-four benches")
def test_drawn_benches_without_an_encoder_are_inside_their_intervals() -> None:
    """Four benches of each motor: coverage of each quantity, and the worst error."""
    benches = [(name, FIRST + seed) for seed in range(4) for name in NAMES]
    inside, worst, refused = coverage(benches, told_its_pole_pairs, encoder=False)
    told = {key: (inside[key], worst[key]) for key in worst}
    assert not refused
    assert all(inside[key] >= 0.9 * len(benches) * (12 if key == "edges" else 1) for key in worst), told
    assert worst["psi_f"] < WITHIN["psi_f"], told
    assert worst["edges"] < WORST_EDGES, told


def told_its_pole_pairs(of: MadeBench, seed: int) -> tuple[dict[str, Outcome], list[str]]:
    with standing(of, seed) as stand:
        stand.pole_pairs = of.n_p
        outcomes, said = steps_of(stand)
    return outcomes, [each for each in said if "ring sits" not in each]

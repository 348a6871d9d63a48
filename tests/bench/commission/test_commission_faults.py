"""What is wrong with motor, shaft, encoder and Hall wires is named before it hurts, on three motors."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import pytest
from drawn_benches import PAPER, MadeBench, made
from plant_watch import PlantWatch
from test_commission_drive import found, standing, steps_of

from bench.commission.outcome import Outcome
from bench.commission.sequence import STEPS
from bench.device.simulator import motors
from bench.rig.rig import Rig
from sim.config.params import load_params
from tests.choice import sampled

MOTORS = [PAPER, *(pytest.param(name, marks=pytest.mark.slow) for name in ("gimbal-4310", "maxon-ec45-flat"))]
Prepare = Callable[[Rig, float], None]


@dataclass
class Said:
    """What came of the steps on a faulty bench."""

    of: MadeBench
    outcomes: dict[str, Outcome] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    """All that was refused, and remarked."""
    ended: str = ""
    """The step that ended it, empty for none."""
    u_dc: float = 0.0
    """V, the most that the DC link had."""

    def has(self, words: str) -> bool:
        return any(re.search(words, each) for each in self.said)

    def all_found(self, rightly: str) -> None:
        """In the drive's units, as well as they say, and nothing refused but what is so `rightly`."""
        values = found(self.outcomes)
        assert not self.ended, self.said
        refused = [str(each) for outcome in self.outcomes.values() for each in outcome.refused]
        assert not [each for each in refused if not rightly or not re.search(rightly, each)], refused
        for name, truth in {**self.of.truth, **self.of.turning}.items():
            error, width = (x / truth for x in (values[name].value - truth, values[name].half_width))
            assert abs(error) < SURELY * width, (name, error, width)


def said_of(of: MadeBench, prepare: Prepare | None = None) -> Said:
    """Take the steps; the plant has never had more current in the motor, nor more speed, than was agreed to."""
    told = Said(of)
    with standing(of) as stand:
        watch = PlantWatch(stand.rig.client.link.device)  # type: ignore[attr-defined]
        if prepare is not None:
            prepare(stand.rig, _rated(of))
        told.outcomes, told.said = steps_of(stand)
        told.ended = next((step.name for step in STEPS if step.name not in told.outcomes), "")
        assert not stand.rig.drive.on
    assert watch.largest <= of.i_max
    assert watch.fastest * 60.0 / math.tau <= of.rpm
    told.u_dc = watch.highest
    return told


def _rated(of: MadeBench) -> float:
    """N m, of the agreed current."""
    return 1.5 * of.n_p * of.config.get("motor", {}).get("psi_f", 6.55e-3) * of.i_max


def brake(share: float) -> Prepare:
    """A load machine that acts one way, by a share of the rated torque."""
    return lambda rig, rated: rig.load.torque(share * rated)


def held(rig: Rig, rated: float) -> None:
    """The load machine holds the shaft."""
    rig.load.speed(rpm=0.0)


SURELY = 1.5
"""Times the half width of a 95 % interval, outside of which none of some hundred truths should be."""
THREE = (PAPER, "gimbal-4310", "maxon-ec45-flat")
WINDING: list[tuple[dict[str, Any], str, str]] = [
    ({"faults__motor__open": 1}, "first-current", "phase a carries no current"),
    ({"faults__motor__open": 2}, "first-current", "phase b carries no current"),
    ({"faults__motor__open": 4}, "first-current", "phase c carries no current"),
    ({"faults__motor__open": 7}, "first-current", "no motor is connected"),
    *(({"faults__motor__short": each, "faults__motor__short_R": 0.01}, "first-current",
       r"OVERCURRENT.*short|A flowed, and .* were agreed to") for each in (1, 2, 3)),
]  # fmt: skip
TURNED: list[tuple[dict[str, Any], str, str]] = [
    *(({"faults__motor__swap": each}, "spin", "two motor phases are exchanged") for each in (1, 2, 3)),
    ({"faults__encoder__pulses_hat": 2500}, "turn", "the shaft slips, or the encoder's lines are not 3600"),
]
WIRES: list[tuple[dict[str, Any], str]] = [
    *(({"wiring__hall_swap": each}, "two Hall wires are exchanged") for each in (1, 2, 3)),
    ({"wiring__hall_open": 1}, r"sensor a open \(always 1\)"),
    ({"wiring__hall_short": 4}, r"sensor c .*\(always 0\)"),
    ({"wiring__hall_invert": 2}, "sensor b inverted"),
]


@pytest.mark.long("three motors, each until the fault is named")
@pytest.mark.parametrize("name", MOTORS)
@pytest.mark.parametrize(("settings", "step", "words"), [*WINDING, *TURNED])
def test_what_is_wrong_with_motor_and_encoder_ends_it_by_name(
    name: str, settings: dict[str, Any], step: str, words: str
) -> None:
    told = said_of(made(name, True, **settings))
    assert told.ended == step, told.said
    assert told.has(words), told.said


@pytest.mark.slow
@pytest.mark.long("a whole commissioning")
@pytest.mark.parametrize("name", MOTORS)
@pytest.mark.parametrize(("settings", "words"), WIRES)
def test_what_is_wrong_with_hall_wires_is_named_and_the_motor_is_found_nevertheless(
    name: str, settings: dict[str, Any], words: str
) -> None:
    told = said_of(made(name, True, **settings))
    assert not told.ended, told.said
    assert told.has(words), told.said


@pytest.mark.long("three motors, turned by a load machine, or not")
@pytest.mark.parametrize("name", MOTORS)
@pytest.mark.parametrize(
    ("prepare", "step", "words"),
    [(held, "turn", "does not follow: .* it is blocked"),
     (brake(0.3), "spin", "of i_max to turn the shaft: something is attached, or it binds"),
     (brake(0.6), "turn", "the shaft slips"),
     (brake(0.1), "", "the two ways differ, something acts one way")],
    ids=["held", "heavy", "too heavy", "one way"],
)  # fmt: skip
def test_what_acts_on_the_shaft_is_named(name: str, prepare: Prepare, step: str, words: str) -> None:
    told = said_of(made(name, True), prepare)
    assert told.ended == step, told.said
    assert told.has(words), told.said


@pytest.mark.slow
@pytest.mark.long("until the encoder slips")
@pytest.mark.parametrize("name", MOTORS)
def test_an_encoder_that_slips_ends_it(name: str) -> None:
    """The disc is loose, and keeps up with a shaft that is dragged; it does not with one that is spun."""
    grip = 0.1 * load_params(None).firmware.alpha_m_max if name == PAPER else 30.0
    told = said_of(made(name, True, faults__encoder__slip_alpha=grip))
    assert told.ended == "spin", told.said
    assert told.has("slip"), told.said


@pytest.mark.long("a whole commissioning")
def test_an_encoder_that_counts_backwards_is_told_and_put_right() -> None:
    of = made(PAPER, True, faults__encoder__reversed=1)
    with standing(of) as stand:
        outcomes = {step.name: step.perform(stand) for step in STEPS}
        assert stand.rig.drive.parameters["encoder_reverse"] == 1.0
    turn = outcomes["turn"]
    assert turn.settings == {"n_p": 6.0, "encoder_reverse": 1.0}
    assert "the encoder counts backwards" in turn.remarks[0]
    assert outcomes["spin"]["psi_f"].covers(of.turning["psi_f"])
    assert outcomes["spin"]["edge_up_1"].half_width < 0.01
    assert not outcomes["spin"].refused


# -- a bench that is not as usual, and a motor that is found nevertheless ------------------------------------------


def small_motor(i_max: float) -> dict[str, Any]:
    """A drive whose full scale is 20 times the motor's current, with noise and offsets likewise."""
    offsets = [0.02 * i_max, -0.015 * i_max, 0.01 * i_max]
    return {"current_sensor__range": 20.0 * i_max, "current_sensor__noise_rms": 0.02 * i_max,
            "current_sensor__offset": offsets}  # fmt: skip


WEAK = "a voltage that turns with the rotor was clear in|speeds were told at"
"""What may be refused where the voltage, or the sensors, leave little to see of a motor of much resistance."""
NEVERTHELESS: dict[str, tuple[Callable[[float], dict[str, Any]], str]] = {
    "12 V": (lambda i_max: {"inverter__u_dc": 12.0}, ""),
    "motor too small for the drive": (small_motor, ""),
    "nothing takes energy back": (lambda i_max: {"dc_link__u_brake": 0.0, "dc_link__regenerates": 0}, ""),
    "encoder's index comes late": (
        lambda i_max: {"encoder__index_search": 1, "mechanics__theta_0_deg": 200.0},
        "index came by and moved its angle by .* after each power-on"
    ),
    "encoder counts backwards": (lambda i_max: {"faults__encoder__reversed": 1}, "the encoder counts backwards"),
    "Hall wires rotated": (lambda i_max: {"wiring__hall_swap": 4}, "the Hall ring sits at"),
    "Hall wires rotated the other way": (lambda i_max: {"wiring__hall_swap": 5}, "the Hall ring sits at"),
}  # fmt: skip


@pytest.mark.long("a whole commissioning")
@pytest.mark.parametrize(
    ("which", "name"), sampled("nevertheless", product(NEVERTHELESS, THREE), 2, campaign="commission")
)
def test_a_motor_is_found_on_a_bench_that_is_not_as_usual(which: str, name: str) -> None:
    make, words = NEVERTHELESS[which]
    of = made(name, True, **make(_i_max(name)))
    told = said_of(of)
    told.all_found(WEAK if name != PAPER and which in ("12 V", "motor too small for the drive") else "")
    assert not words or told.has(words), told.said
    assert told.u_dc < 1.06 * of.config["inverter"].get("u_dc", 24.0)  # nothing brakes


def _i_max(name: str) -> float:
    return load_params(motors().get(name)).motor.i_max


@pytest.mark.long("until the supply is at its limit")
@pytest.mark.parametrize(("share", "name"), sampled("supplies", product((0.02, 0.1), THREE), 2, campaign="commission"))
def test_a_supply_that_limits_its_current_is_named(share: float, name: str) -> None:
    told = said_of(made(name, True, dc_link__R_source=0.05, dc_link__i_limit=share * _i_max(name)))
    assert told.ended in ("first-current", "resistance", "inductance", "turn", "spin"), told.said
    assert told.has(r"tripped: UNDERVOLTAGE \(the supply limits its current"), told.said


@pytest.mark.long("until the encoder's zero has moved")
@pytest.mark.parametrize(("each", "name"), sampled("lost", product((5.0, -5.0), THREE), 1, campaign="commission"))
def test_an_encoder_that_loses_counts_ends_it(each: float, name: str) -> None:
    told = said_of(made(name, True, faults__encoder__lost_per_rev=each))
    assert told.ended == "spin", told.said
    assert told.has("slips on the shaft, or loses counts|has slipped, or is wrong"), told.said

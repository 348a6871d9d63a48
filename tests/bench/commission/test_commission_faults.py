"""What is wrong with motor, shaft, encoder and Hall wires is named before it hurts, on three motors."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from drawn_benches import PAPER, MadeBench, made
from test_commission_drive import standing

from bench.commission.refusal import Refused
from bench.commission.sequence import STEPS
from bench.rig.rig import Rig
from sim.config.params import load_params

MOTORS = [PAPER, *(pytest.param(name, marks=pytest.mark.slow) for name in ("gimbal-4310", "maxon-ec45-flat"))]
Prepare = Callable[[Rig, float], None]


def said_of(of: MadeBench, prepare: Prepare | None = None) -> tuple[list[str], str, float]:
    """All that is refused and remarked, the step that ended it (empty for none), and the largest current seen, A."""
    said: list[str] = []
    ended = ""
    with standing(of) as stand:
        if prepare is not None:
            prepare(stand.rig, _rated(of))
        for step in STEPS:
            try:
                outcome = step.perform(stand)
            except Refused as refused:
                said.append(str(refused))
                ended = step.name
                break
            said += [*map(str, outcome.refused), *outcome.remarks]
        assert not stand.rig.drive.on
        whole = stand.rig.between(0, stand.rig.recorder.newest)
    return said, ended, max(float(np.abs(whole[f"i_{phase}"]).max()) for phase in "abc")


def _rated(of: MadeBench) -> float:
    """N m, of the agreed current."""
    return 1.5 * of.n_p * of.config.get("motor", {}).get("psi_f", 6.55e-3) * of.i_max


def brake(share: float) -> Prepare:
    """A load machine that acts one way, by a share of the rated torque."""
    return lambda rig, rated: rig.load.torque(share * rated)


def held(rig: Rig, rated: float) -> None:
    """The load machine holds the shaft."""
    rig.load.speed(rpm=0.0)


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
    of = made(name, True, **settings)
    said, ended, largest = said_of(of)
    assert ended == step, said
    assert any(re.search(words, each) for each in said), said
    if "faults__motor__short" not in settings:  # what flows in a short nothing limits but the trip
        assert largest < 1.05 * of.i_max


@pytest.mark.slow
@pytest.mark.long("a whole commissioning")
@pytest.mark.parametrize("name", MOTORS)
@pytest.mark.parametrize(("settings", "words"), WIRES)
def test_what_is_wrong_with_hall_wires_is_named_and_the_motor_is_found_nevertheless(
    name: str, settings: dict[str, Any], words: str
) -> None:
    of = made(name, True, **settings)
    said, ended, largest = said_of(of)
    assert not ended, said
    assert [each for each in said if re.search(words, each)], said
    assert largest < 1.05 * of.i_max


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
    of = made(name, True)
    said, ended, largest = said_of(of, prepare)
    assert ended == step, said
    assert any(re.search(words, each) for each in said), said
    assert largest < 1.05 * of.i_max


@pytest.mark.slow
@pytest.mark.long("until the encoder slips")
@pytest.mark.parametrize("name", MOTORS)
def test_an_encoder_that_slips_ends_it(name: str) -> None:
    """The disc is loose, and keeps up with a shaft that is dragged; it does not with one that is spun."""
    grip = 0.1 * load_params(None).firmware.alpha_m_max if name == PAPER else 30.0
    said, ended, largest = said_of(of := made(name, True, faults__encoder__slip_alpha=grip))
    assert ended == "spin", said
    assert any("slip" in each for each in said), said
    assert largest < 1.05 * of.i_max


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

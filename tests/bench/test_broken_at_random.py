"""Devices broken at random behind links that lose at random: no traceback, no false `ok`, no false accusation.

The truth is the generator's: what it broke, what the link lost, how the shaft turned and how the outputs were left.
"""

from __future__ import annotations

import random
import re
from dataclasses import dataclass
from math import tau

import pytest
from against import bench
from conforming import ON_CAN, RICH, TO_MOTION, TO_STATES, TO_STREAMS
from lossy_link import LossyLink, Trouble, drawn
from test_bad_drive import COMMANDS, TABLES

from tests.choice import sampled
from tests.devices import FAULTS, FULL, OWN, serving
from tests.devices.device import Device
from tests.devices.spec import State

pytestmark = pytest.mark.slow

RUNS = 2000
CONFORM = {f"conform_{level}": f"conform TARGET --level {level} --yes" for level in range(5)}
ALL = COMMANDS | CONFORM
TURNS = {"spin": 300, "spin_longer": 300, "spin_fitted": 300}  # r/min
CODES = {0, 1, 2, 5, 6}
NOT_OK = {
    (frozenset(case.faults.split()), case.command) for rows in TABLES.values() for case in rows if 0 not in case.codes
}
"""Faults with which a command must not end well, however well the link works."""
OF_THE_MOTOR = {case.faults for case in TABLES["motors"]} | {"nan-samples", "overcurrent", "angles-unwrapped"}
OF_THE_HALLS = OF_THE_MOTOR | {
    "edges-uncounted",
    "hall-as-read",
    "hall-set-is-an-edge",
    "edges-after-samples",
    "n-p-zero",
}
MISDATED = {"samples-of-the-future", "samples-of-the-past"}
ACCUSATIONS = {
    r"has rebooted|reboots": {"reboots", "tick-back"},
    r"result +implausible: (?!the drive contradicts)": OF_THE_MOTOR | MISDATED,
    r"contradicts itself": {"edges-uncounted", "state-9", "tick-back", "outputs-told-off"} | MISDATED,
    r"let its motor run away": {"backwards", "setpoint-clipped"},
    r"two devices answer": set(),
    r"left RUNNING without": {"leaves-running", "foreign-stop"},
    r"did not start": {"start-stays-armed", "start-says-armed"},
    r"watchdog is inactive": {"no-watchdog", "no-watchdog-running", "watchdog-nan"},
}
"""Words that blame the device or the motor, and the faults of which each may be said."""


IN_BYTES = {2: TO_STREAMS, 3: TO_STREAMS | TO_STATES, 4: TO_STREAMS | TO_STATES | TO_MOTION}
FOUND = {
    (link, f"conform_{level}"): set(IN_BYTES.get(level, {}) if link == "bytes" else ON_CAN if level == 4 else {})
    for link in ("bytes", "CAN")
    for level in range(5)
}
"""What conform finds at a level, by its own tests."""


@dataclass(frozen=True)
class Case:
    """What is drawn."""

    command: str
    faults: tuple[str, ...]
    trouble: Trouble
    link: str
    own: bool
    pwm_hz: int


def draw(seed: int) -> Case:
    """A case: half of the devices are sound, and a third of the links."""
    dice = random.Random(f"broken {seed}")
    link = dice.choice(("bytes", "CAN"))
    possible = sorted(fault for fault in FAULTS if link == "CAN" or not fault.startswith(("can-", "foreign-")))
    faults = tuple(dice.sample(possible, dice.choice((0, 0, 0, 1, 1, 2))))
    return Case(dice.choice(sorted(ALL)), faults, drawn(dice), link, dice.random() < 0.1, dice.choice((250, 500, 1000)))


def judge(case: Case, seed: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Run it; the truth says what must not be said."""
    options = {"after": 0.3, "watchdog": 0.2, "pwm_hz": case.pwm_hz}
    words = OWN if case.own else RICH if case.command in CONFORM else FULL
    with serving(words, case.faults, case.link, **options) as device:
        device.link = link = LossyLink(device.link, case.trouble, random.Random(seed))
        ran = bench(ALL[case.command], device, capsys, patience=240.0)
    said, what = ran.text, f"{seed}: {case}\n{ran.out}\n{ran.err}"
    assert ran.code in CODES, what
    assert "a bug in hallbench" not in said, what
    if device.outputs_on:
        assert ran.code == 5, what
        assert "OUTPUTS MAY STILL BE ON" in said, what
    for words, faults in ACCUSATIONS.items():
        if not faults & set(case.faults):
            assert not re.search(words, said), f"{words}\n{what}"
    if case.command in ("hall", "hall_passive") and not OF_THE_HALLS & set(case.faults):
        dated = MISDATED & set(case.faults) and "the channel hall and the EDGES records contradict each other" in said
        assert dated or ran.code != 1, what
    if not case.faults and case.command in CONFORM:
        assert not re.search(r"does not conform|checks? failed", said), what
    if ran.code == 0:
        well(case, device, link, said, what)


def well(case: Case, device: Device, link: LossyLink, said: str, what: str) -> None:
    """What must be so where a command ended well."""
    assert device.state in (State.IDLE, State.FAULT), what
    assert (frozenset(case.faults), case.command) not in NOT_OK, what
    if case.command in CONFORM and not case.own:
        assert not set(case.faults) & FOUND[case.link, case.command], what
    if re.search(r"result +ok( |$)(?!as far)", said) and case.command in TURNS and not case.own:
        asked = TURNS[case.command] * tau / 60
        assert abs(device.motor.fastest - asked) < 0.1 * asked, what
        assert link.up.lost + link.up.damaged <= 0.2 * link.up.frames, what


@pytest.mark.parametrize("seed", sampled("broken", tuple(range(RUNS)), 12, campaign="broken"))
def test_nothing_false_is_said(seed: int, capsys: pytest.CaptureFixture[str]) -> None:
    judge(draw(seed), seed, capsys)

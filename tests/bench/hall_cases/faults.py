"""Faults of Hall sensors, wires, encoder and the drive's settings, each in several sizes, and what is to be said.

A case is a fault of one size on one of three motors at one of two speeds, with an encoder or without; its seed draws
all else: which sensor, when, how often. Shafts are turned as `bench hall check` does it; with seed 3 (mod 5) they are
run up and let go, with seed 4 turned by hand. `right` are codes of findings of which one is to be named; further ones
that are true are `allowed`, and any other is a wrong accusation. Where the recording cannot show the fault, or it is
smaller than `smallest`, saying that nothing is wrong is right too.
"""

from __future__ import annotations

import itertools
import math
import re
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from tests.bench.hall_cases.drives import MOTORS, around, drawn, telling_ring, top_rpm
from tests.bench.hall_cases.recording import Bounce, Contact, Pulses, Recording, Sensors, Three, Wires
from tests.bench.hall_cases.shaft import Way, check, coast, hand, rest

INPUTS = "abc"
PLACES = ("kind", "unkind", "turned")
"""Motors: six pole pairs and ideal sensors at 0 mod 60 deg; any with sensors as real ones are, anywhere; four or eight
with their sensors at 30 mod 60 deg."""
SMALL_PART = 6.0
"""Electrical deg, a tenth of a sector, within which an input that returns is a bounce."""
SEEN = 4.0
"""Electrical deg by which a delay moves an edge at the highest speed, below which it need not be named."""
TURNS = {True: 3.0, False: 8.0}
"""Of the shaft, both ways together, below which what comes once a turn need not be named: with an encoder, without."""
Codes = frozenset[str]


@dataclass(frozen=True)
class Expected:
    """What is to be said."""

    right: Codes = frozenset()
    """Empty: nothing is wrong."""
    allowed: Codes = frozenset()
    smallest: float | None = None
    """Instead of the fault's."""
    unseen: bool = False
    """Whether these data cannot show it."""
    inputs: str = ""
    """Letters of the inputs that may be named; empty: any."""


Made = tuple[Recording, Expected]
Make = Callable[[np.random.Generator, Recording, float], Made]


class Fault(NamedTuple):
    """A fault, in words; `sizes` in `unit`, of which `smallest` is the smallest that is to be named."""

    name: str
    about: str
    unit: str
    sizes: tuple[float, ...]
    smallest: float
    make: Make
    needs_encoder: bool = False


FAULTS: dict[str, Fault] = {}


def _fault(
    about: str, sizes: Iterable[float] = (1.0,), unit: str = "", smallest: float = 0.0, encoder: bool = False
) -> Callable[[Make], Make]:
    """A maker of cases; its name is the fault's."""

    def add(make: Make) -> Make:
        name = make.__name__.strip("_")
        FAULTS[name] = Fault(name, about, unit, tuple(sizes), smallest, make, encoder)
        return make

    return add


@dataclass(frozen=True)
class Case:
    """One of them."""

    fault: Fault
    size: float
    speed: str
    place: str
    encoder: bool
    seed: int

    @property
    def name(self) -> str:
        with_it = "encoder" if self.encoder else "none"
        return f"{self.fault.name}/{self.size:g}/{self.speed}/{self.place}/{with_it}/{self.seed}"

    @cached_property
    def _made(self) -> Made:
        rng = np.random.default_rng(zlib.crc32(self.name.encode()))
        return self.fault.make(rng, base(rng, self), self.size)

    @property
    def recording(self) -> Recording:
        return self._made[0]

    @property
    def expected(self) -> Expected:
        return self._made[1]

    @property
    def large(self) -> bool:
        """Whether it is to be named."""
        its = self.expected
        smallest = self.fault.smallest if its.smallest is None else its.smallest
        return bool(its.right) and not its.unseen and self.size >= smallest

    def judged(self, verdict: str, said: Iterable[tuple[str, str]]) -> str:
        """right, cannot tell, missed or wrong, of a verdict and findings (code, words)."""
        its, said = self.expected, list(said)
        codes = {code for code, _ in said}
        if verdict == "INVALID" and not codes:
            return "cannot tell"
        if codes - its.right - its.allowed or (its.inputs and any(others_named(its, *one) for one in said)):
            return "wrong"
        if codes & its.right or (codes <= its.allowed and not self.large):
            return "right"
        return "missed"


def others_named(its: Expected, code: str, words: str) -> bool:
    """Whether the words accuse inputs, none of which has anything."""
    named = set("".join(re.findall(r"\b(?:sensor|input)s? ([abc])\b", words)))
    return code in its.right and bool(named) and not named & set(its.inputs)


def cases(only: str = "", quick: bool = False, seeds: int = 5, first: int = 0) -> Iterator[Case]:
    """All of them, or those of faults whose names have `only` in them; `quick`: one of the seeds for each, in turn.

    `first`: the first of the seeds, for cases that nobody has looked at.
    """
    number = 0
    for fault in FAULTS.values():
        kinds = itertools.product(fault.sizes, (True, False)[: 2 - fault.needs_encoder], ("slow", "fast"), PLACES)
        for size, encoder, speed, place in kinds if only in fault.name else ():
            number += 1
            for seed in (number % seeds,) if quick else range(seeds):
                yield Case(fault, size, speed, place, encoder, first + seed)


def by_name(name: str) -> Case:
    """The case of this name."""
    fault, size, speed, place, encoder, seed = name.split("/")
    return Case(FAULTS[fault], float(size), speed, place, encoder == "encoder", int(seed))


def base(rng: np.random.Generator, case: Case) -> Recording:
    """The drive that a fault is given; half of them tell where their ring is."""
    place = case.place
    n_p = {"kind": 6, "unkind": int(rng.choice([2, 3, 4, 7, 10, 15, 23])), "turned": int(rng.choice([4, 8]))}[place]
    motor = next((motor for motor in MOTORS if motor.n_p == n_p), MOTORS[5]._replace(n_p=n_p))
    top = top_rpm(motor, case.speed)
    way = check(top, n_p)
    if case.seed % 5 == 3:
        way = coast(top, float(rng.uniform(2.0, 4.0)))
    elif case.seed % 5 == 4:
        way = hand({"slow": 40.0, "fast": 80.0}[case.speed], max(2.5, 12.0 / n_p))
    recording = around(rng, motor, way, case.encoder)
    if place == "kind":
        return telling_ring(recording) if rng.uniform() < 0.5 else recording
    sensors = drawn(rng, n_p, recording.omega)
    if place == "turned":
        sensors = replace(sensors, ring=30.0 + 60.0 * int(rng.integers(6)) + float(rng.normal(0.0, 3.0)))
    recording = recording.but(sensors=sensors)
    return telling_ring(recording) if rng.uniform() < 0.5 else recording


def is_(*right: str, allowed: Iterable[str] = (), **further: object) -> Expected:
    return Expected(frozenset(right), frozenset(allowed), **further)  # type: ignore[arg-type]


def _one(rng: np.random.Generator) -> tuple[int, str]:
    number = int(rng.integers(3))
    return number, INPUTS[number]


def _some(rng: np.random.Generator) -> tuple[tuple[int, ...], str]:
    """One input or all."""
    number, letter = _one(rng)
    return ((number,), letter) if rng.uniform() < 0.6 else ((0, 1, 2), "")


def _log(rng: np.random.Generator, lo: float, hi: float) -> float:
    return float(np.exp(rng.uniform(math.log(lo), math.log(hi))))


def _at(rng: np.random.Generator, sensors: Sensors, name: str, number: int, value: float) -> Sensors:
    values: list[float] = list(getattr(sensors, name))
    values[number] = value
    return replace(sensors, **{name: tuple(values)})  # type: ignore[arg-type]


# -- inputs that do not change -------------------------------------------------------------------------------------


@_fault("an input that is open, and reads 1 always")
def open_input(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    return on.with_effect(Contact((number,), 1.0, 0.0, 1)), is_("dead", inputs=letter)


@_fault("an input that is shorted, and reads 0 always")
def shorted_input(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    return on.with_effect(Contact((number,), 1.0, 0.0, 0)), is_("dead", inputs=letter)


@_fault("an input that is dead from this share of the run on", (20.0, 50.0, 75.0), "%")
def dead_later(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    since = (0.01 * size + float(rng.uniform(-0.1, 0.1))) * on.way.seconds
    effect = Contact((number,), 1.0, 0.0, int(rng.integers(2)), since)
    return on.with_effect(effect), is_("dead", "contact", inputs=letter)


@_fault("one wire with an intermittent contact, open for this share of the time in stretches of 5 to 100 ms",
        (0.2, 2.0, 10.0, 50.0), "%", 2.0)  # fmt: skip
def contact(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    seconds = _log(rng, 0.005, 0.1)
    few = 0.01 * size * on.way.seconds / seconds < 8.0  # stretches, half of which show
    effect = Contact((number,), 0.01 * size, seconds, int(rng.uniform() < 0.3))
    return on.with_effect(effect), is_(
        "contact", allowed=("pulses",) if seconds < 0.01 else (), unseen=few, inputs=letter
    )


@_fault("one wire that has contact now and then only, open for this share of the time", (80.0, 95.0, 99.0), "%")
def contact_mostly_open(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    effect = Contact((number,), 0.01 * size, _log(rng, 0.01, 0.1), int(rng.uniform() < 0.7))
    return on.with_effect(effect), is_("contact", *(("dead",) if size >= 95 else ()), allowed=("dead",), inputs=letter)


@_fault(
    "one wire with a contact that opens for 0.05 to 1 ms, for this share of the time", (0.1, 1.0, 10.0, 30.0), "%", 1.0
)
def contact_short(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    effect = Contact((number,), 0.01 * size, _log(rng, 0.05e-3, 1e-3), int(rng.uniform() < 0.7))
    return on.with_effect(effect), is_("contact", "pulses", inputs=letter)


@_fault("two wires with intermittent contacts, each open for this share of the time", (2.0, 10.0, 40.0), "%", 2.0)
def contact_two(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    both = tuple(k for k in range(3) if k != number)
    seconds = _log(rng, 0.001, 0.05)
    few = 0.01 * size * on.way.seconds / seconds < 8.0
    effect = Contact(both, 0.01 * size, seconds, int(rng.uniform() < 0.7), together=bool(rng.integers(2)))
    letters = INPUTS.replace(letter, "")
    return on.with_effect(effect), is_(
        "contact", allowed=("pulses",) if seconds < 0.01 else (), unseen=few, inputs=letters
    )


# -- pulses and bounces --------------------------------------------------------------------------------------------


def _pulses(
    rng: np.random.Generator, on: Recording, rate: float, width: tuple[float, float], current: bool = False
) -> Made:
    inputs, letter = _some(rng)
    wide = on.omega * width[1] > 20.0  # deg: a third of a sector
    n = rate * on.way.seconds
    made = on.with_effect(Pulses(inputs, rate, width, current))
    return made, is_("pulses", *(("contact",) if wide else ()), unseen=n < 8.0, inputs=letter)


@_fault("false pulses of 1 to 20 us, this many a second", (0.3, 3.0, 50.0, 1000.0), "1/s", 1.0)
def pulses_narrow(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _pulses(rng, on, size, (1e-6, 20e-6))


@_fault("false pulses of 20 to 300 us, this many a second", (0.3, 3.0, 30.0, 300.0), "1/s", 1.0)
def pulses_wide(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _pulses(rng, on, size, (20e-6, 300e-6))


@_fault("false pulses of 0.3 to 3 ms, this many a second", (3.0, 20.0), "1/s", 1.0)
def pulses_of_ms(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _pulses(rng, on, size, (0.3e-3, 3e-3))


@_fault("false pulses of 2 to 100 us that come with current, this many a second at most", (10.0, 300.0), "1/s", 1.0)
def pulses_with_current(rng: np.random.Generator, on: Recording, size: float) -> Made:
    way = on.way if on.way.powered else check(top_rpm(on.motor, "slow"), on.motor.n_p)  # by hand there is no current
    return _pulses(rng, on.but(way=way, loads=float(rng.uniform(2.0, 8.0))), size, (2e-6, 100e-6), True)


def _bounce(on: Recording, effect: Bounce, letter: str) -> Made:
    """A bounce that lasts for more than a small part of a sector may be taken for pulses."""
    lasts = 2 * effect.returns * effect.spacing * (2.0 if effect.random else 1.1)
    edges = 2.0 * effect.share * len(effect.inputs) * float(np.abs(np.diff(on.shaft)).sum()) * on.motor.n_p / math.tau
    further = ("pulses",) if lasts * on.omega > SMALL_PART else ()
    return on.with_effect(effect), is_("bounce", *further, unseen=edges < 10.0, inputs=letter)


@_fault("every edge of all inputs returns once to three times, after this many us", (5.0, 20.0, 60.0, 300.0), "us")
def bounce_all(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _bounce(on, Bounce((0, 1, 2), 1.0, int(rng.integers(1, 4)), 1e-6 * size), "")


@_fault("this share of the edges of one input returns, once to three times after 10 to 200 us",
        (3.0, 15.0, 50.0, 100.0), "%", 10.0)  # fmt: skip
def bounce_one(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    return _bounce(on, Bounce((number,), 0.01 * size, int(rng.integers(1, 4)), _log(rng, 10e-6, 200e-6)), letter)


@_fault("this share of all edges returns, once to three times after 10 to 200 us", (1.0, 5.0, 20.0), "%", 5.0)
def bounce_some(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _bounce(on, Bounce((0, 1, 2), 0.01 * size, int(rng.integers(1, 4)), _log(rng, 10e-6, 200e-6)), "")


@_fault("edges that return up to six times at random, this many us apart in the mean", (10.0, 50.0), "us")
def bounce_at_random(rng: np.random.Generator, on: Recording, size: float) -> Made:
    inputs, letter = _some(rng)
    effect = Bounce(inputs, float(rng.uniform(0.3, 1.0)), int(rng.integers(1, 7)), 1e-6 * size, random=True)
    return _bounce(on, effect, letter)


# -- edges that come late ------------------------------------------------------------------------------------------


def _late(rng: np.random.Generator, on: Recording, size: float, which: str, some: tuple[int, ...]) -> Made:
    sensors = on.sensors
    for name in ("rise_late", "fall_late"):
        if which in (name, "both"):
            for number in some:
                sensors = _at(rng, sensors, name, number, 1e-6 * size)
    letter = INPUTS[some[0]] if len(some) == 1 else ""
    small = on.omega * 1e-6 * size < SEEN or (which == "both" and not on.encoder)
    return on.but(sensors=sensors), is_("late_edges", unseen=small, inputs=letter)


@_fault("rising edges of all inputs are late: weak pull-ups", (150.0, 300.0, 1000.0), "us", 300.0)
def rises_late(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _late(rng, on, size, "rise_late", (0, 1, 2))


@_fault("rising edges of one input are late", (150.0, 300.0, 1000.0), "us", 300.0)
def rises_late_one(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _late(rng, on, size, "rise_late", (int(rng.integers(3)),))


@_fault("falling edges are late, of one input or of all", (150.0, 400.0, 1000.0), "us", 400.0)
def falls_late(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _late(rng, on, size, "fall_late", _some(rng)[0])


@_fault("all edges of all inputs are late: a filter", (300.0, 700.0, 1500.0), "us", 700.0)
def all_late(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _late(rng, on, size, "both", (0, 1, 2))


# -- sensors and magnets -------------------------------------------------------------------------------------------


@_fault("one sensor off its place, against the middle of the two others", (5.0, 15.0, 20.0, 30.0), "deg", 15.0)
def displaced(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    off = [0.0 if on.sensors.displaced == (0.0, 0.0, 0.0) else float(rng.uniform(-3.0, 3.0))] * 3
    off[(number + 1) % 3] *= -1.0
    off[number] = size * float(rng.choice([-1.0, 1.0]))
    a, b, c = off
    rest_of_it = ("hall_setting", "encoder_zero") if size >= 24.0 else ()  # a third of it is common to all
    return on.sensing(displaced=(a, b, c)), is_("displaced", allowed=rest_of_it, inputs=letter)


@_fault("rise and fall of one sensor apart, each by this much", (4.0, 12.0, 18.0), "deg", 12.0)
def apart_one(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    sensors = _at(rng, on.sensors, "apart", number, size * float(rng.choice([-1.0, 1.0])))
    return on.but(sensors=sensors), is_("duty", inputs=letter)


@_fault("rise and fall of all sensors apart, each by this much: weak magnets", (4.0, 12.0, 18.0), "deg", 12.0)
def apart_all(rng: np.random.Generator, on: Recording, size: float) -> Made:
    size *= float(rng.choice([-1.0, 1.0]))
    return on.sensing(apart=(size, size, size)), is_("duty")


@_fault("edges that do not stand still, of one sensor or all, rms", (1.0, 3.5, 6.0), "deg", 3.5)
def unsteady(rng: np.random.Generator, on: Recording, size: float) -> Made:
    inputs, letter = _some(rng)
    sensors = on.sensors
    for number in inputs:
        sensors = _at(rng, sensors, "jitter", number, size)
    return on.but(sensors=sensors), is_("unsteady", unseen=_by_hand_alone(on), inputs=letter)


def _by_hand_alone(on: Recording) -> bool:
    """Whether a hand's own unsteadiness hides that of edges: there is no encoder."""
    return not on.encoder and on.way.by_hand > 0.0


def _magnets(on: Recording) -> np.ndarray:
    return np.array(on.sensors.magnets or [0.0] * 2 * on.motor.n_p)


def _hardly_a_turn(on: Recording) -> bool:
    """Whether these data do not tell what comes once a turn: of two pole pairs, each shows the other's."""
    turns = float(np.abs(np.diff(on.shaft)).sum()) / math.tau
    return on.motor.n_p < 3 or turns < TURNS[on.encoder is not None] or _by_hand_alone(on)


@_fault("one pole pair off its place", (3.0, 8.0, 12.0, 15.0), "deg", 8.0)
def pole_pair_off(rng: np.random.Generator, on: Recording, size: float) -> Made:
    ends = _magnets(on)
    first = 2 * int(rng.integers(on.motor.n_p))
    ends[first : first + 2] += size * float(rng.choice([-1.0, 1.0])) - ends[first : first + 2].mean()
    smallest = 8.0 if on.encoder else 12.0
    return on.sensing(magnets=tuple(ends.tolist())), is_("magnet", smallest=smallest, unseen=_hardly_a_turn(on))


@_fault("all poles uneven, standard deviation", (1.4, 4.0, 6.0), "deg", 4.0)
def poles_uneven(rng: np.random.Generator, on: Recording, size: float) -> Made:
    ends = rng.normal(0.0, 1.0, 2 * on.motor.n_p)
    ends = (ends - ends.mean()) / ends.std() * size
    smallest = 4.0 if on.encoder else 6.0
    return on.sensing(magnets=tuple(ends.tolist())), is_("magnet", smallest=smallest, unseen=_hardly_a_turn(on))


@_fault("an eccentric magnet ring, amplitude", (1.5, 5.0, 10.0), "deg", 5.0)
def ring_eccentric(rng: np.random.Generator, on: Recording, size: float) -> Made:
    n = 2 * on.motor.n_p
    ends = _magnets(on) + size * np.sin(math.tau * np.arange(n) / n + rng.uniform(0.0, math.tau))
    unseen = _hardly_a_turn(on) or not on.encoder  # without an encoder a load that is uneven does the same
    return on.sensing(magnets=tuple(ends.tolist())), is_("magnet", "encoder_eccentric", unseen=unseen)


# -- wires and settings --------------------------------------------------------------------------------------------


def _emf(on: Recording) -> bool:
    """Whether the back-EMF tells where the rotor flux is."""
    return on.voltages and bool(on.way.powered)


def _known(on: Recording) -> bool:
    return "hall_offset" in on.parameters


@_fault("two of the Hall wires exchanged")
def exchanged(rng: np.random.Generator, on: Recording, size: float) -> Made:
    order = [(1, 0, 2), (0, 2, 1), (2, 1, 0)][int(rng.integers(3))]
    further = () if _emf(on) else ("encoder_reversed",)
    return on.but(wires=Wires(order)), is_("wiring", "hall_setting", *further, unseen=not on.encoder)


def _shifted(on: Recording, wires: Wires) -> Made:
    """The same as a ring elsewhere: seen by a drive that knows where the ring is, and where the rotor is."""
    further = () if _emf(on) else ("encoder_zero",)
    unseen = not _known(on) or not on.encoder
    return on.but(wires=wires), is_("wiring", "hall_setting", *further, unseen=unseen)


@_fault("the three Hall wires rotated")
def rotated(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _shifted(on, Wires([(1, 2, 0), (2, 0, 1)][int(rng.integers(2))]))


@_fault("all three inputs inverted")
def inverted_all(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _shifted(on, Wires(inverted=7))


@_fault("one input inverted")
def inverted_one(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return on.but(wires=Wires(inverted=1 << int(rng.integers(3)))), is_("wiring", "hall_setting")


@_fault("any order of the wires, with one or two inputs inverted")
def any_wires(rng: np.random.Generator, on: Recording, size: float) -> Made:
    order = [(0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0), (2, 0, 1)][int(rng.integers(6))]
    further = () if _emf(on) else ("encoder_reversed", "encoder_zero")
    return on.but(wires=Wires(order, int(rng.integers(1, 7)))), is_("wiring", "hall_setting", allowed=further)


@_fault("sensors 60 deg apart, their wires in any order")
def sixty(rng: np.random.Generator, on: Recording, size: float) -> Made:
    made, expected = any_wires(rng, on, size)
    return made.but(wires=replace(made.wires, inverted=0)).sensing(spacing=60.0), expected


@_fault("a drive that takes the ring to be elsewhere, by this angle", (3.0, 15.0, 30.0, 60.0, 180.0), "deg", 15.0)
def setting_of_ring(rng: np.random.Generator, on: Recording, size: float) -> Made:
    ring = on.sensors.ring
    wrong = telling_ring(on.sensing(ring=ring + size * float(rng.choice([-1.0, 1.0]))))
    further = () if _emf(on) else ("encoder_zero",)
    shifted = ("wiring",) if size % 60.0 == 0.0 else ()
    return wrong.sensing(ring=ring), is_("hall_setting", *further, *shifted, unseen=not on.encoder)


@_fault("a drive that takes wires to be exchanged (1), or one input to be inverted (2), that are not", (1.0, 2.0))
def setting_of_wires(rng: np.random.Generator, on: Recording, size: float) -> Made:
    name, value = (("hall_swap_hat", int(rng.integers(1, 4))), ("hall_invert_hat", 1 << int(rng.integers(3))))[
        int(size) - 1
    ]
    unseen = size == 1.0 and not on.encoder
    further = () if _emf(on) else ("encoder_reversed",)
    order = {1: (1, 0, 2), 2: (0, 2, 1), 3: (2, 1, 0)}[value] if size == 1.0 else (0, 1, 2)
    wires = Wires(order, 0 if size == 1.0 else value)  # codes are told as the drive corrects them
    made = on.but(wires=wires, parameters=on.parameters | {name: float(value)})
    return made, is_("hall_setting", "wiring", *further, unseen=unseen)


# -- encoder -------------------------------------------------------------------------------------------------------


@_fault("the encoder's zero off by this much", (2.0, 6.0, 15.0, 60.0, 180.0), "deg", 6.0, encoder=True)
def encoder_zero(rng: np.random.Generator, on: Recording, size: float) -> Made:
    further = () if _emf(on) else ("hall_setting", "wiring") if _known(on) else ()
    smallest = 6.0 if _emf(on) else 15.0
    made = on.encoding(zero=size * float(rng.choice([-1.0, 1.0])))
    return made, is_("encoder_zero", *further, smallest=smallest, unseen=not _emf(on) and not _known(on))


@_fault("an encoder that counts down where the rotor turns up", encoder=True)
def encoder_reversed(rng: np.random.Generator, on: Recording, size: float) -> Made:
    further = () if _emf(on) else ("wiring", "hall_setting")
    return on.encoding(way=-1.0), is_("encoder_reversed", *further, allowed=("encoder_zero",))


@_fault("an encoder that shows where the rotor was", (50.0, 250.0, 1000.0), "us", 250.0, encoder=True)
def encoder_late(rng: np.random.Generator, on: Recording, size: float) -> Made:
    on = on.sensing(
        rise_late=(0.0, 0.0, 0.0), fall_late=(0.0, 0.0, 0.0)
    )  # else Hall edges that are late hide some of it
    return on.encoding(late=1e-6 * size), is_("encoder_late", unseen=on.omega * 1e-6 * size < SEEN)


def _slipped(rng: np.random.Generator, on: Recording, size: float, after: float) -> Made:
    """At the first moment after `after` s when the shaft is not near its zero: there it could be an index pulse."""
    turns, its = on.shaft / math.tau, on.encoder
    assert its is not None
    angle = (turns * on.motor.n_p * 360.0 + its.zero) % 360.0
    moving = np.abs(np.gradient(turns, on.t)) * on.motor.n_p > 1.0
    there = (on.t >= after) & (angle > 100.0 + size) & (angle < 260.0 - min(size, 60.0)) & moving
    there &= (turns % 1.0 > 0.1) & (turns % 1.0 < 0.9)
    when = float(on.t[np.argmax(there)]) if there.any() else after
    count = 360.0 * on.motor.n_p / (4 * its.lines)
    by = size * float(rng.choice([-1.0, 1.0]))
    made = on.encoding(slips=((when, by),))
    allowed = ["encoder_zero"] if size >= 2.0 or abs(its.zero + by) > 2.2 else []  # then it is off by enough
    if size > 9.0 and _known(on) and not _emf(on):  # as an encoder's zero that is off is told
        allowed += ["hall_setting", "wiring"]
    early = float(np.ptp(turns[on.t <= when])) < 1.2  # an index pulse that sets an angle of its own looks the same
    unseen = early and not _emf(on) and not _known(on)
    return made, is_("encoder_slipped", allowed=allowed, smallest=max(3.0, 3.0 * count), unseen=unseen)


@_fault("an encoder that slips once, at any moment", (1.0, 3.0, 5.0, 20.0, 60.0), "deg", 3.0, encoder=True)
def encoder_slips_once(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _slipped(rng, on, size, float(rng.uniform(0.12, 0.88)) * on.way.seconds)


@_fault("an encoder that slips as the shaft turns round", (1.0, 3.0, 10.0, 20.0), "deg", 10.0, encoder=True)
def encoder_slips_between(rng: np.random.Generator, on: Recording, size: float) -> Made:
    made, expected = _slipped(rng, on, size, 0.0)
    assert made.encoder is not None
    (_, by) = made.encoder.slips[0]
    turns_back = float(on.t[np.argmax(np.cumsum(np.gradient(on.shaft)))])
    return made.encoding(slips=((turns_back, by),)), replace(expected, smallest=10.0, unseen=False)


@_fault("an encoder that slips within the first turn of the shaft", (5.0, 20.0, 60.0), "deg", 5.0, encoder=True)
def encoder_slips_first(rng: np.random.Generator, on: Recording, size: float) -> Made:
    first = float(on.t[np.argmax(np.abs(on.shaft - on.shaft[0]) > math.tau * rng.uniform(0.3, 0.7))])
    return _slipped(rng, on, size, first)


@_fault("an encoder that slips three to ten times, by this much each", (5.0, 20.0), "deg", 5.0, encoder=True)
def encoder_slips_often(rng: np.random.Generator, on: Recording, size: float) -> Made:
    when = np.sort(rng.uniform(0.1, 0.9, int(rng.integers(3, 11)))) * on.way.seconds
    made = on.encoding(slips=tuple((float(t), size * float(rng.choice([-1.0, 1.0]))) for t in when))
    return made, is_("encoder_slipped", "encoder_slips", "encoder_drifts", allowed=("encoder_zero",))


@_fault("counts lost at one place of the disc, whichever way it goes: this much a turn", (0.2, 4.0, 20.0), "deg", 4.0,
        encoder=True)  # fmt: skip
def counts_lost(rng: np.random.Generator, on: Recording, size: float) -> Made:
    drifts = is_("encoder_drifts", "encoder_slips", "pole_pairs", allowed=("encoder_zero", "encoder_slipped"))
    return on.encoding(lost=size), _by_way(on, size, drifts)


@_fault("counts gained at any place, whichever way it goes: this much a turn", (0.2, 4.0, 20.0), "deg", 4.0,
        encoder=True)  # fmt: skip
def counts_gained(rng: np.random.Generator, on: Recording, size: float) -> Made:
    drifts = is_("encoder_drifts", "encoder_slips", allowed=("encoder_zero", "encoder_slipped"))
    return on.encoding(gained=size), _by_way(on, size, drifts)


def _by_way(on: Recording, size: float, expected: Expected) -> Expected:
    """Seen where all of it is some degrees; one step of it is a slip."""
    turns = float(np.ptp(on.shaft)) / math.tau
    if turns < 3.0:
        expected = replace(expected, right=expected.right | {"encoder_slipped"})
    return replace(expected, unseen=turns * size < 8.0)


@_fault("an encoder with this many times the counts that the drive takes it to have (lines, quadrature, a gear)",
        (0.2, 0.25, 0.5, 2.0, 4.0, 5.0), "times", encoder=True)  # fmt: skip
def lines_times(rng: np.random.Generator, on: Recording, size: float) -> Made:
    n = on.motor.n_p * 1.0 / size
    drifts = () if abs(n - round(n)) < 1e-6 and n >= 1 else ("encoder_slips",)
    return on.but(decimation=1).encoding(ratio=size), is_("pole_pairs", *drifts, allowed=("encoder_zero",))


@_fault("an encoder with nearly the right lines: this ratio", (0.9766, 1.024, 1.2), "times", encoder=True)
def lines_nearly(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return on.encoding(ratio=size), is_("encoder_slips", "encoder_drifts", "pole_pairs", allowed=("encoder_zero",))


@_fault("a drive with the wrong pole pairs: more by", (-2.0, -1.0, 1.0, 2.0))
def wrong_n_p(rng: np.random.Generator, on: Recording, size: float) -> Made:
    n_p = max(1, on.motor.n_p + int(size))
    n_p = n_p if n_p != on.motor.n_p else n_p + 1
    return on.but(n_p=n_p), is_("pole_pairs", allowed=("encoder_zero",), smallest=-9.0, unseen=not on.encoder)


@_fault("an eccentric disc of the encoder, amplitude", (1.0, 5.0, 10.0), "deg", 5.0, encoder=True)
def disc_eccentric(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return on.encoding(eccentric=size), is_(
        "encoder_eccentric", "magnet", allowed=("encoder_zero",), unseen=_hardly_a_turn(on)
    )


@_fault("an encoder whose angle scatters, rms", (0.5, 4.0, 8.0), "deg", 4.0, encoder=True)
def encoder_noisy(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return on.encoding(noise=size), is_("unsteady", "encoder_slips")


# -- two at once ---------------------------------------------------------------------------------------------------


def _both(rng: np.random.Generator, on: Recording, *two: tuple[Make, float]) -> Made:
    """The second on top of the first; one of both is to be named."""
    found = Expected(unseen=True)
    for make, size in two:
        on, its = make(rng, on, size)
        found = Expected(found.right | its.right, found.allowed | its.allowed, 0.0, found.unseen and its.unseen)
    return on, found


TWO: tuple[tuple[tuple[Make, float], tuple[Make, float]], ...] = (
    ((displaced, 20.0), (bounce_all, 20.0)), ((encoder_slips_once, 20.0), (pulses_wide, 30.0)),
    ((exchanged, 1.0), (bounce_one, 50.0)), ((encoder_zero, 15.0), (rises_late, 1000.0)),
    ((open_input, 1.0), (encoder_slips_once, 20.0)), ((wrong_n_p, 1.0), (pulses_narrow, 50.0)),
    ((pole_pair_off, 12.0), (contact, 10.0)), ((lines_times, 4.0), (apart_one, 18.0)),
    ((inverted_one, 1.0), (bounce_some, 20.0)), ((encoder_late, 1000.0), (unsteady, 6.0)),
)  # fmt: skip


@_fault("two faults at once, pair", tuple(map(float, range(len(TWO)))), encoder=True)
def two(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return _both(rng, on, *TWO[int(size)])


# -- nothing is wrong ----------------------------------------------------------------------------------------------


@_fault("nothing: the ring sits anywhere, and the drive does not know where (1) or does (2)", (1.0, 2.0))
def ring_anywhere(rng: np.random.Generator, on: Recording, size: float) -> Made:
    there = on.sensing(ring=float(rng.uniform(-180.0, 180.0)))
    return telling_ring(there) if size == 2.0 else there.but(parameters={}), is_()


@_fault("nothing: an index pulse that comes later than the first sample, after this share of a turn", (0.02, 0.3, 0.9),
        encoder=True)  # fmt: skip
def index_later(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return on.but(start=1.0 - size).encoding(indexed=False), is_()


@_fault("nothing: codes that are sampled this many times a second", (2000.0, 5000.0, 16000.0), "Hz")
def codes_sampled(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return on.but(resolution=1.0 / size), is_()


@_fault("nothing: samples that come this many times a second", (1000.0, 2000.0), "Hz")
def slow_samples(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return on.but(decimation=round(on.pwm_hz / size)), is_()


@_fault(
    "nothing: a shaft that rocks by this much (electrical) at 2 to 20 Hz, or trembles",
    (1.0, 5.0, 40.0, 100.0, 400.0),
    "deg",
)
def rocking(rng: np.random.Generator, on: Recording, size: float) -> Made:
    angle = math.radians(size) / on.motor.n_p
    still = rest(float(rng.uniform(2.0, 8.0)))
    way = (
        replace(still, tremble=angle)
        if size < 10.0 and rng.integers(2)
        else replace(still, rocking=(angle, _log(rng, 2.0, 20.0)))
    )
    edge = on.sensors.ring + 60.0 * int(rng.integers(6)) + float(rng.normal(0.0, 0.3 * size))
    return on.but(way=way, start=edge / (360.0 * on.motor.n_p)), is_()


@_fault("an input that chatters, this much of the time, while the shaft stands", (10.0, 50.0), "%")
def chatter_at_rest(rng: np.random.Generator, on: Recording, size: float) -> Made:
    number, letter = _one(rng)
    made = on.but(way=rest(float(rng.uniform(2.0, 8.0))))
    effect = Contact((number,), 0.01 * size, _log(rng, 0.1e-3, 0.02), int(rng.integers(2)))
    return made.with_effect(effect), is_("contact", "pulses", "bounce", unseen=True, inputs=letter)


@_fault("nothing: a shaft that is turned by hand, this many turns each way", (0.5, 3.0))
def by_hand(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return on.but(way=hand(float(rng.uniform(30.0, 80.0)), size)), is_()


@_fault("nothing: a shaft that coasts down, or stands", (0.0, 1.0))
def coasting(rng: np.random.Generator, on: Recording, size: float) -> Made:
    return on.but(way=coast(on.way.top, float(rng.uniform(1.0, 4.0))) if size else rest()), is_()


@_fault("nothing: one input inverted (1) or sensors 60 deg apart (2), and the drive knows it", (1.0, 2.0))
def settings_right(rng: np.random.Generator, on: Recording, size: float) -> Made:
    """What the drive corrects does not show: codes are told as it corrects them."""
    name, value = (("hall_invert_hat", 1 << int(rng.integers(3))), ("hall_swap_hat", int(rng.integers(1, 6))))[
        int(size) - 1
    ]
    return on.but(parameters=on.parameters | {name: float(value)}), is_()


__all__ = ["FAULTS", "Case", "Expected", "Fault", "Three", "Way", "base", "by_name", "cases"]

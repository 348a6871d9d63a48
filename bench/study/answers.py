"""What a study says, from its rows: as objects, as plain data, and in a few lines."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bench.files import finite
from bench.study.capability import Capability, capability
from bench.study.drives import ALL, Drives
from bench.study.pairs import ValuePair, YieldPair, value_pairs, yield_pairs
from bench.study.rows import Rows
from bench.study.sensitivity import Sensitivity, sensitivities
from bench.study.statistics import Estimate, figure, percent, span
from bench.study.worst import Worst, worst
from bench.study.yields import Yield, yields
from protocol.text import counted


@dataclass(frozen=True)
class About:
    """What a study says of itself."""

    title: str
    facts: tuple[tuple[str, str], ...]
    """Label and text: what is varied and how, experiments, designs, versions."""
    sampling: str
    """How the drives were drawn, in words."""
    sample_count: int
    """Drives that were asked for."""
    replay: Callable[[int], str]
    """The command that runs a row again."""
    points: bool = False
    """Drawn evenly (Sobol points, Latin hypercube), not each by chance."""
    saltelli: tuple[str, ...] = ()
    """The factors of a Saltelli design without second order, in SALib's order; empty of other sampling."""


@dataclass(frozen=True)
class Answers:
    """All that can be said."""

    drives: int
    """Drives of which there are rows."""
    yields: list[Yield]
    capability: list[Capability]
    """By measurement, those with the least room first, then those without limits."""
    sensitivity: list[Sensitivity]
    inputs: tuple[str, ...]
    """Those that indices are told of."""
    worst: list[Worst]
    yield_pairs: list[YieldPair]
    """Every other design against the first."""
    value_pairs: list[ValuePair]
    notes: tuple[str, ...]
    """What to know of the figures: how drives were drawn, what is left out."""


def answer(rows: Rows, about: About) -> Answers:
    """Compute them."""
    designs = drives_of(rows, about)
    every = sorted(rows.measured, key=lambda name: name not in rows.limits)
    found = [each for name in every for drives in designs if (each := capability(drives, name)) is not None]
    room: dict[str, tuple[bool, float, float]] = {}
    for each in found:
        room[each.name] = min(room.get(each.name, (True, math.inf, math.inf)), _room(each))
    found.sort(key=lambda each: room[each.name])
    names = list(room)
    names.sort(key=lambda name: room[name])
    tests = [ALL, *rows.verdicts]
    pairs = [(designs[0], other) for other in designs[1:]]
    inputs = [name for drives in designs for name in drives.inputs.told]
    left = [note for drives in designs for note in drives.inputs.notes]
    full = [Drives(rows, drives.design) for drives in designs]
    return Answers(
        len(np.unique(rows.sample)),
        yields(designs),
        found,
        [each for drives in designs for each in sensitivities(drives, names, about.saltelli)],
        about.saltelli or tuple(dict.fromkeys(inputs)),
        sorted((each for drives in full for each in worst(drives, about.replay)), key=_badness),
        sorted((one for pair in pairs for one in yield_pairs(*pair)), key=lambda one: tests.index(one.test)),
        sorted((one for pair in pairs for one in value_pairs(*pair, names)), key=lambda one: names.index(one.name)),
        tuple(_notes(rows, about, list(dict.fromkeys(left)), designs)),
    )


def drives_of(rows: Rows, about: About) -> list[Drives]:
    """The independent drives of each design that has any."""
    groups = len(about.saltelli) + 2 if about.saltelli else 0
    every = (Drives(rows, design, groups) for design in range(len(rows.designs)))
    return [drives for drives in every if len(drives)]


def _once(found: list[Capability]) -> list[str]:
    return list(dict.fromkeys(each.name for each in found))


def _room(found: Capability) -> tuple[bool, float, float]:
    beyond = max((side.share.value for side in found.sides), default=0.0)
    away = min((side.away.value for side in found.sides if side.away), default=math.inf)
    return not found.sides, -beyond, away


def _badness(found: Worst) -> tuple[bool, float]:
    return found.verdict == "PASS", -math.inf if math.isnan(found.share) else found.share


def _notes(rows: Rows, about: About, left: list[str], designs: list[Drives]) -> list[str]:
    there, repetitions = len(np.unique(rows.sample)), int(rows.repetition.max(initial=0)) + 1
    notes = []
    if there < about.sample_count:
        notes.append(f"{there} of {about.sample_count} drives are there: the rest was not run yet, or is lost.")
    if about.saltelli and designs:
        notes.append(
            f"Of each {len(about.saltelli) + 2} drives of a Saltelli design two are drawn independently. Yields, "
            f"distributions and comparisons are of those {len(designs[0])} only; indices are of all."
        )
    if about.points or about.saltelli:
        notes.append(
            "Drives drawn evenly are not independent of each other. For figures that grow or fall with each input the "
            "intervals are wider than they need be; for others they are not exact."
        )
    if repetitions > 1:
        notes.append(
            f"The {repetitions} repetitions of a drive are not independent: a drive counts once, and passes if all of "
            "them pass. Means, sd and Cpk are of the first, comparisons and indices of the mean over them."
        )
    notes.append(
        "Each interval alone holds with 95 %: of many statements some are wrong by chance. Those of shares are Clopper "
        "and Pearson's."
    )
    return notes + [f"{words[:1]}{words[1:]}." for words in left]


def answers(rows: Rows, about: About, found: Answers | None = None) -> dict[str, Any]:
    """Plain data for `json.dumps`; numbers that are not finite are None. `found`: where it is there already."""
    found = found or answer(rows, about)
    plain: dict[str, Any] = finite(_named(asdict(found)))
    return {"title": about.title, "sampling": about.sampling, "drives_wanted": about.sample_count, **plain}


def _named(value: Any) -> Any:
    """An estimate by the names of its parts."""
    if isinstance(value, Estimate):
        return value._asdict()
    if isinstance(value, dict):
        return {key: _named(item) for key, item in value.items()}
    return [_named(item) for item in value] if isinstance(value, list | tuple) else value


def lines(rows: Rows, about: About, found: Answers | None = None) -> list[str]:
    """The few for a terminal: yields, the worst drive, the most influential input, the comparison."""
    found = found or answer(rows, about)
    return [*map(yield_words, found.yields), *_worst_line(found), *_strongest_line(found), *_pair_lines(found)]


def yield_words(found: Yield) -> str:
    """A yield with its interval and its counts."""
    name = f"{found.test}{_in(found.design)}"
    n = found.passed + found.failed
    if found.share is None:
        return f"{name}: not known, none of {counted(found.unknown, 'drive')} passed or failed"
    they = f"{percent(found.share.value)} pass ({span(found.share, share=True)})"
    words = f"{name}: {they}, {found.passed} of {counted(n, 'drive')}"
    return words + (f"; {unknown_words(found)}" if found.unknown else "")


def unknown_words(found: Yield) -> str:
    """How many drives told nothing, and what the yield were if they all failed or passed."""
    lo, hi = map(percent, found.bounds)
    return f"{found.unknown} unknown: {lo} if all of them fail, {hi} if they pass"


def _in(design: str) -> str:
    return f", {design}" if design else ""


def _worst_line(found: Answers) -> list[str]:
    known = [each for each in found.worst if each.measurement][:1]
    return [
        f"worst: {one.measurement} {figure(one.value)}, {one.limits}{_in(one.design)}: {one.replay}" for one in known
    ]


def _strongest_line(found: Answers) -> list[str]:
    """Of the measurement with the least room of which an input is known."""
    for name in _once(found.capability):
        for each in found.sensitivity:
            if each.name == name and (index := each.strongest):
                one = index.total or index.first
                where, size = f"{index.input} on {name}{_in(each.design)}", percent(one.value)
                return [f"most influential: {where}: {size} of its variance ({span(one, share=True)})"]
    why = [each.why or "none is seen to matter" for each in found.sensitivity][:1]
    return [f"most influential input: not known, {words}" for words in why]


def _pair_lines(found: Answers) -> list[str]:
    whole = {pair.b: pair for pair in reversed(found.yield_pairs)}  # of each design the first: all tests
    return [f"{pair.test}: {pair.verdict}" for pair in reversed(whole.values())]

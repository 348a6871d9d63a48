"""Events and parameters in which two runs differ."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

from bench.compare.alignment import event_words
from bench.record.times import Side

LATE = 1e-3  # s from which on an event is at another time


@dataclass(frozen=True)
class EventPair:
    """The same event in both runs, or in one: s after time 0, None where it is not."""

    words: str
    a: float | None
    b: float | None


@dataclass(frozen=True)
class ParameterPair:
    """A parameter with its value where the stretch begins; None where a run does not tell it."""

    name: str
    a: float | None
    b: float | None


def events(a: Side, b: Side) -> list[EventPair]:
    """Events and settings within the stretch that are in one run only, or in both at different times; by time."""
    found = [_said(side) for side in (a, b)]
    pairs = []
    for words in dict.fromkeys([*found[0], *found[1]]):
        times = [side.get(words, []) for side in found]
        for k in range(max(map(len, times))):
            at_a, at_b = (its[k] if k < len(its) else None for its in times)
            if at_a is None or at_b is None or abs(at_a - at_b) > LATE:
                pairs.append(EventPair(words, at_a, at_b))
    return sorted(pairs, key=lambda pair: min(at for at in (pair.a, pair.b) if at is not None))


def _said(side: Side) -> dict[str, list[float]]:
    """Times by words."""
    run = side.run
    said = [(event.tick, event_words(event, run.info.node)) for event in run.events]
    said += [(change.tick, f"{change.name} set to {change.value:g}") for change in run.changes]
    times: dict[str, list[float]] = defaultdict(list)
    for tick, words in sorted(said):
        if side.first <= tick <= side.last:
            times[words].append(side.seconds(tick))
    return times


def parameters(a: Side, b: Side) -> list[ParameterPair]:
    """Parameters of the drive that differ, as they are where the stretch begins."""
    one, other = _parameters(a), _parameters(b)
    names = dict.fromkeys([*one, *other])
    pairs = [ParameterPair(name, one.get(name), other.get(name)) for name in names]
    return [pair for pair in pairs if str(pair.a) != str(pair.b)]  # NaN is no other value than NaN


def _parameters(side: Side) -> dict[str, float]:
    run = side.run
    set_before = {
        change.name: change.value
        for change in run.changes
        if change.tick <= side.first and change.node == run.info.node
    }
    return {**run.info.parameters, **set_before}

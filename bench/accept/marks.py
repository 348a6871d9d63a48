"""How a test says beforehand what it measures, what it needs and how far it goes.

Loaded by every pytest of the environment: it imports nothing heavy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import pytest

from bench.rig.envelope import Envelope
from bench.signal.limits import RATED_CURRENT, RATED_SPEED, YES_NO, Limits

if TYPE_CHECKING:
    from bench.rig.ratings import Ratings

LIMITS, NEEDS, ENERGISES, CALLED = "bench_limits", "bench_needs", "bench_energises", "bench_called"
MARKS = {
    LIMITS: "what the test measures, with limits (bench.accept.limit)",
    NEEDS: "what the rig must have for it (bench.accept.needs)",
    ENERGISES: "how far it goes (bench.accept.energises)",
    CALLED: "its name for people (bench.accept.called)",
}
Test = TypeVar("Test", bound=Callable[..., Any])


def limit(
    name: str,
    unit: str = "",
    *,
    lo: float | None = None,
    hi: float | None = None,
    about: str = "",
    of: str = "",
    tells: str = "",
    chance: bool = False,
) -> pytest.MarkDecorator:
    """Declare a measurement `name` in `unit` with what is allowed, both included; None is no limit.

    `of`: the bounds are shares of that rating of the drive, RATED_SPEED (r/min) or RATED_CURRENT (A). `tells`: what of
    the drive it tells, where a report is to say how small a deviation of that is still seen. `chance`: it is a matter
    of chance, and no band is learned. Raises ValueError for limits that are not finite or leave no room.
    """
    return limits(Limits(name, unit, lo, hi, about, of=of, tells=tells, chance=chance))


def limits(*declared: Limits) -> pytest.MarkDecorator:
    """Declare several measurements: for a map, whose names a loop makes."""
    return pytest.mark.bench_limits(*declared)


def yes(name: str, *, about: str = "") -> pytest.MarkDecorator:
    """Declare a measurement that is an answer, which must be yes: `measure(name, True)`."""
    return limits(must_be_yes(name, about))


def must_be_yes(name: str, about: str = "") -> Limits:
    """Limits of an answer that must be yes, for `limits`."""
    return Limits(name, YES_NO, 1.0, 1.0, about)


def called(name: str) -> pytest.MarkDecorator:
    """Give a test a name for people, in place of its function's: for the report.

    Parameters of the test stand in braces, and so does the `id` of the case: `called("Hall wire {wire} broken")`.
    """
    return pytest.mark.bench_called(name)


def needs(*what: str) -> pytest.MarkDecorator:
    """Name what a rig must have; without it the test is skipped, and the reason says which.

    `encoder`, `load`, `load.speed` (one that forces a speed), `hall-faults` (fault insertion),
    `hall-placement` (a rig that moves the sensors), `rate:HZ` (samples a second), `channel:NAME`, `parameter:NAME`,
    `feature:NAME` (of HELLO), `observer:NAME` (an angle source that the drive offers), `speed` (by encoder or
    estimate), `currents` (of three phases, or d and q).
    """
    return pytest.mark.bench_needs(*what)


@dataclass(frozen=True)
class _Asked:
    """How far a test goes: mechanical r/min and A, or shares of the drive's ratings."""

    rpm: float | None
    current: float | None
    rated_speed: float | None
    rated_current: float | None
    unrated_rpm: float | None = None

    def within(self, ratings: Ratings) -> Envelope:
        """The same for a drive with these ratings; nothing where one is needed that nobody has told."""
        rpm, current, without = self.rpm, self.current, self.unrated_rpm
        if self.rated_speed is not None:
            told = ratings.told.get(RATED_SPEED)
            rpm = self.rated_speed * told if told is not None else 0.0 if without is None else without
        if self.rated_current is not None:
            told = ratings.told.get(RATED_CURRENT)
            current = self.rated_current * told if told is not None else 0.0 if without is None else math.inf
        assert rpm is not None
        assert current is not None
        return Envelope(rpm, current)

    def rated_by(self) -> set[str]:
        """The ratings that are needed for that."""
        if self.unrated_rpm is not None:
            return set()
        shares = {RATED_SPEED: self.rated_speed, RATED_CURRENT: self.rated_current}
        return {rating for rating, share in shares.items() if share is not None}


def energises(
    rpm: float | None = None,
    current: float | None = None,
    *,
    rated_speed: float | None = None,
    rated_current: float | None = None,
    unrated_rpm: float | None = None,
) -> pytest.MarkDecorator:
    """Announce the highest speed and current that the test asks for.

    Mechanical r/min and A (peak), or either as a share of what the drive is rated for. Raises ValueError unless each is
    given once. A test with `unrated_rpm` runs without ratings too: at that speed, with the drive's own current limit.
    """
    if (rpm is None) == (rated_speed is None) or (current is None) == (rated_current is None):
        raise ValueError("energises: give rpm or rated_speed, and current or rated_current")
    return pytest.mark.bench_energises(_Asked(rpm, current, rated_speed, rated_current, unrated_rpm))


def declared_limits(item: pytest.Item) -> list[Limits]:
    """Of a test, in the order in which they stand above it. BenchError if one is declared twice."""
    from bench.errors import BenchError

    found: list[Limits] = []
    for mark in reversed(list(item.iter_markers(LIMITS))):
        found.extend(mark.args)
    names = [declared.name for declared in found]
    for name in names:
        if names.count(name) > 1:
            raise BenchError(f"{item.nodeid} declares '{name}' twice")
    return found


def label_of(item: pytest.Item) -> str:
    """What a test is called for people: what `called` says, or its function's name with the values of its parameters.

    BenchError for braces that name no parameter.
    """
    from bench.accept.naming import in_words
    from bench.errors import BenchError

    case = getattr(item, "callspec", None)
    if (mark := item.get_closest_marker(CALLED)) is None:
        found = [in_words(getattr(item, "originalname", item.name).removeprefix("test_"))]
        if case is not None:
            plain = all(isinstance(value, str | int | float) for value in case.params.values())
            values = [f"{name.replace('_', ' ')} {value}" for name, value in case.params.items()]
            found += values if plain else [case.id]
        return ", ".join(found)
    try:
        return str(mark.args[0]).format(**({"id": case.id} | case.params if case else {}))
    except (LookupError, AttributeError, ValueError, TypeError) as error:
        raise BenchError(f"{item.nodeid}: called('{mark.args[0]}') names no parameter of the test: {error}") from None


def needed(item: pytest.Item) -> list[str]:
    """What a test needs."""
    return [what for mark in item.iter_markers(NEEDS) for what in mark.args]


def announced(item: pytest.Item, ratings: Ratings) -> Envelope:
    """How far a test goes on a drive with these ratings; as far as the drive lets it, if it does not say."""
    mark = item.get_closest_marker(ENERGISES)
    return Envelope() if mark is None else mark.args[0].within(ratings)


def rated_by(item: pytest.Item) -> list[str]:
    """The ratings that a test's limits and setpoints are shares of, but for one that does without."""
    mark = item.get_closest_marker(ENERGISES)
    if mark is not None and mark.args[0].unrated_rpm is not None:
        return []
    asked = set() if mark is None else mark.args[0].rated_by()
    return sorted(asked | {limits.of for limits in declared_limits(item) if limits.of})

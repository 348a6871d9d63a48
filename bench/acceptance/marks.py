"""How a test says beforehand what it measures, what it needs and how far it goes.

Loaded by every pytest of the environment: it imports nothing heavy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import pytest

from bench.analysis.limits import Limits
from bench.rig.envelope import Envelope

LIMITS, NEEDS, ENERGISES = "bench_limits", "bench_needs", "bench_energises"
MARKS = {
    LIMITS: "what the test measures, with limits (bench.acceptance.limit)",
    NEEDS: "what the rig must have for it (bench.acceptance.needs)",
    ENERGISES: "how far it goes (bench.acceptance.energises)",
}
Test = TypeVar("Test", bound=Callable[..., Any])


def limit(
    name: str, unit: str = "", *, lo: float | None = None, hi: float | None = None, about: str = ""
) -> pytest.MarkDecorator:
    """Declare a measurement `name` in `unit` with what is allowed, both bounds included; None is no bound.

    Raises ValueError for limits that are not finite or leave no room.
    """
    return limits(Limits(name, unit, lo, hi, about))


def limits(*declared: Limits) -> pytest.MarkDecorator:
    """Declare several measurements: for a map, whose names a loop makes."""
    return pytest.mark.bench_limits(*declared)


def needs(*what: str) -> pytest.MarkDecorator:
    """Name what a rig must have; without it the test is skipped, and the reason says which.

    `encoder`, `load`, `load.speed` (one that forces a speed), `hall-faults` (fault insertion),
    `hall-placement` (a rig that moves the sensors), `rate:HZ` (samples a second), `channel:NAME`, `parameter:NAME`,
    `feature:NAME` (of HELLO), `observer:NAME` (an angle source that the drive offers), `speed` (by encoder or
    estimate), `currents` (of three phases, or d and q).
    """
    return pytest.mark.bench_needs(*what)


def energises(speed_rpm: float, current: float) -> pytest.MarkDecorator:
    """Announce the highest speed (mechanical r/min) and current (A, peak) that the test asks for."""
    return pytest.mark.bench_energises(Envelope(speed_rpm, current))


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


def needed(item: pytest.Item) -> list[str]:
    """What a test needs."""
    return [what for mark in item.iter_markers(NEEDS) for what in mark.args]


def announced(item: pytest.Item) -> Envelope:
    """How far a test goes; as far as the drive lets it, if it does not say."""
    mark = item.get_closest_marker(ENERGISES)
    return Envelope() if mark is None else mark.args[0]

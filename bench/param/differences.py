"""Two tables of parameters compared: what is one value to a device is no difference."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

from bench.param.table import ParameterEntry, Parameters, same, shortest


class Difference(NamedTuple):
    """A parameter that has two values."""

    name: str
    a: float
    b: float
    unit: str


@dataclass(frozen=True)
class Differences:
    """What differs between `a` and `b`; `only_a`, `only_b`: names that the other does not have."""

    a: Parameters
    b: Parameters
    values: tuple[Difference, ...]
    only_a: tuple[str, ...]
    only_b: tuple[str, ...]
    compared: int
    """Parameters that both have."""

    @property
    def none(self) -> bool:
        """Whether both are the same."""
        return not (self.values or self.only_a or self.only_b)

    def as_json(self) -> dict[str, Any]:
        """It as plain data."""
        return {
            "a": self.a.title,
            "b": self.b.title,
            "equal": self.none,
            "compared": self.compared,
            "differences": [difference._asdict() for difference in self.values],
            "only_a": list(self.only_a),
            "only_b": list(self.only_b),
        }

    def rows(self) -> list[list[str]]:
        """Name, both values and unit of each difference, as text."""
        return [[d.name, shortest(d.a), shortest(d.b), d.unit] for d in self.values]

    def lines(self) -> list[str]:
        """What only one of both has, in words."""
        pairs = ((self.only_a, self.a), (self.only_b, self.b))
        return [f"only {side.title} has {', '.join(names)}" for names, side in pairs if names]


def compare(
    a: Parameters, b: Parameters, groups: Collection[str] = (), alike: Callable[[str, float, float], bool] | None = None
) -> Differences:
    """What differs, in the order of `a`, of some groups (none given: all). What does not last is left out.

    `alike(name, a, b)`: whether two values that differ as float32 are still one to the device, because it rounds.
    """
    volatile = {n for side in (a, b) for n, entry in side.entries.items() if not entry.lasts}

    def wanted(name: str) -> bool:
        known = a.entries.get(name) or b.entries[name]
        other = b.entries.get(name, known)
        return name not in volatile and (not groups or not {known.group, other.group}.isdisjoint(groups))

    both = [name for name in a.entries if name in b.entries and wanted(name)]
    values = [
        Difference(name, a[name], b[name], _unit(a.entries[name], b.entries[name]))
        for name in both
        if not same(a[name], b[name]) and not (alike and alike(name, a[name], b[name]))
    ]
    only_a = tuple(name for name in a.entries if name not in b.entries and wanted(name))
    only_b = tuple(name for name in b.entries if name not in a.entries and wanted(name))
    return Differences(a, b, tuple(values), only_a, only_b, len(both))


def _unit(a: ParameterEntry, b: ParameterEntry) -> str:
    return a.unit or b.unit

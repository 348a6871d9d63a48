"""A drive's parameters over a run: as they were at its beginning, and each change with the time since when it holds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple


class Change(NamedTuple):
    """A parameter that has another value for all samples after the device tick `tick`."""

    tick: int
    name: str
    value: float


class ParameterCourse(Mapping[str, float]):
    """The values at the beginning, as a mapping by name, in their units; `changes`, by tick, are what came after."""

    def __init__(self, initial: Mapping[str, float], changes: Iterable[Change] = ()) -> None:
        self._initial = dict(initial)
        self.changes = tuple(sorted(changes, key=lambda change: change.tick))

    def __getitem__(self, name: str) -> float:
        return self._initial[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._initial)

    def __len__(self) -> int:
        return len(self._initial)

    def __repr__(self) -> str:
        return f"{self._initial!r}" + (f", {len(self.changes)} changes" if self.changes else "")

    def since(self, tick: int) -> ParameterCourse:
        """The course as it begins with the sample at this device tick."""
        before = {change.name: change.value for change in self.changes if change.tick < tick}
        return ParameterCourse(self._initial | before, (change for change in self.changes if change.tick >= tick))

    def fixed(self, values: Mapping[str, float]) -> ParameterCourse:
        """The course with these values from the beginning to the end, whatever the drive had."""
        return ParameterCourse(self._initial | dict(values), (c for c in self.changes if c.name not in values))


def course_of(parameters: Mapping[str, float]) -> ParameterCourse:
    """Parameters as a course; those of a plain table never change."""
    return parameters if isinstance(parameters, ParameterCourse) else ParameterCourse(parameters)

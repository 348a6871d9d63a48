"""Values of a configuration that recordings told, each number with what is known of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

from bench.commission.quantity import Quantity
from protocol.text import printable

Number = float | int | list[float]
DIGITS = 7
"""Of numbers in the file."""


@dataclass(frozen=True)
class Value:
    """Of one dotted key; `told`: a quantity for each number that the recordings told, in the drive's own units."""

    key: str
    value: Number
    told: tuple[Quantity, ...] = ()

    @property
    def comment(self) -> str:
        """Intervals for the TOML, in words."""
        widths = ", ".join(f"{one.half_width:.2g}" for one in self.told)
        wide = ", ".join(f"{one.absolute_half_width():.2g}" for one in self.told)
        unit = f"{self.told[0].unit}, " if self.told[0].unit else ""
        absolute = "" if wide == widths else f" in the drive's own volts and amperes; +- {wide} absolute"
        return f"{unit}95 %: +- {widths}{absolute}"


def single(key: str, unit: str, value: float, parts: Mapping[str, float], powers: Sequence[float] = ()) -> Value:
    """One number; `powers`: those with which volts and amperes enter."""
    return Value(key, value, (Quantity(key, unit, value, parts, *powers),))


def several(
    key: str, unit: str, values: Iterable[float], parts: Iterable[Mapping[str, float] | None],
    powers: Sequence[float] = (), names: Sequence[str] = (),
) -> Value:  # fmt: skip
    """A list; `parts`: of each number, None of one that was not told.

    `names`: by which its quantities are told apart; 1, 2, … where there are none.
    """
    numbers = [float(value) for value in values]
    told = tuple(
        Quantity(f"{key}[{name}]", unit, value, of, *powers)
        for name, value, of in zip(names or count(1), numbers, parts, strict=False)
        if of is not None
    )
    return Value(key, numbers, told)


def as_json(told: Sequence[Quantity]) -> list[dict[str, Any]]:
    """Plain data."""
    return [
        {
            "name": one.name, "unit": one.unit, "value": one.value, "half_width_95": one.half_width,
            "absolute_half_width_95": one.absolute_half_width(), "dominated_by": one.dominated_by or None,
        }
        for one in told
    ]  # fmt: skip


def toml(values: Mapping[str, Number], comments: Mapping[str, str], head: Sequence[str]) -> str:
    """A configuration of these dotted keys, sections in their order."""
    sections: dict[str, list[str]] = {}
    for key, value in values.items():
        section, _, name = key.rpartition(".")
        comment = f" # {comments[key]}" if key in comments else ""
        sections.setdefault(section, []).append(f"{name} = {_written(value)}{comment}")
    lines = [f"# {printable(line)}" for line in head]
    for section, rows in sections.items():
        lines += ["", f"[{section}]", *rows]
    return "\n".join(lines) + "\n"


def _written(value: Number) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_written, value))}]"
    return str(value) if isinstance(value, int) else f"{value:.{DIGITS}g}"

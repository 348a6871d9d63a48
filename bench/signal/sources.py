"""Angle sources by name, number and short name: those of the protocol's table, and those that the catalogue has beside.

The catalogue is asked only about what the table does not have: it takes a while to load.
"""

from __future__ import annotations

from protocol.signals import SOURCE_NAMES, AngleSource


def source_number(name: str) -> int | None:
    """The value of the parameter `observer` that chooses a source, - or _ in its name; None if there is none."""
    wanted = name.replace("_", "-")
    if wanted in SOURCE_NAMES:
        return int(SOURCE_NAMES[wanted])
    return next((number for number, (known, _) in _others().items() if known == wanted), None)


def source_names() -> list[str]:
    """All of them, as people write them."""
    return [*SOURCE_NAMES, *(name for name, _ in _others().values())]


def source_name(number: float) -> str:
    """What a source is called; empty if there is none of that number."""
    return next((name for name, source in SOURCE_NAMES.items() if source == number), "") or _other(number)[0]


def source_short(number: float) -> str:
    """What channels call it; empty if there is none of that number."""
    return next((source.short for source in AngleSource if source == number), "") or _other(number)[1]


def _other(number: float) -> tuple[str, str]:
    known = number > max(AngleSource) and float(number).is_integer()
    return _others().get(int(number), ("", "")) if known else ("", "")


def _others() -> dict[int, tuple[str, str]]:
    from sim.observers.catalogue import CATALOGUE

    numbered = enumerate(CATALOGUE.values(), 1)
    return {n: (entry.name.replace("_", "-"), entry.short) for n, entry in numbered if n > max(AngleSource)}

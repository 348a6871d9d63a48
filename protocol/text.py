"""Text that comes from outside, made safe to show: one line, no control characters, nothing invisible."""

from __future__ import annotations

from collections.abc import Iterable


def printable(text: str) -> str:
    r"""Return `text` on one line, with an escape such as \x1b or \u202e for each character that is not to be printed.

    Those are control characters, line ends, bidirectional controls, invisible characters and surrogates: they could
    clear a terminal, or make text read otherwise than it is. Applied twice it changes nothing more.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def counted(number: int, noun: str) -> str:
    """So many of a thing: 1 outage, 2 outages."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def either(names: Iterable[str]) -> str:
    """One or more names as a choice: a, b or c."""
    *most, last = names
    return f"{', '.join(most)} or {last}" if most else last


def told(value: object) -> str:
    """A value of what a device says of itself, for people: yes or no, a list's items or "none", text or "not told"."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return ", ".join(f"{key} {told(inner)}" for key, inner in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "none"
    return str(value) or "not told"

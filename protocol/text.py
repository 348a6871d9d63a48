"""Text that comes from outside, made safe to show: one line, no control characters, nothing invisible."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


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


def did_you_mean(
    name: str, known: Iterable[str], otherwise: str = "", form: str = "did you mean {}?", cutoff: float = 0.6
) -> str:
    """The nearest of the `known` names, in the words of `form`; `otherwise` if none is near.

    `cutoff`: the least likeness, 0 to 1, of difflib.
    """
    near = get_close_matches(name, list(known), 1, cutoff)
    return form.format(near[0]) if near else otherwise


def told(value: object) -> str:
    """A value of what a device says of itself, for people: yes or no, a list's items or "none", text or "not told"."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return ", ".join(f"{key} {told(inner)}" for key, inner in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "none"
    return str(value) or "not told"

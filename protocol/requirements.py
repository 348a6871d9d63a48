"""The requirements of SPEC.md by number, as they stand there: what a check of conformance cites."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

_TAG = re.compile(r"\[(\d+\.\d+) (DH|D|H)\] ?")
_ENDS = re.compile(r"\[\d+\.\d+ (?:DH|D|H)\]|\n\n|\n(?:- |\d\. |#|\|)")


@dataclass(frozen=True)
class Requirement:
    """A sentence, or a row of a table: its number, such as "7.13", whom it binds, and its words."""

    number: str
    device: bool
    host: bool
    text: str


@cache
def requirements() -> dict[str, Requirement]:
    """All of them by number, in the order of the text."""
    text = files("protocol").joinpath("SPEC.md").read_text(encoding="utf-8")
    found = {}
    for tag in _TAG.finditer(text):
        end = _ENDS.search(text, tag.end())
        words = " ".join(text[tag.end() : end.start() if end else len(text)].replace("**", "").split())
        if words.startswith("|"):
            words = ", ".join(cell for each in words.strip("| ").split("|") if (cell := each.strip()))
        found[tag[1]] = Requirement(tag[1], "D" in tag[2], "H" in tag[2], words)
    return found

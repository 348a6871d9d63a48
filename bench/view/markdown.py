"""Text and tables as markdown, in which whatever a device or a file says is text and never markup."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from protocol.text import printable

_MARKUP = re.compile(r"([\\`*|<>\[\]~&]|(?<![^\W_])_|_(?![^\W_]))")  # an underscore within a word is none


def escaped(text: object) -> str:
    """Text on one line, with a backslash before each character that could be markup, end a cell or fetch a picture."""
    return _MARKUP.sub(r"\\\1", printable(str(text)))


def table(headers: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table; `headers` may be empty strings."""
    lines = [headers, ["---"] * len(headers), *([escaped(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)

"""Tables in Markdown, and their places on a page, which comments mark: what the `make_*.py` beside it share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

BEGIN, END = "<!-- {}: begin -->\n", "<!-- {}: end -->\n"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """In Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)) + "\n"


def filled(page: str, made: Mapping[str, str]) -> str:
    """The page with what was made in its places, by their names. ValueError for a place that it does not have."""
    for place, text in made.items():
        begin, end = BEGIN.format(place), END.format(place)
        head, rest = page.split(begin)
        page = head + begin + text + end + rest.split(end)[1]
    return page

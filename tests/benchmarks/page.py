"""The tables of docs/benchmarks.md and docs/reliability.md, made from the last figures."""

from __future__ import annotations

from collections.abc import Iterator

from tests.benchmarks.last import Last, Measured
from tests.benchmarks.parts import LONG, PARTS

PAGES = {"benchmarks.md": [part for part in PARTS if part not in LONG], "reliability.md": list(LONG)}
"""Which parts' tables stand on which page of docs."""
BEGIN, END = "<!-- benchmarks: begin -->", "<!-- benchmarks: end -->"


def with_tables(page: str, last: Last) -> str:
    """The page with the figures' tables between its two marks."""
    before, _, rest = page.partition(BEGIN)
    _, mark, after = rest.partition(END)
    if not mark:
        raise ValueError(f"no {BEGIN} … {END} in the page")
    tables = "".join(f"{line}\n" for part, measured in last.items() for line in _lines(part, measured))
    return f"{before}{BEGIN}\n{tables}{END}{after}"


def _lines(part: str, measured: Measured) -> Iterator[str]:
    yield f"### {PARTS[part]}"
    yield ""
    yield f"`{part}`, {measured.date}, {measured.machine}, reference kernel {1000 * measured.reference:.1f} ms"
    yield ""
    yield "| | measured | goal | |"
    yield "|---|---|---|---|"
    for row in measured.rows:
        what, figure, goal, verdict = row.cells()
        yield f"| {what} | {figure} | {goal} | {f'**{verdict}**' if row.missed else verdict} |"
    yield ""

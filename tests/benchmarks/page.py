"""The tables of docs/benchmarks.md and docs/reliability.md, made from the last figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from tests.benchmarks.last import Comparison, Last, Measured
from tests.benchmarks.parts import LONG, PARTS

FIRST = "benchmarks.md"
"""The page that comparisons stand on, too."""
PAGES = {FIRST: [part for part in PARTS if part not in LONG], "reliability.md": list(LONG)}
"""Which parts' tables stand on which page of docs."""
BEGIN, END = "<!-- benchmarks: begin -->", "<!-- benchmarks: end -->"


def with_tables(page: str, last: Last, against: Mapping[str, Comparison] | None = None) -> str:
    """The page with the figures' tables between its two marks, those of comparisons first."""
    before, _, rest = page.partition(BEGIN)
    _, mark, after = rest.partition(END)
    if not mark:
        raise ValueError(f"no {BEGIN} … {END} in the page")
    lines = [line for rev in _revs(against or {}) for line in _ratios(rev, against or {})]
    lines += [line for part, measured in last.items() for line in _lines(part, measured)]
    return f"{before}{BEGIN}\n{''.join(f'{line}{chr(10)}' for line in lines)}{END}{after}"


def _revs(against: Mapping[str, Comparison]) -> list[str]:
    return list(dict.fromkeys(key.split()[0] for key in against))


def _ratios(rev: str, against: Mapping[str, Comparison]) -> Iterator[str]:
    its = {key.split()[1]: compared for key, compared in against.items() if key.split()[0] == rev}
    yield f"### Against {rev}, turn about"
    yield ""
    for about in dict.fromkeys((each.commit, each.date, each.machine) for each in its.values()):
        parts = [f"`{part}`" for part, each in its.items() if (each.commit, each.date, each.machine) == about]
        yield f"{', '.join(parts)}: {', '.join(about)}."
    yield ""
    yield f"| | now | {rev} | now over {rev} | goal | |"
    yield "|---|---|---|---|---|---|"
    for row in (row for each in its.values() for row in each.rows):
        *cells, verdict = row.cells(rev)
        yield f"| {' | '.join(cells)} | {f'**{verdict}**' if row.missed else verdict} |"
    yield ""


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

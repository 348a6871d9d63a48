"""`python -m tests.benchmarks [PART …]`: every figure beside its goal, and beside the last one.

With --against REV the present tree and that commit are measured turn about, and ratios are printed. Exits 1 if a goal
is missed or a part is broken; what is slower than the last time is named. Figures are kept in last.json, ratios in
against.json, and docs/benchmarks.md gets its tables from there.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path

from bench.files import write
from tests.benchmarks import against
from tests.benchmarks.last import Comparison, Last, Measured, compared, read, slower, text_of
from tests.benchmarks.page import FIRST, PAGES, with_tables
from tests.benchmarks.parts import LONG, PARTS, measure
from tests.benchmarks.ratio import SLOW

LAST, AGAINST = (Path(__file__).with_name(name) for name in ("last.json", "against.json"))
DOCS = Path(__file__).parents[2] / "docs"


def show(measured: Measured) -> None:
    """Print a part's figures."""
    rows = [row.cells() for row in measured.rows]
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    for what, figure, goal, verdict in rows:
        print(f"  {what:<{widths[0]}}  {figure:>{widths[1]}}  {goal:<{widths[2]}}  {verdict}".rstrip())


def keep(last: Last, ratios: Mapping[str, Comparison]) -> None:
    """Write last.json, against.json and the pages' tables, each as a whole."""
    write(LAST, text_of(last), LAST.name)
    write(AGAINST, text_of(ratios), AGAINST.name)
    for name, parts in PAGES.items():
        page = DOCS / name
        its = {part: last[part] for part in parts if part in last}
        write(page, with_tables(page.read_text("utf-8"), its, ratios if name == FIRST else None), name)


def kept() -> tuple[dict[str, Measured], dict[str, Comparison]]:
    """What was kept the last time."""
    return (
        read(LAST.read_text("utf-8")) if LAST.exists() else {},
        compared(AGAINST.read_text("utf-8")) if AGAINST.exists() else {},
    )


def turn_about(rev: str, parts: Sequence[str], short: bool, keeps: bool) -> int:
    """The present tree against another commit; the exit code."""
    try:
        now, found = against.run(rev, parts, short)
    except against.UnknownCommit as unknown:
        print(f"error: {unknown}", file=sys.stderr)
        return 2
    last, ratios = kept()
    if keeps and now:
        merged = {**ratios, **now}
        order = [
            f"{each} {part}" for each in dict.fromkeys(key.split()[0] for key in merged) for part in against.ROUNDS
        ]
        keep(last, {key: merged[key] for key in order if key in merged})
    print()
    print("\n".join(found) or (f"no row is {SLOW} x as slow" if short else "every goal reached"))
    return 1 if found else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parts that were asked for, all by default; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument(
        "--against", metavar="REV", help=f"measure the present tree and REV turn about: {', '.join(against.ROUNDS)}"
    )
    parser.add_argument(
        "--short",
        action="store_true",
        help=f"only whether each part still runs: no goals, not kept; with --against, fails from {SLOW} x on",
    )
    parser.add_argument("--no-keep", action="store_true", help="leave what is kept and docs/benchmarks.md as they are")
    given = parser.parse_args(arguments)
    known = list(PARTS if given.against is None else against.SHORT if given.short else against.ROUNDS)
    if unknown := [part for part in given.parts if part not in known]:
        parser.error(f"no part {', '.join(unknown)}; there are {', '.join(known)}")
    if given.against is not None:
        return turn_about(given.against, given.parts, given.short, not (given.short or given.no_keep))
    last, ratios = kept()
    now: dict[str, Measured] = {}
    found: list[str] = []  # what keeps the exit code from being 0
    every = [part for part in PARTS if given.short or part not in LONG]
    for part in given.parts or every:
        print(f"\n{PARTS[part]} ({part})", flush=True)
        try:
            now[part] = measure(part, given.short)
        except Exception:
            traceback.print_exc()
            found.append(f"BROKEN: {part}")
        else:
            show(now[part])
            found += [f"MISSED: {part}: {', '.join(row.cells()[:3])}" for row in now[part].rows if row.missed]
    print()
    if not given.short:
        for part in (part for part in now if part in last):
            for what, times in slower(last[part], now[part]):
                print(f"slower than last: {part}: {what}: {times:.2f} x")
        if not given.no_keep:
            merged = {**last, **now}
            keep({part: merged[part] for part in PARTS if part in merged}, ratios)
    print("\n".join(found) or ("every part runs" if given.short else "every goal reached"))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

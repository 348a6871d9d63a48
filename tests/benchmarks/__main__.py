"""`python -m tests.benchmarks [PART …]`: every figure beside its goal, and beside the last one.

Exits 1 if a goal is missed or a part is broken; what is slower than the last time is named. Figures are kept in
last.json, and docs/benchmarks.md gets its tables from there.
"""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from bench.files import write
from tests.benchmarks.last import Last, Measured, read, slower, text_of
from tests.benchmarks.page import PAGES, with_tables
from tests.benchmarks.parts import LONG, PARTS, measure

LAST = Path(__file__).with_name("last.json")
DOCS = Path(__file__).parents[2] / "docs"


def show(measured: Measured) -> None:
    """Print a part's figures."""
    rows = [row.cells() for row in measured.rows]
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    for what, figure, goal, verdict in rows:
        print(f"  {what:<{widths[0]}}  {figure:>{widths[1]}}  {goal:<{widths[2]}}  {verdict}".rstrip())


def keep(last: Last) -> None:
    """Write last.json and the pages' tables, each as a whole."""
    write(LAST, text_of(last), LAST.name)
    for name, parts in PAGES.items():
        page = DOCS / name
        write(page, with_tables(page.read_text("utf-8"), {part: last[part] for part in parts if part in last}), name)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the parts that were asked for, all by default; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--short", action="store_true", help="only whether each part still runs: no goals, not kept")
    parser.add_argument("--no-keep", action="store_true", help="leave last.json and docs/benchmarks.md as they are")
    given = parser.parse_args(arguments)
    last = read(LAST.read_text("utf-8")) if LAST.exists() else {}
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
            keep({part: merged[part] for part in PARTS if part in merged})
    print("\n".join(found) or ("every part runs" if given.short else "every goal reached"))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

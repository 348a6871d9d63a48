"""Makes docs/edge-kalman.md: its words from docs/edge-kalman/edge-kalman.md.j2, its figures from the last benchmark.

python -m tests.benchmarks edges disturbed; python docs/make_edge_kalman.py

Beside each figure stands that of the observer which this one took the place of, from docs/edge-kalman/before.json: the
same benchmark with `OBSERVER = "learned_edges"`, run on the commit 1575d98.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

DOCS = Path(__file__).parent
PARTS = DOCS / "edge-kalman"
PAGE = DOCS / "edge-kalman.md"
LAST = DOCS.parent / "tests" / "benchmarks" / "last.json"


def main() -> None:
    """Write the page."""
    PAGE.write_text(page())


def page() -> str:
    """The page from its words and the figures."""
    last = json.loads(LAST.read_text())
    rows = {row["what"]: row for row in last["edges"]["rows"]}
    before = json.loads((PARTS / "before.json").read_text())
    environment = Environment(
        loader=FileSystemLoader(PARTS), undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    environment.filters["n"] = number
    pairs = [what.removesuffix(": std") for what in rows if what.endswith(": std")]
    single = [what for what in pairs if "r/min" not in what and ", kind" not in what and ", unkind" not in what]
    return environment.get_template("edge-kalman.md.j2").render(
        disturbed={row["what"]: row["measured"] for row in last["disturbed"]["rows"]},
        rows={what: row["measured"] for what, row in rows.items()},
        goals={what: row.get("goal") for what, row in rows.items()},
        missed=[what for what, row in rows.items() if missed(row)],
        before=before,
        single=single,
        motors=sorted({what.partition(",")[0] for what in pairs if what.endswith(", kind")}),
        steps=list(dict.fromkeys(what.rpartition(":")[0].partition(", ")[2] for what in rows if "of all" in what)),
    )


def missed(row: dict[str, Any]) -> bool:
    """Whether a figure is above its goal: all here are at most that."""
    return row.get("goal") is not None and row["measured"] > row["goal"]


def number(value: float) -> str:
    """Two significant digits."""
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


if __name__ == "__main__":
    main()

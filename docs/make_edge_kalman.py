"""Makes docs/edge-kalman.md: its words from docs/edge-kalman/edge-kalman.md.j2, its figures from the last benchmark.

python -m tests.benchmarks edges disturbed; python docs/make_edge_kalman.py [--drawn]

With --drawn it first runs the drawn cases of tests/sim/observers/lost.py (two minutes), and keeps what they gave in
docs/edge-kalman/drawn.json; docs/edge-kalman-misses.md lists those that miss a goal.

Beside each figure stands that of the observer which this one took the place of, from docs/edge-kalman/before.json: the
same benchmark with `OBSERVER = "learned_edges"`, run on the commit 1575d98.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

DOCS = Path(__file__).parent
PARTS = DOCS / "edge-kalman"
PAGE, MISSES = DOCS / "edge-kalman.md", DOCS / "edge-kalman-misses.md"
DRAWN = PARTS / "drawn.json"
SEEDS = range(2000, 3000)  # none below 400, on which it was designed
LAST = DOCS.parent / "tests" / "benchmarks" / "last.json"


def main() -> None:
    """Write the pages."""
    if sys.argv[1:] == ["--drawn"]:
        DRAWN.write_text(json.dumps(drawn_cases(), indent=1) + "\n")
    PAGE.write_text(page())
    MISSES.write_text(misses())


def drawn_cases() -> dict[str, Any]:
    """Of the drawn cases how many miss which goal, the errors (deg rms) by operation, and those that miss one."""
    sys.path.insert(0, str(DOCS.parent))
    from bench.hall.table_reading import rms
    from tests.sim.observers.lost import BESIDE, OPERATIONS, drawn, held

    found = [held(drawn(seed)) for seed in SEEDS]
    errors = {}
    for operation in OPERATIONS:
        part = [one for one in found if one.case.operation == operation]
        of = {"filter": [one.rms for one in part], "best": [min(one.others.values()) for one in part]}
        of |= {name: [one.others[name] for one in part] for name in BESIDE}
        errors[operation] = {name: round(rms(np.array(values)), 1) for name, values in of.items()}
    count = Counter(miss for one in found for miss in one.misses)
    return {
        "count": {goal: count[goal] for goal in ("trip", "outside", "sigma", "worse")},
        "any": sum(bool(one.misses) for one in found),
        "beyond": round(100.0 * sum(one.beyond for one in found) / len(found), 2),
        "others_worse": {name: sum(one.others_worse[name] > 2.0 for one in found) for name in BESIDE},
        "errors": errors,
        "misses": [
            {
                "case": str(one.case), "outside": round(one.outside, 3), "beyond": round(100.0 * one.beyond, 1),
                "worse": round(one.worse, 1), "rms": round(one.rms, 1), "sigma": round(one.sigma, 1),
                "largest": round(one.largest), "misses": one.misses,
            }
            for one in found if one.misses
        ],
    }  # fmt: skip


def environment() -> Environment:
    """Of the templates."""
    made = Environment(
        loader=FileSystemLoader(PARTS), undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True
    )
    made.filters["n"] = number
    return made


def misses() -> str:
    """The page of the drawn cases that miss a goal."""
    return environment().get_template("misses.md.j2").render(drawn=json.loads(DRAWN.read_text()))


def page() -> str:
    """The page from its words and the figures."""
    last = json.loads(LAST.read_text())
    rows = {row["what"]: row for row in last["edges"]["rows"]}
    before = json.loads((PARTS / "before.json").read_text())
    pairs = [what.removesuffix(": std") for what in rows if what.endswith(": std")]
    single = [what for what in pairs if "r/min" not in what and ", kind" not in what and ", unkind" not in what]
    return (
        environment()
        .get_template("edge-kalman.md.j2")
        .render(
            disturbed={row["what"]: row["measured"] for row in last["disturbed"]["rows"]},
            rows={what: row["measured"] for what, row in rows.items()},
            goals={what: row.get("goal") for what, row in rows.items()},
            missed=[what for what, row in rows.items() if missed(row)],
            before=before,
            single=single,
            motors=sorted({what.partition(",")[0] for what in pairs if what.endswith(", kind")}),
            steps=list(dict.fromkeys(what.rpartition(":")[0].partition(", ")[2] for what in rows if "of all" in what)),
            drawn=json.loads(DRAWN.read_text()),
        )
    )


def missed(row: dict[str, Any]) -> bool:
    """Whether a figure is above its goal: all here are at most that."""
    return row.get("goal") is not None and row["measured"] > row["goal"]


def number(value: float) -> str:
    """Two significant digits."""
    return f"{value:.2g}" if abs(value) < 10 else f"{value:.0f}"


if __name__ == "__main__":
    main()

"""Makes docs/conform.md of its words, docs/conform/conform.md.j2, of the checks, and of what they find (found.json).

python docs/make_conform.py

The figures are those of `python -m tests.bench.conform_power`; unchecked.toml says why no check looks at a requirement.
"""

from __future__ import annotations

import json
import tomllib
from collections import Counter
from pathlib import Path
from textwrap import shorten
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from bench.conform import states
from bench.conform.catalogue import checks
from bench.conform.claim import check_data
from bench.conform.identity import RATE_ERROR
from bench.conform.levels import LEVELS
from bench.conform.run import CHECK_TAKES, MOST
from protocol.requirements import requirements

DOCS = Path(__file__).parent
PARTS = DOCS / "conform"
PAGE = DOCS / "conform.md"
WORDS = 90  # characters of a requirement that the page has


def unchecked() -> dict[str, str]:
    """Why no check looks at a requirement, by number."""
    found: dict[str, str] = tomllib.loads((PARTS / "unchecked.toml").read_text())
    return found


def found() -> dict[str, Any]:
    """How many violations are found, by chapter, and which are not."""
    rows = json.loads((PARTS / "found.json").read_text())
    counts = Counter((row["chapter"], row["how"]) for row in rows)
    chapters = sorted({row["chapter"] for row in rows})
    hows = ("found", "elsewhere", "missed")
    by_chapter = [(chapter, *(counts[chapter, how] for how in hows)) for chapter in chapters]
    return {
        "total": len(rows), "in_c": sum(row["in_c"] for row in rows),
        "in_python": sum(row.get("in_python", False) for row in rows), "sentences": len({row["name"] for row in rows}),
        "found": sum(row["how"] == "found" for row in rows), "by_chapter": by_chapter,
        "others": [row for row in rows if row["how"] != "found"],
    }  # fmt: skip


def by_requirement() -> list[tuple[str, str, str]]:
    """Number, words and checks of each requirement of a device, or why there is no check."""
    why = unchecked()
    return [
        (
            number,
            shorten(each.text, WORDS, placeholder=" …").replace("|", ","),
            ", ".join(f"`{check.id}`" for check in checks() if number in check.cites) or f"none: {why[number]}",
        )
        for number, each in requirements().items()
        if each.device
    ]


def page() -> str:
    """The page."""
    environment = Environment(
        loader=FileSystemLoader(PARTS),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,
    )
    rows = [check_data(check) for check in checks()]
    made = environment.get_template("conform.md.j2").render(
        levels=[
            (f"Level {number}: {name}", [row for row in rows if row["level"] == number])
            for number, name in enumerate(LEVELS)
        ],
        total=len(rows),
        late_ms=1e3 * states.LATE,
        late_percent=100 * states.LATE_SHARE,
        early_ms=1e3 * states.EARLY,
        lapse_ms=1e3 * states.LAPSE_ERROR,
        rate_percent=100 * RATE_ERROR,
        check_s=CHECK_TAKES,
        whole_s=MOST,
        requirements=by_requirement(),
        unchecked=len(unchecked()),
        violations=found(),
    )
    return made.rstrip("\n") + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())

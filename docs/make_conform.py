"""Makes docs/conform.md of its words, docs/conform/conform.md.j2, and of the checks themselves.

python docs/make_conform.py
"""

from __future__ import annotations

from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from bench.conform import states
from bench.conform.catalogue import checks
from bench.conform.claim import check_data
from bench.conform.identity import RATE_ERROR
from bench.conform.levels import LEVELS

DOCS = Path(__file__).parent
PAGE = DOCS / "conform.md"


def page() -> str:
    """The page."""
    environment = Environment(
        loader=FileSystemLoader(DOCS / "conform"),
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
    )
    return made.rstrip("\n") + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())

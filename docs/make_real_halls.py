"""Writes the table of real captures in docs/hall.md: what `bench hall check` tells of them, without an encoder.

python docs/make_real_halls.py

The captures are those of tests/bench/moteus_captures.py; without them nothing is written.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent
PAGE = DOCS / "hall.md"
BEGIN, END = "<!-- real captures: begin -->\n", "<!-- real captures: end -->\n"
sys.path.insert(0, str(DOCS.parent))  # for `tests`

from bench.findings.health import examine  # noqa: E402
from bench.hall.report import as_json  # noqa: E402
from bench.hall.trace import trace  # noqa: E402
from bench.hall.turning import Turned  # noqa: E402
from tests.bench.moteus_captures import FOLDER, NAMES, read  # noqa: E402

HEAD = (
    "capture", "sectors forward, reverse; turned round", "el. turns/s", "pole pairs",
    "a, b, c displaced: forward", "reverse", "±", "sectors I … VI, deg", "±", "rising later, us",
)  # fmt: skip


def row(name: str, data: dict[str, Any]) -> tuple[str, ...]:
    """What the JSON of a check says; intervals of 95 %."""
    steps, sensors = data["steps"], list(data["sensors"].values())
    slow, fast = (data["omega_rad_s"][which] / math.tau for which in ("slowest", "fastest"))
    late, within = (sensors[0][key] for key in ("rising_after_falling_s", "late_half_width_95_s"))
    ways = (
        "–" if sensors[0][key] is None else ", ".join(f"{one[key]:z.2f}".replace("-", "−") for one in sensors)
        for key in ("displaced_up_deg", "displaced_down_deg")
    )
    return (
        name,
        f"{steps['up']}, {steps['down']}; {steps['reversals']}",
        f"{slow:.0f} to {fast:.0f}",
        str(data["n_p_by_edges"] or "–"),
        *ways,
        f"{max(one['displaced_each_way_half_width_95_deg'] for one in sensors):.2f}",
        " ".join(f"{width:.1f}" for width in data["sector_widths_deg"]),
        f"{max(data['sector_widths_half_width_95_deg']):.1f}",
        "–" if late is None else f"{1e6 * late:.0f} ± {1e6 * within:.0f}",
    )


def table() -> str:
    """The rows of all captures, in Markdown."""
    rows = [HEAD, ("---",) * len(HEAD)]
    for name in NAMES:
        capture = read(name)
        looked_at = trace(capture)
        rows.append(row(name, as_json(examine(looked_at), looked_at, Turned(capture, "recorded"), name)))
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def page(old: str, made: str) -> str:
    """The page with the table in its place."""
    head, rest = old.split(BEGIN)
    return head + BEGIN + "\n" + made + "\n" + END + rest.split(END)[1]


def main() -> None:
    """Write it."""
    if not (FOLDER / f"{NAMES[0]}.dat.gz").is_file():
        sys.exit(f"no captures in {FOLDER}: get fw/test/data of mjbots/moteus, and set HALLBENCH_CAPTURES")
    PAGE.write_text(page(PAGE.read_text(), table()))


if __name__ == "__main__":
    main()

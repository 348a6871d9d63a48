"""Writes the tables of real captures in docs/hall.md: what `bench hall check` tells of them, without an encoder, and
how observers do on their edges alone; and tests/bench/tables/real_observers.toml, limits around the latter.

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
BEGIN, END = "<!-- real {}: begin -->\n", "<!-- real {}: end -->\n"
CAPTURES, OBSERVERS = "captures", "observers"
sys.path.insert(0, str(DOCS.parent))  # for `tests`

from bench.findings.health import examine  # noqa: E402
from bench.hall.report import as_json  # noqa: E402
from bench.hall.trace import trace  # noqa: E402
from bench.hall.turning import Turned  # noqa: E402
from tests.bench.moteus_captures import FOLDER, NAMES, read  # noqa: E402
from tests.bench.moteus_scores import LIMITS, METRIC, PUBLISHED, WORSE, as_toml, best_published, figures  # noqa: E402

HEAD = (
    "capture", "sectors forward, reverse; turned round", "el. turns/s", "pole pairs",
    "a, b, c displaced: forward", "reverse", "±", "sectors I … VI, deg", "±", "rising later, us", "verdict",
)  # fmt: skip
SCORES = {
    "rms": ("rms", ".2f"), "std": ("std", ".2f"), "max": ("max", ".1f"), "bias": ("bias", "+.2f"),
    "speed": ("speed, r/min", ".1f"), "position": ("position, count²", ".3f"), "position_max": ("max, count", ".2f"),
    "velocity": ("velocity, (count/s)²", ".0f"), "velocity_max": ("max, count/s", ".0f"),
}  # fmt: skip
"""Of each figure its heading and its form."""


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
        ", ".join([data["outcome"].replace("_", " "), *(found["code"] for found in data["findings"])]),
    )


def table() -> str:
    """The rows of all captures, in Markdown."""
    rows = [HEAD, ("---",) * len(HEAD)]
    for name in NAMES:
        capture = read(name)
        looked_at = trace(capture)
        rows.append(row(name, as_json(examine(looked_at), looked_at, Turned(capture, "recorded"), name)))
    return lines(rows)


def lines(rows: list[tuple[str, ...]]) -> str:
    """A table in Markdown."""
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def scores() -> str:
    """Figures of observers on edges alone, moteus's limits, and why one of ours is above these, in Markdown."""
    head = ("capture", "observer", *(heading for heading, _ in SCORES.values()))
    rows, whys = [head, ("---",) * len(head)], dict[str, list[str]]()
    for name in NAMES:
        for number, (observer, of) in enumerate(figures(name).items()):
            cells = []
            for key, (_, form) in SCORES.items():
                why = WORSE.get((name, observer, key), "")
                mark = f" ({list(whys).index(why) + 1})" if why and whys.setdefault(why, []) is not None else ""
                cells.append(f"{of[key]:{form}}{mark}".replace("-", "−"))
            rows.append(("" if number else name, observer, *cells))
        if name in PUBLISHED:
            best = best_published(name)._asdict()
            cells = [f"{best[key]:{form}}" if key in METRIC else "" for key, (_, form) in SCORES.items()]
            rows.append(("", "moteus, at most", *cells))
    return lines(rows) + "\n" + "".join(f"({number}) {why}.\n" for number, why in enumerate(whys, 1))


def page(old: str, made: str, which: str = CAPTURES) -> str:
    """The page with a table in its place."""
    begin, end = BEGIN.format(which), END.format(which)
    head, rest = old.split(begin)
    return head + begin + "\n" + made + "\n" + end + rest.split(end)[1]


def main() -> None:
    """Write it."""
    if not (FOLDER / f"{NAMES[0]}.dat.gz").is_file():
        sys.exit(f"no captures in {FOLDER}: get fw/test/data of mjbots/moteus, and set HALLBENCH_CAPTURES")
    PAGE.write_text(page(page(PAGE.read_text(), table()), scores(), OBSERVERS))
    LIMITS.write_text(as_toml(NAMES))


if __name__ == "__main__":
    main()

"""Writes the tables of docs/tune.md from tests/tuning/found.json, which `python -m tests.tuning` makes.

python docs/make_tune.py
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from markdown_tables import filled, table

DOCS = Path(__file__).parent
PAGE = DOCS / "tune.md"
sys.path.insert(0, str(DOCS.parent))  # for `tests`

from tests.tuning.__main__ import FOUND, KINDS  # noqa: E402

SHOWN = 12  # constants, of those that matter


def tables(found: dict[str, Any]) -> dict[str, str]:
    """By the name of its place."""
    gains = []
    for row in found["paper"]:
        (point,) = row["points"]
        checked = point["on_other_drives"]["error"]
        was, now = checked["as_it_was"], checked["tuned"]
        ends = ", ".join(key.rpartition(".")[2] for key in point["at_an_end"]) or "–"
        gains.append([
            row["range"], row["use"], f"{was:.2f}", f"{now:.2f}",
            f"{checked['difference']:.2f} ({checked['from']:.2f} to {checked['to']:.2f})",
            f"{100.0 * (1.0 - now / was):.0f} %", f"{point['objectives']['error']:.2f}", ends,
        ])  # fmt: skip
    head = ["", "use", "the paper's", "tuned", "difference (95 %)", "less", "tuned, where it was tuned", "at an end"]
    wanted = ("k_p_vt", "k_i_vt", "tau_max", "bw_omega_lpf", "load_angle_comp", "k_ic")
    values = []
    for row in found["paper"]:
        named = {key.rpartition(".")[2]: value for key, value in row["points"][0]["parameters"].items()}
        values.append([row["range"], row["use"], *(f"{float(format(named[name], '.3g')):g}" for name in wanted)])
    proved = [
        [
            f"{row['drives']}, {row['kind']}", "in control" if row["control"] else "beside", str(row["n"]),
            *(f"{row[kind][0]:.2f} ({row[kind][1]:.2f} to {row[kind][2]:.2f})" for kind in (*KINDS, "all")),
            " -> ".join(f"{x:.2g}" for x in row["beyond"]),
        ]
        for row in found["prove"]
    ]  # fmt: skip
    order = sorted(found["screen"].items(), key=lambda one: -max(map(abs, one[1])))
    tuned = found["tune"]["constants"]
    effects = [
        [f"`{name}`", *(f"{x:+.3f}" for x in effect), f"{tuned[name] / found['as_they_are'][name]:.2f}"]
        for name, effect in order[:SHOWN]
    ]
    return {
        "gains": table(head, gains),
        "values": table(["", "use", *wanted], values),
        "proof": table(
            ["drives", "use", "n", "slow", "middle", "fast", "steps", "all", "beyond 3 sigma, %"], proved
        ),
        "screen": table(["constant", "x 0.71", "x 1.4", "found: times"], effects),
    }  # fmt: skip


def page(text: str, found: dict[str, Any]) -> str:
    """The page with its tables."""
    return filled(text, tables(found))


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text("utf-8"), json.loads(FOUND.read_text())), "utf-8")

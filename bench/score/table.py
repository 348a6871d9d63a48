"""The board as text: a table that fits 100 columns, and rows for CSV. Prints nothing itself."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from bench.report.words import number
from bench.score.board import Figures, Scoreboard, flat

HEADERS = ("observer", "rms", "std", "max", "p99", "bias", "trans", "start", "rev", "speed", "lag", "ns")


def legend(board: Scoreboard) -> tuple[str, ...]:
    """What the columns are."""
    return (
        f"Position {board.noun} ({board.taken_from} minus estimate), electrical degrees:"
        " rms over all motion (the rank);",
        "std, max, p99 and bias in steady running; maximum in transients, at start-up, at reversal.",
        f"speed: std of the speed {board.noun}, r/min. lag: of the angle, µs. ns: time per step on this machine.",
    )


def row(name: str, figures: Figures) -> list[str]:
    """An observer's statistics as text under `HEADERS`; – where undefined."""
    error = figures["error"]
    return [
        name,
        number(figures["moving"]["rms"], ".2f"),
        *(number(error[key], ".2f") for key in ("std", "max", "p99")),
        number(error["bias"], "+.2f"),
        *(number(figures[phase]["max"], ".1f") for phase in ("transient", "start_up", "reversal")),
        number(figures["speed"]["std"], ".1f"),
        number(figures["lag"]["angle_us"], ".0f"),
        number(figures["step_ns"], ".0f"),
    ]


def lines(observers: dict[str, Figures], recordings: int = 1) -> list[str]:
    """The table, aligned: names to the left, numbers to the right; marked who is in only some of the `recordings`."""
    rows = [list(HEADERS), *(row(name, figures) for name, figures in observers.items())]
    for cells, figures in zip(rows[1:], observers.values(), strict=True):
        if figures["recordings"] < recordings:
            cells[0] += f" ({figures['recordings']} of {recordings})"
    widths = [max(len(cells[k]) for cells in rows) for k in range(len(HEADERS))]
    return [
        "  ".join([cells[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(cells[1:], widths[1:], strict=True))])
        for cells in rows
    ]


def as_text(board: Scoreboard) -> list[str]:
    """The whole board: pooled, then by recording where there are several, then notes and a legend."""
    found = lines(board.pooled, len(board.tracks))
    if len(board.by_file) > 1:
        for path, observers in board.by_file.items():
            found += ["", path, *lines(observers)]
        found = [f"{len(board.by_file)} recordings pooled", *found]
    notes = [f"note: {note}" for note in board.notes]
    return [*found, "", *notes, *legend(board)]


def as_csv(board: Scoreboard) -> str:
    """Every statistic as a row: file (empty: pooled), observer, figure (its name), value (empty: undefined)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["file", "observer", "figure", "value"])
    tables: Sequence[tuple[str, dict[str, Figures]]] = [("", board.pooled), *board.by_file.items()]
    for path, observers in tables:
        for name, figures in observers.items():
            for figure, value in flat(figures):
                writer.writerow([path, name, figure, "" if value is None else repr(value)])
    return text.getvalue()

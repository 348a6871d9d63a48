"""Limits on statistics of the pooled board, by their dotted names: read, checked, and written from a run.

A limit has two sides, so that an error which vanishes is noticed as well as one which grows. One side may be infinite.
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from bench.errors import BenchError
from bench.files import leaves
from bench.score.board import PHASES, Scoreboard, flat
from protocol.text import did_you_mean

WRITTEN = (*PHASES, "speed", "lag")  # groups of figures that are written; the cost of a step is the machine's
NOT_WRITTEN = ("n", "events")
LAG_FLOOR = 50.0  # us: a lag below it gets the margin of this one
Bounds = Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Outside:
    """A statistic outside its limits; None: it is undefined."""

    name: str
    value: float | None
    lo: float
    hi: float

    def __str__(self) -> str:
        found = "is undefined" if self.value is None else f"is {self.value:.6g}"
        return f"{self.name} {found}, expected {self.lo:.6g} … {self.hi:.6g}"


def read(path: Path) -> dict[str, tuple[float, float]]:
    """Limits from a TOML or JSON (.json) file: `name = [lo, hi]`. BenchError names the file and what is wrong in it."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        data = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except OSError as error:
        raise BenchError(f"--expect {path} cannot be read: {error.strerror}") from None
    except (ValueError, UnicodeDecodeError) as error:
        raise BenchError(f"--expect {path}: {error}") from None
    if not isinstance(data, dict):
        raise BenchError(f"--expect {path} must be a table of name = [lo, hi]")
    bounds: dict[str, tuple[float, float]] = {}
    for name, value in leaves(data):
        numbers = isinstance(value, list) and all(type(x) in (int, float) and not math.isnan(x) for x in value)
        if not numbers or len(value) != 2 or value[0] > value[1]:
            raise BenchError(f"--expect {path}: {name} must be [lo, hi] with lo <= hi, got {value}")
        bounds[name] = float(value[0]), float(value[1])
    if not bounds:
        raise BenchError(f"--expect {path} has no limits")
    return bounds


def check(board: Scoreboard, bounds: Bounds) -> list[Outside]:
    """The statistics outside their limits. BenchError for a name that the board does not have."""
    figures = dict(flat(board.pooled))
    found = []
    for name, (lo, hi) in bounds.items():
        observer = name.partition(".")[0]
        if observer not in board.pooled:
            raise BenchError(
                f"--expect has limits for {observer}, which is not scored; scored: {', '.join(board.pooled)}"
            )
        if name not in figures:
            own = [figure for figure in figures if figure.startswith(f"{observer}.")]
            near = did_you_mean(name, own, form=" (did you mean {}?)")
            raise BenchError(f"no statistic '{name}' in this score{near}")
        value = figures[name]
        if value is None or not lo <= value <= hi:
            found.append(Outside(name, value, lo, hi))
    return found


def as_toml(board: Scoreboard, margin: float) -> str:
    """Limits around the board's statistics, `margin` (a share) on both sides; for a bias, at least that of its std.

    By phase, speed and lag; not by bin, and not what depends on this machine.
    """
    lines = [f"# Limits on the statistics of `bench score`, {margin:.0%} on both sides."]
    for name, figures in board.pooled.items():
        lines += ["", f"[{name}]"]
        for group in WRITTEN:
            for key, value in figures[group].items():
                if value is None or key in NOT_WRITTEN:
                    continue
                least = LAG_FLOOR if group == "lag" else figures[group]["std"] if key == "bias" else 0.0
                spread = margin * max(abs(value), least)
                lines.append(f"{group}.{key} = [{value - spread:.6g}, {value + spread:.6g}]")
    return "\n".join(lines) + "\n"

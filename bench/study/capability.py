"""How far measurements stay from their limits: Cpk, distance in standard deviations, yield over the limit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bench.signal.limits import YES_NO, Limits
from bench.study.drives import Drives
from bench.study.rows import F64
from bench.study.statistics import (
    Estimate,
    beyond,
    clopper_pearson,
    cp,
    cpk,
    distance,
    drives_for,
    not_normal,
    percent,
    quantile,
    share,
    varies,
)

WANTED = 0.99
"""The yield that a limit is looked for."""
POINTS = 60  # of a curve
SIGMAS, BEYOND_SIGMAS = 3.0, 0.00135


@dataclass(frozen=True)
class Side:
    """A limit and what lies beyond it. A drive's value is that of its worst repetition, as in its verdict."""

    side: str
    """`lo` or `hi`."""
    limit: float
    n: int
    beyond: int
    share: Estimate
    """Beyond it, as seen."""
    away: Estimate | None
    """Distance of the limit from the mean in sd, positive where the mean is within; None where nothing varies."""
    by_theory: Estimate | None
    """Share beyond it of a normal population."""
    wanted: Estimate
    """The limit that `WANTED` of the drives keep."""
    three_sigma: str
    """Whether the limit is three sd away: yes, no, or cannot tell. Of values that are not normal: whether as few lie
    beyond it as beyond three sd of normal ones, 0.135 %.
    """
    curve: tuple[tuple[float, float, float, float], ...]
    """Where the limit would be, the share beyond it, and its pointwise interval."""

    @property
    def too_few(self) -> str:
        """Why the limit that `WANTED` keep has an open end; empty where it has none."""
        if math.isfinite(self.wanted.hi if self.side == "hi" else self.wanted.lo):
            return ""
        least = percent(share(self.n, self.n).lo)
        return f"{drives_for(WANTED)} drives tell its other end; at the furthest of {self.n} at least {least} pass"


@dataclass(frozen=True)
class Capability:
    """A measurement in one design, one value of each of n drives: that of its first repetition."""

    name: str
    design: str
    limits: Limits | None
    n: int
    missing: int
    """Drives without a value."""
    mean: float
    sd: float
    quantiles: Mapping[str, float]
    """As seen: 0.1 %, 50 % and 99.9 % of a thousand drives or more, else least, median and largest."""
    not_normal: str
    """Why Cp, Cpk and shares by theory do not mean what they say; empty where nothing speaks against them."""
    cp: Estimate | None
    cpk: Estimate | None
    sides: tuple[Side, ...]

    @property
    def unit(self) -> str:
        """Empty where it is not known."""
        return self.limits.unit if self.limits else ""


def capability(drives: Drives, name: str) -> Capability | None:
    """None where no drive has a value, or where the answers are yes or no, of which a yield says all."""
    limits = drives.rows.limits.get(name)
    table = drives.values(name)
    values = table[:, 0][np.isfinite(table[:, 0])]
    if not len(values) or (limits and limits.unit == YES_NO):
        return None
    moves, n = varies(values), len(values)
    mean, sd = float(values.mean()), float(values.std(ddof=1)) if moves else 0.0
    found = Capability(
        name, drives.rows.designs[drives.design], limits, n, len(table) - n, mean, sd, _quantiles(values),
        not_normal(values) if moves else "it does not vary", None, None, (),
    )  # fmt: skip
    if limits is None:
        return found
    given = {side: limit for side in ("lo", "hi") if (limit := getattr(limits, side)) is not None}
    sides = tuple(_side(side, limit, table, found) for side, limit in given.items())
    near = min((side.away for side in sides if side.away), default=None)
    if near is None:
        return replace(found, sides=sides)
    if len(sides) == 1:
        return replace(found, sides=sides, cpk=Estimate(*(end / SIGMAS for end in near)))
    width = (given["hi"] - given["lo"]) / (2.0 * SIGMAS * sd)
    return replace(found, sides=sides, cpk=cpk(near.value / SIGMAS, n), cp=cp(width, n))


def _side(side: str, limit: float, table: F64, found: Capability) -> Side:
    sign = 1.0 if side == "hi" else -1.0
    reach = (sign * table).max(axis=1)
    reach = np.sort(reach[np.isfinite(reach)])
    if not len(reach):  # no drive has all its repetitions
        reach = np.sort(sign * table[:, 0][np.isfinite(table[:, 0])])
    n, at = len(reach), sign * limit
    out = n - int(np.searchsorted(reach, at, "right"))
    away = distance(sign * (limit - found.mean) / found.sd, found.n) if found.sd else None
    value, lo, hi = quantile(reach, WANTED)
    seen = share(out, n)
    return Side(
        side, limit, n, out, seen, away, beyond(away) if away else None,
        Estimate(value, lo, hi) if sign > 0 else Estimate(-value, -hi, -lo),
        _three_sigma(away, seen, found.not_normal), _curve(reach, sign),
    )  # fmt: skip


def _three_sigma(away: Estimate | None, seen: Estimate, not_normal: str) -> str:
    if away is None or not_normal:
        return "yes" if seen.hi <= BEYOND_SIGMAS else "no" if seen.lo > BEYOND_SIGMAS else "cannot tell"
    return "yes" if away.lo >= SIGMAS else "no" if away.hi < SIGMAS else "cannot tell"


def _curve(reach: F64, sign: float) -> tuple[tuple[float, float, float, float], ...]:
    """Evenly in rank, and all of the last ones: there the limit is."""
    n = len(reach)
    last = n - 1 - np.unique(np.geomspace(1, n, POINTS // 2).astype(int) - 1)
    ranks = np.unique(np.concatenate([np.linspace(0, n - 1, POINTS // 2).astype(int), last]))
    at = np.unique(reach[ranks])
    out = n - np.searchsorted(reach, at, "right")
    columns = (sign * at, out / n, *clopper_pearson(out, np.full(len(at), n)))
    return tuple(zip(*(column.tolist() for column in columns), strict=True))


def _quantiles(values: F64) -> dict[str, float]:
    names = ("0.1 %", "50 %", "99.9 %") if len(values) >= 1000 else ("least", "median", "largest")
    at = (0.001, 0.5, 0.999) if len(values) >= 1000 else (0.0, 0.5, 1.0)
    return dict(zip(names, (float(value) for value in np.quantile(values, at)), strict=True))

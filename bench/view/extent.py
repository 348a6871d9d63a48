"""How far the long plots of a recorded run reach: from least to most, or over what is common, the rest being marked.

One glitch of 180 degrees would press an hour of 5 degrees into a line. So a plot that is mostly much narrower than its
peaks shows what is common, says in its title how far the rest goes, and marks at its edge where that is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.view.plots import Plot

COMMON = (2.0, 98.0)  # % of the rows, between which lies what is common
MARGIN = 0.5  # of its width that is shown on either side of it
BEYOND = 2.0  # times what would be shown, from which on peaks are left out
MOST_MARKS = 500  # on either edge
INSIDE = 0.97  # of the way to the edge, where marks stand

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]


@dataclass(frozen=True)
class Extent:
    """From least to most; `shown` if that is too far: then also when and at which edge something lies beyond."""

    least: float
    most: float
    shown: tuple[float, float] | None
    t_ns: I64
    marks: F32

    @property
    def words(self) -> str:
        """For the title of a plot."""
        ends = (np.format_float_positional(end, 3, fractional=False, trim="-") for end in (self.least, self.most))
        return " to ".join(ends).replace("-", "−")


class Extents:
    """Keeps the rows of the long plots, by component."""

    def __init__(self) -> None:
        self._t: list[I64] = []
        self._rows: list[Mapping[str, F32]] = []

    def add(self, t_ns: I64, rows: Mapping[str, F32]) -> None:
        """Add rows at `t_ns`, (n,) each."""
        self._t.append(t_ns)
        self._rows.append(rows)

    def of(self, plot: Plot) -> Extent | None:
        """How far the lines of a plot reach; None where they hold nothing that is finite."""
        components = [line.component for line in plot.lines]
        parts = [self._bounds(rows, components, len(t)) for t, rows in zip(self._t, self._rows, strict=True)]
        if not parts:
            return None
        t_ns = np.concatenate(self._t)
        low, high = (np.concatenate(side) for side in zip(*parts, strict=True))
        finite = np.isfinite(low) & np.isfinite(high)
        if not finite.any():
            return None
        t_ns, low, high = t_ns[finite], low[finite], high[finite]
        least, most = float(low.min()), float(high.max())
        bottom, top = float(np.percentile(low, COMMON[0])), float(np.percentile(high, COMMON[1]))
        room = max(MARGIN * (top - bottom), plot.least)
        bottom, top = bottom - room, top + room
        if plot.y_range is not None or most - least <= BEYOND * (top - bottom):
            return Extent(least, most, None, t_ns[:0], high[:0])
        centre = (bottom + top) / 2
        edges = [centre + INSIDE * (edge - centre) for edge in (bottom, top)]
        beyond = [np.flatnonzero(low < bottom), np.flatnonzero(high > top)]
        thinned = [rows[:: max(1, len(rows) // MOST_MARKS)] for rows in beyond]
        marks = np.repeat(np.array(edges, np.float32), [len(rows) for rows in thinned])
        return Extent(least, most, (bottom, top), t_ns[np.concatenate(thinned)], marks)

    @staticmethod
    def _bounds(rows: Mapping[str, F32], components: Sequence[str], n: int) -> tuple[F32, F32]:
        there = [rows[component] for component in components if component in rows]
        if not there:
            nothing = np.full(n, np.nan, np.float32)
            return nothing, nothing
        return np.minimum.reduce(there), np.maximum.reduce(there)

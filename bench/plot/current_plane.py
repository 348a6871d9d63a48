"""i_d and i_q as a plane: how often the currents were where, their references, and the limit of the current."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.plot.motion import Piece
from bench.report.style import FONT_SIZE, axis_labels, colour, legend_above, new_figure
from bench.signal.position import Moments
from protocol.streams import SampleChunk

F64 = NDArray[np.float64]

CELLS = 100  # from 0 to the limit of the current
FARTHEST = 2000  # cells from 0: what lies beyond counts there
CURRENTS, REFERENCES = ("i_d", "i_q"), ("i_d_ref", "i_q_ref")


@dataclass(frozen=True)
class Plane:
    """Currents of n samples, A."""

    cell: float
    """Side of a cell of the plane."""
    counts: Mapping[tuple[int, int], int]
    """Samples by cell: that of (k, m) has its middle at i_d = k cell, i_q = m cell."""
    references: Mapping[tuple[int, int], int]
    """The same of the references; empty where they were not recorded."""
    n: int
    mean: tuple[float, float]
    std: tuple[float, float]
    largest: float
    """Of the current vector."""
    beyond: int | None
    """Samples beyond the limit; None where no limit is known."""
    limit: float | None


class CurrentPlane:
    """Counts currents while the drive is RUNNING. `limit`: the drive's i_max, A, None where it tells none."""

    def __init__(self, limit: float | None, references: bool) -> None:
        self._limit = limit
        self._cell = (limit or 10.0) / CELLS
        self._counts: Counter[int] = Counter()
        self._wanted: Counter[int] = Counter()
        self._references = references
        self._moments = (Moments(), Moments())
        self._largest, self._beyond = 0.0, 0

    def add(self, piece: Piece) -> None:
        """Add the samples of a piece."""
        self.add_samples(piece.samples, piece.running)

    def add_samples(self, samples: SampleChunk, where: NDArray[np.bool_]) -> None:
        """Add the samples (n,) `where` (n,) is set."""
        i_d, i_q = (samples.physical(name)[where] for name in CURRENTS)
        known = np.isfinite(i_d) & np.isfinite(i_q)
        i_d, i_q = i_d[known], i_q[known]
        if not len(i_d):
            return
        self._counts.update(self._cells(i_d, i_q))
        size = np.hypot(i_d, i_q)
        self._largest = max(self._largest, float(size.max()))
        if self._limit is not None:
            self._beyond += int(np.count_nonzero(size > self._limit))
        for moments, values in zip(self._moments, (i_d, i_q), strict=True):
            moments.add(values)
        if self._references:
            self._wanted.update(self._cells(*(np.nan_to_num(samples.physical(r)[where]) for r in REFERENCES)))

    def _cells(self, i_d: F64, i_q: F64) -> dict[int, int]:
        """How many samples by cell, as one number."""
        k, m = (np.clip(np.rint(i / self._cell), -FARTHEST, FARTHEST).astype(np.int64) + FARTHEST for i in (i_d, i_q))
        cells, n = np.unique(k * (2 * FARTHEST + 1) + m, return_counts=True)
        return dict(zip(cells.tolist(), n.tolist(), strict=True))

    def result(self) -> Plane | None:
        """What was counted; None for nothing."""
        d, q = self._moments
        if not d.n:
            return None
        return Plane(
            self._cell, _pairs(self._counts), _pairs(self._wanted), d.n, (d.mean, q.mean), (d.std, q.std),
            self._largest, None if self._limit is None else self._beyond, self._limit,
        )  # fmt: skip


def _pairs(counts: Counter[int]) -> dict[tuple[int, int], int]:
    split = ((divmod(cell, 2 * FARTHEST + 1), n) for cell, n in counts.items())
    return {(k - FARTHEST, m - FARTHEST): n for (k, m), n in split}


def as_json(of: Plane) -> dict[str, Any]:
    """Plain data, without the cells."""
    return {
        "n": of.n, "i_d_mean": of.mean[0], "i_q_mean": of.mean[1], "i_d_std": of.std[0], "i_q_std": of.std[1],
        "largest": of.largest, "i_max": of.limit, "beyond_i_max": of.beyond,
    }  # fmt: skip


def words(of: Plane) -> str:
    """What the figure says, in a line."""
    limit = "" if of.limit is None else f", {of.beyond} of {of.n} samples beyond {of.limit:g} A"
    return (
        f"i_d {of.mean[0]:+.2f} ± {of.std[0]:.2f} A, i_q {of.mean[1]:+.2f} ± {of.std[1]:.2f} A, "
        f"up to {of.largest:.2f} A{limit}"
    )


def draw(of: Plane) -> Figure:
    """The plane, darker where the current was more often, by logarithm, with references as points."""
    figure, (ax,) = new_figure(1, height=4.8)
    figure.set_figwidth(5.4)  # a square and its scale
    cells = np.array(list(of.counts))
    low, high = cells.min(axis=0), cells.max(axis=0)
    image = np.zeros(high - low + 1)
    image[tuple((cells - low).T)] = list(of.counts.values())
    hue = colour("i_q")
    colours = LinearSegmentedColormap.from_list("currents", ["#f6e0f4", hue, "#3c0f3a"])
    sides = [(np.arange(a, b + 2) - 0.5) * of.cell for a, b in zip(low, high, strict=True)]
    shown = ax.pcolormesh(
        *sides, np.ma.masked_equal(image.T, 0), cmap=colours, norm=LogNorm(1, max(image.max(), 2)), rasterized=True
    )
    bar = figure.colorbar(shown, ax=ax, shrink=0.85, pad=0.02)
    bar.set_label(f"samples in {of.cell:.2g} A × {of.cell:.2g} A", fontsize=FONT_SIZE)
    bar.ax.tick_params(labelsize=FONT_SIZE)
    if of.references:
        d, q = np.array(list(of.references)).T * of.cell
        ax.plot(d, q, ".", color=colour("i_q_ref"), markersize=1.5, alpha=0.6, label="references")
    ax.plot(*of.mean, "+", color="black", markersize=9, markeredgewidth=1.4, label="mean")
    reach = 1.05 * max(of.largest, of.cell)
    if of.limit is not None:
        turn = np.linspace(0, 2 * np.pi, 361)
        circle = of.limit * np.cos(turn), of.limit * np.sin(turn)
        ax.plot(*circle, "--", color="0.35", linewidth=1.0, label=f"limit {of.limit:g} A")
        reach = max(reach, 1.08 * of.limit)
    ax.axhline(0, color="black", linewidth=0.5)
    ax.axvline(0, color="black", linewidth=0.5)
    ax.set_xlim(-reach, reach)
    ax.set_ylim(-reach, reach)
    ax.set_aspect("equal")
    axis_labels(ax, "i_d", "i_q", "A", "A")
    legend_above(ax)
    return figure

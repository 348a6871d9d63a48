"""Parts of plots that several reports draw alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.report.style import BLACK, FONT_SIZE, LIGHT, LINE_WIDTH, WIDTH, plain
from bench.signal.error_bins import ANGLES
from bench.signal.waveforms.sectors import NUMERALS, SECTOR_WIDTH, SECTORS, edge_angle


def draw_band(
    ax: Axes, mean: NDArray[np.float64], std: NDArray[np.float64], hue: str, words: str, dash: str = "-", band: str = ""
) -> None:
    """A mean over the electrical angle as a line, and the standard deviation about it as a band: (BINS,) each.

    `words` and `band` are what the legend says of both.
    """
    ax.fill_between(ANGLES, mean - std, mean + std, color=hue, alpha=0.22, linewidth=0, label=band)
    ax.plot(ANGLES, mean, dash, color=hue, linewidth=LINE_WIDTH, label=words)


def edge_axes(under: Sequence[str], hue: str, width: float, hall_offset: float) -> tuple[Figure, Axes, Axes]:
    """A figure with the circle on which Hall edges lie, and a chart over the edges, `under` which stand these words.

    The circle has the ideal edges, from `hall_offset` (rad) on, as wide as `width`, and the names of the sectors that
    they open, in `hue`.
    """
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained", facecolor="white")
    grid = figure.add_gridspec(1, 2, width_ratios=[1.0, 1.35])
    circle, chart = figure.add_subplot(grid[0, 0], projection="polar"), figure.add_subplot(grid[0, 1])
    ideal = edge_angle(np.arange(SECTORS), hall_offset)
    circle.vlines(ideal, 0, 1, color=LIGHT, linewidth=width, label="ideal")
    for name, angle in zip(NUMERALS, ideal, strict=True):
        circle.text(angle + SECTOR_WIDTH / 2, 0.6, name, ha="center", va="center", fontsize=FONT_SIZE, color=hue)
    circle.set_xticks(ideal % (2.0 * np.pi))
    circle.set_yticks([])
    circle.set_ylim(0, 1)
    circle.grid(False)
    circle.tick_params(labelsize=FONT_SIZE)
    chart.axhline(0.0, color=BLACK, linewidth=0.6)
    chart.set_xticks(range(SECTORS), under)
    chart.set_xlim(-0.6, 5.6)
    plain(chart)
    chart.grid(False, axis="x")
    return figure, circle, chart


def turn_axis(ax: Axes) -> None:
    """The abscissa is an electrical turn, in degrees."""
    ax.set_xlim(0, 360)
    ax.set_xticks(range(0, 361, 60))

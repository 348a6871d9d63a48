"""Parts of plots that several reports draw alike."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from bench.report.style import FONT_SIZE, LIGHT, LINE_WIDTH
from bench.signal.error_bins import ANGLES


def draw_band(
    ax: Axes, mean: NDArray[np.float64], std: NDArray[np.float64], hue: str, words: str, dash: str = "-", band: str = ""
) -> None:
    """A mean over the electrical angle as a line, and the standard deviation about it as a band: (BINS,) each.

    `words` and `band` are what the legend says of both.
    """
    ax.fill_between(ANGLES, mean - std, mean + std, color=hue, alpha=0.22, linewidth=0, label=band)
    ax.plot(ANGLES, mean, dash, color=hue, linewidth=LINE_WIDTH, label=words)


def edge_circle(circle: Axes, names: Sequence[str], hue: str, width: float) -> NDArray[np.float64]:
    """Draw ideal Hall edges and the names of the sectors that they open on polar axes; the edges' angles, rad, (6,)."""
    ideal = np.arange(6) * math.pi / 3
    circle.vlines(ideal, 0, 1, color=LIGHT, linewidth=width, label="ideal")
    for name, angle in zip(names, ideal, strict=True):
        circle.text(angle + math.pi / 6, 0.6, name, ha="center", va="center", fontsize=FONT_SIZE, color=hue)
    circle.set_xticks(ideal)
    circle.set_yticks([])
    circle.set_ylim(0, 1)
    circle.grid(False)
    circle.tick_params(labelsize=FONT_SIZE)
    return ideal


def turn_axis(ax: Axes) -> None:
    """The abscissa is an electrical turn, in degrees."""
    ax.set_xlim(0, 360)
    ax.set_xticks(range(0, 361, 60))

"""Parts of plots that several reports draw alike."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from bench.analysis.error_bins import ANGLES
from bench.reports.style import LINE_WIDTH


def draw_band(
    ax: Axes, mean: NDArray[np.float64], std: NDArray[np.float64], hue: str, words: str, dash: str = "-", band: str = ""
) -> None:
    """A mean over the electrical angle as a line, and the standard deviation about it as a band: (BINS,) each.

    `words` and `band` are what the legend says of both.
    """
    ax.fill_between(ANGLES, mean - std, mean + std, color=hue, alpha=0.22, linewidth=0, label=band)
    ax.plot(ANGLES, mean, dash, color=hue, linewidth=LINE_WIDTH, label=words)


def turn_axis(ax: Axes) -> None:
    """The abscissa is an electrical turn, in degrees."""
    ax.set_xlim(0, 360)
    ax.set_xticks(range(0, 361, 60))

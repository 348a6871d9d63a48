"""Errors of an observer over speed, one curve a load, with another observer's dashed behind. Nothing here measures."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from bench.analysis.capture import F64
from bench.analysis.colours import SPARES
from bench.reports.style import FONT_SIZE, LINE_WIDTH, axis_labels, new_figure

DASHED: dict[str, Any] = {"linestyle": "--", "linewidth": LINE_WIDTH}
DOTTED: dict[str, Any] = {"linestyle": ":", "linewidth": 0.8, "color": "0.4"}


class Panel(NamedTuple):
    """One plot: (m, n) values of m loads at n speeds."""

    title: str
    name: str
    unit: str
    values: F64
    others: F64
    limit: float  # drawn as a line


def draw_by_speed(speeds: Sequence[float], loads: Sequence[str], panels: Sequence[Panel], other: str) -> Figure:
    """The panels side by side, both axes logarithmic; `speeds` (n,) in r/min, `loads` (m,) by name.

    `other`: name of the observer that is dashed.
    """
    figure, axes = new_figure(1, len(panels), height=3.2)
    for ax, panel in zip(axes, panels, strict=True):
        for look, name, mine, others in zip(SPARES, loads, panel.values, panel.others, strict=False):
            ax.plot(speeds, others, color=look.paper, alpha=0.6, **DASHED)
            ax.plot(speeds, mine, marker=look.mark, color=look.paper, linewidth=LINE_WIDTH, markersize=4, label=name)
        ax.axhline(panel.limit, **DOTTED)
        ax.set(xscale="log", yscale="log", xticks=_labelled(speeds))
        ax.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        ax.yaxis.set_minor_formatter(NullFormatter())
        axis_labels(ax, f"{panel.title} Mechanical speed", panel.name, "r/min", panel.unit)
    handles, labels = axes[0].get_legend_handles_labels()
    handles += [Line2D([], [], color="0.4", **DASHED), Line2D([], [], **DOTTED)]
    labels += [other, "limit"]
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=FONT_SIZE)
    return figure


def _labelled(speeds: Sequence[float]) -> list[float]:
    """The speeds that are far enough from the next for their labels."""
    return [a for a, b in pairwise(speeds) if b >= 1.6 * a] + [speeds[-1]]

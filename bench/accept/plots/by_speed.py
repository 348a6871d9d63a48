"""What an observer makes of currents and angle over speed, one curve a load. Nothing here measures.

Source of the THD map: (20) and Fig. 13 of Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from bench.report.style import FONT_SIZE, LINE_WIDTH, axis_labels, new_figure
from bench.signal.capture import F64
from bench.signal.colours import SPARES

POINTS: dict[str, Any] = {"linewidth": LINE_WIDTH, "markersize": 4}
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


def draw_by_speed(speeds: Sequence[float], loads: Sequence[float], panels: Sequence[Panel], other: str) -> Figure:
    """Errors with another observer's dashed behind: the panels side by side, both axes logarithmic.

    `speeds` (n,) in r/min, `loads` (m,) in A. `other`: name of the observer that is dashed.
    """
    figure, axes = new_figure(1, len(panels), height=3.2)
    for ax, panel in zip(axes, panels, strict=True):
        for look, others in zip(SPARES, panel.others, strict=False):
            ax.plot(speeds, others, color=look.paper, alpha=0.6, **DASHED)
        _curves(ax, speeds, loads, panel.values)
        ax.axhline(panel.limit, **DOTTED)
        ax.set(xscale="log", xticks=_labelled(speeds))
        ax.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        ax.xaxis.set_minor_formatter(NullFormatter())
        axis_labels(ax, f"{panel.title} Mechanical speed", panel.name, "r/min", panel.unit)
    more = {other: Line2D([], [], color="0.4", **DASHED), "limit": Line2D([], [], **DOTTED)}
    _legend_above(figure, axes[0], more)
    return figure


def draw_thd_map(loads: Sequence[float], speeds: Sequence[float], approaches: Mapping[str, F64]) -> Figure:
    """Total harmonic distortions of a phase current, the approaches side by side with the same axes; by logarithm.

    `loads` (m,) in A; `speeds` (n,) in r/min; `approaches`: distortions in %, (m, n), by name.
    """
    figure, axes = new_figure(1, len(approaches), height=3.2)
    values = np.concatenate([thd.ravel() for thd in approaches.values()])
    values = values[np.isfinite(values) & (values > 0.0)]
    for ax, (name, thd) in zip(axes, approaches.items(), strict=True):
        _curves(ax, speeds, loads, thd)
        axis_labels(ax, f"{name}: mechanical speed", "THD", "r/min", "%")
        ax.set_xlim(0, 1.04 * max(speeds))
        if len(values):
            ax.set_ylim(0.8 * values.min(), 1.25 * values.max())
    _legend_above(figure, axes[0], {})
    return figure


def _curves(ax: Axes, speeds: Sequence[float], loads: Sequence[float], values: F64) -> None:
    """Draw `values`, (m, n) of m loads at n speeds, over a logarithmic ordinate."""
    for look, amps, y in zip(SPARES, loads, values, strict=False):
        ax.plot(speeds, y, marker=look.mark, color=look.paper, label=f"{amps:g} A", **POINTS)
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def _legend_above(figure: Figure, ax: Axes, more: Mapping[str, Line2D]) -> None:
    """One legend for all axes: the curves of `ax`, and `more` by name."""
    handles, labels = ax.get_legend_handles_labels()
    handles, labels = [*handles, *more.values()], [*labels, *more]
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False, fontsize=FONT_SIZE)


def _labelled(speeds: Sequence[float]) -> list[float]:
    """The speeds that are far enough from the next for their labels."""
    return [a for a, b in pairwise(speeds) if b >= 1.6 * a] + [speeds[-1]]

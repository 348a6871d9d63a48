"""The picture of a step: its panels below each other, measured as points, fitted as lines. Nothing here measures."""

from __future__ import annotations

from matplotlib.figure import Figure

from bench.commission.outcome import Evidence
from bench.report.style import GREY, SERIES, axis_labels, column_title, legend_above, new_figure

FIT = "fit"
DENSE = 200
"""Points of a series from which it is drawn as a line."""


def draw(evidence: Evidence) -> Figure:
    """One axes a panel."""
    figure, axes = new_figure(max(len(evidence.panels), 1), height=2.1 * len(evidence.panels) + 0.5, share_x=False)
    for ax, panel in zip(axes, evidence.panels, strict=False):
        hues = iter(SERIES * 4)
        for name, (x, y) in panel.series.items():
            if name.startswith(FIT):
                ax.plot(x, y, color=GREY, linewidth=0.9, label=name)
            else:
                style = "-" if len(x) >= DENSE else "."
                ax.plot(x, y, style, color=next(hues), label=name, linewidth=0.7, markersize=4)
        if panel.y == "residuals":
            ax.axhline(0.0, color=GREY, linewidth=0.6)
        axis_labels(ax, panel.x, panel.y, panel.x_unit, "" if panel.y_unit == "1" else panel.y_unit)
        if len(panel.series) > 1:
            legend_above(ax)
    column_title(axes[0], evidence.title)
    figure.align_ylabels(axes)
    return figure

"""The picture of a check: speed, torque current and position errors of both, over time. Nothing here measures."""

from __future__ import annotations

from matplotlib.figure import Figure

from bench.report.style import SERIES, axis_labels, column_title, legend_above, new_figure, time_axes
from bench.twin.check import Checked

UNITS = {"omega_enc": "rad/s", "i_q": "A"}
"""Of what is no position error."""


def draw(found: Checked) -> Figure:
    """One axes a channel: recorded in colour, the twin as a thin line upon it."""
    figure, axes = new_figure(max(len(found.traces), 1), height=1.7 * len(found.traces) + 0.5)
    for ax, (name, (t, recorded, twin)) in zip(axes, found.traces.items(), strict=False):
        ax.plot(t, recorded, color=SERIES[0], linewidth=2.0, label="recorded")
        ax.plot(t, twin, color="black", linewidth=0.4, label="twin")
        axis_labels(ax, "", name if name in UNITS else f"{name} error", "", UNITS.get(name, "el. °"))
    if found.traces:
        legend_above(axes[0])
        column_title(axes[0], f"{found.run.name} and its twin")
        t = next(iter(found.traces.values()))[0]
        time_axes(axes, float(t[0]), float(t[-1]))
    figure.align_ylabels(axes)
    return figure

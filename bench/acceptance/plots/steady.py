"""Steady state with two position estimates side by side: Fig. 8. Nothing here measures.

Source: Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bench.analysis.capture import Capture
from bench.reports.style import (
    axis_labels,
    column_title,
    degrees_axis,
    legend_above,
    line,
    new_figure,
    wrapped_degrees,
)


def draw_steady(average: Capture, proposed: Capture, seconds: float) -> Figure:
    """Phase current, actual and estimated position, and position error, over the first `seconds` of each capture.

    On the left with the average-speed approach in the control loop, on the right with the proposed one. Both columns
    have the same axes.
    """
    figure, axes = new_figure(3, 2, height=5.0)
    rows = [axes[k : k + 2] for k in (0, 2, 4)]
    for column, (capture, estimate, words) in enumerate(
        ((average, "theta_avg", "(a) average speed"), (proposed, "theta_vt", "(b) proposed"))
    ):
        start = capture.span[0]
        part = capture.between(start, start + seconds)
        t = part.t - start
        current, position, error = (row[column] for row in rows)
        column_title(current, words)
        line(current, t, part["i_a"], "i_a")
        line(position, t, wrapped_degrees(part[part.reference]), part.reference, label="actual")
        line(position, t, wrapped_degrees(part[estimate]), estimate, label="estimated")
        line(error, t, np.degrees(part.position_error(estimate)), estimate)
        axis_labels(current, "", "phase current", unit_y="A")
        degrees_axis(position, "position", 180)
        degrees_axis(error, "error", 30)
        axis_labels(error, "t", "error", "s", "el. °")
        error.set_xlim(0, seconds)
        legend_above(position)
    largest = max(np.abs(capture["i_a"]).max() for capture in (average, proposed))
    for ax in rows[0]:
        ax.set_ylim(-1.1 * largest, 1.1 * largest)
    figure.align_ylabels(axes)
    return figure

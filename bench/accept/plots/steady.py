"""Steady state with two position estimates side by side: Fig. 8. Nothing here measures.

Source: Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bench.report import style
from bench.signal.capture import Capture


def draw_steady(average: Capture, proposed: Capture, seconds: float) -> Figure:
    """Phase current, actual and estimated position, and position error, over the first `seconds` of each capture.

    On the left with the average-speed approach in the control loop, on the right with the proposed one. Both columns
    have the same axes.
    """
    figure, axes = style.new_figure(3, 2, height=5.0)
    rows = [axes[k : k + 2] for k in (0, 2, 4)]
    for column, (capture, estimate, words) in enumerate(
        ((average, "theta_avg", "(a) average speed"), (proposed, "theta_vt", "(b) proposed"))
    ):
        start = capture.span[0]
        part = capture.between(start, start + seconds)
        t = part.t - start
        current, position, error = (row[column] for row in rows)
        style.column_title(current, words)
        style.line(current, t, part["i_a"], "i_a")
        style.line(position, t, style.wrapped_degrees(part[part.reference]), part.reference, label="actual")
        style.line(position, t, style.wrapped_degrees(part[estimate]), estimate, label="estimated")
        style.line(error, t, np.degrees(part.position_error(estimate)), estimate)
        style.axis_labels(current, "", "phase current", unit_y="A")
        style.degrees_axis(position, "position", 180)
        style.degrees_axis(error, "error", 30)
        style.axis_labels(error, "t", "error", "s", "el. °")
        error.set_xlim(0, seconds)
        style.legend_above(position)
    largest = max(np.abs(capture["i_a"]).max() for capture in (average, proposed))
    for ax in rows[0]:
        ax.set_ylim(-1.1 * largest, 1.1 * largest)
    figure.align_ylabels(axes)
    return figure

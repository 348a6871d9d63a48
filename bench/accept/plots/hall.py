"""Where the Hall edges lie, and what misplaced ones make of the average-speed estimate: Table I and Fig. 2.

Angles are electrical. Nothing here measures: offsets come in as `waveforms.edge_offsets` found them.

Source: Kim et al. 2011, DOI 10.1109/TIE.2010.2098367.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from bench.report import style
from bench.report.plots import edge_axes
from bench.report.style import FONT_SIZE, LIGHT, LINE_WIDTH, SERIES
from bench.signal.capture import F64, Capture
from bench.signal.waveforms import FORWARD, REVERSE, EdgeOffsets
from bench.signal.waveforms.sectors import NUMERALS, edge_angle


def draw_edge_offsets(offsets: EdgeOffsets, expected: F64, tolerance: float, hall_offset: float = 0.0) -> Figure:
    """The six edges on the circle, and their offsets over the sector that they open.

    `expected` (6,) and `tolerance` in rad: the offsets that they should have, halfway between both directions.
    `hall_offset` (rad): where the first edge belongs.
    """
    figure, circle, chart = edge_axes(NUMERALS, style.BLACK, 3.0, hall_offset)
    middle = offsets.mean.mean(axis=1)
    x = np.arange(6)
    circle.vlines(edge_angle(x, hall_offset) - middle, 0, 1, color=SERIES[0], linewidth=LINE_WIDTH, label="measured")
    circle.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, frameon=False, fontsize=FONT_SIZE)
    chart.bar(x, 2 * np.degrees(tolerance), 0.8, np.degrees(expected - tolerance), color=LIGHT, label="allowed")
    for values, mark, hue, words in (
        (offsets.mean[:, FORWARD], ">", SERIES[1], "forward"),
        (offsets.mean[:, REVERSE], "<", SERIES[2], "reverse"),
        (middle, "o", SERIES[0], "middle"),
    ):
        chart.plot(x, np.degrees(values), mark, color=hue, markersize=4.5, label=words)
    style.axis_labels(chart, "edge that opens the sector", "ideal − measured", unit_y="el. °")
    style.legend_above(chart)
    return figure


def draw_misaligned_hall(capture: Capture) -> Figure:
    """The outputs of the three Hall sensors, actual and estimated position, and the error, over the actual angle.

    The paper's Fig. 2 over the angle in place of the time: at the grid lines a well placed sensor of the paper's ring
    would switch. It shows the first two whole electrical turns of `capture`, which must turn forwards.
    """
    shown = 720.0  # deg
    theta = np.degrees(capture.theta)
    start = 360.0 * np.ceil(theta[0] / 360.0)
    part = (theta >= start) & (theta <= start + shown)
    x = theta[part] - start
    figure, (codes, position, error) = style.new_figure(3, height=5.2)
    if (grid := codes.get_gridspec()) is not None:
        grid.set_height_ratios([1.1, 1.6, 1.2])

    hall = capture["hall"].astype(int)[part]
    for bit, name in enumerate("abc"):
        level = 2 - bit
        codes.plot(x, level + 0.7 * ((hall >> bit) & 1), color=style.colour(f"i_{name}"), linewidth=LINE_WIDTH)
        codes.text(-0.008, (level + 0.35 + 0.15) / 3.0, f"Hall {name}", ha="right", va="center", fontsize=FONT_SIZE,
                   transform=codes.transAxes)  # fmt: skip
    codes.set_ylim(-0.15, 2.85)
    codes.set_yticks([])

    style.line(position, x, style.wrapped_degrees(capture["theta_enc"][part]), capture.reference, label="actual")
    style.line(position, x, style.wrapped_degrees(capture["theta_avg"][part]), "theta_avg", label="estimated")
    style.degrees_axis(position, "position", 180)
    style.legend_above(position)
    style.line(error, x, np.degrees(capture.position_error("theta_avg"))[part], "theta_avg")
    style.degrees_axis(error, "error", 40)

    error.set_xlim(0, shown)
    error.set_xticks(np.arange(0, shown + 1, 60))
    style.axis_labels(error, "actual angle", "error", "el. °", "el. °")
    figure.align_ylabels([position, error])
    return figure

"""Where the Hall edges lie by the encoder, and how far that is from where they belong, by direction.

Without an encoder: where they lie against each other, their mean where it belongs. Measured as `bench hall` does
(`bench.signal.hall_edges`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bench.record.layout import SAMPLES
from bench.record.reader import Run, captures
from bench.report import style
from bench.report.plots import edge_axes
from bench.report.style import FONT_SIZE, GREY, LINE_WIDTH, SERIES
from bench.signal.channels import reference_angle
from bench.signal.hall_edges import Measured, measure
from bench.signal.trace import trace_of
from bench.signal.waveforms.sectors import NUMERALS


def edges_of(run: Run, first: int, last: int) -> Measured | None:
    """What was measured of the ticks `first` to `last`; None without a single edge of a shaft that turns."""
    wanted = [name for name in ("hall", reference_angle(run.config(SAMPLES).channels)) if name]
    measured = measure(trace_of(captures(run, first, last, wanted)))
    with_encoder = len(wanted) > 1
    return None if measured.fit is None or (measured.blind and with_encoder) else measured


def as_json(of: Measured) -> dict[str, Any]:
    """Plain data, electrical degrees; `late` is the measured less the ideal angle."""
    edges = [
        {
            "sector": NUMERALS[edge.sector],
            "edge": edge.name,
            "ideal": math.degrees(edge.ideal),
            **{
                way: {
                    "angle": math.degrees(passages.angle) % 360.0,
                    "late": -math.degrees(edge.delta(passages)),
                    "std": math.degrees(passages.jitter),
                    "half_width_95": math.degrees(passages.half_width),
                    "n": passages.n,
                }
                for way, passages in (("forwards", edge.up), ("backwards", edge.down))
                if passages.n
            },
        }
        for edge in of.edges
    ]
    return {"edges": edges, "delay_s": of.delay, "outliers": of.outliers, "against": _against(of)}


def _against(of: Measured) -> str:
    """What the places are told against."""
    return "mean of the edges" if of.blind else "encoder"


def words(of: Measured) -> str:
    """What the figure says, in a line."""
    late = (-math.degrees(edge.mean_delta) for edge in of.edges)
    ring = f"ring at {math.degrees(of.edges[0].offset):.1f}°, " if of.edges[0].offset else ""
    told = ", ".join("–" if math.isnan(each) else f"{each:+.2f}" for each in late)
    return f"{ring}late by {told} el. ° (I … VI){', against their mean: no encoder' if of.blind else ''}"


def draw(of: Measured) -> Figure:
    """The edges on the circle, and how late each comes, with the standard deviation of its passages."""
    names = [f"{name}\n{edge.name.replace(' ', chr(10))}" for name, edge in zip(NUMERALS, of.edges, strict=True)]
    figure, circle, chart = edge_axes(names, GREY, 4.0, of.edges[0].ideal)
    late_all = []
    for way, mark, hue, shift, inner in (("forward", ">", SERIES[1], -0.1, 0.0), ("reverse", "<", SERIES[0], 0.1, 0.3)):
        passages = [edge.up if way == "forward" else edge.down for edge in of.edges]
        met = np.array([each.n > 0 for each in passages])
        if not met.any():
            continue
        angle = np.array([each.angle for each in passages])[met]
        circle.vlines(angle, inner, 1, color=hue, linewidth=LINE_WIDTH, label=way)
        late = np.degrees([-edge.delta(each) for edge, each in zip(of.edges, passages, strict=True)])[met]
        spread = np.nan_to_num(np.degrees([each.jitter for each in passages]))[met]
        late_all += [late - spread, late + spread]
        chart.errorbar(
            np.arange(6)[met] + shift, late, spread, fmt=mark, color=hue, markersize=5, capsize=2.5, linewidth=1.0,
            label=f"{way} ± std, {sum(each.n for each in passages)} edges",
        )  # fmt: skip
    circle.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False, fontsize=FONT_SIZE,
                  handlelength=1.4, columnspacing=1.0)  # fmt: skip
    reach = max(1.15 * float(np.abs(np.concatenate(late_all)).max()), 0.5)
    chart.set_ylim(-reach, reach)
    late_by = "from its place by the mean" if of.blind else "measured − ideal"
    style.axis_labels(chart, "edge at the start of the sector (turning forward)", late_by, unit_y="el. °")
    chart.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False, fontsize=FONT_SIZE, borderaxespad=0.2)
    return figure

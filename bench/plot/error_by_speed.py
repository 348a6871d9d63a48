"""Position errors over the speed, while the shaft turns steadily."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bench.plot.looks import looks
from bench.report.style import LINE_WIDTH, axis_labels, legend_above, new_figure
from bench.signal.error_bins import BySpeed, ErrorBySpeed
from bench.view.schema import label

PERCENT = ErrorBySpeed.PERCENT


def as_json(found: Mapping[str, BySpeed]) -> dict[str, Any]:
    """Plain data."""
    rows = {
        name: {
            "rpm": of.rpm.tolist(), "n": of.n.tolist(), "mean": of.mean.tolist(), "rms": of.rms.tolist(),
            "p95": of.percentile.tolist(),
        }
        for name, of in found.items()
    }  # fmt: skip
    return {"bin_rpm": next(iter(found.values())).width, "estimates": rows}


def words(found: Mapping[str, BySpeed]) -> str:
    """What the figure says, in a line."""
    rows = ((name, of, int(np.argmax(of.rms))) for name, of in found.items())
    return "; ".join(f"{name} rms up to {of.rms[k]:.2f}° (at {of.rpm[k]:g} r/min)" for name, of, k in rows)


def draw(found: Mapping[str, BySpeed], unit: str) -> Figure:
    """Mean, rms and percentile over the speed in `unit`, one below the other, a line for each estimate."""
    figure, axes = new_figure(3, height=5.4)
    look_of = looks(found)
    for name, of in found.items():
        look = look_of[name]
        style: dict[str, Any] = {"marker": look.mark, "markersize": 4, "linewidth": LINE_WIDTH * 0.8}
        for sign in (-1, 1):
            side = of.rpm * sign > 0
            if not side.any():
                continue
            words = "" if sign < 0 and (of.rpm > 0).any() else label(name)
            for ax, values in zip(axes, (of.mean, of.rms, of.percentile), strict=True):
                ax.plot(of.rpm[side], values[side], look.dash, color=look.paper, label=words, **style)
    axes[0].axhline(0.0, color="black", linewidth=0.5)
    means, highest = (
        max(float(np.abs(row).max()) for row in rows)
        for rows in ([of.mean for of in found.values()], [of.rms for of in found.values()])
    )
    reach = max(1.15 * means, 0.1 * highest, 1e-3)  # not a magnified nothing
    axes[0].set_ylim(-reach, reach)
    for ax, what in zip(axes, ("mean", "rms", f"{PERCENT:g} %"), strict=True):
        axis_labels(ax, "", f"error, {what}", unit_y="el. °")
        ax.margins(x=0.04)
        if what != "mean":
            ax.set_ylim(0, 1.08 * max(ax.dataLim.y1, 1e-3))  # a mark at the top is whole
    rpm = np.concatenate([of.rpm for of in found.values()])
    if np.ptp(rpm) == 0:  # a single speed: not at an edge of nothing
        axes[-1].set_xlim(rpm[0] - 0.2 * abs(rpm[0]) - 1, rpm[0] + 0.2 * abs(rpm[0]) + 1)
    axis_labels(axes[-1], "speed", f"error, {PERCENT:g} %", unit, "el. °")
    figure.align_ylabels(axes)
    legend_above(axes[0])
    return figure

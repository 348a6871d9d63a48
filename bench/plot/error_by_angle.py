"""Position errors over the electrical angle, both directions apart, while the shaft turns steadily."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bench.plot.looks import looks
from bench.report.plots import draw_band, turn_axis
from bench.report.style import FONT_SIZE, axis_labels, legend_above, new_figure
from bench.signal.error_bins import ANGLES, ErrorByAngle
from bench.signal.waveforms.sectors import FORWARD, REVERSE
from bench.view.schema import label


def as_json(found: Mapping[str, ErrorByAngle]) -> dict[str, Any]:
    """Plain data; `angle_deg` are the middles of the bins."""
    rows = {}
    for name, of in found.items():
        mean, std = of.band()
        rows[name] = {**of.overall, "n": int(of.n.sum())} | {
            way: {"n": of.n[k].astype(int).tolist(), "mean": mean[k].tolist(), "std": std[k].tolist()}
            for k, way in ((FORWARD, "forwards"), (REVERSE, "backwards"))
            if of.n[k].any()
        }
    return {"angle_deg": ANGLES.tolist(), "estimates": rows}


def words(found: Mapping[str, ErrorByAngle]) -> str:
    """What the figure says, in a line."""
    rows = ((name, of.overall) for name, of in found.items())
    return "; ".join(f"{name} {all['mean']:+.2f} ± {all['std']:.2f}°" for name, all in rows)


def draw(found: Mapping[str, ErrorByAngle]) -> Figure:
    """Mean and band of one standard deviation, an estimate a panel with its own scale; turning back is dashed."""
    columns = 1 if len(found) == 1 else 2
    rows = -(-len(found) // columns)
    figure, axes = new_figure(rows, columns, height=0.6 + (2.4 if rows == 1 else 1.75 * rows))
    look_of = looks(found)
    for ax, (name, of) in zip(axes, found.items(), strict=False):
        own, met = look_of[name].paper, [bool(n.any()) for n in of.n]
        mean, std = of.band()
        for way, dash, words in ((FORWARD, "-", label(name)), (REVERSE, "--", "reverse")):
            if met[way]:
                words = words if met[FORWARD] else f"{label(name)}, {words}"
                draw_band(ax, mean[way], std[way], own, words, dash)
        ax.axhline(0.0, color="black", linewidth=0.5)
        for edge in range(60, 360, 60):
            ax.axvline(edge, color="0.75", linewidth=0.5, linestyle=":")
        turn_axis(ax)
        reach = 1.3 * float(np.nanmax(np.abs(mean) + std)) or 1.0
        ax.set_ylim(-reach, reach)
        all_of_it = of.overall
        told = f"{all_of_it['mean']:+.2f}° ± {all_of_it['std']:.2f}°"
        ax.text(0.99, 0.97, told, transform=ax.transAxes, ha="right", va="top", fontsize=FONT_SIZE)
        legend_above(ax)
    for ax in axes[len(found) :]:
        ax.set_visible(False)
    for number, ax in enumerate(axes[: len(found)]):
        lowest = number + columns >= len(found)
        ax.tick_params(labelbottom=lowest)
        axis_labels(ax, "electrical angle" if lowest else "", "error" if number % columns == 0 else "",
                    "el. °" if lowest else "", "el. °" if number % columns == 0 else "")  # fmt: skip
    return figure

"""Where the Hall edges lie by the encoder, and how far that is from where they belong, by direction.

Measured as `bench hall` does (`bench.hall.edges`); of a run with very many edges, on a share drawn by chance.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bench.analysis.capture import Capture
from bench.analysis.chunks import join, part
from bench.analysis.trace import Edges
from bench.hall.edges import NUMERALS, Measured, measure
from bench.hall.trace import trace
from bench.reports import style
from bench.reports.style import FONT_SIZE, GREY, LIGHT, LINE_WIDTH, SERIES
from protocol.streams import EdgeChunk, SampleChunk

MOST = 400_000  # edges that are kept
BEFORE = 0.05  # s before samples that are looked at with them


class HallEdges:
    """Collects edges with their angles; edges of a shaft that hardly moves, and false pulses, are left out."""

    def __init__(self) -> None:
        self._kept: list[Edges] = []
        self._share = 1.0
        self._held: SampleChunk | None = None
        self._chance = np.random.default_rng(0)

    def before(self) -> int | None:
        """The tick from which edges are wanted with the next samples; None where there were none before."""
        return None if self._held is None else int(self._held.tick[-1]) + 1

    def add(self, samples: SampleChunk, edges: EdgeChunk) -> None:
        """Add the edges since the last samples that were added up to the last one of `samples`."""
        whole = samples if self._held is None else join([self._held, samples])
        found = trace(Capture(whole, edges)).edges
        self._held = part(samples, max(0, len(samples) - round(BEFORE * samples.config.rate)), len(samples))
        self._kept.append(_chosen(found, self._chance.random(len(found.tick)) < self._share))
        if sum(len(each.tick) for each in self._kept) > MOST:
            self._share /= 2.0
            whole_edges = _joined(self._kept)
            self._kept = [_chosen(whole_edges, self._chance.random(len(whole_edges.tick)) < 0.5)]

    def result(self) -> Measured | None:
        """What was measured; None without a single edge."""
        edges = _joined(self._kept) if self._kept else None
        if edges is None or not np.isfinite(edges.theta).any():
            return None
        return measure(edges)


def _chosen(edges: Edges, which: Any) -> Edges:
    return Edges(*(getattr(edges, field.name)[which] for field in fields(Edges)))


def _joined(parts: list[Edges]) -> Edges:
    return Edges(*(np.concatenate([getattr(each, field.name) for each in parts]) for field in fields(Edges)))


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
    return {"edges": edges, "delay_s": of.delay, "outliers": of.outliers}


def words(of: Measured) -> str:
    """What the figure says, in a line."""
    late = (-math.degrees(edge.mean_delta) for edge in of.edges)
    return f"late by {', '.join('–' if math.isnan(each) else f'{each:+.2f}' for each in late)} el. ° (I … VI)"


def draw(of: Measured) -> Figure:
    """The edges on the circle, and how late each comes, with the standard deviation of its passages."""
    figure = Figure(figsize=(style.WIDTH, 3.6), layout="constrained", facecolor="white")
    grid = figure.add_gridspec(1, 2, width_ratios=[1.0, 1.35])
    circle = figure.add_subplot(grid[0, 0], projection="polar")
    chart = figure.add_subplot(grid[0, 1])
    ideal = np.array([edge.ideal for edge in of.edges])
    circle.vlines(ideal, 0, 1, color=LIGHT, linewidth=4.0, label="ideal")
    for name, angle in zip(NUMERALS, ideal, strict=True):
        circle.text(angle + math.pi / 6, 0.62, name, ha="center", va="center", fontsize=FONT_SIZE, color=GREY)
    late_all = []
    for way, mark, hue, shift, inner in (
        ("forward", ">", SERIES[1], -0.1, 0.0),
        ("reverse", "<", SERIES[0], 0.1, 0.3),
    ):
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
    circle.set_xticks(ideal)
    circle.set_yticks([])
    circle.set_ylim(0, 1)
    circle.grid(False)
    circle.tick_params(labelsize=FONT_SIZE)
    circle.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False, fontsize=FONT_SIZE,
                  handlelength=1.4, columnspacing=1.0)  # fmt: skip
    chart.axhline(0.0, color=style.BLACK, linewidth=0.6)
    names = [f"{name}\n{edge.name.replace(' ', chr(10))}" for name, edge in zip(NUMERALS, of.edges, strict=True)]
    chart.set_xticks(range(6), names)
    chart.set_xlim(-0.5, 5.5)
    style.plain(chart)
    chart.grid(False, axis="x")
    reach = max(1.15 * float(np.abs(np.concatenate(late_all)).max()), 0.5)
    chart.set_ylim(-reach, reach)
    style.axis_labels(chart, "edge at the start of the sector (turning forward)", "measured − ideal", unit_y="el. °")
    chart.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False, fontsize=FONT_SIZE, borderaxespad=0.2)
    return figure

"""Figures of the scoreboard: what errs when, where in a turn, and at which speed. Nothing here measures or judges."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.acceptance.style import (
    BLACK,
    BLUE,
    LINE_WIDTH,
    SPARE_COLOURS,
    axis_labels,
    degrees_axis,
    legend_above,
    new_figure,
)
from bench.score.board import Figures
from bench.score.phases import RPM
from bench.score.tracks import Track
from bench.statistics import wrap

F64 = NDArray[np.float64]
POINTS = 3000  # of a line over time: minimum and maximum of as many stretches, so that no peak is lost
ANGLE_BINS = 120
DASHES = ("-", "--", ":")


def draw_error_over_time(track: Track, name: str) -> Figure:
    """Speed and position error of an observer over a whole recording; the start of a recording is t = 0."""
    figure, (speed, error) = new_figure(2, height=3.6)
    begin = float(track.stretches[0].t[0])
    for k, stretch in enumerate(track.stretches):
        t = stretch.t - begin
        degrees = np.degrees(wrap(stretch.theta - stretch.estimates[name].theta))
        rpm = RPM / track.pole_pairs
        for omega, colour, words in ((stretch.estimates[name].omega, BLUE, name), (stretch.omega, BLACK, "encoder")):
            label = "" if k else words
            speed.plot(*_envelope(t, omega * rpm), color=colour, linewidth=LINE_WIDTH, label=label)
        error.plot(*_envelope(t, degrees), color=BLUE, linewidth=0.6)
    axis_labels(speed, "", "speed", unit_y="r/min")
    axis_labels(error, "t", "error", "s", "el. °")
    figure.align_ylabels([speed, error])
    legend_above(speed)
    return figure


def draw_error_by_angle(tracks: Sequence[Track], name: str) -> Figure:
    """Mean position error by the electrical angle, with a band of one standard deviation and lines of the extremes.

    Over the steady samples of all `tracks` that have the estimate.
    """
    stretches = [s for track in tracks if name in track.kinds for s in track.stretches]
    theta = np.concatenate([s.theta[s.phases.steady] for s in stretches])
    estimated = np.concatenate([s.estimates[name].theta[s.phases.steady] for s in stretches])
    error = np.degrees(wrap(theta - estimated))
    figure, (ax,) = new_figure(height=2.4)
    width = 2.0 * math.pi / ANGLE_BINS
    bins = np.minimum((np.mod(theta, 2.0 * math.pi) / width).astype(np.int64), ANGLE_BINS - 1)
    order = np.argsort(bins, kind="stable")
    present, starts = np.unique(bins[order], return_index=True)
    if len(present):
        sorted_ = error[order]
        n = np.diff(np.append(starts, len(sorted_)))
        mean = np.add.reduceat(sorted_, starts) / n
        std = np.sqrt(np.maximum(np.add.reduceat(sorted_**2, starts) / n - mean**2, 0.0))
        x = np.degrees((present + 0.5) * width)
        ax.fill_between(x, mean - std, mean + std, color=BLUE, alpha=0.25, linewidth=0, label="± one std")
        ax.plot(x, mean, color=BLUE, linewidth=LINE_WIDTH, label="mean")
        for extreme, words in ((np.minimum, ""), (np.maximum, "extremes")):
            ax.plot(x, extreme.reduceat(sorted_, starts), color=BLACK, linewidth=0.6, label=words)
    ax.set_xlim(0, 360)
    ax.set_xticks(range(0, 361, 60))
    axis_labels(ax, "electrical angle", "error", "°", "el. °")
    legend_above(ax)
    return figure


def draw_error_by_speed(observers: Mapping[str, Figures]) -> Figure:
    """Standard deviation and largest position error in steady running by bin of speed, a line for each observer."""
    figure, axes = new_figure(2, height=4.6)
    bins = sorted({bin for figures in observers.values() for bin in figures["by_speed"]}, key=_lowest)
    for k, (name, figures) in enumerate(observers.items()):
        colour, dash = SPARE_COLOURS[k % len(SPARE_COLOURS)], DASHES[k // len(SPARE_COLOURS) % len(DASHES)]
        at = [i for i, bin in enumerate(bins) if bin in figures["by_speed"]]
        for ax, key in zip(axes, ("std", "max"), strict=True):
            values = [figures["by_speed"][bins[i]][key] for i in at]
            ax.plot(at, values, dash, marker="o", markersize=2.5, linewidth=LINE_WIDTH, label=name, color=colour)
    for ax, words in zip(axes, ("error, std", "error, max"), strict=True):
        degrees_axis(ax, words)
        ax.set_ylim(bottom=0)
    axes[-1].set_xticks(range(len(bins)), [bin.replace("_to_", " … ") for bin in bins], rotation=30, ha="right")
    axis_labels(axes[-1], "speed", "error, max", "r/min", "el. °")
    legend_above(axes[0])
    return figure


def _envelope(t: F64, values: F64) -> tuple[F64, F64]:
    """Fewer points with the same peaks: minimum and maximum of each of `POINTS` stretches, or all points."""
    n = len(values) // (2 * POINTS)
    if n < 2:
        return t, values
    rows = values[: len(values) // n * n].reshape(-1, n)
    points = np.column_stack([rows.min(axis=1), rows.max(axis=1)]).ravel()
    return np.repeat(t[: len(rows) * n : n], 2), points


def _lowest(bin: str) -> float:
    return float(bin.split("_to_")[0])

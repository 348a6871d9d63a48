"""Figures of the scoreboard: what errs when, where in a turn, and at which speed. Nothing here measures or judges."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.analysis.colours import Look, apart
from bench.analysis.position import position_error
from bench.analysis.units import RPM
from bench.reports.style import (
    FONT_SIZE,
    GREY,
    LINE_WIDTH,
    SERIES,
    axis_labels,
    colour,
    degrees_axis,
    legend_above,
    new_figure,
)
from bench.scoring.board import Figures
from bench.scoring.tracks import Track
from sim.observers.catalogue import CATALOGUE

F64 = NDArray[np.float64]
POINTS = 3000  # of a line over time: minimum and maximum of as many stretches, so that no peak is lost
ANGLE_BINS = 120
SHOWN = 99.9  # percentile of the error in motion that the axis over time covers; the peak is told in words


def looks(names: Iterable[str]) -> dict[str, Look]:
    """Looks of observers by their names on the board: those run here have their own before the same one recorded."""
    shorts = {name: CATALOGUE[name].short if name in CATALOGUE else name.partition("_")[2] for name in names}
    return apart({name: f"theta_{shorts[name]}" for name in sorted(shorts, key=lambda name: name not in CATALOGUE)})


def draw_error_over_time(track: Track, name: str) -> Figure:
    """Speed and position error of an observer over a whole recording; the start of a recording is t = 0."""
    figure, (speed, error) = new_figure(2, height=3.6)
    begin = float(track.stretches[0].t[0])
    own = looks(track.kinds)[name].paper
    for k, stretch in enumerate(track.stretches):
        t = stretch.t - begin
        degrees = np.degrees(position_error(stretch.theta, stretch.estimates[name].theta))
        rpm = 1.0 / (RPM * track.pole_pairs)
        by_encoder = stretch.omega, colour("omega_enc"), "encoder"
        for omega, hue, words in ((stretch.estimates[name].omega, own, name), by_encoder):
            label = "" if k else words
            speed.plot(*_envelope(t, omega * rpm), color=hue, linewidth=LINE_WIDTH, label=label)
        error.plot(*_envelope(t, degrees), color=own, linewidth=0.6)
    _limit(error, track, name, begin)
    axis_labels(speed, "", "speed", unit_y="r/min")
    axis_labels(error, "t", "error", "s", "el. °")
    figure.align_ylabels([speed, error])
    legend_above(speed)
    return figure


def _limit(ax: Axes, track: Track, name: str, begin: float) -> None:
    """Make the axis of the error cover `SHOWN` percent of the samples in motion, and tell a peak beyond it."""
    sizes = [np.abs(np.degrees(position_error(s.theta, s.estimates[name].theta))) for s in track.stretches]
    moving = np.concatenate([size[s.phases.moving] for size, s in zip(sizes, track.stretches, strict=True)])
    if not len(moving):
        return
    limit = max(1.15 * float(np.percentile(moving, SHOWN)), 0.1)
    highest = max(range(len(sizes)), key=lambda k: float(sizes[k].max()))
    at = int(sizes[highest].argmax())
    if (peak := float(sizes[highest][at])) > limit:
        when = float(track.stretches[highest].t[at]) - begin
        words = f"peak {peak:.1f}° at {when:.2f} s"
        ax.text(1.0, 1.0, words, transform=ax.transAxes, ha="right", va="bottom", fontsize=FONT_SIZE)
    degrees_axis(ax, "error", limit)


def draw_error_by_angle(tracks: Sequence[Track], name: str) -> Figure:
    """Mean position error by the electrical angle, with a band of one standard deviation and lines of the extremes.

    Over the steady samples of all `tracks` that have the estimate.
    """
    stretches = [s for track in tracks if name in track.kinds for s in track.stretches]
    theta = np.concatenate([s.theta[s.phases.steady] for s in stretches])
    estimated = np.concatenate([s.estimates[name].theta[s.phases.steady] for s in stretches])
    error = np.degrees(position_error(theta, estimated))
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
        own = looks(kind for track in tracks for kind in track.kinds)[name].paper
        ax.fill_between(x, mean - std, mean + std, color=own, alpha=0.25, linewidth=0, label="± one std")
        ax.plot(x, mean, color=own, linewidth=LINE_WIDTH, label="mean")
        for extreme, words in ((np.minimum, ""), (np.maximum, "extremes")):
            ax.plot(x, extreme.reduceat(sorted_, starts), color=GREY, linewidth=0.6, label=words)
    ax.set_xlim(0, 360)
    ax.set_xticks(range(0, 361, 60))
    axis_labels(ax, "electrical angle", "error", "°", "el. °")
    legend_above(ax)
    return figure


def draw_error_by_speed(observers: Mapping[str, Figures]) -> Figure:
    """Standard deviation and largest position error in steady running by bin of speed, a line for each observer.

    Of a single bin they are bars.
    """
    bins = sorted({bin for figures in observers.values() for bin in figures["by_speed"]}, key=_lowest)
    if len(bins) == 1:
        return _error_at_one_speed({name: f["by_speed"].get(bins[0]) for name, f in observers.items()}, bins[0])
    figure, axes = new_figure(2, height=4.6)
    found = looks(observers)
    for name, figures in observers.items():
        look = found[name]
        at = [i for i, bin in enumerate(bins) if bin in figures["by_speed"]]
        for ax, key in zip(axes, ("std", "max"), strict=True):
            values = [figures["by_speed"][bins[i]][key] for i in at]
            ax.plot(at, values, look.dash, marker=look.mark, markersize=4, lw=0.8, label=name, color=look.paper)
    for ax, words in zip(axes, ("error, std", "error, max"), strict=True):
        degrees_axis(ax, words)
        ax.set_ylim(bottom=0)
    axes[-1].set_xticks(range(len(bins)), [_words(bin) for bin in bins], rotation=30, ha="right")
    axis_labels(axes[-1], "speed", "error, max", "r/min", "el. °")
    legend_above(axes[0])
    return figure


def _error_at_one_speed(observers: Mapping[str, Figures | None], bin: str) -> Figure:
    known = [(name, figures) for name, figures in observers.items() if figures is not None]
    figure, axes = new_figure(1, 2, height=0.8 + 0.18 * len(known), share_x=False)
    for ax, key in zip(axes, ("std", "max"), strict=True):
        ax.barh([name for name, _ in known], [figures[key] for _, figures in known], color=SERIES[0], height=0.7)
        ax.invert_yaxis()
        axis_labels(ax, f"error, {key}, at {_words(bin)} r/min", "", "el. °")
    axes[1].tick_params(labelleft=False)
    return figure


def _words(bin: str) -> str:
    return bin.replace("_to_", " … ")


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

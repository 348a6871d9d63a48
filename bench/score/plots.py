"""Figures of the scoreboard: what errs when, where in a turn, and at which speed. Nothing here measures or judges."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.report.plots import draw_band, turn_axis
from bench.report.style import (
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
from bench.score.board import Figures
from bench.score.tally import Envelope
from bench.score.tracks import Track
from bench.signal.colours import Look, apart
from bench.signal.error_bins import ANGLES, ErrorByAngle
from sim.observers.catalogue import CATALOGUE

F64 = NDArray[np.float64]
SHOWN = 99.9  # percentile of the error in motion that the axis over time covers; the peak is told in words


def looks(names: Iterable[str]) -> dict[str, Look]:
    """Looks of observers by their names on the board: those run here have their own before the same one recorded."""
    shorts = {name: CATALOGUE[name].short if name in CATALOGUE else name.partition("_")[2] for name in names}
    return apart({name: f"theta_{shorts[name]}" for name in sorted(shorts, key=lambda name: name not in CATALOGUE)})


def draw_error_over_time(track: Track, name: str) -> Figure:
    """Speed and position error of an observer over a whole recording; the start of a recording is t = 0."""
    figure, (speed, error) = new_figure(2, height=3.6)
    begin = track.stretches[0].t
    own = looks(track.kinds)[name].paper
    over_time = track.over_time[name]
    first = 0
    for k, stretch in enumerate(track.stretches):
        points = slice(first, first + -(-stretch.n // track.every))
        first = points.stop
        t = stretch.t - begin + np.arange(points.stop - points.start) * track.every / track.rate
        for envelope, hue, words in (
            (over_time.speed, own, name),
            (track.actual, colour("omega_enc"), track.reference.kind),
        ):
            label = "" if k else words
            speed.plot(*_line(t, envelope, points), color=hue, linewidth=LINE_WIDTH, label=label)
        error.plot(*_line(t, over_time.error, points), color=own, linewidth=0.6)
    _limit(error, track, name, begin)
    axis_labels(speed, "", "speed", unit_y="r/min")
    axis_labels(error, "t", track.reference.noun, "s", "el. °")
    figure.align_ylabels([speed, error])
    legend_above(speed)
    return figure


def _limit(ax: Axes, track: Track, name: str, begin: float) -> None:
    """Make the axis of the error cover `SHOWN` percent of the samples in motion, and tell a peak beyond it."""
    moving, over_time = track.tallies[name].moving, track.over_time[name]
    if not moving.n:
        return
    limit = max(1.15 * moving.size(SHOWN), 0.1)
    if over_time.peak > limit:
        words = f"peak {over_time.peak:.1f}° at {over_time.peak_t - begin:.2f} s"
        ax.text(1.0, 1.0, words, transform=ax.transAxes, ha="right", va="bottom", fontsize=FONT_SIZE)
    degrees_axis(ax, track.reference.noun, limit)


def draw_error_by_angle(tracks: Sequence[Track], name: str) -> Figure:
    """Mean position error by the electrical angle, with a band of one standard deviation and lines of the extremes.

    Over the steady samples of all `tracks` that have the estimate.
    """
    whole = ErrorByAngle()
    for track in tracks:
        if name in track.kinds:
            whole.merge(track.tallies[name].by_angle)
    figure, (ax,) = new_figure(height=2.4)
    if whole.n.any():
        own = looks(kind for track in tracks for kind in track.kinds)[name].paper
        draw_band(ax, *whole.both(), own, "mean", band="± one std")
        for extreme, words in ((whole.lo.min(axis=0), ""), (whole.hi.max(axis=0), "extremes")):
            ax.plot(ANGLES, np.where(np.isfinite(extreme), extreme, np.nan), color=GREY, linewidth=0.6, label=words)
    turn_axis(ax)
    axis_labels(ax, "electrical angle", tracks[0].reference.noun, "°", "el. °")
    legend_above(ax)
    return figure


def draw_error_by_speed(observers: Mapping[str, Figures], noun: str = "error") -> Figure:
    """Standard deviation and largest position error in steady running by bin of speed, a line for each observer.

    Of a single bin they are bars.
    """
    bins = sorted({bin for figures in observers.values() for bin in figures["by_speed"]}, key=_lowest)
    if len(bins) == 1:
        return _error_at_one_speed({name: f["by_speed"].get(bins[0]) for name, f in observers.items()}, bins[0], noun)
    figure, axes = new_figure(2, height=4.6)
    found = looks(observers)
    for name, figures in observers.items():
        look = found[name]
        at = [i for i, bin in enumerate(bins) if bin in figures["by_speed"]]
        for ax, key in zip(axes, ("std", "max"), strict=True):
            values = [figures["by_speed"][bins[i]][key] for i in at]
            ax.plot(at, values, look.dash, marker=look.mark, markersize=4, lw=0.8, label=name, color=look.paper)
    for ax, words in zip(axes, (f"{noun}, std", f"{noun}, max"), strict=True):
        degrees_axis(ax, words)
        ax.set_ylim(bottom=0)
    axes[-1].set_xticks(range(len(bins)), [speeds(bin) for bin in bins], rotation=30, ha="right")
    axis_labels(axes[-1], "speed", f"{noun}, max", "r/min", "el. °")
    legend_above(axes[0])
    return figure


def _error_at_one_speed(observers: Mapping[str, Figures | None], bin: str, noun: str) -> Figure:
    known = [(name, figures) for name, figures in observers.items() if figures is not None]
    figure, axes = new_figure(1, 2, height=0.8 + 0.18 * len(known), share_x=False)
    for ax, key in zip(axes, ("std", "max"), strict=True):
        ax.barh([name for name, _ in known], [figures[key] for _, figures in known], color=SERIES[0], height=0.7)
        ax.invert_yaxis()
        axis_labels(ax, f"{noun}, {key}, at {speeds(bin)} r/min", "", "el. °")
    axes[1].tick_params(labelleft=False)
    return figure


def speeds(bin: str) -> str:
    """A bin of speeds as a person reads it: `-750_to_-350` is "−750 … −350"."""
    return bin.replace("_to_", " … ").replace("-", "−")


def _line(t: F64, envelope: Envelope, points: slice) -> tuple[F64, F64]:
    """The least and the largest at each point, as a line through both, or through one where they are the same."""
    lo, hi = envelope.lo[points], envelope.hi[points]
    if np.array_equal(lo, hi, equal_nan=True):
        return t, lo
    return np.repeat(t, 2), np.column_stack([lo, hi]).ravel()


def _lowest(bin: str) -> float:
    return float(bin.split("_to_")[0])

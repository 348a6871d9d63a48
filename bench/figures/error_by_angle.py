"""Position errors over the electrical angle, both directions apart, while the shaft turns steadily."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.analysis.position import position_error
from bench.figures.looks import looks
from bench.figures.motion import Piece
from bench.reports.style import FONT_SIZE, LINE_WIDTH, axis_labels, legend_above, new_figure
from bench.rerunio.schema import label

F64 = NDArray[np.float64]

BINS = 120
FORWARDS, BACKWARDS = 0, 1
"""Rows of `ByAngle`."""


@dataclass(frozen=True)
class ByAngle:
    """Errors by bins of the angle, electrical degrees; (2, BINS) each, NaN where n is 0."""

    n: NDArray[np.int64]
    mean: F64
    std: F64
    """Of the population, about the mean of its bin."""

    @property
    def overall(self) -> dict[str, float]:
        """Mean, std and rms of all samples."""
        n = self.n[self.n > 0]
        mean, std = self.mean[self.n > 0], self.std[self.n > 0]
        whole = float(np.average(mean, weights=n))
        square = float(np.average(std**2 + mean**2, weights=n))
        return {"mean": whole, "std": math.sqrt(max(square - whole**2, 0.0)), "rms": math.sqrt(square)}


def angles() -> F64:
    """The middle of each bin, degrees."""
    return (np.arange(BINS) + 0.5) * 360.0 / BINS


class ErrorByAngle:
    """Sums of errors, of their squares and of samples, by estimate, direction and bin."""

    def __init__(self, estimates: Sequence[str]) -> None:
        self._sums = {name: np.zeros((3, 2 * BINS)) for name in estimates}

    def add(self, piece: Piece) -> None:
        """Add the steady samples of a piece with an encoder."""
        if piece.theta is None or piece.rpm is None or piece.phases is None:
            return
        steady = piece.phases.steady
        for name in self._sums:
            self.add_errors(name, piece.theta[steady], piece.samples.physical(name)[steady], piece.rpm[steady] < 0)

    def add_errors(self, name: str, actual: F64, estimated: F64, backwards: NDArray[np.bool_]) -> None:
        """Add angles (n,) in rad, wrapped or not, to the estimate `name`; those that are not finite count for nothing.

        `backwards` (n,): whether the shaft turns so.
        """
        error = np.degrees(position_error(actual, estimated))
        known = np.isfinite(error)
        error = error[known]
        bins = np.floor(np.mod(actual[known], math.tau) * (BINS / math.tau)).astype(np.int64) % BINS
        bins += BINS * backwards[known]
        for row, weights in zip(self._sums[name], (None, error, error * error), strict=True):
            row += np.bincount(bins, weights, 2 * BINS)

    def result(self) -> dict[str, ByAngle]:
        """The estimates of which there are samples."""
        found = {}
        for name, sums in self._sums.items():
            n, total, square = sums.reshape(3, 2, BINS)
            if n.any():
                with np.errstate(invalid="ignore"):
                    mean = total / n
                    std = np.sqrt(np.maximum(square / n - mean**2, 0.0))
                found[name] = ByAngle(n.astype(np.int64), mean, std)
        return found


def as_json(found: Mapping[str, ByAngle]) -> dict[str, Any]:
    """Plain data; `angle_deg` are the middles of the bins."""
    rows = {
        name: {
            **of.overall,
            "n": int(of.n.sum()),
            **{
                way: {"n": of.n[k].tolist(), "mean": of.mean[k].tolist(), "std": of.std[k].tolist()}
                for k, way in ((FORWARDS, "forwards"), (BACKWARDS, "backwards"))
                if of.n[k].any()
            },
        }
        for name, of in found.items()
    }
    return {"angle_deg": angles().tolist(), "estimates": rows}


def words(found: Mapping[str, ByAngle]) -> str:
    """What the figure says, in a line."""
    rows = ((name, of.overall) for name, of in found.items())
    return "; ".join(f"{name} {all['mean']:+.2f} ± {all['std']:.2f}°" for name, all in rows)


def draw(found: Mapping[str, ByAngle]) -> Figure:
    """Mean and band of one standard deviation, an estimate a panel with its own scale; turning back is dashed."""
    columns = 1 if len(found) == 1 else 2
    rows = -(-len(found) // columns)
    figure, axes = new_figure(rows, columns, height=0.6 + (2.4 if rows == 1 else 1.75 * rows))
    look_of = looks(found)
    for ax, (name, of) in zip(axes, found.items(), strict=False):
        own, met = look_of[name].paper, [bool(n.any()) for n in of.n]
        for way, dash, words in ((FORWARDS, "-", label(name)), (BACKWARDS, "--", "reverse")):
            if not met[way]:
                continue
            mean, std = of.mean[way], of.std[way]
            ax.fill_between(angles(), mean - std, mean + std, color=own, alpha=0.22, linewidth=0)
            words = words if met[FORWARDS] else f"{label(name)}, {words}"
            ax.plot(angles(), mean, dash, color=own, linewidth=LINE_WIDTH, label=words)
        ax.axhline(0.0, color="black", linewidth=0.5)
        for edge in range(60, 360, 60):
            ax.axvline(edge, color="0.75", linewidth=0.5, linestyle=":")
        ax.set_xlim(0, 360)
        reach = 1.3 * float(np.nanmax(np.abs(of.mean) + of.std)) or 1.0
        ax.set_ylim(-reach, reach)
        ax.set_xticks(range(0, 361, 60))
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

"""Position errors over the speed, while the shaft turns steadily."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.analysis.position import position_error
from bench.figures.looks import looks
from bench.figures.motion import Piece
from bench.reports.style import LINE_WIDTH, axis_labels, legend_above, new_figure
from bench.rerunio.schema import label

F64 = NDArray[np.float64]

NARROWEST = 10.0  # r/min: a bin of the speed, as long as there are few
WIDER = 5  # times: odd, so that the middles of wide bins are middles of narrow ones, and a round speed stays in one
MOST = 80  # bins of the speed
SIZES = 3600  # bins of the error's size, up to 180 degrees
PERCENT = 95.0


@dataclass(frozen=True)
class BySpeed:
    """Errors by bins of the speed, electrical degrees; (k,) each, k bins in the order of their speeds."""

    rpm: F64
    """The middle of each bin; negative for a shaft that turns back."""
    n: NDArray[np.int64]
    mean: F64
    rms: F64
    percentile: F64
    """Size that `PERCENT` % of the errors do not exceed, to a twentieth of a degree."""


@dataclass
class _Bin:
    n: int = 0
    total: float = 0.0
    square: float = 0.0
    sizes: NDArray[np.int64] = field(default_factory=lambda: np.zeros(SIZES, np.int64))

    def merge(self, other: _Bin) -> None:
        self.n += other.n
        self.total += other.total
        self.square += other.square
        self.sizes += other.sizes


class ErrorBySpeed:
    """Errors by estimate and bin of the speed. Bins become wider where there would be too many."""

    def __init__(self, estimates: Sequence[str], rate: float, n_p: int) -> None:
        """`rate`: samples a second; `n_p`: electrical turns in one of the speeds that will be added."""
        self._samples_of_a_turn = 60.0 * rate / n_p  # at 1 r/min
        self.width = NARROWEST
        """Of a bin, r/min."""
        self._bins: dict[str, dict[int, _Bin]] = {name: {} for name in estimates}

    def add(self, piece: Piece) -> None:
        """Add the steady samples of a piece with an encoder."""
        if piece.theta is None or piece.rpm is None or piece.phases is None:
            return
        steady = piece.phases.steady
        for name in self._bins:
            error = position_error(piece.theta[steady], piece.samples.physical(name)[steady])
            self.add_errors(name, piece.rpm[steady], np.degrees(error))

    def add_errors(self, name: str, rpm: F64, error: F64) -> None:
        """Add errors (n,) in degrees at the speeds `rpm` (n,); those that are not finite count for nothing."""
        known = np.isfinite(error) & np.isfinite(rpm)
        rpm, error = rpm[known], error[known]
        while True:
            keys = np.floor(rpm / self.width + 0.5).astype(np.int64)
            present, of = np.unique(keys, return_inverse=True)
            if len({*present.tolist(), *(key for bins in self._bins.values() for key in bins)}) <= MOST:
                break
            self._widen()
        size = np.minimum((np.abs(error) * (SIZES / 180.0)).astype(np.int64), SIZES - 1)
        for number, key in enumerate(present.tolist()):
            here = of == number
            its = error[here]
            new = _Bin(len(its), float(its.sum()), float(its @ its), np.bincount(size[here], minlength=SIZES))
            self._bins[name].setdefault(key, _Bin()).merge(new)

    def _widen(self) -> None:
        self.width *= WIDER
        for name, bins in self._bins.items():
            wide: dict[int, _Bin] = {}
            for key, old in bins.items():
                wide.setdefault((key + WIDER // 2) // WIDER, _Bin()).merge(old)
            self._bins[name] = wide

    def result(self) -> dict[str, BySpeed]:
        """The estimates of which there are samples; a bin with less than an electrical turn is left out."""
        found = {}
        for name, by_key in self._bins.items():
            turn = self._samples_of_a_turn / self.width
            keys = sorted(key for key, its in by_key.items() if its.n * abs(key) >= turn)
            if not keys:
                continue
            bins = [by_key[key] for key in keys]
            n = np.array([each.n for each in bins])
            found[name] = BySpeed(
                np.array(keys) * self.width,
                n,
                np.array([each.total for each in bins]) / n,
                np.sqrt(np.array([each.square for each in bins]) / n),
                np.array([_percentile(each) for each in bins]),
            )
        return found


def _percentile(of: _Bin) -> float:
    """In line within the bin of the sizes where it lies."""
    below = np.cumsum(of.sizes)
    wanted = of.n * PERCENT / 100.0
    at = int(np.searchsorted(below, wanted))
    before = float(below[at - 1]) if at else 0.0
    return (at + (wanted - before) / float(of.sizes[at])) * 180.0 / SIZES


def as_json(found: Mapping[str, BySpeed], width: float) -> dict[str, Any]:
    """Plain data."""
    rows = {
        name: {
            "rpm": of.rpm.tolist(), "n": of.n.tolist(), "mean": of.mean.tolist(), "rms": of.rms.tolist(),
            "p95": of.percentile.tolist(),
        }
        for name, of in found.items()
    }  # fmt: skip
    return {"bin_rpm": width, "estimates": rows}


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
        if what != "mean":
            ax.set_ylim(bottom=0)
        ax.margins(x=0.04)
    rpm = np.concatenate([of.rpm for of in found.values()])
    if np.ptp(rpm) == 0:  # a single speed: not at an edge of nothing
        axes[-1].set_xlim(rpm[0] - 0.2 * abs(rpm[0]) - 1, rpm[0] + 0.2 * abs(rpm[0]) + 1)
    axis_labels(axes[-1], "speed", f"error, {PERCENT:g} %", unit, "el. °")
    figure.align_ylabels(axes)
    legend_above(axes[0])
    return figure

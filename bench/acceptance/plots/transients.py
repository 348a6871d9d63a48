"""Draws the paper's transients (Figs. 9 to 12): the average-speed approach or what is without something on the left.

Captures in, figures out. Nothing here measures, knows a limit or talks to a drive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from bench.analysis.capture import F64, Capture
from bench.analysis.units import RPM
from bench.reports import style


class Transient(NamedTuple):
    """A transient to draw."""

    capture: Capture
    start: float  # device time in s that is shown as zero
    theta: str  # channel of the estimated angle
    omega: str  # channel of the estimated speed

    def t(self) -> F64:
        """Time from the start in s, shape (n,)."""
        return self.capture.t - self.start

    def rpm(self, channel: str) -> F64:
        """A speed in mechanical r/min, shape (n,)."""
        return self.capture[channel] / (self.capture.parameters["n_p"] * RPM)

    def error(self) -> F64:
        """Actual minus estimated angle in electrical degrees, shape (n,)."""
        degrees: F64 = np.degrees(self.capture.position_error(self.theta))
        return degrees

    def between(self, first: float, last: float) -> Transient:
        """The part from `first` to `last` s after the start."""
        return self._replace(capture=self.capture.between(self.start + first, self.start + last))


class LoadAngle(NamedTuple):
    """Load steps with one set of wrong parameters."""

    name: str
    without: Transient
    compensated: Transient


def draw_transient(
    one: Transient,
    other: Transient,
    first: float,
    last: float,
    degrees: float,
    names: tuple[str, str] = ("average speed", "proposed"),
) -> Figure:
    """Estimated and actual speed, position error and currents of two approaches, (a) and (b), as in Figs. 9 to 11.

    `first`, `last`: what is shown, in s from the start. `degrees`: range of the position error, plus and minus.
    `names`: of the approaches.
    """
    figure, axes = style.new_figure(3, 2, height=5.2)
    for column, (transient, words) in enumerate(((one, f"(a) {names[0]}"), (other, f"(b) {names[1]}"))):
        part = transient.between(first, last)
        t = part.t()
        speed, error, current = axes[column::2]
        style.line(speed, t, part.rpm(part.omega), part.omega, label="estimated")
        style.line(speed, t, part.rpm("omega_enc"), "omega_enc", label="actual")
        style.line(error, t, part.error(), part.theta)
        for channel in ("i_q", "i_d"):
            style.line(current, t, part.capture[channel], channel)
        style.legend_above(speed)
        style.column_title(speed, words)
        style.legend_above(current)
        style.time_axes((speed, error, current), first, last)
        style.degrees_axis(error, "position error", degrees)
        speed.set_ylabel("speed [r/min]", fontsize=style.FONT_SIZE)
        current.set_ylabel("current [A]", fontsize=style.FONT_SIZE)
    for row in range(3):
        _same_range(axes[2 * row : 2 * row + 2])
    return figure


def draw_load_angle(cases: Sequence[LoadAngle], first: float = -0.1, last: float = 0.3) -> Figure:
    """Position error of each case, and currents, (a) without and (b) with compensation, as in Fig. 12."""
    rows = len(cases) + 1
    figure, axes = style.new_figure(rows, 2, height=5.2)
    for column, words in enumerate(("(a) without compensation", "(b) with compensation")):
        stack = axes[column::2]
        for case, ax in zip(cases, stack, strict=False):
            whole = case.compensated if column else case.without
            part = whole.between(first, last)
            style.line(ax, part.t(), part.error(), part.theta, linewidth=0.7, label=case.name)
            style.line(ax, whole.t(), _mean(whole), part.theta, color=style.BLACK, linewidth=1.6, label="its mean")
            style.degrees_axis(ax, "position error", 6.5)
            style.legend_above(ax)
        style.column_title(stack[0], words)
        current = stack[-1]
        for channel in ("i_q", "i_d"):
            style.line(current, part.t(), part.capture[channel], channel)
        current.set_ylabel("current [A]", fontsize=style.FONT_SIZE)
        style.legend_above(current)
        style.time_axes(stack, first, last)
        current.xaxis.set_major_locator(MultipleLocator(0.1))
    for row in range(rows):
        _same_range(axes[2 * row : 2 * row + 2])
    return figure


def _mean(transient: Transient) -> F64:
    """The error's mean over an electrical turn around each sample; NaN where that reaches over the step or an end."""
    error, t = transient.error(), transient.t()
    turn = math.tau / abs(float(transient.capture["omega_enc"].mean()))
    length = round(turn * transient.capture.rate)
    mean = np.convolve(error, np.full(length, 1 / length), "same")
    mean[: length // 2] = mean[-length // 2 :] = np.nan
    mean[np.abs(t) < turn / 2] = np.nan
    return mean


def _same_range(axes: Sequence[Axes]) -> None:
    """One range of the ordinate for axes beside each other, so that they can be compared."""
    ranges = [ax.get_ylim() for ax in axes]
    for ax in axes:
        ax.set_ylim(min(low for low, _ in ranges), max(high for _, high in ranges))

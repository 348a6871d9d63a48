"""Draws the paper's transients (Figs. 9 to 12): the average-speed approach or what is without something on the left.

Captures in, figures out. Nothing here measures, knows a limit or talks to a drive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from bench.accept.suite.common import OMEGA, THETA, Transient, error_deg, rpm
from bench.report import style
from bench.signal.capture import F64, Capture


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
        part, observer = transient.part(first, last), transient.observer
        t = part.t - transient.start
        speed, error, current = axes[column::2]
        style.line(speed, t, rpm(part, OMEGA[observer]), OMEGA[observer], label="estimated")
        style.line(speed, t, rpm(part, "omega_enc"), "omega_enc", label="actual")
        style.line(error, t, error_deg(part, observer), THETA[observer])
        style.legend_above(speed)
        style.column_title(speed, words)
        _draw_currents(current, t, part)
        style.time_axes((speed, error, current), first, last)
        style.degrees_axis(error, "position error", degrees)
        speed.set_ylabel("speed [r/min]", fontsize=style.FONT_SIZE)
    _same_ranges(axes)
    return figure


def draw_load_angle(cases: Mapping[str, tuple[Transient, Transient]]) -> Figure:
    """Position error of each case, by name, and currents, (a) without and (b) with compensation, as in Fig. 12."""
    first, last = -0.1, 0.3  # s from the start
    figure, axes = style.new_figure(len(cases) + 1, 2, height=5.2)
    for column, words in enumerate(("(a) without compensation", "(b) with compensation")):
        stack = axes[column::2]
        for (name, pair), ax in zip(cases.items(), stack, strict=False):
            whole, theta = pair[column], THETA[pair[column].observer]
            part = whole.part(first, last)
            t = part.t - whole.start
            style.line(ax, t, error_deg(part, whole.observer), theta, linewidth=0.7, label=name)
            style.line(ax, *_mean(whole), theta, color=style.BLACK, linewidth=1.6, label="its mean")
            style.degrees_axis(ax, "position error", 6.5)
            style.legend_above(ax)
        style.column_title(stack[0], words)
        _draw_currents(stack[-1], t, part)
        style.time_axes(stack, first, last)
        stack[-1].xaxis.set_major_locator(MultipleLocator(0.1))
    _same_ranges(axes)
    return figure


def _draw_currents(ax: Axes, t: F64, capture: Capture) -> None:
    for channel in ("i_q", "i_d"):
        style.line(ax, t, capture[channel], channel)
    ax.set_ylabel("current [A]", fontsize=style.FONT_SIZE)
    style.legend_above(ax)


def _mean(transient: Transient) -> tuple[F64, F64]:
    """Times from the start in s, and the error's mean over an electrical turn around each; both (n,).

    NaN where the turn reaches over the step or an end.
    """
    capture = transient.capture
    error, t = error_deg(capture, transient.observer), capture.t - transient.start
    turn = math.tau / abs(float(capture["omega_enc"].mean()))
    length = round(turn * capture.measured_rate)
    mean = np.convolve(error, np.full(length, 1 / length), "same")
    mean[: length // 2] = mean[-length // 2 :] = np.nan
    mean[np.abs(t) < turn / 2] = np.nan
    return t, mean


def _same_ranges(axes: Sequence[Axes]) -> None:
    """One range of the ordinate for both axes of a row, so that they can be compared."""
    for left, right in zip(axes[::2], axes[1::2], strict=True):
        lows, highs = zip(left.get_ylim(), right.get_ylim(), strict=True)
        left.set_ylim(min(lows), max(highs))
        right.set_ylim(min(lows), max(highs))

"""A run of the drive over time: speed, position error, currents, Hall inputs, with marks where something happened.

Captures in, a matplotlib figure out. Nothing here measures; what a drive does not stream is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.accept.suite.common import PROPOSED, error_deg, rpm
from bench.report import style
from bench.report.style import axis_labels, line
from bench.signal.capture import F64, Capture

MARKS = ((style.BLACK, (0, (1, 1))), (style.GREY, "--"), (style.BLACK, "-."), (style.GREY, "-"))
"""Colour and dashes of the first mark, the second …"""


def draw_run(capture: Capture, rows: Sequence[str], marks: Mapping[str, float]) -> Figure:
    """`rows` of `speed`, `error`, `dq`, `phases` and `hall`, below each other.

    `marks` are device times in s by what happened then; a NaN did not happen and is left out. The abscissa counts from
    the first that did.
    """
    happened = {words: at for words, at in marks.items() if not math.isnan(at)}
    zero = next(iter(happened.values()), capture.span[0])
    t = capture.t - zero
    figure, axes = style.new_figure(len(rows), height=1.55 * len(rows) + 0.4)
    for ax, row in zip(axes, rows, strict=True):
        _ROWS[row](ax, t, capture)
        for (words, at), (hue, dashes) in zip(happened.items(), MARKS, strict=False):
            label = words if ax is axes[0] else None
            ax.axvline(at - zero, color=hue, linestyle=dashes, linewidth=1.0, label=label, zorder=1)
        style.legend_above(ax)
    style.time_axes(axes, t[0], t[-1])
    return figure


def _speed(ax: Axes, t: F64, capture: Capture) -> None:
    for name in ("omega_vt", "omega_enc", "omega_ref"):
        if name in capture:
            line(ax, t, rpm(capture, name), name)
    axis_labels(ax, "", "speed", unit_y="r/min")


def _error(ax: Axes, t: F64, capture: Capture) -> None:
    error = error_deg(capture, PROPOSED)
    line(ax, t, error, "theta_vt", label="", linewidth=0.7)
    style.degrees_axis(ax, "position error", max(10.0, 1.1 * float(np.abs(error).max())))


def _dq(ax: Axes, t: F64, capture: Capture) -> None:
    for name, words, look in (
        ("i_d", "i_d", {"linewidth": 0.7}),
        ("i_q", "i_q", {"linewidth": 1.6}),
        ("i_q_ref", "i_q reference", {"linewidth": 0.5, "linestyle": "-"}),
    ):
        if name in capture:
            line(ax, t, capture[name], name, label=words, **look)
    axis_labels(ax, "", "current", unit_y="A")


def _phases(ax: Axes, t: F64, capture: Capture) -> None:
    for name in ("i_a", "i_b", "i_c"):
        if name in capture:
            line(ax, t, capture[name], name, linewidth=0.7)
    if "i_max" in capture.parameters:
        style.limit_lines(ax, -capture.parameters["i_max"], capture.parameters["i_max"], "i_max")
    axis_labels(ax, "", "current", unit_y="A")


def _hall(ax: Axes, t: F64, capture: Capture) -> None:
    code = capture["hall"].astype(np.int64)
    for bit, sensor in enumerate("abc"):
        level = 2 - bit + 0.7 * (code >> bit & 1)
        ax.plot(t, level, color=style.colour(f"i_{sensor}"), linewidth=0.9, drawstyle="steps-post")
    ax.set_yticks([2.35, 1.35, 0.35], ["a", "b", "c"])
    ax.set_ylim(-0.2, 2.9)
    ax.grid(False, axis="y")
    axis_labels(ax, "", "Hall inputs")


_ROWS: dict[str, Callable[[Axes, F64, Capture], None]] = {
    "speed": _speed,
    "error": _error,
    "dq": _dq,
    "phases": _phases,
    "hall": _hall,
}

"""A motion profile before it is played: what is asked of drive and load machine over time, with its steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bench.motion.profile import OF_DRIVE, OF_LOAD, SPEED, UNITS, Profile, settings_words
from bench.report import style
from protocol.text import counted

F64 = NDArray[np.float64]

POINTS = 40  # of a period of a sine
MOST_POINTS = 4000  # of a step
MOST_NAMES = 24  # that can be read beside each other
NAMES_HEIGHT = 1.1  # in, above the uppermost axes


def points(profile: Profile) -> dict[str, tuple[F64, F64]]:
    """By quantity that is asked for, times in s and values in its unit, (n,) each; NaN while another one is.

    Where it changes at once, two points have one time.
    """
    found: dict[str, list[tuple[F64, F64]]] = {}
    for at, act in profile.begins():
        for course in act.courses:
            times = [0.0, act.seconds]
            if course.sine is not None:
                n = min(MOST_POINTS, math.ceil(POINTS * course.sine.frequency_hz * act.seconds) + 1)
                times = np.linspace(0.0, act.seconds, n).tolist()
            elif 0.0 < course.ramp < act.seconds:
                times.insert(1, course.ramp)
            values = np.array([course.at(t) for t in times])
            found.setdefault(course.quantity, []).append((at + np.array(times), values))
    return {quantity: _joined(found[quantity]) for quantity in UNITS if quantity in found}


def _joined(pieces: Sequence[tuple[F64, F64]]) -> tuple[F64, F64]:
    """Pieces as one line, which is interrupted where they do not follow each other."""
    t: list[F64] = []
    values: list[F64] = []
    for times, of in pieces:
        if t and times[0] > t[-1][-1] + 1e-9 * times[0]:
            t.append(t[-1][-1:])
            values.append(np.array([math.nan]))
        t.append(times)
        values.append(of)
    return np.concatenate(t), np.concatenate(values)


def as_json(profile: Profile) -> dict[str, Any]:
    """The plotted values as plain data."""
    drawn = {name: {"t_s": t.tolist(), "value": v.tolist()} for name, (t, v) in points(profile).items()}
    steps = [
        {"name": act.name, "does": act.title, "from_s": at, "to_s": at + act.seconds, "sets": dict(act.sets)}
        for at, act in profile.begins()
    ]
    return {"name": profile.name, "seconds": profile.seconds, "quantities": drawn, "steps": steps}


def words(profile: Profile) -> str:
    """What it is, in a line."""
    told = [f"{profile.seconds:g} s", counted(len(profile.acts), "step")]
    for name, (_, values) in points(profile).items():
        ends = dict.fromkeys(f"{end:.4g}" for end in (np.nanmin(values), np.nanmax(values)))
        told.append(f"{_label(name)} {' … '.join(ends)} {UNITS[name]}")
    return ", ".join(told)


def draw(profile: Profile) -> Figure:
    """A line for each quantity, and where each step begins, with its name and the parameters that it sets."""
    lines = points(profile)
    rows = [of for of in (OF_DRIVE[:1], OF_DRIVE[1:], OF_LOAD[:1], OF_LOAD[1:2], OF_LOAD[2:]) if of[0] in lines]
    figure, axes = style.new_figure(len(rows), height=NAMES_HEIGHT + 1.5 * len(rows) + 0.4)
    for ax, (quantity,), hue in zip(axes, rows, style.SERIES, strict=False):
        ax.plot(*lines[quantity], color=hue, linewidth=style.LINE_WIDTH)
        style.axis_labels(ax, "", _label(quantity), unit_y=UNITS[quantity])
        ax.margins(y=0.1)
    _name_steps(axes, profile)
    style.time_axes(axes, 0.0, profile.seconds)
    return figure


def _name_steps(axes: Sequence[Axes], profile: Profile) -> None:
    begins = list(profile.begins())
    named = [(at, act) for at, act in begins if len(begins) <= MOST_NAMES or act.name != act.place]
    for at, _ in begins if len(begins) <= 10 * MOST_NAMES else named:
        for ax in axes:
            ax.axvline(at, color=style.GREY, linewidth=0.5, linestyle=(0, (2, 3)))
    step = math.ceil(len(named) / MOST_NAMES)
    for at, act in named[:: max(step, 1)]:
        text = "\n".join([act.name, *settings_words(act.sets)])
        axes[0].annotate(
            text, (at, 1.0), xycoords=("data", "axes fraction"), xytext=(2, 3), textcoords="offset points",
            rotation=90, va="bottom", ha="left", fontsize=style.FONT_SIZE - 1.5, color="0.3",
        )  # fmt: skip


def _label(quantity: str) -> str:
    return "speed" if quantity == SPEED else quantity.rpartition("_")[0].replace("_", " ")

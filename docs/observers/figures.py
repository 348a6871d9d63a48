"""Figures of docs/observers.md, a PNG each. What they show stands in the page; nothing is measured here."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter
from observers.measures import Seen, learned
from observers.recordings import EVENTS, SPEEDS
from PIL import Image

from bench.report.style import (
    BLACK,
    FONT_SIZE,
    GREY,
    LIGHT,
    LINE_WIDTH,
    SERIES,
    axis_labels,
    column_title,
    degrees_axis,
    legend_above,
    new_figure,
    save,
)
from bench.signal.colours import apart
from sim.observers.catalogue import CATALOGUE

COLOURS = 256  # of a figure on the page
LARGEST = 120_000  # bytes
LOOK = apart({name: f"theta_{observer.short}" for name, observer in CATALOGUE.items()})
HUE = {name: look.paper for name, look in LOOK.items()}
TITLES = {
    "start_up": "start-up",
    "speed_step": "speed step",
    "load_step_light": "load of 4 A",
    "load_step_full": "load of 7 A",
    "reversal": "reversal",
}


def draw(paths: Mapping[str, Path], seen: Seen, numbers: Mapping[str, Any], folder: Path) -> None:
    """All of them, into `folder`."""
    events = {name: Seen(paths[name]) for name in EVENTS}
    _save(by_speed(numbers), folder / "by_speed.png")
    _save(transients(numbers), folder / "transients.png")
    weaknesses: dict[str, Callable[[Axes], None]] = {
        "average_speed": lambda ax: _event(ax, events["reversal"], ("average_speed", "vector_tracking"), 0.2),
        "lookup_table": lambda ax: _shares(ax, numbers),
        "hall_vector": lambda ax: _event(ax, events["load_step_full"], ("hall_vector", "vector_tracking"), 0.2),
        "hall_vector_decoupled": lambda ax: _spectrum(ax, numbers),
        "programmable_filter": lambda ax: _against_theory(ax, numbers, "programmable_filter"),
        "vector_tracking": lambda ax: _vector_tracking(ax, numbers),
        "load_angle": lambda ax: _load(ax, numbers),
        "vector_tracking_q15": lambda ax: _rounding(ax, seen),
        "edge_kalman": lambda ax: _learning(ax, Seen(paths["learning"], ("edge_kalman",))),
    }
    for name in CATALOGUE:
        figure, (left, right) = new_figure(1, 2, height=2.5, share_x=False)
        _one_turn(left, seen, name)
        weaknesses.get(name, lambda ax, name=name: _distribution(ax, seen, name))(right)
        _save(figure, folder / f"{name}.png")


def by_speed(numbers: Mapping[str, Any]) -> Any:
    """Standard deviation in steady running by speed, all loads, a line for each observer."""
    figure, (ax,) = new_figure(height=4.4)
    for name in numbers["board"]:
        mark, dash = LOOK[name].mark, LOOK[name].dash  # dashed lines last: what is below them shines through
        values = [numbers["by_speed"][name][str(rpm)]["std"] for rpm in SPEEDS]
        ax.plot(
            SPEEDS,
            values,
            dash,
            marker=mark,
            markersize=3.5,
            color=HUE[name],
            lw=1.3,
            label=name,
            zorder=3 - (dash == "-"),
        )
    _speed_axis(ax, unnamed=0)
    ax.set_yscale("log")
    ax.set_yticks([0.1, 0.2, 0.5, 1, 2, 5, 10, 20], ["0.1", "0.2", "0.5", "1", "2", "5", "10", "20"])
    ax.yaxis.set_minor_formatter(NullFormatter())
    degrees_axis(ax, "error, std")
    ax.legend(*ax.get_legend_handles_labels(), loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=8)
    return figure


def transients(numbers: Mapping[str, Any]) -> Any:
    """Largest error in each event, a bar for each observer, best of the rank on top."""
    figure, axes = new_figure(1, len(EVENTS), height=2.9)
    names = list(numbers["board"])[::-1]
    for ax, event in zip(axes, EVENTS, strict=True):
        values = [numbers["board"][name][event] for name in names]
        ax.barh(range(len(names)), values, color=[HUE[name] for name in names], height=0.7)
        for k, value in enumerate(values):
            ax.text(value + 1.5, k, f"{value:.0f}" if value >= 9.5 else f"{value:.1f}", va="center", fontsize=7)
        ax.set_xlim(0, 80)
        ax.set_xticks([0, 30, 60])
        ax.set_yticks(range(len(names)), names if ax is axes[0] else [""] * len(names), fontsize=7.5)
        column_title(ax, TITLES[event])
        ax.grid(False, axis="y")
    axes[2].set_xlabel("largest error [el. °]", fontsize=FONT_SIZE)
    return figure


def _one_turn(ax: Axes, seen: Seen, name: str) -> None:
    """Error over an electrical turn at 500 r/min and 4 A, the Hall edges in grey."""
    at = seen.where(500, 4.0)[-round(3.2 * seen.rate * 60.0 / (500.0 * seen.n_p)) :]
    wraps = at[1:][np.diff(seen.theta[at]) < -math.pi]
    turn = np.arange(wraps[0], wraps[1])
    t = 1e3 * (turn - turn[0]) / seen.rate
    code = np.flatnonzero(np.diff(seen.errors[name][turn]) < -30.0)
    for edge in code:
        ax.axvline(t[edge], color=LIGHT, linewidth=2.5)
    colour = HUE[name]
    ax.plot(t, seen.errors[name][turn], color=colour, linewidth=LINE_WIDTH)
    ax.axhline(0.0, color=GREY, linewidth=0.6)
    limit = max(0.6, 1.15 * float(np.abs(seen.errors[name][turn]).max()))
    ax.set_ylim(-limit, limit)
    ax.set_xlim(0, t[-1])
    axis_labels(ax, "t", "error", "ms", "el. °")
    column_title(ax, "an electrical turn, 500 r/min, 4 A; grey: Hall edges")


def _event(ax: Axes, seen: Seen, names: tuple[str, ...], length: float) -> None:
    """Errors in an event: `length` s around the largest error of the first name between start-up and stop."""
    between = (seen.t > 0.4 * seen.t[-1]) & (seen.t < 0.75 * seen.t[-1])
    error = np.where(between, np.abs(seen.errors[names[0]]), 0.0)
    first = seen.t[error.argmax()] - length / 2
    part = (seen.t >= first) & (seen.t <= first + length)
    for name in names:
        ax.plot(1e3 * (seen.t[part] - first), seen.errors[name][part], color=HUE[name], lw=LINE_WIDTH, label=name)
    axis_labels(ax, "t", "error", "ms", "el. °")
    legend_above(ax)


def _distribution(ax: Axes, seen: Seen, name: str) -> None:
    """How often which error occurs, beside the uniform one of ideal sensors."""
    # bins of 4.5 deg: four samples at 500 r/min
    error = seen.errors["sector_centre"][seen.whole(500, 4.0)]
    bins = [4.5 * k for k in range(-10, 11)]
    ax.hist(error, bins=bins, density=True, color=HUE[name], alpha=0.5, label="measured")
    ax.plot([-30, -30, 30, 30], [0, 1 / 60, 1 / 60, 0], color=BLACK, lw=LINE_WIDTH, label="ideal sensors")
    axis_labels(ax, "error", "density", "el. °", "1/°")
    legend_above(ax)


def _shares(ax: Axes, numbers: Mapping[str, Any]) -> None:
    """Error by the share of the right table that the drive has."""
    shares = numbers["shares"]
    x = [100.0 * float(share) for share in shares]
    ax.plot(x, [shares[share]["std"] for share in shares], "o-", color=HUE["lookup_table"], lw=LINE_WIDTH, ms=4)
    axis_labels(ax, "share of the right offsets in the table", "error, std", "%", "el. °")
    ax.set_ylim(bottom=0)
    column_title(ax, "500 r/min, 4 A")


def _spectrum(ax: Axes, numbers: Mapping[str, Any]) -> None:
    """Amplitudes of the error's harmonics of an electrical turn at 500 r/min."""
    for k, (name, harmonics) in enumerate(numbers["harmonics"].items()):
        orders = np.array([int(order) for order in harmonics])
        ax.bar(orders + 0.4 * (k - 0.5), list(harmonics.values()), 0.4, label=name, color=HUE[name])
    ax.set_xticks([1, 2, 3, 6, 9, 12, 15, 18])
    axis_labels(ax, "harmonic of the electrical frequency", "amplitude", "", "el. °")
    legend_above(ax)


def _against_theory(ax: Axes, numbers: Mapping[str, Any], name: str) -> None:
    """Standard deviation and mean by speed, measured and computed."""
    for key, mark, words in (("std", "o", "std"), ("bias", "s", "|bias|")):
        computed = [abs(numbers["theory"]["by_speed"][str(rpm)][name][key]) for rpm in SPEEDS]
        measured = [abs(numbers["by_speed"][name][str(rpm)][key]) for rpm in SPEEDS]
        ax.plot(SPEEDS, computed, color=GREY, lw=LINE_WIDTH, label="computed" if key == "std" else "")
        ax.plot(SPEEDS, measured, mark, color=HUE[name], markersize=4, label=words)
    _speed_axis(ax)
    ax.set_ylim(bottom=0)
    degrees_axis(ax, "error")
    legend_above(ax)


def _vector_tracking(ax: Axes, numbers: Mapping[str, Any]) -> None:
    """Standard deviation by speed at 4 A, and what the ripple of omega_h and the dead time make of it."""
    theory = numbers["theory"]["by_speed"]
    parts = {
        "feed-forward": ([theory[str(rpm)]["fed"]["std"] for rpm in SPEEDS], ":", SERIES[0]),
        "with (6)": ([theory[str(rpm)]["ripple"]["std"] for rpm in SPEEDS], "--", SERIES[0]),
        "dead time": ([theory[str(rpm)]["dead_time"]["4"]["std"] for rpm in SPEEDS], "-.", SERIES[1]),
        "together": ([theory[str(rpm)]["vector_tracking"]["4"] for rpm in SPEEDS], "-", GREY),
    }
    for words, (values, dash, colour) in parts.items():
        ax.plot(SPEEDS, values, dash, color=colour, lw=LINE_WIDTH, label=words)
    measured = [numbers["by_load"]["vector_tracking"][str(rpm)]["4"]["std"] for rpm in SPEEDS]
    ax.plot(SPEEDS, measured, "o", color=HUE["vector_tracking"], markersize=4, label="measured, 4 A")
    _speed_axis(ax)
    ax.set_ylim(0, 5)
    degrees_axis(ax, "error, std")
    legend_above(ax)


def _load(ax: Axes, numbers: Mapping[str, Any]) -> None:
    """Mean error by speed at 1, 4 and 8 A, compensated; uncompensated at 8 A."""
    for load, dash in (("1", ":"), ("4", "--"), ("8", "-")):
        values = [numbers["by_load"]["load_angle"][str(rpm)][load]["bias"] for rpm in SPEEDS]
        ax.plot(SPEEDS, values, dash, marker="v", ms=3, color=HUE["load_angle"], lw=LINE_WIDTH, label=f"{load} A")
    values = [numbers["by_load"]["vector_tracking"][str(rpm)]["8"]["bias"] for rpm in SPEEDS]
    ax.plot(SPEEDS, values, color=HUE["vector_tracking"], lw=LINE_WIDTH, label="8 A, vector_tracking")
    _speed_axis(ax)
    degrees_axis(ax, "bias")
    legend_above(ax)


def _rounding(ax: Axes, seen: Seen) -> None:
    """Fixed less floating point at 50 and 500 r/min, over an electrical turn."""
    for rpm, colour in ((50, SERIES[0]), (500, SERIES[1])):
        at = seen.where(rpm, 4.0)[-round(seen.rate * 60.0 / (rpm * seen.n_p)) :]
        difference = seen.errors["vector_tracking"][at] - seen.errors["vector_tracking_q15"][at]
        ax.plot(np.arange(len(at)) / len(at), 1e3 * difference, color=colour, lw=0.7, label=f"{rpm} r/min")
    axis_labels(ax, "electrical turns", "fixed less floating", "", "el. m°")
    legend_above(ax)


def _learning(ax: Axes, seen: Seen) -> None:
    """Error at 50 r/min before the edges are learned and after, over the last mechanical turn of each."""
    colours = SERIES[1], HUE["edge_kalman"]
    for error, colour, words in zip(learned(seen), colours, ("before", "after"), strict=True):
        turn = error[-round(seen.rate * 60.0 / 50.0) :]
        ax.plot(np.arange(len(turn)) / seen.rate, turn, color=colour, lw=LINE_WIDTH, label=f"{words} learning")
    axis_labels(ax, "t", "error, 50 r/min, 4 A", "s", "el. °")
    legend_above(ax)


def _speed_axis(ax: Axes, unnamed: int = 2000) -> None:
    ax.set_xscale("log")
    ax.set_xticks(SPEEDS, [str(rpm) if rpm != unnamed else "" for rpm in SPEEDS], fontsize=7.5)
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("speed [r/min]", fontsize=FONT_SIZE)


def _save(figure: Any, path: Path) -> None:
    """With fewer colours and half the pixels of a printed one. SystemExit if it is still large."""
    save(figure, path)
    picture = Image.open(path).convert("RGB")
    picture = picture.resize((picture.width * 3 // 4, picture.height * 3 // 4), Image.Resampling.LANCZOS)
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    if (size := path.stat().st_size) > LARGEST:
        raise SystemExit(f"{path} has {size} bytes, more than {LARGEST}: take fewer COLOURS")

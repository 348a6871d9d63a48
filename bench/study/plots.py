"""Figures of a study. Nothing here judges or computes an interval."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from bench.report.style import (
    BLACK,
    FONT_SIZE,
    GREY,
    LINE_WIDTH,
    SERIES,
    axis_labels,
    legend_above,
    new_figure,
)
from bench.study.capability import Capability
from bench.study.drives import Drives
from bench.study.pairs import ValuePair
from bench.study.rows import F64
from bench.study.sensitivity import Index, Sensitivity
from bench.study.statistics import Estimate
from bench.study.yields import Yield

SMALL = FONT_SIZE - 1.5
ROW, EDGES = 0.2, 0.75  # in: of a row of a chart of bars, and of what is above and below them
BARS = 40  # of a histogram, at most
DOTS = 1500  # of a scatter, by design
INPUTS = 5  # of a chart of indices
LONGEST = 30  # letters of a name beside an axis
LIMIT = (0, (6, 3))


def hue(design: int) -> str:
    """Colour of a design."""
    return SERIES[design % len(SERIES)]


def draw_yields(yields: Sequence[Yield], designs: Sequence[str]) -> Figure:
    """A row for each test, in it a mark with its interval for each design."""
    tests = list(dict.fromkeys(each.test for each in yields))
    known = [each for each in yields if each.share is not None]
    rows = [tests.index(each.test) for each in known]
    figure, (ax,) = new_figure(height=EDGES + ROW * len(tests) * (0.6 + 0.5 * len(designs)))
    _marks(ax, rows, [designs.index(each.design) for each in known], [_of(each) for each in known], designs)
    _names(ax, tests)
    least = min((_of(each).lo for each in known), default=0.0)
    ax.set_xlim(100.0 * least - max(1.0, 4.0 * (1.0 - least)), 100.5)
    axis_labels(ax, "drives that pass", "", "%")
    legend_above(ax)
    return figure


def _of(found: Yield) -> Estimate:
    assert found.share is not None
    return found.share


def _marks(
    ax: Axes, rows: Sequence[int], kinds: Sequence[int], found: Sequence[Estimate], names: Sequence[str]
) -> None:
    """Marks with intervals in percent, those of one row below each other; in the legend each kind once."""
    for kind, name in enumerate(names):
        mine = [(row, each) for row, of, each in zip(rows, kinds, found, strict=True) if of == kind]
        if mine:
            y = [row + 0.5 * ((kind + 0.5) / len(names) - 0.5) for row, _ in mine]
            x = 100.0 * np.array([each for _, each in mine])
            error = [x[:, 0] - x[:, 1], x[:, 2] - x[:, 0]]
            ax.errorbar(
                x[:, 0],
                y,
                xerr=np.maximum(error, 0.0),
                fmt="o",
                color=hue(kind),
                ms=3,
                capsize=2,
                lw=LINE_WIDTH,
                label=name,
            )


def _names(ax: Axes, names: Sequence[str]) -> None:
    ax.set_yticks(range(len(names)), [short(name) for name in names])
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.grid(False, axis="y")


def short(name: str) -> str:
    """The end of a name, where it is long: there it says what it is."""
    return name if len(name) <= LONGEST else f"…{name[1 - LONGEST :]}"


def draw_measurement(found: Sequence[Capability], drives: Sequence[Drives], made: Sequence[Sensitivity]) -> Figure:
    """A measurement: its distribution beside the limits, what lies beyond a limit anywhere, the strongest input.

    `found` are of its designs, and `drives` and `made` of the same.
    """
    figure, (left, middle, right) = new_figure(1, 3, height=2.35, share_x=False)
    values = [of.values(each.name)[:, 0] for each, of in zip(found, drives, strict=True)]
    _distribution(left, found, [column[np.isfinite(column)] for column in values], [of.design for of in drives])
    _beyond(middle, found, [of.design for of in drives])
    _scatter(right, found[0].name, drives, made)
    name = found[0].unit or "value"
    axis_labels(left, name, "drives", "", "%")
    if found[0].sides:
        axis_labels(middle, f"limit, {name}" if found[0].unit else "limit", "drives beyond it", "", "%")
    _legend(figure, left)
    for ax in (left, middle, right):
        ax.tick_params(labelsize=SMALL)
        ax.xaxis.set_major_locator(MaxNLocator(4))
    return figure


def _legend(figure: Figure, ax: Axes) -> None:
    """Of all axes, in the figure's uppermost line."""
    handles, labels = ax.get_legend_handles_labels()
    if len(handles) > 1:
        figure.legend(handles, labels, loc="outside upper left", ncols=6, frameon=False, fontsize=FONT_SIZE)


def _limits(found: Capability) -> list[float]:
    return [side.limit for side in found.sides]


def _distribution(ax: Axes, found: Sequence[Capability], values: Sequence[F64], designs: Sequence[int]) -> None:
    every = np.concatenate(list(values))
    lo, hi = float(every.min()), float(every.max())
    room = max(hi - lo, 1e-9 * max(abs(lo), abs(hi)), 1e-12)
    edges = np.linspace(lo - 0.02 * room, hi + 0.02 * room, 2 + min(BARS, 2 + int(np.sqrt(len(every)))))
    for column, each, design in zip(values, found, designs, strict=True):
        counts, _ = np.histogram(column, edges)
        ax.stairs(100.0 * counts / len(column), edges, fill=True, color=hue(design), alpha=0.3)
        ax.stairs(100.0 * counts / len(column), edges, color=hue(design), lw=LINE_WIDTH, label=short(each.design))
    ends = [edges[0], edges[-1]]
    for limit in _limits(found[0]):
        if lo - 1.5 * room <= limit <= hi + 1.5 * room:
            ax.axvline(limit, color=GREY, lw=LINE_WIDTH, linestyle=LIMIT)
            ends += [limit - 0.04 * room, limit + 0.04 * room]
        else:
            _far(ax, limit, limit > hi)
    ax.set_xlim(min(ends), max(ends))


def _far(ax: Axes, limit: float, above: bool) -> None:
    """A limit that lies far from all values."""
    words = f"limit {limit:.4g} →" if above else f"← limit {limit:.4g}"
    ax.text(
        0.98 if above else 0.02,
        0.93,
        words,
        transform=ax.transAxes,
        ha="right" if above else "left",
        fontsize=SMALL,
        color=BLACK,
    )


def _beyond(ax: Axes, found: Sequence[Capability], designs: Sequence[int]) -> None:
    """On a logarithmic scale; the lowest decade is 0."""
    floor = 10.0 / max(each.n for each in found)
    for each, design in zip(found, designs, strict=True):
        for side in each.sides:
            at, out, lo, hi = np.array(side.curve).T
            step: Literal["pre", "post"] = "post" if side.side == "hi" else "pre"
            order = np.argsort(at)
            ax.fill_between(at[order], 100 * lo[order], 100 * hi[order], step=step, color=hue(design), alpha=0.2, lw=0)
            ax.step(at[order], np.maximum(100 * out[order], 1e-9), where=step, color=hue(design), lw=LINE_WIDTH)
    for limit in _limits(found[0]):
        ends = [point[0] for each in found for side in each.sides for point in side.curve]
        room = max(ends) - min(ends)
        if min(ends) - 1.5 * room <= limit <= max(ends) + 1.5 * room:
            ax.axvline(limit, color=GREY, lw=LINE_WIDTH, linestyle=LIMIT)
        else:
            _far(ax, limit, limit > max(ends))
    if not found[0].sides:
        _empty(ax, "no limit")
        return
    ax.axhline(1.0, color=BLACK, lw=0.6, linestyle=":")
    ax.set_yscale("log")
    ax.set_ylim(max(floor, 1e-4), 60.0 if len(found[0].sides) > 1 else 120.0)
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _scatter(ax: Axes, name: str, drives: Sequence[Drives], made: Sequence[Sensitivity]) -> None:
    """Over the input that matters most in the first design that has one."""
    index = next((each.strongest for each in made if each.strongest), None)
    if index is None or index.input not in drives[0].inputs:
        why = "no input is seen to matter" if any(each.indices for each in made) else "no indices"
        _empty(ax, why)
        return
    for of in drives:
        every = max(len(of) // DOTS, 1)
        x, y = of.inputs[index.input][::every], of.values(name)[::every, 0]
        ax.plot(x, y, ".", ms=2, color=hue(of.design), alpha=0.5, mew=0)
    for limit in _limits_of(drives[0], name):
        lo, hi = ax.get_ylim()
        if lo - 0.5 * (hi - lo) <= limit <= hi + 0.5 * (hi - lo):
            ax.axhline(limit, color=GREY, lw=LINE_WIDTH, linestyle=LIMIT)
    axis_labels(ax, short(index.input), "")


def _empty(ax: Axes, why: str) -> None:
    ax.set_axis_off()
    ax.text(0.5, 0.5, why, transform=ax.transAxes, ha="center", fontsize=FONT_SIZE, color=GREY)


def _limits_of(drives: Drives, name: str) -> list[float]:
    limits = drives.rows.limits.get(name)
    return [side for side in (limits.lo, limits.hi) if side is not None] if limits else []


def draw_indices(made: Sequence[Sensitivity]) -> Figure:
    """The strongest inputs of each measurement as bars with intervals, two measurements beside each other."""
    rows = -(-len(made) // 2)
    total = any(index.total for each in made for index in each.indices)
    most = max(len(each.indices[:INPUTS]) for each in made)
    figure, axes = new_figure(rows, 2, height=rows * (0.5 + ROW * most) + 0.5, share_x=False)
    for ax, each in zip(axes, made, strict=False):
        _bars(ax, each.indices[:INPUTS], total)
        ax.set_title(short(each.name), fontsize=FONT_SIZE, loc="left")
    for ax in axes[len(made) :]:
        ax.set_axis_off()
    for ax in axes[max(len(made) - 2, 0) : len(made)]:
        axis_labels(ax, "share of the variance", "", "%")
    if total:
        _legend(figure, axes[0])
    return figure


def _bars(ax: Axes, indices: Sequence[Index], total: bool) -> None:
    for k, words in enumerate(("alone", "with others")[: 1 + total]):
        found = [each if (each := index.total if k else index.first) else index.first for index in indices]
        x = 100.0 * np.array(found)
        y = np.arange(len(found)) + (0.2 * (2 * k - 1) if total else 0.0)
        error = np.maximum([x[:, 0] - x[:, 1], x[:, 2] - x[:, 0]], 0.0)
        colours = [hue(k) if index.matters else GREY for index in indices]
        ax.barh(y, x[:, 0], 0.38 if total else 0.65, color=colours, alpha=0.75, label=words)
        ax.errorbar(x[:, 0], y, xerr=error, fmt="none", ecolor=BLACK, elinewidth=0.8, capsize=2)
    _names(ax, [index.input for index in indices])
    ax.set_xlim(min(0.0, ax.get_xlim()[0]), max(100.0, ax.get_xlim()[1]))
    ax.tick_params(labelsize=SMALL)


def draw_pairs(pairs: Sequence[ValuePair]) -> Figure:
    """Mean differences in percent of the sd of the first design, so that all are on one axis."""
    names, designs = list(dict.fromkeys(pair.name for pair in pairs)), list(dict.fromkeys(pair.b for pair in pairs))
    figure, (ax,) = new_figure(height=EDGES + ROW * len(names) * (0.6 + 0.5 * len(designs)))
    ax.axvline(0.0, color=BLACK, lw=0.6)
    found = [Estimate(*(end / pair.sd_of_a for end in pair.difference)) for pair in pairs]
    rows, kinds = [names.index(pair.name) for pair in pairs], [1 + designs.index(pair.b) for pair in pairs]
    _marks(ax, rows, kinds, found, [pairs[0].a, *designs])
    _names(ax, names)
    axis_labels(ax, f"mean difference from {pairs[0].a}, of its standard deviation over drives", "", "%")
    legend_above(ax)
    return figure

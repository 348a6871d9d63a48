"""Figures of a study. Nothing here judges or computes an interval."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from bench.report.style import BLACK, FONT_SIZE, GREY, LINE_WIDTH, SERIES, axis_labels, legend_above, new_figure
from bench.signal.limits import Limits
from bench.study.capability import Capability
from bench.study.drives import Drives
from bench.study.pairs import ValuePair
from bench.study.sensitivity import Index, Sensitivity
from bench.study.statistics import Estimate
from bench.study.yields import Yield

SMALL = FONT_SIZE - 1.5
ROW, EDGES = 0.18, 0.75  # in: of a mark in a chart, and of what is above and below all
BARS = 40  # of a histogram, at most
DOTS = 1500  # of a scatter, by design
INPUTS = 5  # of a chart of indices
LONGEST = 44  # letters of a name beside an axis
FAR = 1.5  # times as wide as the values lie that a limit may be away from them


def hue(design: int) -> str:
    """Colour of a design."""
    return SERIES[design % len(SERIES)]


def draw_yields(yields: Sequence[Yield], designs: Sequence[str]) -> Figure:
    """A row for each test, in it a mark with its interval for each design; each has a share."""
    found = [(each.test, each.design, each.share) for each in yields if each.share]
    figure, ax = _marks(found, designs, designs)
    least = 100.0 * min(share.lo for _, _, share in found)
    room = max(100.0 - least, 1.0)
    ax.set_xlim(100.0 - 1.05 * room, 100.0 + 0.02 * room)
    axis_labels(ax, "drives that pass", "", "%")
    return figure


def draw_pairs(pairs: Sequence[ValuePair]) -> Figure:
    """Mean differences in percent of the sd of the first design, so that all are on one axis."""
    shares = [(pair.name, pair.b, Estimate(*(end / pair.sd_of_a for end in pair.difference))) for pair in pairs]
    others = list(dict.fromkeys(pair.b for pair in pairs))
    figure, ax = _marks(shares, others, [pairs[0].a, *others])
    ax.axvline(0.0, color=BLACK, lw=0.6)
    axis_labels(ax, f"mean difference from {pairs[0].a}, of its standard deviation over drives", "", "%")
    return figure


def _marks(
    found: Sequence[tuple[str, str, Estimate]], designs: Sequence[str], hues: Sequence[str]
) -> tuple[Figure, Axes]:
    """A row for each name, in it a mark for each design, in percent; `hues` has the designs in the order of colours."""
    names = list(dict.fromkeys(name for name, _, _ in found))
    figure, (ax,) = new_figure(height=EDGES + ROW * len(names) * (len(designs) + 0.5))
    for k, design in enumerate(designs):
        mine = [(names.index(name), each) for name, of, each in found if of == design]
        y = [row + 0.7 * ((k + 0.5) / len(designs) - 0.5) for row, _ in mine]
        _interval(ax, [each for _, each in mine], y, "o", hue(hues.index(design)), design if len(hues) > 1 else "")
    _names(ax, names)
    legend_above(ax)
    return figure, ax


def _interval(ax: Axes, found: Sequence[Estimate], y: Sequence[float], mark: str, colour: str, words: str = "") -> None:
    value, lo, hi = 100.0 * np.array(found).reshape(-1, 3).T
    error = np.maximum([value - lo, hi - value], 0.0)
    ax.errorbar(value, y, xerr=error, fmt=mark, color=colour, ms=3, capsize=2, lw=LINE_WIDTH, label=words)


def _names(ax: Axes, names: Sequence[str]) -> None:
    """The end of a name, where it is long: there it says what it is."""
    short = [name if len(name) <= LONGEST else f"…{name[1 - LONGEST :]}" for name in names]
    ax.set_yticks(range(len(names)), short)
    ax.set_ylim(len(names) - 0.5, -0.5)
    ax.grid(False, axis="y")


def draw_measurement(found: Sequence[Capability], drives: Sequence[Drives], made: Sequence[Sensitivity]) -> Figure:
    """Its distribution beside the limits, what lies beyond a limit anywhere, and values over the strongest input.

    `found` are of its designs, and `drives` and `made` of the same.
    """
    figure, (left, middle, right) = new_figure(1, 3, height=2.3, share_x=False)
    _distribution(left, found, drives)
    if found[0].sides:
        _beyond(middle, found, drives)
    else:
        _empty(middle, "no limit")
    _scatter(right, found[0], drives, made)
    axis_labels(left, found[0].unit or "value", "drives", "", "%")
    if len(found) > 1:
        figure.legend(
            *left.get_legend_handles_labels(), loc="outside upper left", ncols=6, frameon=False, fontsize=SMALL
        )
    for ax in (left, middle, right):
        ax.tick_params(labelsize=SMALL)
        ax.xaxis.set_major_locator(MaxNLocator(4))
    return figure


def _legend(figure: Figure, ax: Axes) -> None:
    """Of all axes, in the uppermost line."""
    entries = ax.get_legend_handles_labels()
    figure.legend(*entries, loc="outside upper left", ncols=6, frameon=False, fontsize=SMALL)


def _distribution(ax: Axes, found: Sequence[Capability], drives: Sequence[Drives]) -> None:
    table = [of.values(each.name)[:, 0] for each, of in zip(found, drives, strict=True)]
    every = np.concatenate(table)
    lo, hi = float(np.nanmin(every)), float(np.nanmax(every))
    room = max(hi - lo, 1e-3 * max(abs(lo), abs(hi)), 1e-12)
    edges = np.linspace(lo - 0.02 * room, hi + 0.02 * room, 2 + min(BARS, 2 + int(np.sqrt(found[0].n))))
    for values, of, each in zip(table, drives, found, strict=True):
        counts = 100.0 * np.histogram(values[np.isfinite(values)], edges)[0] / each.n
        ax.stairs(counts, edges, fill=True, color=hue(of.design), alpha=0.3)
        ax.stairs(counts, edges, color=hue(of.design), lw=LINE_WIDTH, label=each.design)
    ax.set_xlim(edges[0], edges[-1])
    _draw_limits(ax, found[0].limits)


def _draw_limits(ax: Axes, limits: Limits | None) -> None:
    """Dashed where they are near what is shown, else in words."""
    lo, hi = ax.get_xlim()
    near = FAR * (hi - lo)
    for limit in (limits.lo, limits.hi) if limits else ():
        if limit is None:
            continue
        if lo - near <= limit <= hi + near:
            ax.axvline(limit, color=GREY, lw=LINE_WIDTH, linestyle=(0, (6, 3)))
            ax.set_xlim(min(lo, limit - 0.02 * near, ax.get_xlim()[0]), max(hi, limit + 0.02 * near, ax.get_xlim()[1]))
        else:
            above = limit > hi
            words, side = (f"limit {limit:.4g} →", "right") if above else (f"← limit {limit:.4g}", "left")
            ax.text(0.98 if above else 0.02, 0.93, words, transform=ax.transAxes, ha=side, fontsize=SMALL)


def _beyond(ax: Axes, found: Sequence[Capability], drives: Sequence[Drives]) -> None:
    """On a logarithmic scale, which ends below one drive; of two sides the middle is left out, where both are high."""
    for each, of in zip(found, drives, strict=True):
        for side in each.sides:
            at, out, lo, hi = np.array(sorted(side.curve)).T
            step: Literal["pre", "post"] = "post" if side.side == "hi" else "pre"
            ax.fill_between(at, 100 * lo, 100 * hi, step=step, color=hue(of.design), alpha=0.2, lw=0)
            ax.step(at, np.maximum(100 * out, 1e-9), where=step, color=hue(of.design), lw=LINE_WIDTH)
    ax.set_xlim(*ax.get_xlim())
    _draw_limits(ax, found[0].limits)
    ax.axhline(1.0, color=BLACK, lw=0.6, linestyle=":")
    ax.set_yscale("log")
    ax.set_ylim(max(min(10.0 / max(each.n for each in found), 0.5), 1e-4), 60.0 if len(found[0].sides) > 1 else 120.0)
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis_labels(ax, "where the limit would be", "drives beyond it", found[0].unit, "%")


def _scatter(ax: Axes, found: Capability, drives: Sequence[Drives], made: Sequence[Sensitivity]) -> None:
    """Over the input that matters most in the first design that has one."""
    index = next((each.strongest for each in made if each.strongest), None)
    if index is None:
        _empty(ax, "no input is seen to matter" if any(each.indices for each in made) else "no indices")
        return
    have = [of for of in drives if index.input in of.inputs.told]
    if not have:  # a factor that is no figure of the drive
        _empty(ax, f"strongest:\n{index.input}")
        return
    for of in have:
        every = max(len(of) // DOTS, 1)
        x, y = of.inputs.told[index.input][::every], of.values(found.name)[::every, 0]
        ax.plot(x, y, ".", ms=2.5, color=hue(of.design), alpha=0.5, mew=0)
    axis_labels(ax, index.input, found.unit or "value")
    ax.xaxis.label.set_fontsize(SMALL)


def _empty(ax: Axes, why: str) -> None:
    ax.set_axis_off()
    ax.text(0.5, 0.5, why, transform=ax.transAxes, ha="center", fontsize=FONT_SIZE, color=GREY)


def draw_indices(made: Sequence[Sequence[Sensitivity]], designs: Sequence[str]) -> Figure:
    """The strongest inputs of each measurement as bars with intervals, two measurements beside each other.

    `made` are of its designs; of several they have their colours, and of one the index alone and with others.
    """
    total = all(index.total for of in made for each in of for index in each.indices)
    series = len(designs) if len(designs) > 1 else 1 + total
    rows = -(-len(made) // 2)
    figure, axes = new_figure(rows, 2, height=rows * (0.6 + INPUTS * max(ROW, 0.11 * series)) + 0.5, share_x=False)
    for ax, of in zip(axes, made, strict=False):
        names = list(dict.fromkeys(index.input for index in sorted(_indices(of), key=lambda index: -index.size)))[
            :INPUTS
        ]
        for k in range(series):
            mine = _indices([each for each in of if len(designs) == 1 or each.design == designs[k]])
            words = designs[k] if len(designs) > 1 else ("alone", "with others")[k]
            _bars(ax, [index for index in mine if index.input in names], names, (k, series, words))
        _names(ax, names)
        ax.set_xlim(0.0, 100.0)
        ax.set_title(of[0].name, fontsize=SMALL, loc="left")
        ax.tick_params(labelsize=SMALL)
    for ax in axes[len(made) :]:
        ax.set_axis_off()
    if series > 1:
        _legend(figure, axes[0])
    return figure


def _indices(made: Sequence[Sensitivity]) -> list[Index]:
    return [index for each in made for index in each.indices]


def _bars(ax: Axes, indices: Sequence[Index], names: Sequence[str], of: tuple[int, int, str]) -> None:
    """Of the series `of`: its number, how many there are, and what it is. What is not told from 0 is pale."""
    k, series, words = of
    alone = words == "alone" or (k == 0 and series == 1)
    found = [index.first if alone or index.total is None else index.total for index in indices]
    y = [names.index(index.input) + 0.8 * ((k + 0.5) / series - 0.5) for index in indices]
    bars = ax.barh(y, [100.0 * each.value for each in found], 0.75 / series, color=hue(k))
    ax.plot([], [], "s", color=hue(k), label=words)
    for bar, index in zip(bars, indices, strict=True):
        bar.set_alpha(1.0 if index.matters else 0.3)
    _interval(ax, found, y, "none", BLACK)

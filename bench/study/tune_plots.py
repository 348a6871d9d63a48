"""The picture of a tune: each objective over trials and over each parameter, and of several the Pareto front."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.report.style import BLACK, FONT_SIZE, GREY, ROW_HEIGHT, SERIES, WIDTH, plain, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from bench.study.objectives import F64, Objective
    from bench.study.tune_file import Tuned

HIGHEST = 90.0  # % of the trials that must be seen: a few bad ones are cut off
AS_IT_WAS: dict[str, Any] = {"color": BLACK, "linewidth": 0.9, "linestyle": ":"}
MOST_PAIRS = 3


def draw(tuned: Tuned, file: Path, most: int) -> None:
    """Draw it; of the parameters the first `most`."""
    from matplotlib.figure import Figure

    plan, able = tuned.plan, [one for one in tuned.trials if not one.why]
    if not able:
        return
    values = np.array([one.objectives for one in able])
    parameters = plan.parameters[:most]
    pairs = [*combinations(range(len(plan.objectives)), 2)][:MOST_PAIRS]
    columns = min(4, max(len(pairs), 1 + len(parameters)))
    first = columns if pairs else 0
    rows = -(-(first + len(plan.objectives) * (1 + len(parameters))) // columns)
    figure = Figure(figsize=(WIDTH, ROW_HEIGHT * rows), layout="constrained", facecolor="white")
    every = list(figure.subplots(rows, columns, squeeze=False).flat)
    for ax in every[len(pairs) : first]:
        ax.set_visible(False)
    axes = iter([*every[: len(pairs)], *every[first:]])
    for a, b in pairs:
        _front(plain_next(axes), tuned, values, a, b)
    numbers = np.array([one.number for one in able])
    for k, objective in enumerate(plan.objectives):
        _course(plain_next(axes), numbers, values[:, k], objective, tuned, k)
        for one in parameters:
            ax = plain_next(axes)
            _points(ax, np.array([trial.values[one.key] for trial in able]), values[:, k], tuned, k)
            if one.kind == "log":
                ax.set_xscale("log")
            if one.before is not None:
                ax.axvline(one.before, **AS_IT_WAS)
            _named(ax, one.key.rpartition(".")[2], _label(objective))
    for ax in axes:
        ax.set_visible(False)
    figure.suptitle("grey: trials; dotted: as it was; coloured: best, or the front", fontsize=FONT_SIZE)
    save(figure, file)


def plain_next(axes: Any) -> Axes:
    """The next axes, in the usual look."""
    ax: Axes = next(axes)
    plain(ax)
    return ax


def _front(ax: Axes, tuned: Tuned, values: F64, a: int, b: int) -> None:
    front = np.array([one.objectives for one in tuned.points])
    ax.scatter(values[:, a], values[:, b], s=6, color=GREY, alpha=0.5)
    ax.plot(front[:, a], front[:, b], "o-" if values.shape[1] == 2 else "o", ms=3, color=SERIES[0], linewidth=0.8)
    ax.plot(tuned.before.objectives[a], tuned.before.objectives[b], "x", color=BLACK)
    for limits, k in ((ax.set_xlim, a), (ax.set_ylim, b)):
        limits(*_span(np.append(values[:, k], tuned.before.objectives[k]), tuned.plan.objectives[k]))
    _named(ax, *(_label(tuned.plan.objectives[k]) for k in (a, b)))


def _course(ax: Axes, numbers: F64, values: F64, objective: Objective, tuned: Tuned, k: int) -> None:
    _points(ax, numbers, values, tuned, k)
    if len(tuned.plan.objectives) == 1:
        best = np.minimum.accumulate(objective.sign * values) * objective.sign
        ax.step(numbers, best, where="post", color=SERIES[0], linewidth=1.0)
    _named(ax, "trial", _label(objective))


def _points(ax: Axes, x: F64, values: F64, tuned: Tuned, k: int) -> None:
    ax.scatter(x, values, s=6, color=GREY, alpha=0.5)
    numbers = {one.number for one in tuned.points}
    able = [one for one in tuned.trials if not one.why]
    on = np.array([one.number in numbers for one in able])
    ax.scatter(x[on], values[on], s=14, color=SERIES[0], zorder=3)
    ax.axhline(tuned.before.objectives[k], **AS_IT_WAS)
    ax.set_ylim(*_span(np.append(values, tuned.before.objectives[k]), tuned.plan.objectives[k]))


def _span(values: F64, objective: Objective) -> tuple[float, float]:
    """What is shown of an objective: all that is good, and most of the rest."""
    costs = objective.sign * values[np.isfinite(values)]
    lo, hi = float(costs.min()), float(max(np.percentile(costs, HIGHEST), objective.sign * values[-1]))
    room = 0.06 * (hi - lo) or 0.1 * abs(hi) or 1.0
    ends = sorted(objective.sign * x for x in (lo - room, hi + room))
    return ends[0], ends[1]


def _label(objective: Objective) -> str:
    return f"{objective.name}, {objective.unit}" if objective.unit else objective.name


def _named(ax: Axes, x: str, y: str) -> None:
    ax.set_xlabel(x, fontsize=FONT_SIZE)
    ax.set_ylabel(y, fontsize=FONT_SIZE)

"""The look of figures, in one place: size, axes of time and angle, legend, file.

Figures are as wide as a page of two columns (7.16 in), so they may be printed as they are. They have no titles but
those of columns: what they show stands in the caption, and the room above the axes is the legend's. Nothing here
measures, keeps state or touches matplotlib's global settings; figures are made of the object API and drawn by Agg,
from any thread.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray
from PIL import Image

from bench.signal.colours import SPARES, look
from bench.view.schema import label

WIDTH, ROW_HEIGHT = 7.16, 1.9  # in
DPI = 200
COLOURS = 256  # of a file's palette
FONT_SIZE = 8.5  # pt
LINE_WIDTH = 1.1  # pt
# in: a letter of a legend, what stands before its text and after it, room for the ordinate
LETTER, HANDLE, MARGIN = 0.062, 0.5, 0.75
LEGEND_LINE = 20  # pt: height of a legend of one line, with the space above it
CHUNK = 10_000  # points that Agg draws at a time; a noisy line of more can be too much for it

BLACK, GREY, LIGHT = "#1a1a1a", "#7f7f7f", "#d9d9d9"
SERIES = tuple(look.paper for look in SPARES)  # of lines that are no quantity of the table


def colour(name: str) -> str:
    """Colour of a quantity, by its channel's name: fixed for the known ones, steady for one that is not known."""
    return look(name).paper


def new_figure(
    rows: int = 1, columns: int = 1, *, height: float | None = None, share_x: bool = True
) -> tuple[Figure, list[Axes]]:
    """A figure of the full width with `rows` times `columns` axes, row by row; `height` in inches.

    With `share_x` the axes of a column have one abscissa, whose numbers stand below the lowest only.
    """
    figure = Figure(figsize=(WIDTH, height or ROW_HEIGHT * rows + 0.4), layout="constrained", facecolor="white")
    axes: list[Axes] = list(figure.subplots(rows, columns, squeeze=False, sharex="col" if share_x else "none").flat)
    for ax in axes:
        plain(ax)
        ax.spines[["left", "bottom"]].set_linewidth(0.6)
        ax.set_prop_cycle(color=SERIES)
    return figure, axes


def plain(ax: Axes) -> None:
    """Axes with a light grid behind the data, small ticks, and no frame above and on the right."""
    ax.grid(True, color=LIGHT, linewidth=0.5)
    ax.set_axisbelow(True)
    ax.tick_params(labelsize=FONT_SIZE, width=0.6, length=3)
    ax.spines[["top", "right"]].set_visible(False)


def line(ax: Axes, x: NDArray[Any], y: NDArray[Any], name: str, **properties: Any) -> Line2D:
    """Draw the quantity `name`, both (n,), in its colour and under its label; references are dashed."""
    dashed = "--" if name.endswith("_ref") else "-"
    chosen: dict[str, Any] = {"color": colour(name), "label": label(name), "linewidth": LINE_WIDTH, "linestyle": dashed}
    (drawn,) = ax.plot(x, y, **(chosen | properties))
    return drawn


def axis_labels(ax: Axes, x: str, y: str, unit_x: str = "", unit_y: str = "") -> None:
    """Name the axes, with their units in brackets."""
    for axis, name, unit in ((ax.xaxis, x, unit_x), (ax.yaxis, y, unit_y)):
        axis.set_label_text(f"{name} [{unit}]" if unit else name, fontsize=FONT_SIZE)


def time_axes(axes: Sequence[Axes], first: float, last: float) -> None:
    """Axes that stand below each other show the time from `first` to `last`, in s; it is named below the lowest."""
    for ax in axes:
        ax.set_xlim(first, last)
    axes[-1].set_xlabel("t [s]", fontsize=FONT_SIZE)
    axes[0].figure.align_ylabels(axes)


def degrees_axis(ax: Axes, name: str, limit: float | None = None) -> None:
    """The ordinate is an electrical angle in degrees; with `limit` it goes from minus to plus that."""
    ax.set_ylabel(f"{name} [el. °]", fontsize=FONT_SIZE)
    if limit is not None:
        ax.set_ylim(-limit, limit)
        step = next((s for s in (1, 2, 5, 10, 15, 30, 60, 90) if limit / s <= 3), 180)
        ax.yaxis.set_major_locator(MultipleLocator(step if limit >= 2 else limit / 2))


def wrapped_degrees(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in rad, (n,), in [-pi, pi), as degrees to draw: NaN where they wrap, so that no line crosses the plot."""
    degrees: NDArray[np.float64] = np.degrees(angle)
    degrees[1:][np.abs(np.diff(angle)) > math.pi] = np.nan
    return degrees


def limit_lines(ax: Axes, lo: float | None, hi: float | None, name: str = "") -> None:
    """Draw limits of the ordinate, in grey; None is no limit. In the legend they are `name`, once."""
    for limit in (lo, hi):
        if limit is not None:
            ax.axhline(limit, color=GREY, linewidth=0.9, linestyle=(0, (6, 3)), label=name)
            name = ""


def legend_above(ax: Axes) -> None:
    """Put the legend above the axes, where it hides no data; nothing where nothing has a label."""
    handles, labels = ax.get_legend_handles_labels()
    if not handles:
        return
    grid = ax.get_gridspec()
    room = WIDTH / (grid.ncols if grid is not None else 1) - MARGIN
    widths = [LETTER * len(text) + HANDLE for text in labels]
    columns = next((n for n in range(len(labels), 1, -1) if _wide(widths, n) <= room), 1)
    ax.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.2,
        ncols=columns,
        frameon=False,
        fontsize=FONT_SIZE,
        handlelength=1.8,
        columnspacing=1.4,
    )


def _wide(widths: Sequence[float], columns: int) -> float:
    """Width of a legend whose entries are filled into so many columns, one column after the other."""
    return sum(float(column.max()) for column in np.array_split(np.asarray(widths), columns))


def column_title(ax: Axes, words: str) -> None:
    """Name the column whose uppermost axes these are, above their legend, which must be there already."""
    ax.set_title(words, fontsize=FONT_SIZE, loc="left", pad=LEGEND_LINE if ax.get_legend() else None)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG. The same figure makes the same bytes: no date, no version in it. Raises OSError.

    Lines on white need few colours: with a palette the file is a third as large, and looks the same.
    """
    figure.set_dpi(DPI)
    canvas: Any = FigureCanvasAgg(figure)
    with rc_context({"agg.path.chunksize": CHUNK}):
        canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    few = picture.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    few.save(path, "PNG", dpi=(DPI, DPI))

"""How the close-ups are drawn: lanes above each other over one axis, with a grid, levels and words.

Coordinates are rerun's, y downward. A lane is 1 high and WIDE wide; its texts are beside it and above.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from bench.signal.colours import GROUND, RGB
from bench.view import schema
from bench.view.plane import FAINT
from bench.view.plots import Plot

Values = NDArray[Any]
F64 = NDArray[np.float64]
Place = tuple[float, float]
Strip = tuple[NDArray[np.float32], RGB]
Range = tuple[float, float, float]
Ticks = tuple[tuple[float, str], ...]
"""Places of the horizontal axis, from its begin, 0, to its end, 1, with their texts."""

DEGREES: Ticks = tuple((k / 6, f"{60 * k}°") for k in range(7))
WIDE, PITCH = 4.4, 1.36  # of a lane, and from lane to lane
X_RANGE = (-1.3, WIDE + 0.45)
ABOVE, BELOW = 0.72, 0.3  # room for words above the lanes, and for the axis below
BINS = 256  # of a line with more points: least and most of each
PALE = 0.45  # share of its colour that the one before keeps
LEVELS = 3.3  # of a lane, about
_DROP = 0.1  # by which rerun draws a text below its place, about
_GRID: RGB = (38, 40, 42)
_LINE_RADIUS, _UNSEEN = -0.7, 0.0  # points; a text has none
_PLACE = pa.list_(pa.field("item", pa.float32(), nullable=False), 2)
_LINE = pa.list_(pa.field("item", _PLACE, nullable=False))


class Picture(NamedTuple):
    """Lines with their colours, and texts with their places; the first text tells what is shown."""

    strips: list[Strip]
    texts: list[tuple[Place, str]]

    def columns(self) -> dict[str, pa.Array]:
        """A row for rerun, by component."""
        points = np.concatenate([strip for strip, _ in self.strips])
        ends = np.cumsum([0, *(len(strip) for strip, _ in self.strips)], dtype=np.int32)
        colours = np.array([r << 24 | g << 16 | b << 8 | 0xFF for _, (r, g, b) in self.strips], np.uint32)
        places = np.array([(x, y - _DROP) for (x, y), _ in self.texts], np.float32)
        return {
            schema.STRIPS: _row(pa.ListArray.from_arrays(ends, _places(points), type=_LINE)),
            schema.STRIP_COLOURS: _row(pa.array(colours)),
            schema.PLACES: _row(_places(places)),
            schema.TEXTS: _row(pa.array([text for _, text in self.texts])),
        }

    def told(self, words: str) -> Picture:
        """The same with other words above it."""
        return Picture(self.strips, [(self.texts[0][0], words), *self.texts[1:]])


def y_range(lanes: int) -> tuple[float, float]:
    """From where to where a picture of so many lanes reaches."""
    return -ABOVE, lanes * PITCH + BELOW


def framed(ticks: Ticks, lanes: int, words: str) -> Picture:
    """A picture of so many lanes without lines: the axis below, and `words` above."""
    foot = lanes * PITCH
    grid = [np.array([(at * WIDE, PITCH - 1.0), (at * WIDE, foot)], np.float32) for at, _ in ticks]
    texts = [((WIDE / 2, -0.4), words), *(((at * WIDE, foot + 0.16), text) for at, text in ticks)]
    return Picture([(line, _GRID) for line in grid], texts)


def levels(picture: Picture, foot: float, shown: Range) -> None:
    """Draw the levels of a lane that stands at `foot` and shows a range, and how high they are."""
    low, high, step = shown
    marks = np.arange(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1) * step
    for mark in marks.tolist():
        y = foot - (mark - low) / (high - low)
        picture.strips.append((np.array([(0.0, y), (WIDE, y)], np.float32), _GRID))
        picture.texts.append(((WIDE + 0.22, y), f"{mark:.6g}".replace("-", "−")))


def legend(entries: Sequence[tuple[str, RGB]], heights: Iterable[float]) -> rr.Points2D:
    """Names in their colours at the left edge, at these heights."""
    names, colours = zip(*entries, strict=True)
    places = [(X_RANGE[0] / 2, height - _DROP) for height in heights]
    return rr.Points2D(places, labels=names, colors=colours, radii=_UNSEEN, show_labels=True)


def looks() -> tuple[rr.LineStrips2D, rr.Points2D]:
    """How the lines and texts of every picture look."""
    texts = rr.Points2D.from_fields(radii=[_UNSEEN], colors=[FAINT], show_labels=True)
    return rr.LineStrips2D.from_fields(radii=[_LINE_RADIUS]), texts


def strips(x: F64, y: Values) -> NDArray[np.float32]:
    """Lines (k, n, 2) from places of the axis `x`, (n,) from 0 to 1, and their heights `y`, (k, n)."""
    found = np.empty((*y.shape, 2), np.float32)
    found[:, :, 0], found[:, :, 1] = x * WIDE, y
    return found


def pieces(strip: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """The pieces of a line, (n, 2), between heights that are not finite."""
    good = np.isfinite(strip[:, 1])
    if good.all():
        return [strip]
    ends = np.flatnonzero(np.diff(good)) + 1
    return [piece for piece in np.split(strip, ends) if math.isfinite(piece[0, 1])]


def thinned(x: F64, y: Values) -> tuple[F64, Values]:
    """Lines (k, n) with no more than twice BINS points each: the least and the most of as many neighbours."""
    n = len(x)
    if n <= 2 * BINS:
        return x, y
    starts = np.arange(BINS) * n // BINS
    low, high = (extreme.reduceat(y, starts, axis=1) for extreme in (np.minimum, np.maximum))
    at = np.stack([x[starts], x[(starts + np.append(starts[1:], n)) // 2]], axis=1).reshape(-1)
    at[-1] = x[-1]
    return at, np.stack([low, high], axis=2).reshape(len(y), -1)


def needed(plot: Plot, known: Values) -> Range:
    """From least to most that a lane has to show of these values, (n,), and the step between its levels."""
    known = np.append(known, (-plot.least, plot.least) if plot.least or not len(known) else ())
    low, high = plot.y_range or (float(known.min()), float(known.max()))
    span = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-6)
    power = 10.0 ** math.floor(math.log10(span / LEVELS))
    step = next(nice * power for nice in (1, 2, 5, 10) if nice * power >= 0.999 * span / LEVELS)
    if plot.y_range:
        return low, high, step
    bottom = math.floor(low / step)
    return bottom * step, max(math.ceil(high / step), bottom + 1) * step, step


def pale(colour: RGB) -> RGB:
    """The colour of the one before where that of the newest is `colour`."""
    red, green, blue = (round(ground + PALE * (part - ground)) for part, ground in zip(colour, GROUND, strict=True))
    return red, green, blue


def _places(points: NDArray[np.float32]) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(points.reshape(-1)), type=_PLACE)


def _row(values: pa.Array) -> pa.Array:
    """One row that holds all of them."""
    return pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values)

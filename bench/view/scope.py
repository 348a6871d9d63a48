"""Close-ups that stand still: the last whole electrical turn over the electrical angle, the one before it pale.

Each is one picture, logged as a whole a few times a second: a viewer shows the newest of them, and no window of time
moves. Before the first turn, and without an angle, a close-up shows the last moments over time. Whatever it shows, the
words above it say which turn or moments that is, and why there is none since.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from bench.record.info import RunInfo
from bench.signal.colours import GROUND, RGB
from bench.signal.units import RPM
from bench.signal.waveforms.sectors import NUMERALS, sector_of_code
from bench.view import schema
from bench.view.plane import FAINT
from bench.view.plots import POINTS, WAVE, Plot, plots
from bench.view.states import HALL_COLOURS, HIGH, ILLEGAL, NO_EDGE
from bench.view.turns import REST, Look, Turn, Turns
from protocol.signals import Flag
from protocol.streams import EdgeChunk, SampleChunk

PERIOD = 0.25  # s of device time between two pictures, at least
MOST_MESSAGES = 40.0  # a second: a viewer lags by messages
WIDE = 3.4  # of a picture, by its height
X_RANGE, Y_RANGE = (-0.95, WIDE + 0.3), (-1.2, 0.22)
BINS = 256  # of a line with more points: least and most of each
PALE = 0.4  # share of its colour that the turn before keeps
FULL = 0.4  # share of a range that its data fill at least: else a smaller one is chosen
LEVELS, LEVEL = (0.98, 0.73, 0.48), 0.19  # feet of the Hall sensors' lines, and how far they rise
SECTOR, SECTOR_NAMED = (0.05, 0.21), 0.13  # from where to where a sector is drawn, and how wide it is to have its name
_GRID, _AXIS = (42, 44, 46), (84, 86, 88)
_UNSEEN = 0.0  # a radius: labels only

Values = NDArray[Any]
F64 = NDArray[np.float64]
Range = tuple[float, float, float]
PLACE = pa.list_(pa.field("item", pa.float32(), nullable=False), 2)
Place = tuple[float, float]
Strip = tuple[NDArray[np.float32], RGB]


class Picture(NamedTuple):
    """Lines with their colours, and texts with their places; in a picture's coordinates, y downward."""

    strips: list[Strip]
    texts: list[tuple[Place, str]]

    def columns(self) -> dict[str, pa.Array]:
        """A row for rerun, by component."""
        points = np.concatenate([strip for strip, _ in self.strips])
        ends = np.cumsum([0, *(len(strip) for strip, _ in self.strips)], dtype=np.int32)
        colours = np.array([r << 24 | g << 16 | b << 8 | 0xFF for _, (r, g, b) in self.strips], np.uint32)
        places = np.array([place for place, _ in self.texts], np.float32)
        return {
            schema.STRIPS: _row(pa.ListArray.from_arrays(ends, _places(points))),
            schema.STRIP_COLOURS: _row(pa.array(colours)),
            schema.PLACES: _row(_places(places)),
            schema.TEXTS: _row(pa.array([text for _, text in self.texts])),
        }


Pictures = dict[str, Picture]
"""By entity."""
Ticks = tuple[tuple[float, str], ...]
"""Places of the horizontal axis, from its begin, 0, to its end, 1, with their texts."""
DEGREES: Ticks = tuple((k / 6, f"{60 * k}°") for k in range(7))


def scopes(run: RunInfo) -> dict[str, Plot]:
    """The close-ups that a run's channels allow, by entity, without the Hall sensors'."""
    found = {key: plot for key, plot in plots(run).items() if plot.entity == schema.FAST}
    return {
        f"{schema.SCOPE}/{f'unit-{k}' if plot.by_unit else key}": plot for k, (key, plot) in enumerate(found.items())
    }


class Scope:
    """Makes the close-ups of a run."""

    def __init__(self, run: RunInfo) -> None:
        self._run = run
        self._plots = scopes(run)
        self._names = sorted({line.quantity for plot in self._plots.values() for line in plot.lines})
        self._wraps = {channel.name for channel in run.channels if channel.flags & Flag.WRAPS}
        self._period = max(PERIOD, (len(self._plots) + run.hall) / MOST_MESSAGES)
        self._turns = Turns(run)
        self.restart()

    def restart(self) -> None:
        """Start anew: the drive has rebooted."""
        self._turns.restart()
        self._ranges: dict[str, tuple[float, float, float]] = {}
        self._held: dict[str, Picture] = {}  # of the last turn
        self._words = ""
        self._end = self._repeated = self._next = -math.inf  # s: of that turn; when it was logged last, and again

    def samples(self, chunk: SampleChunk, values: Mapping[str, Values]) -> None:
        """Take samples and their `values`, (n,) each, see `Line.quantity`."""
        self._seconds = max(WAVE, POINTS * chunk.config.decimation / self._run.pwm_hz)
        self._turns.samples(chunk, values)

    def edges(self, chunk: EdgeChunk) -> None:
        """Take Hall edges."""
        self._turns.edges(chunk)

    def frame(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Yield entity and static content: legends, and how lines and texts look."""
        legends = {entity: [(line.name, line.colour) for line in plot.lines] for entity, plot in self._plots.items()}
        if self._run.hall:
            sensors = [(f"sensor {name}", HALL_COLOURS[HIGH]) for name in "abc"]
            legends[schema.SCOPE_HALL] = [*sensors, ("sector", FAINT)]
        for entity, entries in legends.items():
            yield entity, rr.LineStrips2D.from_fields(radii=[-0.8])
            yield entity, rr.Points2D.from_fields(radii=[_UNSEEN], colors=[FAINT], show_labels=True)
            if entity == schema.SCOPE_HALL:
                heights = [*(level - LEVEL / 2 for level in LEVELS), sum(SECTOR) / 2]
            else:
                heights = [1.0 - 1.0 * (k + 0.5) / max(4, len(entries)) for k in range(len(entries))]
            names, colours = zip(*entries, strict=True)
            places = [(X_RANGE[0] / 2, -height) for height in heights]
            legend = rr.Points2D(places, labels=names, colors=colours, radii=_UNSEEN, show_labels=True)
            yield f"{entity}/legend", legend

    def pictures(self) -> tuple[int, Pictures] | None:
        """The tick of the newest sample, and the close-ups, if it is time for them."""
        newest = self._turns.newest
        if newest is None or (now := newest / self._run.tick_hz) < self._next:
            return None
        self._next = now + self._period
        look = self._turns.look()
        if look.turns and (end := self._times(look, look.turns[-1])[1]) > self._end:
            self._end, self._repeated = end, now
            self._held, self._words = self._of_turns(look)
            return newest, self._held
        if not self._held:
            return newest, self._of_moments(look)
        if now < max(self._end, self._repeated) + REST:
            return None
        self._repeated = now  # a viewer that comes late is given the newest only
        return newest, self._stale(look.why)

    def left_out(self) -> tuple[int, Pictures] | None:
        """The same, when samples are left out from here on."""
        newest = self._turns.newest
        return (newest, self._stale("no samples are shown here")) if newest is not None and self._held else None

    def _stale(self, why: str) -> Pictures:
        words = f"{why}; {self._words}"
        return {
            entity: Picture(picture.strips, [(picture.texts[0][0], words), *picture.texts[1:]])
            for entity, picture in self._held.items()
        }

    def _of_turns(self, look: Look) -> tuple[Pictures, str]:
        """The last turns over the angle, and which that is."""
        begin, end = self._times(look, look.turns[-1])
        hertz = (look.turns[-1].end - look.turns[-1].begin) / (end - begin)
        speed = f"{hertz * math.tau / (RPM * self._run.n_p):.0f} r/min" if self._run.n_p else f"{hertz:.3g} Hz"
        words = f"turn of {begin:.3f} s, {1e3 * (end - begin):.3g} ms, {speed}, angle by {look.source}"
        parts = [self._part(look, turn) for turn in look.turns]
        found = {entity: self._plot(entity, plot, parts, DEGREES, words) for entity, plot in self._plots.items()}
        if self._run.hall:
            spans = [_Span(*self._times(look, turn), part.x, look.tick[turn.first - 1 : turn.stop + 1])
                     for turn, part in zip(look.turns, parts, strict=True)]  # fmt: skip
            found[schema.SCOPE_HALL] = self._hall(spans, DEGREES, words)
        return found, words

    def _of_moments(self, look: Look) -> Pictures:
        """The last moments over time."""
        span = self._seconds * self._run.tick_hz
        first = int(np.searchsorted(look.tick, look.tick[-1] - span))
        tick = look.tick[first:]
        x = 1.0 + (tick - tick[-1]) / span
        ticks = tuple((k / 4, f"{self._seconds * (k / 4 - 1):.3g} s" if k < 4 else "0") for k in range(5))
        words = f"{look.why}: no whole turn yet, the last {self._seconds:.3g} s over time"
        part = _Part(x, self._turns.values(self._names, first, None))
        found = {entity: self._plot(entity, plot, [part], ticks, words) for entity, plot in self._plots.items()}
        if self._run.hall:
            begin, end = (float(at) / self._run.tick_hz for at in (tick[0], tick[-1]))
            found[schema.SCOPE_HALL] = self._hall([_Span(begin, end, x, tick)], ticks, words)
        return found

    def _times(self, look: Look, turn: Turn) -> tuple[float, float]:
        """When a turn began and ended, s."""
        found = []
        for row, angle in ((turn.first, turn.begin), (turn.stop, turn.end)):
            share = _share(look.angle, row, angle)
            found.append((look.tick[row - 1] + share * (look.tick[row] - look.tick[row - 1])) / self._run.tick_hz)
        return float(found[0]), float(found[1])

    def _part(self, look: Look, turn: Turn) -> _Part:
        """The samples of a turn, between what lies at its begin and its end; of angles that wrap what is next to it."""
        rows = slice(turn.first - 1, turn.stop + 1)
        x = np.clip(look.angle[rows] - min(turn.begin, turn.end), 0.0, 1.0)
        values = self._turns.values(self._names, rows.start, rows.stop)
        for name, value in values.items():
            wraps = name in self._wraps
            first = 1.0 if wraps else _share(look.angle, turn.first, turn.begin)
            last = 0.0 if wraps else _share(look.angle, turn.stop, turn.end)
            value[0] += first * (value[1] - value[0])
            value[-1] = value[-2] + last * (value[-1] - value[-2])
        return _Part(x, values)

    def _plot(self, entity: str, plot: Plot, parts: Sequence[_Part], ticks: Ticks, words: str) -> Picture:
        """Lines of a plot, the newest of `parts` last."""
        drawn = [_thinned(part.x, np.stack([line.of(part.values) for line in plot.lines])) for part in parts]
        known = np.concatenate([y[np.isfinite(y)] for _, y in drawn])
        if bad := [
            line.name for k, line in enumerate(plot.lines) if not all(np.isfinite(y[k]).all() for _, y in drawn)
        ]:
            words = f"{words}; not finite: {', '.join(bad)}"
        low, high, step = self._ranges[entity] = _range(plot, known, self._ranges.get(entity))
        marks = np.arange(math.ceil(low / step - 1e-6), math.floor(high / step + 1e-6) + 1) * step
        levels = [((mark - low) / (high - low), f"{mark:.6g}".replace("-", "−")) for mark in marks.tolist()]
        picture = _framed(ticks, levels, words)
        for part, (x, y) in enumerate(drawn):
            for line, row in zip(plot.lines, (y - low) / (high - low), strict=True):
                colour = line.colour if part == len(drawn) - 1 else pale(line.colour)
                picture.strips.extend((_strip(*piece), colour) for piece in _finite(x, row))
        return picture

    def _hall(self, spans: Sequence[_Span], ticks: Ticks, words: str) -> Picture:
        """Levels of the sensors, and the sectors of the newest of `spans`."""
        picture = _framed(ticks, (), words)
        tick, old, new = self._turns.hall()
        seconds = tick / self._run.tick_hz
        for span in spans:
            newest = span is spans[-1]
            a, b = np.searchsorted(seconds, (span.begin, span.end), side="right")
            code = int(new[a - 1]) if a else int(old[a]) if a < b else self._turns.code
            if code is None:
                picture.texts.append(((WIDE / 2, -sum(SECTOR) / 2), NO_EDGE))
                continue
            codes = np.concatenate([[code], new[a:b]]).astype(np.uint8) & 7
            x = np.concatenate([span.x[:1], np.interp(tick[a:b], span.tick, span.x), span.x[-1:]])
            for bit, level in enumerate(LEVELS):
                colour = HALL_COLOURS[HIGH] if newest else pale(HALL_COLOURS[HIGH])
                y = level - LEVEL + LEVEL * (codes >> bit & 1)
                picture.strips.append((_strip(np.repeat(x, 2)[1:-1], np.repeat(y, 2)), colour))
            for k, sector in enumerate(sector_of_code(codes).tolist() if newest else ()):
                name = NUMERALS[sector] if sector >= 0 else ILLEGAL
                corners = np.array([x[k], x[k + 1], x[k + 1], x[k], x[k]])
                box = _strip(corners, np.array(SECTOR)[[0, 0, 1, 1, 0]])
                picture.strips.append((box, HALL_COLOURS[ILLEGAL] if sector < 0 else FAINT))
                if abs(x[k + 1] - x[k]) > SECTOR_NAMED:
                    picture.texts.append(((float(x[k] + x[k + 1]) / 2 * WIDE, -sum(SECTOR) / 2), name))
        return picture


class _Part(NamedTuple):
    """Samples at places `x` of the axis, (n,), and their values, (n,) each."""

    x: F64
    values: dict[str, Values]


class _Span(NamedTuple):
    """From when to when, s, and the places `x` of the axis, (n,), that the ticks have."""

    begin: float
    end: float
    x: F64
    tick: NDArray[np.int64]


def pale(colour: RGB) -> RGB:
    """The colour of the turn before where that of the newest is `colour`."""
    red, green, blue = (round(ground + PALE * (part - ground)) for part, ground in zip(colour, GROUND, strict=True))
    return red, green, blue


def _share(angle: F64, row: int, at: float) -> float:
    """Where between the samples before `row` and at it the angle was `at`, from 0 to 1."""
    return float((at - angle[row - 1]) / (angle[row] - angle[row - 1]))


def _framed(ticks: Ticks, levels: Iterable[tuple[float, str]], words: str) -> Picture:
    """A picture with its grid, texts at its edges, and these words above it, which come first."""
    strips: list[Strip] = []
    texts: list[tuple[Place, str]] = [((WIDE / 2, -1.1), words)]
    for at, text in ticks:
        strips.append((_strip(np.array([at, at]), np.array([0.0, 1.0])), _GRID))
        texts.append(((at * WIDE, 0.11), text))
    for level, text in levels:
        strips.append((_strip(np.array([0.0, 1.0]), np.array([level, level])), _GRID))
        texts.append(((WIDE + 0.16, -level), text))
    strips.append((_strip(np.array([0.0, 1.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0, 0.0])), _AXIS))
    return Picture(strips, texts)


def _strip(x: Values, y: Values) -> NDArray[np.float32]:
    """Places of the axis, from 0 to 1, and heights, from 0 to 1, as a line, (n, 2)."""
    return np.stack([x * WIDE, -y], axis=1).astype(np.float32)


def _finite(x: F64, y: Values) -> list[tuple[F64, Values]]:
    """The pieces of a line between values that are not finite."""
    good = np.isfinite(y)
    if good.all():
        return [(x, y)]
    ends = np.flatnonzero(np.diff(good)) + 1
    pieces = zip(np.split(x, ends), np.split(y, ends), np.split(good, ends), strict=True)
    return [(of, its) for of, its, there in pieces if there[0]]


def _thinned(x: F64, y: Values) -> tuple[F64, Values]:
    """Lines (k, n) with no more than twice BINS points each: the least and the most of as many neighbours."""
    n = len(x)
    if n <= 2 * BINS:
        return x, y
    starts = np.arange(BINS) * n // BINS
    low, high = (extreme.reduceat(y, starts, axis=1) for extreme in (np.minimum, np.maximum))
    middles = (starts + np.append(starts[1:], n)) // 2
    at = np.stack([x[starts], x[middles]], axis=1).reshape(-1)
    at[-1] = x[-1]
    return at, np.stack([low, high], axis=2).reshape(len(y), -1)


def _range(plot: Plot, known: Values, before: Range | None) -> Range:
    """From least to most of a plot, and the step between its levels; as before where that fits."""
    known = np.append(known, (-plot.least, plot.least) if plot.least or not len(known) else ())
    low, high = plot.y_range or (float(known.min()), float(known.max()))
    span = max(high - low, 1e-3 * max(abs(low), abs(high)), 1e-6)
    if before and before[0] <= low and high <= before[1] and span >= FULL * (before[1] - before[0]):
        return before
    power = 10.0 ** math.floor(math.log10(span / 3))
    step = next(nice * power for nice in (1, 2, 5, 10) if nice * power >= span / 3.001)
    if plot.y_range:
        return low, high, step
    bottom = math.floor(low / step)
    return bottom * step, max(math.ceil(high / step), bottom + 1) * step, step


def _places(points: NDArray[np.float32]) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(points.reshape(-1)), type=PLACE)


def _row(values: pa.Array) -> pa.Array:
    """One row that holds all of them."""
    return pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values)

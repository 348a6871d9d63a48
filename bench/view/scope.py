"""Close-ups that stand still: the last whole electrical revolution over the angle, the one before it pale.

They are logged as a whole a few times a second: a viewer shows the newest, and no window of time moves. Before the
first revolution, and without an angle, they show the last moments over time. The words above say which of both that
is, of when, and why there is nothing since.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bench.record.info import RunInfo
from bench.signal.colours import RGB
from bench.signal.units import RPM
from bench.signal.waveforms.sectors import NUMERALS, sector_of_code
from bench.view import schema
from bench.view import scope_picture as draw
from bench.view.plane import FAINT
from bench.view.plots import POINTS, WAVE, Plot, plots
from bench.view.revolutions import REST, Look, Revolution, Revolutions
from bench.view.scope_picture import PITCH, Picture, Range, Ticks
from bench.view.states import HALL_COLOURS, HIGH, ILLEGAL, NO_EDGE
from protocol.signals import Flag
from protocol.streams import EdgeChunk, SampleChunk

PERIOD = 0.25  # s of device time between two pictures, at least
MOST_MESSAGES = 25.0  # a second: a viewer lags by messages
WIDER = 2.0  # s that a lane shows a range that is wider than needed
LANES = 5  # of a picture, at most
FEET, RISE = (0.02, 0.27, 0.52), 0.19  # of the Hall sensors' lines from the top of their lane, and how far they rise
SECTOR, NAMED = (0.79, 0.99), 0.06  # from where to where sectors are drawn; how wide one is to have its name
HALL_NAME = "Hall sensors and sector"

Values = NDArray[Any]
F64 = NDArray[np.float64]
Lanes = tuple[Plot | None, ...]
"""Plots, and None for the Hall sensors."""
Pictures = dict[str, Picture]
"""By entity."""


def scopes(run: RunInfo) -> dict[str, Lanes]:
    """The lanes of each picture that a run's channels allow, by entity; those of the vocabulary come first."""
    shown = [plot for plot in plots(run).values() if plot.entity == schema.FAST]
    known: list[Plot | None] = [plot for plot in shown if not plot.by_unit]
    if run.hall:
        known.append(None)
    others: list[Plot | None] = [plot for plot in shown if plot.by_unit]
    parts = [known, *(others[at : at + LANES] for at in range(0, len(others), LANES))]
    return {f"{schema.SCOPE}/{k}": tuple(part) for k, part in enumerate(part for part in parts if part)}


class Scope:
    """Makes the close-ups of a run."""

    def __init__(self, run: RunInfo) -> None:
        self._run = run
        self._scopes = scopes(run)
        self._plots = {plot.name: plot for lanes in self._scopes.values() for plot in lanes if plot}
        self._names = sorted({line.quantity for plot in self._plots.values() for line in plot.lines})
        self._wraps = {channel.name for channel in run.channels if channel.flags & Flag.WRAPS}
        self._period = max(PERIOD, len(self._scopes) / MOST_MESSAGES)
        self._revolutions = Revolutions(run)
        self.restart()

    def restart(self) -> None:
        """Start anew: the drive has rebooted."""
        self._revolutions.restart()
        self._ranges: dict[str, tuple[Range, float]] = {}  # and until when it may be wider than needed
        self._shown: Pictures = {}
        self._words = ""  # of these
        self._end = self._logged = self._next = -math.inf  # s: of it; when it was logged; when it is time

    def samples(self, chunk: SampleChunk, values: Mapping[str, Values]) -> None:
        """Take samples and their `values`, (n,) each, see `Line.quantity`."""
        self._seconds = max(WAVE, POINTS * chunk.config.decimation / self._run.pwm_hz)
        self._revolutions.samples(chunk, values)

    def edges(self, chunk: EdgeChunk) -> None:
        """Take Hall edges."""
        self._revolutions.edges(chunk)

    def frame(self) -> Iterator[tuple[str, rr.AsComponents]]:
        """Yield entity and static content: how lines and texts look, legends, and names of lanes."""
        for entity, lanes in self._scopes.items():
            for look in draw.looks():
                yield entity, look
            entries: list[tuple[str, RGB]] = []
            heights: list[float] = []
            for k, plot in enumerate(lanes):
                foot = (k + 1) * PITCH
                if plot is None:
                    entries += [(f"sensor {name}", HALL_COLOURS[HIGH]) for name in "abc"] + [("sector", FAINT)]
                    heights += [foot - 1.0 + RISE / 2 + at for at in FEET] + [foot - 1.0 + sum(SECTOR) / 2]
                else:
                    entries += [(line.name, line.colour) for line in plot.lines]
                    pitch = 1.0 / max(4, len(plot.lines))
                    heights += [foot - 1.0 + pitch * (n + 0.5) for n in range(len(plot.lines))]
            yield f"{entity}/legend", draw.legend(entries, heights)

    def pictures(self) -> tuple[int, Pictures] | None:
        """The tick of the newest sample, and the close-ups, if it is time for them."""
        newest = self._revolutions.newest
        if newest is None or (now := newest / self._run.tick_hz) < self._next:
            return None
        self._next = now + self._period
        look = self._revolutions.look()
        if look.whole and (end := self._times(look, look.whole[-1])[1]) > self._end:
            self._end, self._logged = end, now
            self._shown = self._of_revolutions(look)
            return newest, self._shown
        if self._end == -math.inf:
            self._shown = self._of_moments(look)
            return newest, self._shown
        if now < self._logged + REST:
            return None
        self._logged = now  # a viewer that comes late is given the newest only
        return newest, self._told(f"no whole revolution since: {look.why}")

    def left_out(self) -> tuple[int, Pictures] | None:
        """The same, where samples are left out from here on."""
        newest = self._revolutions.newest
        return None if newest is None else (newest, self._told("from here on samples are left out"))

    def _told(self, more: str) -> Pictures:
        """What is shown, with other words above it."""
        return {entity: picture.told(f"{self._words}\n{more}") for entity, picture in self._shown.items()}

    def _of_revolutions(self, look: Look) -> Pictures:
        """The last revolutions over the angle."""
        begin, end = self._times(look, look.whole[-1])
        hertz = (look.whole[-1].end - look.whole[-1].begin) / (end - begin)
        speed = (
            f"{hertz * math.tau / (RPM * self._run.n_p):.0f} r/min" if self._run.n_p else f"{hertz:.3g} Hz electrical"
        )
        speed = speed.replace("-", "−")
        lasted = f"{end - begin:.3g} s" if end - begin >= 1.0 else f"{1e3 * (end - begin):.3g} ms"
        self._words = f"revolution of {begin:.3f} s, {lasted}, {speed}, angle by {look.source}"
        more = "pale: the one before" if len(look.whole) > 1 else "none before it"
        return self._drawn([self._part(look, one) for one in look.whole], draw.DEGREES, f"{self._words}\n{more}")

    def _of_moments(self, look: Look) -> Pictures:
        """The last moments over time."""
        span = self._seconds * self._run.tick_hz
        first = int(np.searchsorted(look.tick, look.tick[-1] - span))
        x = 1.0 + (look.tick[first:] - look.tick[-1]) / span
        part = _Part(x, look.tick[first:], self._revolutions.values(self._names, first, None))
        ticks = tuple((k / 4, f"{self._seconds * (k / 4 - 1):.3g} s".replace("-", "−")) for k in range(4))
        self._words = f"the last {self._seconds:.3g} s over time"
        words = f"{self._words}\nno whole revolution yet: {look.why}"
        return self._drawn([part], (*ticks, (1.0, "0 s")), words)

    def _times(self, look: Look, one: Revolution) -> tuple[float, float]:
        """When a revolution began and ended, s."""
        found = []
        for row, angle in ((one.first, one.begin), (one.stop, one.end)):
            share = _share(look.angle, row, angle)
            found.append((look.tick[row - 1] + share * (look.tick[row] - look.tick[row - 1])) / self._run.tick_hz)
        return float(found[0]), float(found[1])

    def _part(self, look: Look, one: Revolution) -> _Part:
        """The samples of one, and what lies at its begin and its end: of angles that wrap, what is next to that."""
        rows = slice(one.first - 1, one.stop + 1)
        x = look.angle[rows] - min(one.begin, one.end)
        values = self._revolutions.values(self._names, rows.start, rows.stop)
        for name, value in values.items():
            wraps = name in self._wraps
            first = 1.0 if wraps else _share(look.angle, one.first, one.begin)
            last = 0.0 if wraps else _share(look.angle, one.stop, one.end)
            value[0] += first * (value[1] - value[0])
            value[-1] = value[-2] + last * (value[-1] - value[-2])
        return _Part(x, look.tick[rows], values)

    def _drawn(self, parts: Sequence[_Part], ticks: Ticks, words: str) -> Pictures:
        """All pictures of these parts, the newest last."""
        found: Pictures = {}
        for entity, lanes in self._scopes.items():
            picture = draw.framed(ticks, len(lanes), words)
            for k, plot in enumerate(lanes):
                name = HALL_NAME if plot is None else plot.title
                if plot is None:
                    self._draw_hall(picture, (k + 1) * PITCH, parts)
                elif unknown := self._draw_plot(picture, (k + 1) * PITCH, plot, parts):
                    name = f"{name}; not finite: {', '.join(unknown)}"
                picture.texts.append(((draw.WIDE / 2, k * PITCH + 0.15), name))
            found[entity] = picture
        return found

    def _draw_plot(self, picture: Picture, foot: float, plot: Plot, parts: Sequence[_Part]) -> list[str]:
        """Draw the lines of a plot; those are returned that are not finite everywhere."""
        lines = [
            draw.thinned(part.x.clip(0.0, 1.0), np.stack([line.of(part.values) for line in plot.lines]))
            for part in parts
        ]
        finite = [np.isfinite(y) for _, y in lines]
        known = np.concatenate([y[good] for (_, y), good in zip(lines, finite, strict=True)])
        low, high, step = self._range(plot, draw.needed(plot, known))
        draw.levels(picture, foot, (low, high, step))
        for k, (x, y) in enumerate(lines, 1):
            for line, strip in zip(plot.lines, draw.strips(x, foot - (y - low) / (high - low)), strict=True):
                colour = line.colour if k == len(lines) else draw.pale(line.colour)
                picture.strips.extend((piece, colour) for piece in draw.pieces(strip))
        whole = np.logical_and.reduce([good.all(axis=1) for good in finite])
        return [line.name for line, good in zip(plot.lines, whole, strict=True) if not good]

    def _range(self, plot: Plot, needed: Range) -> Range:
        """The range that a lane shows: what is needed, or for some time what was."""
        before, until = self._ranges.get(plot.name, (needed, 0.0))
        if before == needed or self._next > until or needed[0] < before[0] or before[1] < needed[1]:
            before, until = needed, self._next + WIDER
        self._ranges[plot.name] = before, until
        return before

    def _draw_hall(self, picture: Picture, foot: float, parts: Sequence[_Part]) -> None:
        """Draw the levels of the sensors, and the sectors of the newest part."""
        tick, old, new = self._revolutions.hall()
        top = foot - 1.0
        for part in parts:
            newest = part is parts[-1]
            a, b = np.searchsorted(tick, (part.tick[0], part.tick[-1]), side="right")
            code = int(new[a - 1]) if a else int(old[a]) if a < b else self._revolutions.code
            if code is None:
                picture.texts.append(((draw.WIDE / 2, top + sum(SECTOR) / 2), NO_EDGE))
                continue
            codes = np.concatenate([[code], new[a:b]]).astype(np.uint8) & 7
            x = np.concatenate([part.x[:1], np.interp(tick[a:b], part.tick, part.x), part.x[-1:]]).clip(0.0, 1.0)
            colour = HALL_COLOURS[HIGH] if newest else draw.pale(HALL_COLOURS[HIGH])
            y = top + np.array(FEET)[:, None] + RISE * (1 - (codes >> np.arange(3)[:, None] & 1))
            picture.strips.extend((strip, colour) for strip in draw.strips(np.repeat(x, 2)[1:-1], y.repeat(2, axis=1)))
            for k, sector in enumerate(sector_of_code(codes).tolist() if newest else ()):
                name = NUMERALS[sector] if sector >= 0 else ILLEGAL
                corners = x[[k, k + 1, k + 1, k, k]], top + np.array([SECTOR])[:, [0, 0, 1, 1, 0]]
                picture.strips.append((draw.strips(*corners)[0], FAINT if sector >= 0 else HALL_COLOURS[ILLEGAL]))
                if abs(x[k + 1] - x[k]) > NAMED:
                    picture.texts.append(((float(x[k] + x[k + 1]) / 2 * draw.WIDE, top + sum(SECTOR) / 2), name))


class _Part(NamedTuple):
    """Samples at places `x` of the axis, beside which the first and the last may lie, and at these ticks, (n,) each."""

    x: F64
    tick: NDArray[np.int64]
    values: dict[str, Values]


def _share(angle: F64, row: int, at: float) -> float:
    """Where between the samples before `row` and at it the angle was `at`, from 0 to 1."""
    return float((at - angle[row - 1]) / (angle[row] - angle[row - 1]))

"""What the last second comes to: errors over the angle, harmonics, how late the Hall edges are, the current vector.

None of it is a plot over time. It is made anew every second of device time, from samples without a gap, and is blank
where it is undefined: a shaft that rests has no harmonics. Angles are electrical, by the encoder; harmonics of a drive
without an encoder are taken over its first estimate.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bench.record.info import RunInfo
from bench.signal.colours import RGB, TABLE
from bench.signal.error_bins import angle_bins
from bench.signal.position import wrap
from bench.signal.units import RPM
from bench.signal.waveforms import Thd, thd_by_angle
from bench.signal.waveforms.harmonics import ORDER, PERIODS
from bench.signal.waveforms.sectors import NUMERALS, edge_angle, edge_passages, hall_offset
from bench.view import markdown, schema
from bench.view.plane import FAINT, circle
from bench.view.revolutions import too_fast
from protocol.streams import EdgeChunk, SampleChunk

SPAN = 1.0  # s
KEPT = 5  # of them, for which edges are kept until samples come
PERIOD = 1.0  # s of device time from one picture to the next
BINS = 36  # of an electrical revolution
MOST_ROWS = 800  # samples from which harmonics are found
LEGEND, LEGEND_LATE = 1.5, 1.25  # times the axis of a bar chart, so that its legend covers no bar
TRAIL, TRAIL_POINTS = 0.2, 400  # s of the current vector's way, in so many points at most
FORWARD, REVERSE = "forward", "reverse"
WAYS: dict[str, RGB] = {FORWARD: (240, 240, 240), REVERSE: (136, 128, 120)}
X_RANGE, Y_RANGE = (-1.55, 1.55), (-1.4, 1.25)  # of the current plane

_CHANGES = {
    batch.component_descriptor() for batch in rr.BarChart.from_fields(values=np.zeros(1)).as_component_batches()
}

Values = NDArray[Any]
Part = tuple[str, rr.AsComponents | Iterable[rr.DescribedComponentBatch]]
Drawn = tuple[list[Part], list[tuple[str, str]]]
"""Entities with their content, and lines of the table of numbers."""


class LastSecond:
    """Keeps what has come in the last second and makes pictures of it. `views` tells which a run can fill."""

    def __init__(self, run: RunInfo) -> None:
        self._run = run
        self._reference = run.position_reference
        estimates = run.position_estimates
        self._angle = self._reference or (estimates[0] if estimates else None)
        self._estimates = estimates if self._reference else ()
        self._phases = [name for name in schema.PHASES if run.has(name)] if self._angle else []
        self._dq = run.has(*schema.DQ_CURRENTS)
        self._voltage = run.has("u_dc", *schema.VOLTAGE_VECTOR)
        self._speed = run.speeds[-1] if run.speeds else ""
        wanted = (self._angle, self._speed, *self._phases, "u_dc", *schema.DQ_CURRENTS, *schema.DQ_REFERENCES)
        self._wanted = [name for name in dict.fromkeys(wanted) if name and any(c.name == name for c in run.channels)]
        edges = self._reference is not None and "edges" in run.identity.get("features", ("edges",))
        self.views = tuple(
            view
            for view, there in (
                (schema.BY_ANGLE, bool(self._estimates)),
                (schema.DQ, self._dq),
                (schema.LATE, edges),
                (schema.HARMONICS, bool(self._phases)),
            )
            if there
        )
        self._ticks = round(SPAN * run.tick_hz)
        self._samples: deque[tuple[NDArray[np.int64], dict[str, Values]]] = deque()
        self._edges: deque[tuple[NDArray[np.int64], Values, Values]] = deque()
        self._next = 0  # tick
        self._drawn: set[str] = set()

    def restart(self) -> None:
        """Start anew: the drive has rebooted, or samples are missing."""
        self._samples.clear()
        self._edges.clear()
        self._next = 0

    def samples(self, chunk: SampleChunk, values: Mapping[str, Values], errors: Mapping[str, Values]) -> None:
        """Take samples, their `values` by channel or derived quantity, and `errors` of estimates in deg, (n,) each."""
        if not self.views or not len(chunk):
            return
        first = max((gap.position for gap in chunk.gaps), default=0)
        if chunk.gaps:
            self.restart()
        kept = {name: values[name][first:] for name in (*self._wanted, schema.U_ABS) if name in values}
        kept |= {schema.error_component(name): errors[name][first:] for name in self._estimates}
        tick = chunk.tick[first:]
        self._samples.append((tick, kept))
        oldest = int(tick[-1]) - self._ticks
        while self._samples and int(self._samples[0][0][-1]) < oldest:
            self._samples.popleft()

    def edges(self, chunk: EdgeChunk) -> None:
        """Take Hall edges."""
        if schema.LATE in self.views:
            self._edges.append((chunk.tick, chunk.hall_old, chunk.hall_new))
            while int(self._edges[0][0][-1]) < int(chunk.tick[-1]) - KEPT * self._ticks:  # samples may come later
                self._edges.popleft()

    def due(self) -> int | None:
        """The tick of the newest sample if it is time for new pictures, else None."""
        if not self._samples or (tick := int(self._samples[-1][0][-1])) < self._next:
            return None
        self._next = tick + round(PERIOD * self._run.tick_hz)
        return tick

    # -- pictures -----------------------------------------------------------------------------------------------

    def frame(self) -> Iterator[Part]:
        """Yield entity and static content: places and colours of bars; circle, axes and names of the current plane."""
        for entity, at, width, colour in self._bars():
            more = LEGEND_LATE if entity.startswith(schema.LATE) else LEGEND
            at = np.append(at, more * at[-1])  # a bar without a height
            look = rr.BarChart(np.zeros(len(at)), abscissa=at, widths=np.full(len(at), width), color=colour)
            yield entity, [part for part in look.as_component_batches() if part.component_descriptor() not in _CHANGES]
        if schema.DQ in self.views:
            axes = [[(-1.15, 0.0), (1.15, 0.0)], [(0.0, -1.15), (0.0, 1.15)]]
            places = {"i_d": (1.3, 0.0), "i_q": (0.0, -1.28)}
            yield from circle(schema.DQ, axes, [(at, name, TABLE[name].rgb) for name, at in places.items()])

    def _bars(self) -> Iterator[tuple[str, Values, float, RGB]]:
        """Entity, places on the axis, width and colour of every bar chart."""
        if schema.BY_ANGLE in self.views:
            wide = 360.0 / BINS
            bar = 0.9 * wide / len(self._estimates)
            for k, name in enumerate(self._estimates):
                yield _by_angle(name), (np.arange(BINS) + 0.05) * wide + bar * (k + 0.5), bar, self._run.colours[name]
        for k, name in enumerate(self._phases):
            at = np.arange(2, ORDER + 1) + 0.28 * (k - 1)
            yield f"{schema.HARMONICS}/{name}", at, 0.26, self._run.colours[name]
        if schema.LATE in self.views:
            for k, (way, colour) in enumerate(WAYS.items()):
                yield f"{schema.LATE}/{way}", np.arange(len(NUMERALS)) + 1 + 0.4 * (k - 0.5), 0.36, colour

    def pictures(self) -> Iterator[Part]:
        """Yield entity and content of the last second; what is not defined any more is cleared."""
        tick = np.concatenate([tick for tick, _ in self._samples])
        rows = slice(int(np.searchsorted(tick, tick[-1] - self._ticks)), None)
        names = self._samples[-1][1].keys()
        values = {name: np.concatenate([v[name] for _, v in self._samples if name in v])[rows] for name in names}
        tick = tick[rows]
        if bad := [name for name, value in values.items() if not np.isfinite(value).all()]:
            yield from self._cleared(())  # a float channel of a physical drive can hold anything
            yield _numbers([("undefined", f"not a finite number: {', '.join(bad)}")], tick, self._run.tick_hz)
            return
        theta = np.unwrap(values[self._angle].astype(np.float64)) if self._angle else None
        facts: list[tuple[str, str]] = []
        seconds = (tick[-1] - tick[0]) / max(1, len(tick) - 1) / self._run.tick_hz
        blind = "" if theta is None else too_fast(theta, values.get(self._speed), seconds)
        if blind:
            facts.append(("undefined: speed, edges, THD", blind))
        elif theta is not None:
            facts += self._mean_speed(tick, theta)
        parts: list[Part] = []
        for view, make in (
            (schema.BY_ANGLE, self._by_angle),
            (schema.DQ, self._current_plane),
            (schema.HARMONICS, self._harmonics),
            (schema.LATE, self._late),
        ):
            if view in self.views and not (blind and view in (schema.HARMONICS, schema.LATE)):
                more, text = make(tick, theta, values)
                parts += more
                facts += text
        if self._voltage:
            facts += self._modulation(values)
        yield from self._cleared([entity for entity, _ in parts])
        yield from parts
        yield _numbers(facts, tick, self._run.tick_hz)

    def _cleared(self, drawn: Iterable[str]) -> Iterator[Part]:
        """What was drawn last time and is not among the entities that are drawn now."""
        for entity in self._drawn.difference(drawn):
            yield entity, rr.Clear(recursive=False)
        self._drawn = set(drawn)

    def _mean_speed(self, tick: NDArray[np.int64], theta: Values) -> list[tuple[str, str]]:
        seconds = (tick[-1] - tick[0]) / self._run.tick_hz
        if seconds <= 0:
            return []
        omega = float(theta[-1] - theta[0]) / seconds
        n_p = self._run.n_p
        mechanical = f"{omega / (RPM * n_p):.1f} r/min, " if n_p else ""
        return [("mean speed", f"{mechanical}{omega / math.tau:.2f} Hz electrical")]

    def _by_angle(self, tick: Any, theta: Any, values: Mapping[str, Values]) -> Drawn:
        """Mean error in each bin of the angle, a bar for each estimate side by side."""
        parts: list[Part] = []
        facts: list[tuple[str, str]] = []
        bins = angle_bins(theta, BINS)
        whole = abs(theta[-1] - theta[0]) >= math.tau
        for name in self._estimates:
            error = values[schema.error_component(name)]
            text = f"{error.mean():+.2f}, {error.std():.2f}, {np.abs(error).max():.2f} deg"
            facts.append((f"{schema.label(name)}: mean, std, max", text))
            if whole:
                parts.append((_by_angle(name), _values(_mean(bins, error, BINS))))
        return parts, facts

    def _current_plane(self, tick: Any, theta: Any, values: Mapping[str, Values]) -> Drawn:
        """The current vector's way over the last moments, its mean and its reference; the circle is a round number."""
        n = max(1, int(np.searchsorted(tick[-1] - tick[::-1], TRAIL * self._run.tick_hz)))
        step = max(1, n // TRAIL_POINTS)
        d, q = (values[name][-n:][::step] for name in schema.DQ_CURRENTS)
        full = schema.nice_ceiling(float(np.hypot(d, q).max()))
        means = [float(values[name].mean()) for name in schema.DQ_CURRENTS]
        trail = np.stack([d, -q], axis=1) / full
        mean_d, mean_q = float(d.mean()) / full, -float(q.mean()) / full
        parts: list[Part] = [
            (f"{schema.DQ}/trail", rr.LineStrips2D([trail.tolist()], colors=[TABLE["i_q"].rgb], radii=[-1.0])),
            (f"{schema.DQ}/mean", rr.Arrows2D(vectors=[(mean_d, mean_q)], colors=[(255, 255, 255)], radii=[-1.6])),
            (f"{schema.DQ}/circle", rr.Points2D([(-1.1, -1.2)], labels=[f"circle {full:g} A"], colors=[FAINT],
                                                radii=0.0, show_labels=True)),
        ]  # fmt: skip
        if all(name in values for name in schema.DQ_REFERENCES):
            ref = [float(values[name][-1]) / full for name in schema.DQ_REFERENCES]
            parts.append((f"{schema.DQ}/reference",
                          rr.Points2D([(ref[0], -ref[1])], colors=[TABLE["i_q_ref"].rgb], radii=[-4.0])))  # fmt: skip
        return parts, [("i_d, i_q, mean", f"{means[0]:+.3f} A, {means[1]:+.3f} A")]

    def _harmonics(self, tick: Any, theta: Any, values: Mapping[str, Values]) -> Drawn:
        """Harmonics 2 to 20 of the phase currents in % of the fundamental, and their distortion."""
        parts: list[Part] = []
        texts: list[tuple[str, str]] = []
        for name in self._phases:
            try:
                found = distortion(theta, values[name])
            except ValueError as error:
                texts.append((f"THD {name}", f"undefined: {str(error).partition(':')[0]}"))
                continue
            share = np.zeros(ORDER - 1)
            share[: len(found.amplitudes) - 1] = 100 * found.amplitudes[1:] / found.amplitudes[0]
            parts.append((f"{schema.HARMONICS}/{name}", _values(share)))
            texts.append((f"THD {name}", f"{100 * found.value:.1f} % of {found.amplitudes[0]:.3g} A"))
        return parts, texts

    def _late(self, tick: Any, theta: Any, values: Mapping[str, Values]) -> Drawn:
        """By how much each edge comes after its ideal angle, in the direction of travel."""
        if not self._edges:
            return [], []
        at, old, new = (np.concatenate(column) for column in zip(*self._edges, strict=True))
        known = (at >= tick[0]) & (at <= tick[-1])
        opened, passed = edge_passages(old[known] & 7, new[known] & 7)
        angle = np.interp(at[known], tick, theta)
        parts: list[Part] = []
        facts: list[tuple[str, str]] = []
        for way, sign in ((FORWARD, 1), (REVERSE, -1)):
            met = passed == sign
            sector = opened[met]
            late = sign * np.degrees(wrap(angle[met] - edge_angle(sector, hall_offset(self._run.parameters))))
            seen = np.flatnonzero(np.bincount(sector, minlength=len(NUMERALS)))
            if not len(seen):
                continue
            mean = _mean(sector, late, len(NUMERALS))
            parts.append((f"{schema.LATE}/{way}", _values(mean)))
            each = [f"{NUMERALS[s]} {mean[s]:+.1f}" for s in seen]
            facts += [(f"edges late, {way}, deg", ", ".join(each[at : at + 3])) for at in range(0, len(each), 3)]
        return parts, facts

    def _modulation(self, values: Mapping[str, Values]) -> list[tuple[str, str]]:
        bus, size = values["u_dc"], values[schema.U_ABS]
        text = f"{float(bus.mean()):.2f} V, {float(bus.min()):.2f} to {float(bus.max()):.2f} V"
        if float(bus.min()) <= 0:
            return [("DC link", text)]
        share = 100 * math.sqrt(3) * size / bus
        return [("DC link", text), ("|u| of u_dc/√3", f"{share.mean():.1f} %, max {share.max():.1f} %")]


def _numbers(facts: list[tuple[str, str]], tick: NDArray[np.int64], tick_hz: int) -> Part:
    """The table to read, of samples at these ticks."""
    text = markdown.table((f"last {(tick[-1] - tick[0]) / tick_hz:.2f} s", ""), facts)
    return schema.NUMBERS, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def distortion(theta: Values, current: Values) -> Thd:
    """Harmonics of `current` (n,) over the unwrapped angle `theta` (n,) rad, from about 800 samples or fewer.

    Raises ValueError for fewer than three electrical revolutions, and where there is no fundamental.
    """
    n = len(theta)
    revolutions = abs(float(theta[-1] - theta[0])) / math.tau
    if revolutions < PERIODS:
        raise ValueError(f"{revolutions:.1f} revolutions, needs {PERIODS}")
    if n > MOST_ROWS and revolutions * MOST_ROWS / n >= PERIODS + 1:
        theta, current = theta[-MOST_ROWS:], current[-MOST_ROWS:]
    else:
        step = -(-n // MOST_ROWS)
        theta, current = theta[::step], current[::step]
    widest = float(np.abs(np.diff(theta)).max())
    return thd_by_angle(theta, current, order=max(2, min(ORDER, math.ceil(math.pi / widest) - 1)))


def _mean(bins: NDArray[np.int64], values: Values, n: int) -> Values:
    """Mean of `values` in each of `n` bins, (n,); 0 where there is none."""
    number = np.bincount(bins, minlength=n)
    return np.bincount(bins, values, n) / np.maximum(number, 1)


def _values(values: Values) -> rr.BarChart:
    """New values of a bar chart, and of the bar that makes room for the legend."""
    return rr.BarChart.from_fields(values=np.append(values, 0.0))


def _by_angle(estimate: str) -> str:
    """Entity of the errors of an estimate: its legend shows the name."""
    return f"{schema.BY_ANGLE}/{''.join(char if char.isalnum() else '-' for char in schema.label(estimate))}"

"""A motor, three Hall sensors, their wires and an encoder by formula: recordings whose every figure is known.

Sensor s of three is 1 over half an electrical turn, from -60 + 120 s deg on; all that real ones do otherwise is added.
The level of an input is kept as the times at which it changes; nothing comes from the code under test or from `sim`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bench.record.info import RunInfo
from bench.record.writer import RunWriter
from bench.signal.capture import Capture
from protocol.codes import DriveState, StreamEvent
from protocol.signals import DRIVE_CHANNELS
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig
from tests.bench.hall_cases.shaft import Floats, Way, check

Ints = NDArray[np.int64]
Three = tuple[float, float, float]
NONE: Three = (0.0, 0.0, 0.0)
DRIVE = ("hall", "status", "omega_enc", "i_a", "i_b", "i_d", "i_q")
HALF_TURN = 180.0


class Motor(NamedTuple):
    """Pole pairs, ohm, H, V s, and the A that friction takes."""

    n_p: int
    r: float = 0.158
    l: float = 0.176e-3
    psi: float = 6.55e-3
    amperes: float = 0.6


PAPER = Motor(6)


@dataclass(frozen=True)
class Sensors:
    """Where sensors and magnets are, electrical deg; of sensors in the order a, b, c."""

    ring: float = 0.0
    """By which all of them are later than in SPEC 12."""
    displaced: Three = NONE
    apart: Three = NONE
    """By which a rise comes sooner and a fall later."""
    hysteresis: Three = (0.5, 0.5, 0.5)
    jitter: Three = (0.05, 0.05, 0.05)
    magnets: tuple[float, ...] = ()
    """By which the ends of the magnets, 2 n_p of them, come later: even ones make inputs rise."""
    spacing: float = 120.0
    rise_late: Three = NONE
    """s."""
    fall_late: Three = NONE

    @property
    def most_late(self) -> float:
        return max(*self.rise_late, *self.fall_late)


@dataclass(frozen=True)
class Wires:
    """Input k reads sensor `order[k]`, turned round where bit k of `inverted` is set."""

    order: tuple[int, int, int] = (0, 1, 2)
    inverted: int = 0


@dataclass(frozen=True)
class Bounce:
    """An edge that is there, gone again and back, `returns` times, `spacing` s apart."""

    inputs: tuple[int, ...]
    share: float
    returns: int
    spacing: float
    random: bool = False
    """Whether spacings have an exponential distribution."""


@dataclass(frozen=True)
class Pulses:
    """Levels turned round for `width` s (lowest, highest), `rate` times a second in all, at random."""

    inputs: tuple[int, ...]
    rate: float
    width: tuple[float, float]
    with_current: bool = False


@dataclass(frozen=True)
class Contact:
    """Inputs that read `level` for a `share` of the time from `since` s on, in stretches of `seconds`, exponential.

    Inputs that share a plug (`together`) lose it at once.
    """

    inputs: tuple[int, ...]
    share: float
    seconds: float
    level: int = 1
    since: float = 0.0
    together: bool = False


Effect = Bounce | Pulses | Contact


@dataclass(frozen=True)
class Encoder:
    """What theta_enc has of the shaft: angles electrical deg, counts as 4 times `lines`."""

    lines: int = 1024
    zero: float = 0.0
    way: float = 1.0
    ratio: float = 1.0
    """Turns that it counts for one of the shaft."""
    late: float = 0.0
    """s."""
    slips: tuple[tuple[float, float], ...] = ()
    """At which s by how much."""
    lost: float = 0.0
    """A turn, at one place of its disc, whichever way it goes: back what was lost comes again."""
    gained: float = 0.0
    """A turn, whichever way it goes."""
    indexed: bool = True
    """Otherwise it counts from 0 where the shaft stands, and is right once the shaft has passed 0."""
    eccentric: float = 0.0
    noise: float = 0.0


@dataclass(frozen=True)
class Recording:
    """What is recorded."""

    motor: Motor = PAPER
    way: Way = field(default_factory=lambda: check(240.0, 6))
    sensors: Sensors = Sensors()
    wires: Wires = Wires()
    effects: tuple[Effect, ...] = ()
    encoder: Encoder | None = Encoder()
    voltages: bool = True
    loads: float = 0.0
    """A that come and go on top of friction every 0.3 s."""
    start: float = 0.1
    """Turns of the shaft."""
    tick_hz: int = 20_000_000
    pwm_hz: int = 16_000
    decimation: int = 4
    resolution: float = 0.0
    """s from look to look at the inputs; 0 where edges are captured."""
    n_p: int | None = None
    """That the drive has; None: the motor's."""
    parameters: dict[str, float] = field(default_factory=dict)
    seed: int = 1

    def but(self, **changed: Any) -> Self:
        return replace(self, **changed)

    def sensing(self, **changed: Any) -> Self:
        return replace(self, sensors=replace(self.sensors, **changed))

    def encoding(self, **changed: Any) -> Self:
        return replace(self, encoder=replace(self.encoder or Encoder(), **changed))

    def with_effect(self, effect: Effect) -> Self:
        return replace(self, effects=(*self.effects, effect))

    @property
    def omega(self) -> float:
        """The highest speed, electrical deg/s."""
        return 6.0 * self.motor.n_p * self.way.top

    @cached_property
    def t(self) -> Floats:
        """s of every PWM period."""
        return np.arange(round(self.way.seconds * self.pwm_hz)) / self.pwm_hz

    @cached_property
    def shaft(self) -> Floats:
        """rad in every PWM period."""
        return self.way.angle(self.t, self._rng(0)) + self.start * math.tau

    @cached_property
    def current(self) -> Floats:
        """i_q, A, in every PWM period."""
        speed = np.gradient(self.shaft, self.t)
        i_q = self.motor.amperes * np.tanh(speed / 2.0) + 2.0 * self.motor.amperes * (self.way.rocking[0] > 0)
        i_q += self.loads * (np.floor(self.t / 0.3) % 2.0) * np.sign(speed)
        return np.where(self.way.on(self.t), i_q, 0.0)

    def _rng(self, what: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, what))

    # -- Hall inputs --------------------------------------------------------------------------------------------

    @cached_property
    def lines(self) -> list[Line]:
        """The three inputs."""
        rng = self._rng(1)
        sensed = [self._sensor(k, rng) for k in range(3)]
        there = [sensed[k].inverted() if self.wires.inverted >> n & 1 else sensed[k]
                 for n, k in enumerate(self.wires.order)]  # fmt: skip
        late = zip(there, self.sensors.rise_late, self.sensors.fall_late, strict=True)
        lines = [line.late(rise, fall) for line, rise, fall in late]
        for effect in self.effects:
            shared = self._open(effect, rng) if isinstance(effect, Contact) else None
            for k in effect.inputs:
                if isinstance(effect, Bounce):
                    lines[k] = lines[k].bouncing(effect, rng)
                elif isinstance(effect, Pulses):
                    lines[k] = lines[k].toggled(self._pulses(effect, rng))
                else:
                    opened = shared if effect.together and shared is not None else self._open(effect, rng)
                    lines[k] = lines[k].forced(opened, effect.level)
        return lines

    def _sensor(self, number: int, rng: np.random.Generator) -> Line:
        """A sensor by its hysteresis: an edge is passed up half of it later, and down half of it sooner."""
        sensors, n_p = self.sensors, self.motor.n_p
        turn, both = 360.0 * n_p, np.arange(2 * n_p)
        apart = np.where(both % 2 == 0, -sensors.apart[number], sensors.apart[number])
        places = HALF_TURN * both + apart + (np.array(sensors.magnets) if sensors.magnets else 0.0)
        zero = sensors.ring - 60.0 + sensors.spacing * number + sensors.displaced[number] + places[0]
        places -= places[0]
        degrees = np.degrees(self.shaft) * n_p - zero

        def passed(degrees: Floats) -> Ints:
            whole = np.floor(degrees / turn)
            return (whole * 2 * n_p + np.searchsorted(places, degrees - whole * turn, side="right")).astype(np.int64)

        half = sensors.hysteresis[number] / 2.0
        times, levels = [], []
        for way in (1, -1):
            count = passed(degrees - way * half)
            at = np.flatnonzero(np.diff(count) * way > 0)
            edge = count[at + (way > 0)] - 1  # number of the magnet's end that was passed
            place = places[edge % (2 * n_p)] + edge // (2 * n_p) * turn + way * half
            step = degrees[at + 1] - degrees[at]
            moved = np.clip(
                rng.normal(0.0, sensors.jitter[number], len(at)) / step, -0.002 * self.pwm_hz, 0.002 * self.pwm_hz
            )
            times.append((at + (place - degrees[at]) / step + moved) / self.pwm_hz)
            levels.append((edge % 2 == 0) == (way > 0))
        order = np.argsort(np.concatenate(times), kind="stable")
        return Line.of(int(passed(degrees[:1])[0] % 2), np.concatenate(times)[order], np.concatenate(levels)[order])

    def _pulses(self, effect: Pulses, rng: np.random.Generator) -> Floats:
        """Times at which pulses begin and end; `rate` is that of all inputs, at the largest current if they know it."""
        seconds = self.way.seconds
        begin = rng.uniform(0.0, seconds, rng.poisson(effect.rate * seconds / len(effect.inputs)))
        if effect.with_current:
            size = np.abs(np.interp(begin, self.t, self.current))
            begin = begin[rng.uniform(size=len(begin)) < size / max(float(np.abs(self.current).max()), 1e-9)]
        width = effect.width[0] * (effect.width[1] / effect.width[0]) ** rng.uniform(size=len(begin))
        return np.concatenate([begin, begin + width])

    def _open(self, effect: Contact, rng: np.random.Generator) -> Line:
        seconds = self.way.seconds
        if effect.share >= 1.0:
            return Line(0, np.array([effect.since]))
        closed = effect.seconds * (1.0 / effect.share - 1.0)
        n = 20 + int(3.0 * seconds / (effect.seconds + closed))
        both = np.stack([rng.exponential(closed, n), rng.exponential(effect.seconds, n)], axis=1)
        times = effect.since + np.cumsum(both.ravel())
        return Line(0, times[times < seconds])

    def edges(self) -> tuple[Ints, Ints]:
        """Ticks at which the code changes, and the codes: before the first, after it and so on."""
        step = max(1, round(self.resolution * self.tick_hz))
        lines = [Line(line.first, np.ceil(line.times * self.tick_hz / step) * step) for line in self.lines]
        last = (len(self.t) - 1) * (self.tick_hz // self.pwm_hz)
        ticks = np.unique(np.concatenate([line.times for line in lines]))
        ticks = np.concatenate([[0.0], ticks[(ticks > 0.0) & (ticks <= last)]])
        codes = sum((line.at(ticks) << k for k, line in enumerate(lines)), start=np.zeros(len(ticks), np.int64))
        new = np.concatenate([[False], np.diff(codes) != 0])
        return ticks[new].astype(np.int64), np.concatenate([codes[:1], codes[new]])

    # -- channels -----------------------------------------------------------------------------------------------

    def encoder_angle(self) -> Floats:
        """theta_enc, rad, unwrapped, in every PWM period."""
        its, n_p, rng = self.encoder or Encoder(), self.motor.n_p, self._rng(2)
        turns = np.interp(self.t - its.late, self.t, self.shaft) / math.tau
        passed = np.flatnonzero(np.diff(np.floor(turns)))
        if not its.indexed:
            turns = turns - np.where(np.arange(len(turns)) <= (passed[0] if len(passed) else np.inf), turns[0], 0.0)
        way = np.cumsum(np.abs(np.diff(turns, prepend=turns[0])))
        deg = its.eccentric * np.sin(math.tau * turns + 1.0) - its.lost * np.floor(turns - 0.37)
        deg += its.gained * np.floor(way + 0.3)
        for when, size in its.slips:
            deg += np.where(self.t >= when, size, 0.0)
        counts = 4 * its.lines
        turns = its.way * its.ratio * (np.floor((turns + deg / (360.0 * n_p)) * counts) + 0.5) / counts
        noise = rng.normal(0.0, its.noise, len(turns)) if its.noise else 0.0
        return turns * (self.n_p or n_p) * math.tau + np.radians(its.zero + noise)

    def _values(self, at: slice) -> dict[str, Floats]:
        """By channel, of the PWM periods `at`; the voltage is the mean of the period that ends at the sample."""
        rng, motor, t = self._rng(3), self.motor, self.t[at]
        omega = np.gradient(self.shaft, self.t)[at] * motor.n_p
        theta, i_q, on = self.shaft[at] * motor.n_p, self.current[at], self.way.on(t)
        noise = rng.normal(0.0, 0.01, (2, len(t)))
        i = 1j * i_q * np.exp(1j * theta) + noise[0] + 1j * noise[1]
        u = ((motor.r + 1j * omega * motor.l) * 1j * i_q + 1j * omega * motor.psi) * np.exp(
            1j * (theta - 0.5 * omega / self.pwm_hz)
        )
        own = i * np.exp(-1j * theta)
        values = {
            "status": np.where(on, float(DriveState.RUNNING), float(DriveState.IDLE)),
            "i_a": i.real, "i_b": (-i.real + math.sqrt(3.0) * i.imag) / 2.0, "i_d": own.real, "i_q": own.imag,
            "u_alpha": u.real * on, "u_beta": u.imag * on,
        }  # fmt: skip
        if its := self.encoder:
            angle = (self.encoder_angle()[at] + math.pi) % math.tau - math.pi
            by = its.way * its.ratio * (self.n_p or motor.n_p) / motor.n_p
            values |= {"theta_enc": np.clip(angle, -math.pi, math.pi - 1e-4), "omega_enc": omega * by}
        return values

    def capture(self) -> Capture:
        """Record it."""
        tick, codes = self.edges()
        at = slice(None, None, self.decimation)
        ticks = np.arange(len(self.t), dtype=np.int64)[at] * (self.tick_hz // self.pwm_hz)
        values = self._values(at) | {"hall": codes[np.searchsorted(tick, ticks, side="right")].astype(float)}
        left = () if self.voltages else ("u_alpha", "u_beta")
        channels = tuple(c for c in DRIVE_CHANNELS if c.name in values and c.name not in left)
        clock = {"tick_hz": self.tick_hz, "pwm_hz": self.pwm_hz}
        config = StreamConfig(1, 0, 1, StreamEvent.PWM, self.decimation, channels, 32, **clock)
        raw = np.zeros(len(ticks), config.dtype)
        for channel in channels:
            raw[channel.name] = np.round(np.clip(values[channel.name] / channel.scale, -32768, 32767))
        index = np.arange(len(ticks), dtype=np.int64) * self.decimation
        old, new = codes[:-1].astype(np.uint8), codes[1:].astype(np.uint8)
        illegal = ~np.isin(old ^ new, (1, 2, 4)) | np.isin(new, (0, 7))
        edges = StreamConfig(1, 1, 2, StreamEvent.EDGES, 1, (), 32, **clock)
        chunk = EdgeChunk(edges, tick, old, new, illegal, np.zeros(len(tick), np.uint16),
                          np.arange(len(tick), dtype=np.int64), ())  # fmt: skip
        known = {"n_p": float(self.n_p or self.motor.n_p), "R_s_hat": self.motor.r, "L_s_hat": self.motor.l,
                 "psi_f_hat": self.motor.psi, "i_max": 30.0,
                 "omega_m_max": 1.25 * self.way.top * math.tau / 60.0}  # fmt: skip
        return Capture(SampleChunk(config, index, ticks, raw, ()), chunk, known | self.parameters)


class Line(NamedTuple):
    """The level of an input: 0 or 1 at first, and another at each of these times (s, growing)."""

    first: int
    times: Floats

    @classmethod
    def of(cls, first: int, times: Floats, levels: NDArray[Any]) -> Line:
        """By the level from each of these times on, the same or another."""
        return cls(first, times[np.diff(np.concatenate([[first], levels.astype(np.int64)])) != 0])

    def at(self, times: Floats) -> Ints:
        return (self.first + np.searchsorted(self.times, times, side="right")) & 1

    def inverted(self) -> Line:
        return Line(1 - self.first, self.times)

    def late(self, rise: float, fall: float) -> Line:
        """Each edge later; a pulse of which nothing is left is gone."""
        rises = (np.arange(len(self.times)) + self.first) % 2 == 0
        times = self.times + np.where(rises, rise, fall)
        while len(wrong := np.flatnonzero(np.diff(times) <= 0.0)):
            times = np.delete(times, [wrong[0], wrong[0] + 1])
        return Line(self.first, times)

    def toggled(self, times: Floats) -> Line:
        """Turned round at these times besides."""
        return Line(self.first, np.sort(np.concatenate([self.times, times])))

    def bouncing(self, effect: Bounce, rng: np.random.Generator) -> Line:
        """Edges that return within four tenths of the time to the next one."""
        n, each = len(self.times), 2 * effect.returns
        gaps = (
            rng.exponential(effect.spacing, (n, each))
            if effect.random
            else effect.spacing * rng.uniform(0.9, 1.1, (n, each))
        )
        returns = np.cumsum(gaps, axis=1)
        free = returns[:, -1] < 0.4 * np.diff(self.times, append=np.inf)
        chosen = free & (rng.uniform(size=n) < effect.share)
        return self.toggled((self.times[:, None] + returns)[chosen].ravel())

    def forced(self, opened: Line, level: int) -> Line:
        """At `level` while `opened` is 1."""
        times = np.unique(np.concatenate([self.times, opened.times]))
        first = level if opened.first else self.first
        return Line.of(first, times, np.where(opened.at(times) == 1, level, self.at(times)))


def pieces(capture: Capture, seconds: float = 0.1) -> Iterator[EdgeChunk | SampleChunk]:
    """In order of time, as a live run has them: edges before the samples that follow them."""
    samples, edges = capture.samples, capture.edges
    step = max(1, round(seconds * samples.config.rate))
    for first in range(0, len(samples), step):
        tick = samples.tick[first : first + step]
        after = int(samples.tick[first - 1]) if first else -1
        a, b = np.searchsorted(edges.tick, (after, int(tick[-1])), side="right")
        if b > a:
            columns = {
                name: getattr(edges, name)[a:b]
                for name in ("tick", "hall_old", "hall_new", "illegal", "encoder", "index")
            }
            yield replace(edges, **columns)
        yield replace(
            samples, index=samples.index[first : first + step], tick=tick, raw=samples.raw[first : first + step]
        )


def write_run(path: Path, capture: Capture) -> Path:
    """The same as the run `path`, a new folder."""
    config = capture.samples.config
    info = RunInfo(config.tick_hz, config.pwm_hz, tuple(config.channels), capture.parameters, {"name": "by formula"})
    writer = RunWriter(path, info)
    for piece in pieces(capture, 0.25):
        writer.take(piece)
    writer.close()
    return path

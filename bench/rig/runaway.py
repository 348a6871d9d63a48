"""Sees that a motor runs away: faster than it was asked for, or the wrong way, and not slowing down.

`Runaway` compares the speed that was asked for with the speed by the encoder, by the Hall edges
and by the drive's own estimate. Each of them sums up how far the shaft has turned beyond what it may (a CUSUM of the
speed); one electrical revolution too far is a runaway. So noise, single wrong samples and edges that jitter come to
nothing, a short overshoot is allowed, and a motor that takes off is seen within some 50 ms. Time is the drive's:
samples that are lost count for nothing.

A speed may lie between the one that was there when a setpoint was given, standstill and the setpoint (a load may slow
or stall a motor: that is no runaway), and beyond that by `OVERSHOOT` of it, or by `MARGIN` of the drive's limit if that
is more. A speed sensor that is wrong is no runaway: one sensor's word counts only if the other one does not see the
shaft turn as it should. Nothing here stops a motor.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from bench.device.heard import Heard
from bench.signal.channels import flagged, reference_angle, speed_channel
from bench.signal.chunks import join
from bench.signal.position import last_state, wrap
from bench.signal.units import RPM, pole_pairs
from bench.signal.waveforms.sectors import SECTOR_WIDTH, steps_between
from protocol.messages import DriveState
from protocol.signals import Flag, Unit
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

OVERSHOOT = 0.6  # of a speed that was asked for, by which the shaft may be faster
MARGIN = 0.1  # of omega_m_max, by which it may be faster, or turn the other way: a load step, a start
LEAST_MARGIN = 60.0 * RPM  # mechanical rad/s, the margin of a drive without omega_m_max
TOO_FAR = math.tau  # electrical rad beyond all that, from which on it is a runaway
TOO_FAR_ALONE = 3 * math.tau  # the same, where sensors stand still and only the drive's estimate says that it turns
BLOCK = 0.01  # s of samples whose median is a speed
FEW = 15  # samples of a block that are enough for its median
MEMORY = 0.2  # s of device time within which a sensor has seen the shaft turn
PATIENCE = 0.15  # s for which a sensor's word waits for that of one that is silent: on CAN edges come with heartbeats
A_TURN = math.tau - 0.1  # electrical rad
KEPT = 5.0  # s of what a sensor has seen: a turn that takes longer is too slow for any limit
BEYOND = 1.1  # of omega_m_max, a speed at which one sensor's word is enough


Forced = Callable[[], float | None]


class _Sensor:
    """One of what tells the speed: electrical rad and rad/s, seconds of device time."""

    def __init__(self, words: str) -> None:
        self.words = words
        self._travel: deque[tuple[float, float, bool]] = deque()  # time, rad gone since the one before, clean
        self.speed = 0.0
        """By the last of it."""
        self.ask(0.0)

    def ask(self, asked: float) -> None:
        """From now on the speed should go to this from where it is."""
        self.low, self.high = min(asked, self.speed), max(asked, self.speed)
        self.over = self.under = 0.0
        self.since = math.inf

    def moved(
        self, time: float, seconds: float, gone: float, margin: float, aims: tuple[float, ...], clean: bool = True
    ) -> None:
        """The shaft has turned by `gone` in `seconds` until `time`; `aims`: speeds that it is brought to.

        `clean`: it has not contradicted itself meanwhile.
        """
        self._travel.append((time, gone, clean))
        while self._travel[0][0] < time - KEPT:
            self._travel.popleft()
        self.speed = gone / seconds
        self.low, self.high = min(self.low, *aims), max(self.high, *aims)
        bottom, top = self.bounds(margin)
        self.over = max(0.0, self.over + gone - max(top, margin) * seconds)
        self.under = max(0.0, self.under + min(bottom, -margin) * seconds - gone)
        self.since = min(self.since, time - seconds) if self.over or self.under else math.inf
        self.low = max(self.low, min(self.speed, *aims))  # it has come nearer: it has no reason to go back
        self.high = min(self.high, max(self.speed, *aims))

    def bounds(self, margin: float) -> tuple[float, float]:
        """The lowest and the highest speed that are allowed."""
        return (
            self.low - max(OVERSHOOT * max(-self.low, 0.0), margin),
            self.high + max(OVERSHOOT * max(self.high, 0.0), margin),
        )

    def over_a_turn(self) -> float:
        """The speed by its last electrical turn, in which the places of single edges even out; 0 before one."""
        gone, until = 0.0, self._travel[-1][0] if self._travel else 0.0
        for time, own, _ in reversed(self._travel):
            if abs(gone) > A_TURN and until > time:
                return gone / (until - time)
            gone += own
        return 0.0

    def sees_it_turn(self, now: float) -> bool:
        """Whether it has seen the shaft go on by a Hall sector just now."""
        while self._travel and self._travel[0][0] < now - 2 * MEMORY:
            self._travel.popleft()
        newest = self._travel[-1][0] if self._travel else -math.inf
        return sum(abs(gone) for time, gone, _ in self._travel if time > newest - MEMORY) >= SECTOR_WIDTH

    def in_order(self, now: float, margin: float) -> bool:
        """Whether it sees the shaft turn as it should."""
        bottom, top = self.bounds(margin)
        turning = self.sees_it_turn(now)
        return turning and all(clean for _, _, clean in self._travel) and bottom <= self.speed <= top


class Runaway:
    """Compares speeds with the one that was asked for, of a drive with `n_p` pole pairs; None: nothing is compared.

    `omega_m_max`: the drive's limit, mechanical rad/s, 0 where it has none; it may change.
    """

    def __init__(self, n_p: int | None, omega_m_max: Callable[[], float] = lambda: 0.0) -> None:
        self.verdict = ""
        """What was seen, once the motor has run away: an end of a sentence; empty before."""
        self.most: float | None = None
        """Where a motor is turned with care: mechanical rad/s that it may have, either way and at any moment."""
        self.most_free: float | None = None
        """The same while no speed is asked for, and a current turns the shaft as fast as its load lets it."""
        self._n_p, self._omega_m_max = n_p, omega_m_max
        self._asked: float | None = None  # electrical rad/s
        self._encoder, self._hall = _Sensor("the encoder"), _Sensor("the Hall sensors")
        self._own = _Sensor("the drive's own estimate")
        self._there: tuple[_Sensor, ...] = (self._encoder, self._hall)

    def ask(self, omega_m: float | None) -> None:
        """From now on this speed is asked for, mechanical rad/s; None: the shaft may turn as it likes."""
        self._asked = None if omega_m is None or self._n_p is None else omega_m * self._n_p
        self.verdict = ""
        self._forget()

    def follow(self, omega_m: float | None) -> None:
        """What is asked for has moved on to this, mechanical rad/s; what was seen so far still counts."""
        if (omega_m is None) != (self._asked is None):
            self.ask(omega_m)
        elif omega_m is not None and self._n_p is not None:
            self._asked = omega_m * self._n_p

    @property
    def _judges(self) -> bool:
        return self._asked is not None or self.most_free is not None

    def _forget(self) -> None:
        for sensor in self._there:
            sensor.ask(self._asked or 0.0)

    @property
    def _margin(self) -> float:
        """Electrical rad/s."""
        return max(LEAST_MARGIN, MARGIN * self._omega_m_max()) * (self._n_p or 0)

    @property
    def _aims(self) -> tuple[float, ...]:
        """Speeds that the shaft is brought to."""
        return (self._asked or 0.0,)

    def by_edges(self, time: float, seconds: float, steps: NDArray[np.float64]) -> None:
        """The Hall sensors went on by `steps` sectors, (n,), in `seconds` of the drive's time, until `time`."""
        each: list[float] = steps.tolist()  # a few at a time, which are counted sooner than added by numpy
        clean = each.count(1.0) + each.count(-1.0) == len(each)
        self._hall.moved(time, seconds, SECTOR_WIDTH * sum(each), self._margin, self._aims, clean)

    def by_encoder(self, time: float, seconds: float, gone: float) -> None:
        """The encoder went on by `gone`, electrical rad, in so many s."""
        self._encoder.moved(time, seconds, gone, self._margin, self._aims)

    def judge(self, now: float) -> None:
        """Whether all that was taken until `now` is a runaway."""
        if not self._judges or self.verdict or self._n_p is None:
            return
        most = self.most_free if self._asked is None else self.most
        with_care = math.inf if most is None else most * self._n_p
        ranked = (self._encoder, self._own, self._hall)
        main = next((sensor for sensor in ranked if sensor in self._there), None)  # taken for the shaft's own speed
        for sensor in self._there:
            far = TOO_FAR_ALONE if sensor is self._own and len(self._there) > 1 else TOO_FAR
            too_far = max(sensor.over, sensor.under) > far and self._asked is not None and self._believed(sensor, now)
            speed = sensor.over_a_turn() if sensor is self._hall else sensor.speed
            if too_far or (sensor is main and abs(speed) > with_care):
                per_rpm = self._n_p * RPM
                asked = f"at most {with_care / per_rpm:g}" if self._asked is None else f"{self._asked / per_rpm:g}"
                seen_by = f"{speed / per_rpm:.0f} r/min by {sensor.words} at {now:.3f} s of device time"
                self.verdict = f"let its motor run away: {asked} r/min asked for, {seen_by}"
                return

    def _believed(self, sensor: _Sensor, now: float) -> bool:
        """Whether no other one says otherwise: one that measures, and sees the shaft turn as it should."""
        limit = BEYOND * self._omega_m_max() * (self._n_p or 0)
        if 0.0 < limit < abs(sensor.speed):
            return True
        others = [other for other in self._there if other not in (sensor, self._own)]
        if any(other.in_order(now, self._margin) for other in others):
            return False
        if all(other.sees_it_turn(now) for other in others):
            return True
        return now - sensor.since >= PATIENCE and not (sensor is self._own and self._asked == 0.0)


class RunawayGuard(Runaway):
    """Sink that looks at the samples of `stream` and, with `edges`, at its drive's Hall edges.

    `parameters`: the drive's, by name, as they are at any time. `forced`: the mechanical speed, rad/s, that a load
    machine forces on the shaft at present, None where none does.
    """

    def __init__(
        self, stream: StreamConfig, edges: bool, parameters: Mapping[str, float], forced: Forced = lambda: None
    ) -> None:
        super().__init__(pole_pairs(parameters), lambda: parameters.get("omega_m_max", 0.0))
        self._stream, self._parameters, self._forced, self._has_edges = stream, parameters, forced, edges
        self._omega = flagged(stream.channels, Unit.RAD_PER_S, Flag.REFERENCE)
        self._theta, self._estimate = "" if self._omega else reference_angle(stream.channels), ""
        self._waiting: list[SampleChunk] = []
        self._held = 0  # samples in them
        self._last_edge: int | None = None

    def ask(self, omega_m: float | None) -> None:
        """See `Runaway.ask`."""
        self._waiting, self._held = [], 0
        self._n_p = pole_pairs(self._parameters)  # a commissioning finds them
        estimate = speed_channel(self._stream.channels, self._parameters)
        self._estimate = "" if estimate == self._omega else estimate
        known = (
            (self._encoder, self._omega or self._theta),
            (self._hall, self._has_edges),
            (self._own, self._estimate),
        )
        self._there = tuple(sensor for sensor, there in known if there)
        super().ask(omega_m)

    @property
    def _aims(self) -> tuple[float, ...]:
        forced = self._forced()
        return super()._aims if forced is None else (*super()._aims, forced * (self._n_p or 0))

    def take(self, item: Heard) -> None:
        """Follow Hall sensors, encoder and estimate."""
        if isinstance(item, EdgeChunk) and item.config.node == self._stream.node:
            self._edges_came(item)
        elif isinstance(item, SampleChunk) and item.config.node == self._stream.node and self._judges:
            self._samples_came(item)

    def _edges_came(self, chunk: EdgeChunk) -> None:
        first, last = self._last_edge, int(chunk.tick[-1])
        self._last_edge = last
        if first is None or first >= last or any(gap.lost_samples for gap in chunk.gaps):
            return
        time = last / chunk.config.tick_hz
        self.by_edges(time, (last - first) / chunk.config.tick_hz, steps_between(chunk.hall_old, chunk.hall_new))
        self.judge(time)

    def _samples_came(self, chunk: SampleChunk) -> None:
        self._waiting.append(chunk)
        self._held += len(chunk)
        if self._held >= max(BLOCK * chunk.config.rate, 3):
            block, self._waiting, self._held = join(self._waiting), [], 0
            self._look(block)

    def _look(self, block: SampleChunk) -> None:
        if last_state(block) not in (None, DriveState.RUNNING):
            self._forget()
            return
        time, seconds = int(block.tick[-1]) / block.config.tick_hz, len(block) / block.config.rate
        margin, aims = self._margin, self._aims
        for sensor, channel in ((self._encoder, self._omega), (self._own, self._estimate)):
            if channel and math.isfinite(speed := _median(block, channel)):
                sensor.moved(time, seconds, speed * seconds, margin, aims)
        if self._theta and not block.gaps:
            fastest = 0.5 * math.pi * block.config.rate  # whose direction the samples of an angle tell
            if max(map(abs, self._encoder.bounds(margin))) < fastest:
                step = float(np.median(wrap(np.diff(block.physical(self._theta)))))
                self.by_encoder(time, seconds, step * len(block))
        self.judge(time)


def _median(block: SampleChunk, channel: str) -> float:
    """Of some of the values, in the channel's unit."""
    told = block.config.channel(channel)
    some = np.sort(block.raw[channel][:: max(1, len(block) // FEW)])
    return float(some[len(some) // 2]) * told.scale + told.offset

"""Step 5: the shaft is spun on the encoder, both ways, and coasts with the outputs off; without one on Hall sensors.

It accelerates by a q current that takes it to the top within about half a second, at most to the agreed speed and to
the speed that takes a share of the voltage. There a d current flows, one sign after the other, which makes no torque.
Then the outputs go off and it coasts: nothing brakes it, because a DC link without a resistor has no place for its
energy.

Without an encoder the d current flows at a lower speed, too: edges that are seen late lie elsewhere there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from bench.commission.analysis import by_edges
from bench.commission.refusal import Refused
from bench.commission.stand import Stand, Stretch
from bench.commission.window import Window
from bench.rig.envelope import Envelope
from bench.signal.position import wrap
from bench.signal.units import RPM

STEP = "spin"
SHARE = 0.5
"""Of the agreed current, at most, to accelerate with, and on d at the top."""
FIRST, MORE, SLIGHTLY_MORE = 0.1, 1.3, 1.1
"""Share of that with which it begins, and by what it grows: until the shaft turns, and once it does."""
TRIES = 25
"""Times that it grows."""
TURNS = 30.0
"""rad/s, electrical, of a shaft that turns."""
GROWS = 0.02
"""Of the speed, that it gains meanwhile: it accelerates."""
TOP, RESISTIVE = 0.6, 0.5
"""Of the linear voltage, that the top speed takes; and of that, what resistance takes of it at most."""
LOWER = 0.45
"""Of the top, a speed at which a d current flows, too, where Hall edges are all that tells the angle."""
RECENT = 0.25
"""s of Hall edges that tell the speed,"""
SILENT, CLEAR, MISSED = math.pi, 200.0, 0.2
"""rad without an edge, and rad/s, electrical, that the shaft had, and share of the largest speed: with a current its
edges are missed. A slower one may have stopped by itself, and where no edge comes the current does not turn either."""
WITHIN, BY_EDGES = 0.9, 0.85
"""Of the agreed speed; and without an encoder."""
SECONDS = 0.4
"""s to the top, about: harmonics of the back-EMF make currents that brake, which i_q does not show; beside more torque
they count for less."""
OVER_FRICTION = 2.5
"""Times the current that friction takes, at least."""
LONGEST, PATIENCE, LONGEST_COAST = 6.0, 2.5, 1.8
"""s to the top, and with less than all of the current, and of a coast, at most."""
LONGEST_HELD, AFTER = 1.5, 0.2
"""s of a coast, at most, where the drive's memory keeps it, and s by which its end is seen late;"""
DRIVEN, LEAST_HELD = 1.2, 0.3
"""and s of a lap with the outputs on, without which such a memory keeps either of both; and that it has to keep."""
SLOW = 2.0
"""Times SECONDS, after which the next acceleration has more current: what friction takes at speed nobody knew."""
LOOK = 0.02
"""s from look to look."""
AHEAD = 2.0
"""Looks that may pass until a command has ended what the last one saw."""
FIRST_LOOKS = 5
"""Looks at the shaft under each current of the first try."""
ALONG, PAIRS = 0.08, 3
"""s of a d current of each sign, and how many of each;"""
BLIND_PAIRS, ALONG_TURNS, MOST_ALONG = 5, 4.0, 0.2
"""and without an encoder so many, each electrical turns at least, and s at most."""
SLOWED = 0.8
"""Of the speed at their beginning, that friction may take meanwhile, and below which it is accelerated again."""
HEAVY, TORQUE = 0.3, 0.04
"""Of the largest current to accelerate with, from which a rotor is heavy enough for s of all of it at the top."""
ENDS = 0.12
"""Of the speed at the top, at which a coast ends."""
COAST, LAPS, MOST_LAPS = 2.0, 2, 8
"""s of coasting each way, and laps: a light rotor coasts briefly."""
TRIP, TRIP_BY_EDGES = 0.97, 1.05
"""Times the agreed speed at which the drive itself trips meanwhile: it sees it late, and the host may be gone. By Hall
edges that lie unevenly it sees more than there is, and early."""


@dataclass(frozen=True)
class Look:
    """A moment of the shaft."""

    window: Window
    speed: float
    """rad/s, electrical."""


@dataclass
class Spin:
    """The manoeuvre: what it has taken so far, on a drive whose encoder, or Hall sensors, are known."""

    stand: Stand
    n_p: int
    """Pole pairs; 1 where nobody knows them, which makes it turn the slower."""
    friction: float
    """A of q current that the shaft takes at the slowest."""
    windows: list[Window] = field(default_factory=list)
    """Of the laps so far,"""
    stretches: list[Stretch] = field(default_factory=list)
    """and those of the one that goes on."""
    fastest: float = 0.0
    """rad/s, electrical, that was seen,"""
    now: float = 0.0
    """and at the last look."""
    began: float = 0.0
    """rad/s, electrical, at which this acceleration began."""
    goal: float = math.inf
    """rad/s, electrical, to which it accelerates, if that is less than the limits allow."""
    slope: float = 0.0
    """rad/s2, electrical, of the last acceleration,"""
    took: float = 0.0
    """and s that it took."""
    psi: float = 0.0
    """V s, rough."""
    every: float = LOOK
    """s from look to look: on a slow link more than was asked for."""
    slows: float = 0.0
    """rad/s2, electrical, by which it slows down with the outputs off."""

    @property
    def most(self) -> float:
        """A, to accelerate with."""
        return min(SHARE * self.stand.i_max, RESISTIVE * TOP * self.stand.u_linear / self.stand.R)

    @property
    def limit(self) -> float:
        """rad/s, electrical, at which it has to stop accelerating, whatever the voltage is."""
        return (BY_EDGES if self.blind else WITHIN) * self.stand.rpm * RPM * self.n_p

    # -- looks --------------------------------------------------------------------------------------------------

    @property
    def blind(self) -> bool:
        """Whether there is no encoder."""
        return self.stand.turned is None or self.stand.turned.dragged is None

    def look(self) -> Look:
        """The next of it, and how fast it was. Refused where a current flows and the edges of Hall sensors stop."""
        return self._look(LOOK)

    def _look(self, seconds: float) -> Look:
        window = self.stand.look(seconds)
        self.now = self._by_edges(window.i_ref) if window.theta is None else speed(window.last(LOOK), self.now)
        self.fastest = max(self.fastest, abs(self.now))
        return Look(window, self.now)

    def _by_edges(self, asked: complex) -> float:
        """rad/s, electrical, while this current is asked for."""
        turned = self.stand.turned
        if turned is None or turned.hall is None or turned.hall.edges is None:
            raise Refused(STEP, "nothing tells the speed of the shaft")
        w, silent = by_edges.speed(self.stand.recent_edges(RECENT), turned.hall.edges, self.stand.T)
        driven = asked and asked.imag * self.now >= 0.0
        if driven and silent > SILENT and abs(self.now) > max(CLEAR, MISSED * self.limit):
            raise Refused(
                STEP, f"no Hall edge came any more of a shaft that turned at {abs(self.now):.0f} rad/s (electrical): "
                "a Hall sensor has lost its supply or its wire, or something holds the shaft"
            )  # fmt: skip
        return w

    def _wait_by_edges(self, seconds: float, asked: complex, slowest: float) -> None:
        """Wait while this current is asked for, and look at the edges meanwhile: no longer than the shaft is fast."""
        for _ in range(round(seconds / LOOK)):
            self.stand.wait(LOOK)
            self.now = self._by_edges(asked)
            if abs(self.now) < slowest:
                break

    def watch(self, seconds: float) -> tuple[list[Look], bool]:
        """Looks for so long, or until it is as fast as it may be, or will be before a command can end it.

        The looks, and whether that was the end. Refused for a shaft that turns against its torque.
        """
        seen = [self.look()]
        while not (top := self.at_the_top(seen)) and _apart(seen) + LOOK < seconds:
            seen.append(self.look())
            self.every = _apart(seen) / (len(seen) - 1)
            i_q = seen[-1].window.i_ref.imag
            way = math.copysign(1.0, i_q)
            if i_q and way * self.now < min(way * self.began, 0.0) - 0.1 * self.limit:
                sensor = "the Hall sensors are" if self.blind else "the encoder has slipped, or is"
                raise Refused(STEP, f"the shaft turns against its torque: {sensor} wrong")
        return seen, top

    def at_the_top(self, seen: list[Look]) -> bool:
        """Whether it will be as fast as it may be when the next looks have been taken."""
        last = seen[-1].speed
        gains = abs(last - seen[-2].speed) if len(seen) > 1 else 0.0
        volts = abs(_voltage(seen[-1].window))
        return volts > TOP * self.stand.u_linear or abs(last) + AHEAD * gains > min(self.limit, self.goal)

    # -- commands -----------------------------------------------------------------------------------------------

    def accelerate(self, i_q: float) -> bool:
        """A q current until it is at the top; whether it got there."""
        self.began = self.now
        self.stand.current(0.0, i_q)
        with self.stand.stretch("up") as taken:
            seen, reached = self.watch(LONGEST if abs(i_q) >= self.most else PATIENCE)
            self.stand.current(0.0, 0.0)
        self.slope, self.took = abs(_slope(seen)), _apart(seen)
        taken.until(seen[-1].window)
        self.stretches.append(taken)
        return reached

    def hold(self, i_d: float, i_q: float, seconds: float, kind: str, slowest: float = 0.0) -> None:
        """A current for so long, by Hall edges while the shaft is faster than `slowest`, rad/s, electrical."""
        self.stand.current(i_d, i_q)
        with self.stand.stretch(kind) as taken:
            if self.blind:
                self._wait_by_edges(seconds, complex(i_d, i_q), slowest)
            else:
                self._look(seconds)
        self.stretches.append(taken)

    def first_torque(self) -> float:
        """A of q current that takes it to the top in SECONDS: by a small one that grows until the shaft turns."""
        i_q = FIRST * self.most
        for _ in range(TRIES):
            self.stand.current(0.0, i_q)
            seen, top = self.watch(FIRST_LOOKS * LOOK)
            w0, w1 = seen[0].speed, seen[-1].speed
            if (w1 > TURNS and w1 - w0 > GROWS * w1) or top:
                break
            i_q = min(i_q * (MORE if w1 < TURNS else SLIGHTLY_MORE), self.most)
        else:
            raise Refused(STEP, "the shaft does not turn on the encoder: a load is attached, or it binds")
        voltage = _voltage(seen[-1].window)
        slope = max(_slope(seen), 1.0)
        back_emf = max(voltage.imag - self.stand.R * i_q, 0.3 * abs(voltage), 1e-6)
        self.psi = back_emf / max(abs(w1), 1.0)
        goal = min(TOP * self.stand.u_linear * w1 / back_emf, self.limit)
        accelerating = max(i_q - self.friction, 0.2 * i_q)
        wanted = accelerating * goal / SECONDS / slope + self.friction
        return float(np.clip(wanted, min(OVER_FRICTION * self.friction + 0.02 * self.most, self.most), self.most))

    def lap(self, way: float, i_q: float, number: int) -> tuple[float, float]:
        """To the top and down again; the q current that it took, A, and s of the coast."""
        if self.stand.held:  # the last lap was read meanwhile
            self.stand.await_rest(STEP)
            self.now = 0.0
        with self.stand.running(None):
            self.stand.keep(*self.kept(number))
            if number == 1 and self.blind:
                self.goal = LOWER * self.fastest
                i_q = self.reach(way, i_q)
                self.along_d(PAIRS, way, i_q)
                self.goal = math.inf
            i_q = self.reach(way, i_q)
            top = abs(self.now)
            if number == 0:
                self.top(way, i_q)
        with self.stand.stretch("off") as taken:
            self.slow_down(ENDS * top, self.longest_coast)
        self.stretches.append(taken)
        windows = [window for each in self.stretches if (window := each.window) is not None]
        self.stretches.clear()
        self.windows += windows
        return i_q, sum(window.seconds for window in windows if window.kind == "off")

    def kept(self, number: int) -> tuple[float, float]:
        """s of a lap before and after the outputs go off that the drive's memory is to keep: of a small one either."""
        room, coast = self.stand.holds, self.longest_coast + AFTER
        if room > DRIVEN + coast:
            return room - coast, coast
        return (room - LOOK, LOOK) if number % 2 == 0 else (LOOK, min(room - LOOK, coast))

    def reach(self, way: float, i_q: float) -> float:
        """Accelerate to the top, with more current where it takes too long; A that the next one should have."""
        while not self.accelerate(way * i_q):
            if i_q >= self.most:
                sensor = "or the Hall sensors are wrong" if self.blind else "or the encoder has slipped"
                raise Refused(
                    STEP, f"the shaft does not reach the speed with {self.most:.3g} A within {LONGEST:g} s: a load "
                    f"is attached, friction is high, {sensor}"
                )  # fmt: skip
            i_q = min(2.0 * i_q, self.most)
        return min(2.0 * i_q, self.most) if self.took > SLOW * SECONDS else i_q

    def top(self, way: float, i_q: float) -> None:
        """A d current of both signs, and a torque for a moment where the rotor is heavy."""
        self.along_d(BLIND_PAIRS if self.blind else PAIRS, way, i_q)
        gains = self.slope * self.most / i_q * (TORQUE + AHEAD * (self.every if self.stand.held else LOOK))
        if i_q > HEAVY * self.most and abs(self.now) + gains < self.limit:
            self.hold(0.0, way * self.most, TORQUE, "q")

    def along_d(self, pairs: int, way: float, i_q: float) -> None:
        """A d current of both signs, some times.

        By Hall edges the angle of a shaft that slows down is wrong, and a d current then makes a torque that slows it
        more. One that friction would stop has as much q current beside as friction takes, and is accelerated again.
        """
        first, seconds = abs(self.now), ALONG
        if self.blind:
            seconds = min(max(ALONG, ALONG_TURNS * math.tau / max(first, 1.0)), MOST_ALONG)
        slowest, beside = 0.0, 0.0
        if self.blind and 2 * pairs * seconds * self.slows > SLOWED * first:
            slowest, beside = SLOWED * first, way * i_q * self.slows / (self.slows + self.slope)
        for _ in range(pairs):
            if abs(self.now) < slowest:
                self.reach(way, i_q)
            for sign, kind in ((1.0, "d+"), (-1.0, "d-")):
                self.hold(sign * self.most, beside, seconds, kind, slowest)

    def slow_down(self, slow: float, longest: float) -> None:
        """With the outputs off until it is no faster than `slow`, rad/s, electrical; `longest` s at most."""
        seen = [self.look()]
        while _apart(seen) < longest and abs(self.now) > slow:
            seen = [seen[0], self.look()]
        self.slows = abs(_slope(seen))

    @property
    def longest_coast(self) -> float:
        """s, at most."""
        return LONGEST_HELD if self.stand.held else LONGEST_COAST


def speed(window: Window, near: float = 0.0) -> float:
    """rad/s, electrical, in the mean, by the encoder; `near` that, so that samples may be a turn apart."""
    apart = np.diff(np.asarray(window.theta))
    return near + float(np.mean(wrap(apart - near * window.dt))) / window.dt if len(apart) else near


def _apart(seen: list[Look]) -> float:
    """s from the first look to the last."""
    first, last = seen[0].window, seen[-1].window
    return float(last.index[-1] - first.index[-1]) * first.dt


def _slope(seen: list[Look]) -> float:
    """rad/s2, electrical, between them."""
    return (seen[-1].speed - seen[0].speed) / max(_apart(seen), seen[0].window.seconds)


def _voltage(window: Window) -> complex:
    return complex(window.u_dq.mean())


def spin(stand: Stand) -> Spin:
    """Spin it both ways. Raises Refused where it may not be spun, and where it does not get there."""
    turned = stand.turned
    if turned is None or (turned.dragged is None and turned.hall is None):
        raise Refused(
            STEP, "there are neither an encoder nor Hall sensors that the drive could run on: flux, inertia, friction "
            "and edges are not claimed"
        )  # fmt: skip
    if stand.held and turned.dragged is None:
        raise Refused(
            STEP, "not spun: the link does not carry every PWM period, and without an encoder nothing tells the speed "
            "meanwhile: use USB, TCP or a serial link of 3 Mbaud"
        )  # fmt: skip
    if stand.holds < LEAST_HELD:
        raise Refused(
            STEP, f"not spun: the link does not carry every PWM period, and the drive's memory holds {stand.holds:.2g} "
            f"s of them, where {LEAST_HELD:g} s are needed: use USB, TCP or a serial link of 3 Mbaud"
        )  # fmt: skip
    if turned.first:
        raise Refused(STEP, f"not spun, because {turned.first}")
    if not math.isfinite(stand.rpm) or stand.rpm <= 0.0:
        raise Refused(STEP, "nobody has agreed to a speed: name it with --speed R/MIN")
    drive = stand.rig.drive
    if "omega_m_trip" in drive.parameters:
        stand.set(
            omega_m_trip=min(
                drive.parameters["omega_m_trip"] or math.inf,
                (TRIP_BY_EDGES if turned.dragged is None else TRIP) * stand.rpm * RPM,
            )
        )
    made = Spin(stand, turned.n_p or 1, turned.share * SHARE * stand.i_max)
    with stand.running(None):
        i_q = made.first_torque()
    made.slow_down(ENDS * max(made.fastest, TURNS), LONGEST)
    for way in (1.0, -1.0):
        lap, coasted = 0, 0.0
        if way < 0.0:  # a torque the other way feeds the DC link, unless the winding takes all of it
            made.slow_down(stand.R * i_q / made.psi, LONGEST)
        while lap < LAPS or (coasted < COAST and lap < MOST_LAPS):
            i_q, seconds = made.lap(way, i_q, lap)
            coasted += seconds
            lap += 1
    return made


def announcement(agreed: Envelope) -> str:
    """What will be done, within what was agreed to."""
    return (
        f"the shaft turns fast, both ways, up to {WITHIN * agreed.rpm:.0f} r/min or {TOP:.0%} of the voltage, with up "
        f"to {SHARE * agreed.current:.3g} A, and coasts; nothing may be attached to it"
    )

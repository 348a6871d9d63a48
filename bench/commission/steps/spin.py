"""Step 5: the shaft is spun on the encoder, both ways, and coasts with the outputs off.

It accelerates by a q current that takes it to the top within about half a second, at most to the agreed speed and to
the speed that takes a share of the voltage. There a d current flows, one sign after the other, which makes no torque.
Then the outputs go off and it coasts: nothing brakes it, because a DC link without a resistor has no place for its
energy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from bench.commission.refusal import Refused
from bench.commission.stand import Stand
from bench.commission.window import Window
from bench.rig.envelope import Envelope
from bench.signal.position import unwrapped
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
TOP = 0.6
"""Of the linear voltage, that the top speed takes."""
WITHIN = 0.9
"""Of the agreed speed."""
SECONDS = 0.4
"""s to the top, about: harmonics of the back-EMF make currents that brake, which i_q does not show; beside more torque
they count for less."""
OVER_FRICTION = 2.5
"""Times the current that friction takes, at least."""
LONGEST, PATIENCE, LONGEST_COAST = 6.0, 2.5, 4.0
"""s to the top, and with less than all of the current, and of a coast, at most."""
SLOW = 2.0
"""Times SECONDS, after which the next acceleration has more current: what friction takes at speed nobody knew."""
LOOK = 0.02
"""s from look to look."""
AHEAD = 2.0
"""Looks that may pass until a command has ended what the last one saw."""
FIRST_LOOKS = 5
"""Looks at the shaft under each current of the first try."""
ALONG, PAIRS = 0.08, 3
"""s of a d current of each sign, and how many of each."""
HEAVY, TORQUE = 0.3, 0.04
"""Of the largest current to accelerate with, from which a rotor is heavy enough for s of all of it at the top."""
ENDS = 0.12
"""Of the speed at the top, at which a coast ends."""
COAST, LAPS, MOST_LAPS = 2.0, 2, 8
"""s of coasting each way, and laps: a light rotor coasts briefly."""
TRIP = 0.97
"""Times the agreed speed at which the drive itself trips meanwhile: it sees it late, and the host may be gone."""


@dataclass
class Spin:
    """The manoeuvre: what it has taken so far, on a drive whose encoder and pole pairs are known."""

    stand: Stand
    n_p: int
    friction: float
    """A of q current that the shaft takes at the slowest."""
    windows: list[Window] = field(default_factory=list)
    fastest: float = 0.0
    """rad/s, electrical, that was seen."""
    slope: float = 0.0
    """rad/s2, electrical, of the last acceleration,"""
    took: float = 0.0
    """and s that it took."""

    @property
    def most(self) -> float:
        """A, to accelerate with."""
        return SHARE * self.stand.i_max

    @property
    def limit(self) -> float:
        """rad/s, electrical, at which it has to stop accelerating, whatever the voltage is."""
        return WITHIN * self.stand.rpm * RPM * self.n_p

    # -- looks --------------------------------------------------------------------------------------------------

    def look(self) -> Window:
        """The next of it, and how fast it was."""
        seen = self.stand.look(LOOK)
        self.fastest = max(self.fastest, abs(speed(seen)))
        return seen

    def watch(self, seconds: float) -> tuple[list[Window], bool]:
        """Looks for so long, or until it is as fast as it may be, or will be before a command can end it.

        The looks, and whether that was the end. Refused for a shaft that turns against its torque.
        """
        seen = [self.look()]
        while not (top := self.at_the_top(seen)) and _apart(seen) + LOOK < seconds:
            seen.append(self.look())
            i_q = seen[-1].i_ref.imag
            if i_q and speed(seen[-1]) * math.copysign(1.0, i_q) < -0.1 * self.limit:
                raise Refused(STEP, "the shaft turns against its torque: the encoder has slipped, or is wrong")
        return seen, top

    def at_the_top(self, seen: list[Window]) -> bool:
        """Whether it will be as fast as it may be when the next looks have been taken."""
        last = speed(seen[-1])
        gains = abs(last - speed(seen[-2])) if len(seen) > 1 else 0.0
        return abs(_voltage(seen[-1])) > TOP * self.stand.u_linear or abs(last) + AHEAD * gains > self.limit

    # -- commands -----------------------------------------------------------------------------------------------

    def accelerate(self, i_q: float) -> bool:
        """A q current until it is at the top; whether it got there. The window is kept."""
        self.stand.current(0.0, i_q)
        with self.stand.stretch("up") as taken:
            seen, reached = self.watch(LONGEST if abs(i_q) >= self.most else PATIENCE)
            self.stand.current(0.0, 0.0)
        self.slope, self.took = abs(_slope(seen)), _apart(seen)
        self.windows.append(replace(taken.window, i_ref=complex(0.0, i_q)).until(seen[-1]))
        return reached

    def hold(self, i_d: float, i_q: float, seconds: float, kind: str) -> None:
        """A current for so long. The window is kept."""
        self.stand.current(i_d, i_q)
        with self.stand.stretch(kind) as taken:
            self.stand.wait(seconds)
        self.windows.append(taken.window)

    def first_torque(self) -> float:
        """A of q current that takes it to the top in SECONDS: by a small one that grows until the shaft turns."""
        i_q = FIRST * self.most
        for _ in range(TRIES):
            self.stand.current(0.0, i_q)
            seen, top = self.watch(FIRST_LOOKS * LOOK)
            w0, w1 = speed(seen[0]), speed(seen[-1])
            if (w1 > TURNS and w1 - w0 > GROWS * w1) or top:
                break
            i_q = min(i_q * (MORE if w1 < TURNS else SLIGHTLY_MORE), self.most)
        else:
            raise Refused(STEP, "the shaft does not turn on the encoder: a load is attached, or it binds")
        voltage = _voltage(seen[-1])
        slope = max(_slope(seen), 1.0)
        back_emf = max(voltage.imag - self.stand.R * i_q, 0.3 * abs(voltage), 1e-6)
        goal = min(TOP * self.stand.u_linear * w1 / back_emf, self.limit)
        accelerating = max(i_q - self.friction, 0.2 * i_q)
        wanted = accelerating * goal / SECONDS / slope + self.friction
        return float(np.clip(wanted, min(OVER_FRICTION * self.friction + 0.02 * self.most, self.most), self.most))

    def lap(self, way: float, i_q: float, first: bool) -> tuple[float, float]:
        """To the top and down again; the q current that it took, A, and s of the coast."""
        with self.stand.running(STEP, None):
            while not self.accelerate(way * i_q):
                if i_q >= self.most:
                    raise Refused(
                        STEP, f"the shaft does not reach the speed with {self.most:.3g} A within {LONGEST:g} s: a load "
                        "is attached, friction is high, or the encoder has slipped"
                    )  # fmt: skip
                i_q = min(2.0 * i_q, self.most)
            if self.took > SLOW * SECONDS:
                i_q = min(2.0 * i_q, self.most)  # from the next one on
            top = abs(speed(self.windows[-1].last(LOOK)))
            if first:
                self.top(way, i_q)
        return i_q, self.coast(top)

    def top(self, way: float, i_q: float) -> None:
        """A d current of both signs, and a torque for a moment where the rotor is heavy."""
        for _ in range(PAIRS):
            for sign, kind in ((1.0, "d+"), (-1.0, "d-")):
                self.hold(sign * self.most, 0.0, ALONG, kind)
        gains = self.slope * self.most / i_q * (TORQUE + AHEAD * LOOK)
        if i_q > HEAVY * self.most and abs(speed(self.windows[-1].last(LOOK))) + gains < self.limit:
            self.hold(0.0, way * self.most, TORQUE, "q")

    def coast(self, top: float) -> float:
        """Outputs off until it is slow; s that it took."""
        with self.stand.stretch("off") as taken:
            seen = [self.look()]
            while _apart(seen) < LONGEST_COAST and abs(speed(seen[-1])) > ENDS * top:
                seen = [seen[0], self.look()]
        self.windows.append(taken.window)
        return taken.window.seconds


def speed(window: Window) -> float:
    """rad/s, electrical, in the mean."""
    theta = unwrapped(np.asarray(window.theta))
    return float(theta[-1] - theta[0]) / (window.T * max(len(theta) - 1, 1))


def _apart(seen: list[Window]) -> float:
    """s from the first look to the last."""
    return float(seen[-1].index[-1] - seen[0].index[-1]) * seen[0].T


def _slope(seen: list[Window]) -> float:
    """rad/s2, electrical, between them."""
    return (speed(seen[-1]) - speed(seen[0])) / max(_apart(seen), seen[0].seconds)


def _voltage(window: Window) -> complex:
    return complex(window.u_dq.mean())


def spin(stand: Stand) -> Spin:
    """Spin it both ways. Raises Refused where it may not be spun, and where it does not get there."""
    stand.require_every_period(STEP)
    turned = stand.turned
    if turned is None or turned.dragged is None:
        raise Refused(STEP, "without an encoder the shaft is not spun: flux, inertia and friction are not claimed")
    if turned.first:
        raise Refused(STEP, f"not spun, because {turned.first}")
    if not math.isfinite(stand.rpm) or stand.rpm <= 0.0:
        raise Refused(STEP, "nobody has agreed to a speed: name it with --speed R/MIN")
    drive = stand.rig.drive
    if "omega_m_trip" in drive.parameters:
        stand.set(omega_m_trip=min(drive.parameters["omega_m_trip"] or math.inf, TRIP * stand.rpm * RPM))
    made = Spin(stand, turned.dragged.n_p, turned.dragged.share * SHARE * stand.i_max)
    with stand.running(STEP, None):
        i_q = made.first_torque()
    made.coast(max(made.fastest, TURNS))
    made.windows.clear()
    for way in (1.0, -1.0):
        lap, coasted = 0, 0.0
        while lap < LAPS or (coasted < COAST and lap < MOST_LAPS):
            i_q, seconds = made.lap(way, i_q, lap == 0)
            coasted += seconds
            lap += 1
    return made


def announcement(agreed: Envelope) -> str:
    """What will be done, within what was agreed to."""
    return (
        f"the shaft turns fast, both ways, up to {WITHIN * agreed.rpm:.0f} r/min or {TOP:.0%} of the voltage, with up "
        f"to {SHARE * agreed.current:.3g} A, and coasts; nothing may be attached to it"
    )

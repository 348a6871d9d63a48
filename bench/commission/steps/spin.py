"""Step 5: the shaft is spun on the encoder, both ways, and coasts with the outputs off.

It accelerates by a q current that takes it to the top within about a second, at most to the agreed speed and to the
speed that takes a share of the voltage. There a d current flows, one sign after the other, which makes no torque. Then
the outputs go off and it coasts: nothing brakes it, because a DC link without a resistor has no place for its energy.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

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
"""Of the speed, that it gains within a part of a window of the first try: it accelerates."""
TOP = 0.6
"""Of the linear voltage, that the top speed takes."""
WITHIN = 0.9
"""Of the agreed speed."""
SECONDS = 0.8
"""s to the top, about."""
OVER_FRICTION = 2.5
"""Times the current that friction takes, at least."""
LONGEST = 6.0
"""s to the top, and of a coast, at most."""
LOOK = 0.02
"""s from look to look."""
ALONG, PAIRS = 0.08, 3
"""s of a d current of each sign, and how many of each."""
HEAVY, TORQUE = 0.3, 0.04
"""Of the largest current to accelerate with, from which a rotor is heavy enough for s of all of it at the top."""
ENDS = 0.12
"""Of the speed at the top, at which a coast ends."""
COAST, LAPS, MOST_LAPS = 2.0, 2, 8
"""s of coasting each way, and laps: a light rotor coasts briefly."""
TRIP = 1.05
"""Times the agreed speed at which the drive itself trips meanwhile."""


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

    @property
    def most(self) -> float:
        """A, to accelerate with."""
        return SHARE * self.stand.i_max

    @property
    def limit(self) -> float:
        """rad/s, electrical, at which it has to stop accelerating, whatever the voltage is."""
        return WITHIN * self.stand.rpm * RPM * self.n_p

    # -- looks --------------------------------------------------------------------------------------------------

    def look(self, seconds: float = LOOK) -> Window:
        """The next of it, and how fast it was."""
        seen = self.stand.look(seconds)
        self.fastest = max(self.fastest, abs(speed(seen)))
        return seen

    def at_the_top(self, seen: Window) -> bool:
        """Whether it is as fast as it may be."""
        return abs(_voltage(seen)) > TOP * self.stand.u_linear or abs(speed(seen)) > self.limit

    # -- commands -----------------------------------------------------------------------------------------------

    def drive(self, i_d: float, i_q: float, seconds: float, kind: str, until: Callable[[Window], bool]) -> bool:
        """A current for so long, or until a look says so: whether it has. The window is kept."""
        self.stand.current(i_d, i_q)
        began, reached = 0.0, False
        with self.stand.stretch(kind) as taken:
            while began < seconds and not reached:
                seen = self.look(min(LOOK, seconds))
                began += max(seen.seconds, 1e-9)
                reached = until(seen)
                if i_q and speed(seen) * math.copysign(1.0, i_q) < -0.1 * self.limit:
                    raise Refused(STEP, "the shaft turns against its torque: the encoder has slipped, or is wrong")
        self.windows.append(taken.window)
        return reached

    def first_torque(self) -> float:
        """A of q current that takes it to the top in SECONDS: by a small one that grows until the shaft turns."""
        i_q = FIRST * self.most
        for _ in range(TRIES):
            self.stand.current(0.0, i_q)
            before = self.look(2 * LOOK)
            self.stand.wait(LOOK)
            after = self.look(2 * LOOK)
            w0, w1 = speed(before), speed(after)
            if (w1 > TURNS and w1 - w0 > GROWS * w1) or self.at_the_top(after):
                break
            i_q = min(i_q * (MORE if w1 < TURNS else SLIGHTLY_MORE), self.most)
        else:
            raise Refused(STEP, "the shaft does not turn on the encoder: a load is attached, or it binds")
        slope = max((w1 - w0) / (3 * LOOK), 1.0)
        back_emf = max(_voltage(after).imag - self.stand.R * i_q, 0.3 * abs(_voltage(after)), 1e-6)
        goal = min(TOP * self.stand.u_linear * w1 / back_emf, self.limit)
        accelerating = max(i_q - self.friction, 0.2 * i_q)
        wanted = accelerating * goal / SECONDS / slope + self.friction
        return float(np.clip(wanted, min(OVER_FRICTION * self.friction + 0.02 * self.most, self.most), self.most))

    def lap(self, way: float, i_q: float, first: bool) -> tuple[float, float]:
        """To the top and down again; the q current that it took, A, and s of the coast."""
        with self.stand.running(STEP, None):
            while not self.drive(0.0, way * i_q, LONGEST, "up", self.at_the_top):
                if i_q >= self.most:
                    raise Refused(
                        STEP, f"the shaft does not reach the speed with {self.most:.3g} A within {LONGEST:g} s: a load "
                        "is attached, friction is high, or the encoder has slipped"
                    )  # fmt: skip
                i_q = min(2.0 * i_q, self.most)
            top = abs(speed(self.windows[-1].last(LOOK)))
            if first:
                self.top(way, i_q)
        return i_q, self.coast(top)

    def top(self, way: float, i_q: float) -> None:
        """A d current of both signs, and a torque for a moment where the rotor is heavy."""
        never = lambda seen: False  # noqa: E731
        for _ in range(PAIRS):
            for sign, kind in ((1.0, "d+"), (-1.0, "d-")):
                self.drive(sign * self.most, 0.0, ALONG, kind, never)
        if i_q > HEAVY * self.most:
            self.drive(0.0, way * self.most, TORQUE, "q", never)

    def coast(self, top: float) -> float:
        """Outputs off until it is slow; s that it took."""
        with self.stand.stretch("off") as taken:
            seconds = 0.0
            while seconds < LONGEST:
                seen = self.look()
                seconds += max(seen.seconds, 1e-9)
                if abs(speed(seen)) < ENDS * top:
                    break
        self.windows.append(taken.window)
        return seconds


def speed(window: Window) -> float:
    """rad/s, electrical, in the mean."""
    theta = unwrapped(np.asarray(window.theta))
    return float(theta[-1] - theta[0]) / (window.T * max(len(theta) - 1, 1))


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

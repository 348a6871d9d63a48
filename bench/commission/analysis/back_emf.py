"""The rotor's angle and flux without a sensor of position, by the voltage behind R and L_q at speed.

What is left of the voltage when R i and L_q di/dt are taken from it turns with the rotor whatever L_d is: its size is
the speed times psi + (L_d - L_q) i_d, and it is a quarter turn ahead of the flux. Its own phase, a parabola in time
over some turns, is the angle. A voltage along a d current, of dead time or of a wrong R, turns it one way with +I and
the other way with -I: the mean of both is the angle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.commission.analysis.flux import ALONG_D, LEAST_PARTS, SETTLE, STEP, ripple_delay
from bench.commission.analysis.stretches import merged, parts
from bench.commission.least_squares import fit
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.window import Complexes, Floats, Window
from bench.signal.position import unwrapped

FLOOR = 1.5e-3
"""Of psi, sd: drift of the current sensors, and harmonics beside dead time."""
DEAD_TIME_LEFT = 8e-3
"""Of the volts that dead time takes, sd: what its compensation leaves across the current. It does not grow with the
speed: of a slow shaft it is a larger share of the back-EMF."""
CLEAR = 0.9
"""Of the rms of the voltage, that its mean along its own phase must be: else another thing than the rotor turns it."""
STEADY = 0.2
"""Of the commanded current, by which the mean of a part's second half may differ from that of the first: an angle by
Hall edges differs from sector to sector."""
UNKNOWN_LATE = Quantity("current_delay", "s", 0.5e-6, {"not measured": 0.6e-6})
"""By which a drive may sample its currents late, where nothing is known of it: 0 to 1.5 us."""
TURNS = 0.8
"""Electrical turns in a part at least: with fewer a voltage that stands is not told from one that turns."""


@dataclass(frozen=True)
class Rotation:
    """A part of a window in which the rotor turned, by its back-EMF."""

    first: float
    """PWM period of the middle of the part,"""
    half: float
    """and periods from there to its ends."""
    phase: Floats
    """rad, the coefficients of the phase's parabola, highest first, over -1 to 1."""
    w: float
    """rad/s, electrical, in the mean; below 0 in reverse."""
    shrink: float
    """sin x / x of half the angle of a PWM period."""
    size: float
    """V, of the voltage along its phase."""
    i: complex
    """A: i_d + j i_q in the mean, by that phase."""
    ahead: float
    """rad per rad/s, by which that phase is ahead of the rotor."""
    along: bool
    """Whether the current was commanded along the flux; else against it."""

    def theta(self, index: Floats) -> Floats:
        """rad, electrical, not wrapped: of the rotor flux at these PWM periods."""
        phase = np.polyval(self.phase, (index - self.first) / self.half)
        return np.asarray(phase - math.copysign(0.5 * math.pi, self.w) - self.ahead * self.w)

    def speed(self, index: Floats) -> Floats:
        """rad/s per s of PWM period counted as one: rad a PWM period at these."""
        slope = np.polyval(np.polyder(self.phase), (index - self.first) / self.half) / self.half
        return np.asarray(slope)

    def holds(self, index: Floats) -> Floats:
        """Which of these PWM periods lie within the part."""
        return np.asarray(np.abs(index - self.first) <= self.half)


def rotations(windows: Sequence[Window], R: float, L_q: float) -> Iterator[Rotation]:
    """The parts of windows of the kinds "d+" and "d-" in which a clear voltage turned; ohm and H."""
    for window in merged(windows):
        if window.kind not in ALONG_D:
            continue
        begin = round(SETTLE / window.T)
        current, u = window.current[begin:], window.u[begin:]
        if len(current) < 3:
            continue
        middle = 0.5 * (current[1:] + current[:-1])
        v = u[1:] - R * middle - L_q * np.diff(current) / window.T
        phase, ahead = unwrapped(np.angle(v)), ripple_delay(R, L_q, window.T)
        for part in parts(phase, window.T):
            at = window.index[0] + begin + part.start
            found = _rotation(v[part], middle[part], phase[part], window, at, ahead)
            if found is not None:
                yield found


def _rotation(v: Complexes, i: Complexes, phase: Floats, window: Window, at: float, ahead: float) -> Rotation | None:
    n = len(v)
    if abs(phase[-1] - phase[0]) < TURNS * math.tau:
        return None
    x = np.linspace(-1.0, 1.0, n)
    for _ in range(2):  # the second time about what noise made of the first
        curve = np.polyfit(x, phase, 2)
        along = v * np.exp(-1j * np.polyval(curve, x))
        phase = np.polyval(curve, x) + np.angle(along)
    mean = along.mean()
    if mean.real < CLEAR * math.sqrt(float(np.mean(np.abs(v) ** 2))):
        return None
    half = 0.5 * (n - 1)
    w = float(curve[1]) / (half * window.T)
    frame = np.exp(-1j * (np.polyval(curve, x) - math.copysign(0.5 * math.pi, w)))
    i_dq = i * frame
    if abs(i_dq[: n // 2].mean() - i_dq[n // 2 :].mean()) > STEADY * abs(window.i_ref):
        return None
    shrink = float(np.sinc(0.5 * w * window.T / math.pi))
    middle = at + 0.5 + half  # the first voltage lies between the samples `at` and `at` + 1
    return Rotation(middle, half, curve, w, shrink, float(mean.real), complex(i_dq.mean()), ahead, window.kind == "d+")


def flux_by_back_emf(
    windows: Sequence[Window], R: Quantity, L_q: Quantity, late: Quantity = UNKNOWN_LATE, U_dead: float = 0.0
) -> Quantity:
    """Psi, V s, of windows of the kinds "d+" and "d-" at speed, without a sensor of position.

    `late`, s: by which currents are sampled late, which nothing tells here; R late / L_q of psi hangs on it. `U_dead`,
    V, that dead time takes of a phase. Refused where a clear voltage turned in too few of them.
    """
    found = list(rotations(windows, R.value, L_q.value))
    if found:
        fastest = max(abs(each.w) for each in found)
        found = [each for each in found if abs(each.w) > 0.2 * fastest]
    plus = sum(each.along for each in found)
    if min(plus, len(found) - plus) < LEAST_PARTS:
        raise Refused(
            STEP,
            f"a voltage that turns with the rotor was clear in {plus} parts with a current along the flux and in "
            f"{len(found) - plus} against it, {LEAST_PARTS} of each are needed: turn it faster, or longer",
        )
    ws = np.array([abs(each.w) * each.shrink for each in found])
    i_d = np.array([each.i.real for each in found])
    told = fit(np.stack([ws, ws * i_d], 1), np.array([each.size for each in found]))
    by = R.value / L_q.value
    value = float(told.x[0]) / (1.0 + by * late.value)
    noise = float(told.sd[0]) * told.inflation()
    i_q, left = float(np.mean([abs(each.i.imag) for each in found])), DEAD_TIME_LEFT * U_dead
    by_cause = {"noise": noise, "R": R.sd * i_q / float(ws.mean()), "dead time": left / float(ws.mean())}
    by_cause |= {"late currents": by * late.sd * value, "method": FLOOR * value}
    return Quantity("psi_f", "V s", value, by_cause, 1.0)

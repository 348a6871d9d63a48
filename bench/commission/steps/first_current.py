"""Step 1: the first current. Nothing is known, so a voltage grows in small steps at a made angle until a current flows.

At three angles, so that each phase has been the one with all of the current: what carries none, or flows elsewhere, is
named. Two settled levels give a rough resistance, a square wave beside one a rough inductance, and both the gains of a
slow current loop, which the other steps use.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.commission.outcome import Evidence, Outcome, Panel
from bench.commission.quantity import Quantity
from bench.commission.refusal import Refused
from bench.commission.stand import Stand
from bench.commission.window import Floats, Window, clarke
from bench.rig.envelope import Envelope

STEP = "first-current"
ANGLES = (0.0, 2.0 * math.pi / 3.0, -2.0 * math.pi / 3.0)
ENOUGH = 0.3
"""Share of the agreed current with which this step measures."""
TOO_MUCH = 0.6
"""Share of it that ends it, whatever its direction."""
SMALL, SMALLER = 0.003, 0.001
"""Steps of the voltage as shares of the DC link's, before a current flows and after."""
SOME = 0.1
"""Share of the agreed current that counts as one."""
HIGHEST = 0.95
"""Share of the linear voltage up to which a current is looked for."""
PAUSE = 6e-3
"""s from step to step."""
NOTHING = 0.2
"""Share of the largest phase current below which a phase carries none."""
ASTRAY = math.radians(35.0)
"""By which a current may flow in another direction than the voltage."""
SUM = 0.2
"""Share of the largest phase current that the sum of the three may be."""
HALF = 2
"""PWM periods of half a cycle of the square wave."""
RIPPLE, STEEP = 0.08, 0.25
"""Its swing as a share of the agreed current, and its largest amplitude as one of the linear voltage."""
FAST = 250.0
"""Hz of the current loop with the rough figures, at most."""


@dataclass(frozen=True)
class Level:
    """A settled current at an angle (electrical rad): the voltage that was given, V, and the phase currents, A."""

    angle: float
    u: float
    i: Floats
    """A, shape (3,)."""

    @property
    def vector(self) -> complex:
        """A, in the frame of the angle."""
        return complex(clarke(self.i) * np.exp(-1j * self.angle))


def level(window: Window, angle: float, u: float) -> Level:
    """The mean of a window."""
    return Level(angle, u, window.i.mean(axis=1))


def missing_phase(levels: Sequence[Level]) -> str:
    """The phase that carries nothing at any angle where a current flows; empty where each carries some."""
    sizes = np.array([np.abs(each.i) / np.abs(each.i).max() for each in levels])
    least = int(np.argmin(sizes.max(axis=0))) if len(sizes) else 0
    return "abc"[least] if len(sizes) and sizes[:, least].max() < NOTHING else ""


def check_level(found: Level) -> None:
    """Raise Refused for a current that is not where the voltage points."""
    where = f"with the voltage at {math.degrees(found.angle):.0f} deg"
    largest = float(np.abs(found.i).max())
    if abs(float(found.i.sum())) > SUM * largest:
        told = ", ".join(f"{x:.3g}" for x in found.i)
        raise Refused(
            STEP, f"{where} the three currents are {told} A, and their sum is not 0: a current sensor is dead or "
            "reversed, or a phase has a connection to the frame"
        )  # fmt: skip
    off = math.atan2(found.vector.imag, found.vector.real)
    if abs(off) > ASTRAY:
        raise Refused(
            STEP, f"{where} the current flows {math.degrees(off):+.0f} deg from it: current sensors and phases are not "
            "in the same order, or one sensor is reversed"
        )  # fmt: skip


def rough_resistance(pairs: Sequence[tuple[Level, Level]]) -> Floats:
    """Ohm, shape (n,): from two settled levels each, so that the dead time goes out."""
    slopes = [(high.u - low.u) / max(high.vector.real - low.vector.real, 1e-9) for high, low in pairs]
    return np.array(slopes)


def swing(window: Window, half: int) -> float:
    """A, peak to peak, of the d current under a square wave of `half` + `half` periods, mean of all cycles."""
    begins = np.flatnonzero(window.cycle)
    if not len(begins):
        raise Refused(STEP, "the drive marked no cycle of its test signal (bit 7 of status)")
    place = (np.arange(len(window)) - begins[0]) % (2 * half)
    later = np.arange(len(window)) >= begins[0] + 10 * half
    i = window.dq.real
    means = [float(i[later & (place == k)].mean()) for k in range(2 * half)]
    return max(means) - min(means)


def perform(stand: Stand) -> Outcome:
    """Find the first current, rough R and L, and set the current loop by them."""
    stand.know_nothing()
    stand.allow_voltage(stand.u_linear)
    steps: list[tuple[float, float, float]] = []  # angle, voltage, current
    pairs: list[tuple[Level, Level]] = []
    with stand.running():
        dead = [angle for angle in ANGLES if not _look(stand, angle, pairs, steps)]
    highs = [high for high, _ in pairs]
    if not highs:
        most = HIGHEST * stand.u_linear
        raise Refused(STEP, f"no current at any angle up to {most:.3g} V: no motor is connected, or its bridge is off")
    if phase := missing_phase(highs):
        raise Refused(STEP, f"phase {phase} carries no current: its wire, its winding or its half bridge is open")
    if dead:
        raise Refused(STEP, f"no current with the voltage at {math.degrees(dead[0]):.0f} deg: a phase is open")
    for each in highs:
        check_level(each)
    R_each = rough_resistance(pairs)
    R = float(np.median(R_each))
    with stand.running():
        L, ripple = _rough_inductance(stand, highs[0].u, R)
    bandwidth = min(FAST, 0.5 * stand.u_linear / (2.0 * math.pi * L * stand.i_max))
    stand.set(R_s_hat=R, L_s_hat=L, bw_current=bandwidth)
    stand.R, stand.L = R, L
    stand.allow_voltage(min(stand.u_linear, 0.35 * stand.u_linear + 2.0 * R * stand.i_max))
    curves = {
        f"at {math.degrees(angle):.0f} deg": (
            np.array([u for at, u, _ in steps if at == angle]),
            np.array([i for at, _, i in steps if at == angle]),
        )
        for angle in ANGLES
    }
    spread = float(R_each.std(ddof=1))
    found = (
        Quantity("R_rough", "Ω", R, {"method": max(spread, 0.1 * R)}, volts=1.0, amperes=-1.0),
        Quantity("L_rough", "H", L, {"method": 0.2 * L}, volts=1.0, amperes=-1.0),
    )
    figures = {"ripple": ripple, "bw_current": bandwidth, "R_spread": spread}
    panel = Panel("voltage", "V", "current along it", "A", curves)
    return Outcome(found, Evidence("The first current, at three angles", (panel,), figures))


def _look(
    stand: Stand, angle: float, pairs: list[tuple[Level, Level]], steps: list[tuple[float, float, float]]
) -> bool:
    """Whether a current flows at this angle; its two settled levels and the way to them are appended."""
    stand.turn_to(angle)
    u, flows = 0.0, False
    while True:
        u += (SMALLER if flows else SMALL) * stand.u_dc
        if u > HIGHEST * stand.u_linear:
            stand.voltage(0.0)
            return False
        stand.voltage(u)
        window = stand.look(PAUSE)
        now = complex(window.dq[len(window) // 2 :].mean())
        steps.append((angle, u, now.real))
        flows = flows or abs(now) > SOME * stand.i_max
        if now.real > ENOUGH * stand.i_max or abs(now) > TOO_MUCH * stand.i_max:
            break
        if abs(now) > ENOUGH * stand.i_max and now.real < 0.5 * abs(now):
            check_level(level(window, angle, u))
    stand.wait(0.3)  # the rotor swings into place, and its back-EMF with it
    high = level(stand.look(0.15), angle, u)
    stand.voltage(0.8 * u)
    stand.wait(0.15)
    low = level(stand.look(0.1), angle, 0.8 * u)
    stand.voltage(0.0)
    stand.wait(0.02)
    pairs.append((high, low))
    return True


def _rough_inductance(stand: Stand, u: float, R: float) -> tuple[float, float]:
    """H, and the swing in A that it is from: a square wave on u_d beside the voltage that holds the current."""
    for share in np.linspace(0.2, 1.0, 9):
        stand.voltage(float(share) * u)
        stand.wait(0.01)
    stand.wait(0.3)
    amplitude = 0.01 * stand.u_dc
    while True:
        with stand.square("u_d", amplitude, HALF):
            ripple = swing(stand.run(0.05, "forced"), HALF)
        if ripple > RIPPLE * stand.i_max or amplitude > STEEP * stand.u_linear:
            break
        amplitude *= 1.5
    stand.voltage(0.0)
    stand.wait(0.01)
    if ripple < 3.0 * stand.noise / math.sqrt(100.0):
        raise Refused(STEP, f"a test voltage of {amplitude:.3g} V moves the current by {ripple:.2g} A only")
    return amplitude * HALF * stand.T / ripple, ripple


def announcement(agreed: Envelope) -> str:
    """What will be done, within what was agreed to."""
    return (
        f"a voltage in small steps at three angles until {ENOUGH * agreed.current:.3g} A flow; the shaft jumps into "
        "place each time, by less than an electrical revolution"
    )

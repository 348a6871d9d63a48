"""The scripted show on the simulated drive: manoeuvres of the paper with the average speed, then with the observer.

It is a motion profile like those that people write: it says what is asked for and when, never how.
"""

from __future__ import annotations

from bench.motion.profile import LOAD_CURRENT, SPEED, Profile, Step
from bench.signal.units import RPM
from protocol.signals import AngleSource

AVERAGE, TRACKING = AngleSource.AVERAGE_SPEED, AngleSource.VECTOR_TRACKING

SLOW = 500.0 * RPM / 330.0
"""The show's lower speed, as a share of the largest: 500 r/min of the paper's motor. The other is twice that."""


def show(omega_m_max: float, i_max: float) -> Profile:
    """The show for a drive with these limits, rad/s and A; for the paper's at 500 and 1000 r/min, with 4 A."""
    slow, amperes = float(f"{SLOW * omega_m_max / RPM:.2g}"), float(f"{0.5 * i_max:.2g}")
    fast = 2.0 * slow
    return Profile((
        _step(f"start-up to {slow:g} r/min, average speed", slow, 0.0, AVERAGE),
        _step(f"step to {fast:g} r/min, average speed", fast, 0.0, AVERAGE),
        _step(f"load step to {amperes:g} A, average speed", fast, amperes, AVERAGE),
        _step(f"switch to vector tracking, {amperes:g} A", fast, amperes, TRACKING),
        _step(f"step to {slow:g} r/min, vector tracking", slow, amperes, TRACKING),
        _step("load off, vector tracking", slow, 0.0, TRACKING),
    ))  # fmt: skip


def _step(name: str, speed_rpm: float, load_a: float, source: AngleSource) -> Step:
    return Step(name, 3.0, {SPEED: speed_rpm, LOAD_CURRENT: load_a}, sets={"observer": float(source)}, title=name)

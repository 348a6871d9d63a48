"""The least motor that turns: first-order speed, an angle, Hall sensors, currents that fit. No physics beyond that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi, tau

import numpy as np

from tests.devices.spec import HALL_CODES, Mode

U_DC = 24.0  # V
R_S, L_S, PSI = 0.5, 0.001, 0.01  # ohm, H, V s
RESPONSE = 0.03  # s, of the speed to its setpoint
COASTING = 0.2  # s, of the speed once the outputs are off
FRICTION = 0.2, 0.002  # A; A per mechanical rad/s
INERTIA = 0.004  # A per mechanical rad/s²
ENCODER = 4096  # counts in a turn of the shaft
SIXTH = pi / 3


@dataclass
class Samples:
    """One value for each PWM period of `period` s; SI units, electrical where not said otherwise."""

    period: float
    tick: np.ndarray
    index: np.ndarray
    theta: np.ndarray  # unwrapped, as the Hall sensors have it
    omega: np.ndarray
    omega_ref: np.ndarray
    i_dq: np.ndarray  # complex: i_d + j i_q
    hall: np.ndarray
    status: np.ndarray
    theta_enc: np.ndarray
    omega_enc: np.ndarray
    estimate: np.ndarray
    u_dc: np.ndarray

    @property
    def current(self) -> np.ndarray:
        """Complex, in the frame of the stator."""
        return self.i_dq * np.exp(1j * self.theta)

    @property
    def voltage(self) -> np.ndarray:
        """In the period before, complex, in the frame of the stator; 0 where no current flows: the outputs are off."""
        turning = (R_S + 1j * self.omega * L_S) * self.i_dq + 1j * self.omega * PSI
        return np.where(self.i_dq == 0, 0, turning * np.exp(1j * (self.theta - self.omega * self.period / 2)))


@dataclass(frozen=True)
class Edge:
    """A Hall edge; `tick` is when it came."""

    tick: int
    before: int
    after: int
    encoder: int


def phases(current: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Phase currents of a complex one, peak-valued."""
    turn = np.exp(1j * tau / 3)
    return current.real, (current / turn).real, (current * turn).real


def hall_code(sector: int) -> int:
    """Of the sector-th sixth of an electrical turn, counted on beyond a turn and below zero."""
    return HALL_CODES[sector % 6]


class Motor:
    """`setpoint` None: the outputs are off."""

    def __init__(self, pole_pairs: int) -> None:
        self.pole_pairs = pole_pairs
        self.setpoint: tuple[Mode, float] | None = None
        self.jammed = False
        """The rotor does not turn, whatever flows."""
        self.speed = 0.0  # mechanical rad/s
        self.fastest = 0.0
        """Largest mechanical speed so far, with its sign."""
        self.theta = 0.5  # electrical rad, not wrapped
        self.i_q = 0.0

    def advance(self, seconds: float, i_max: float) -> None:
        """One PWM period further."""
        static, viscous = FRICTION
        if self.setpoint is None:
            self.i_q = 0.0
            self.speed -= self.speed * seconds / COASTING
        else:
            mode, value = self.setpoint
            drag = static * np.sign(self.speed) + viscous * self.speed
            wanted = value if mode == Mode.CURRENT else drag + INERTIA * (value - self.speed) / RESPONSE
            self.i_q = min(max(wanted, -i_max), i_max)
            self.speed += (self.i_q - drag) / INERTIA * seconds
            if self.jammed:
                self.speed = 0.0
                self.i_q = float(np.copysign(i_max, value)) if value else 0.0
        self.fastest = max(self.fastest, self.speed, key=abs)
        self.theta += self.pole_pairs * self.speed * seconds


def edges_between(
    tick0: int, theta0: float, tick1: int, theta1: float, pole_pairs: int, code: Callable[[int], int]
) -> list[Edge]:
    """The Hall edges on the way, evenly turned; `code`: of a sector."""
    first, last = int(theta0 // SIXTH), int(theta1 // SIXTH)
    step = 1 if last > first else -1
    found = []
    for sector in range(first, last, step):
        border = (sector + (step > 0)) * SIXTH
        tick = tick0 + max(1, round((tick1 - tick0) * (border - theta0) / (theta1 - theta0)))  # after that of a sample
        count = int(border / pole_pairs / tau * ENCODER) & 0xFFFF
        found.append(Edge(tick, code(sector), code(sector + step), count))
    return found

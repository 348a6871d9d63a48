"""What the errors of the observers should be at constant speed, computed from the sensors' edges and the gains alone.

Beside the measured figures these tell whether an error is understood. Angles are in electrical degrees unless said; an
electrical turn is sampled at `N` points, which are points in time as well. No observer is run here.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
N = 6 * 720
SECTOR = 60.0
ORDERS = 40  # harmonics that are taken into account


class Turn:
    """An electrical turn at constant speed over edges that lie `delta` (6,) before where ideal ones would."""

    def __init__(self, delta: list[float]) -> None:
        opens = SECTOR * np.arange(7) - np.array([*delta, delta[0]])
        self.theta = opens[0] + 360.0 * (np.arange(N) + 0.5) / N
        self.sector = np.searchsorted(opens, self.theta, side="right") - 1
        self.since = self.theta - opens[self.sector]
        self.widths = np.diff(opens)
        passed = np.roll(self.widths, 1)[self.sector]
        self.speed = np.minimum(SECTOR / passed, SECTOR / self.since)
        """omega_h by omega: an overdue edge bounds it."""

    @property
    def average_speed(self) -> F64:
        """Error of (1)-(2)."""
        passed = np.roll(self.widths, 1)[self.sector]
        error: F64 = self.theta - SECTOR * self.sector - np.minimum(self.since * SECTOR / passed, SECTOR)
        return error

    @property
    def sector_centre(self) -> F64:
        """Error of the centre of the ideal sector."""
        error: F64 = self.theta - SECTOR * self.sector - 0.5 * SECTOR
        return error

    def vector_tracking(self, omega: float, k_p: float, k_i: float, tau: float) -> tuple[F64, F64]:
        """Error at `omega` rad/s by the ripple of omega_h: what its feed-forward brings, and that with (6) as well.

        The feed-forward passes the high-pass of (11). The inverse of (6)'s filter, whose time constant is `tau` s,
        turns the back-EMF by an angle that goes with omega_h; that passes the low-pass.
        """
        x = tau * omega
        turned = x / (1.0 + x * x)

        def high_pass(s: complex) -> complex:
            return s * s / (s * s + k_p * s + k_i)

        fed = self._filtered(self.speed, omega, lambda s: omega / s * high_pass(s))
        by_filter = self._filtered(self.speed, omega, lambda s: turned * (1.0 - high_pass(s)))
        return -np.degrees(fed), -np.degrees(fed + by_filter)

    def hall_vector(self, omega: float, bandwidth: float, decoupled: bool = False) -> F64:
        """Error of a loop with three poles at `bandwidth` Hz on the Hall vector, linear, its current constant."""
        w = 2.0 * math.pi * bandwidth
        x = np.radians(self.theta)
        seen = -math.pi / 3.0 * np.sin(np.radians(self.sector_centre))
        if decoupled:
            seen = seen - (1 / 5 + 1 / 7) * np.sin(6 * x) - (1 / 11 + 1 / 13) * np.sin(12 * x)

        def closed(s: complex) -> complex:
            return (3.0 * w * s * s + 3.0 * w * w * s + w**3) / (s + w) ** 3

        error: F64 = -math.degrees(1.0) * (seen.mean() + self._filtered(seen, omega, closed))
        return error

    def programmable_filter(self, omega: float, bandwidth: float, T_s: float) -> F64:
        """Error of three stages tuned to omega_h behind its low-pass at `bandwidth` Hz.

        A stage 1 / (1 + j x), x the tangent of its lag, answers to a share d of wrong tuning with j x d / (1 + j x),
        part of it a gain, part of it a lead. A ripple of n omega comes through a stage as that answers to
        (1 + n) omega.
        """
        w = 2.0 * math.pi * bandwidth
        x = math.tan((0.5 * math.pi - 0.5 * omega * T_s) / 3.0)

        def stages(n: float) -> complex:
            h = (1.0 + 1j * x) / (1.0 + 1j * x * (1.0 + n))
            return 1j * x / (1.0 + 1j * x) * (h + h * h + h**3)

        def lead(s: complex) -> complex:
            n = s.imag / omega
            return w / (s + w) * (stages(n) - stages(-n).conjugate()) / 2j

        wrong = (self.speed.mean() - 1.0) * stages(0.0).imag + self._filtered(self.speed, omega, lead)
        error: F64 = -np.degrees(wrong)
        return error

    def _filtered(self, values: F64, omega: float, response: Callable[[complex], complex]) -> F64:
        """What a filter makes of a period of `values`, without their mean."""
        spectrum = np.fft.rfft(values) / N
        out = np.zeros(N)
        phase = 2.0 * math.pi * np.arange(N) / N
        for n in range(1, ORDERS + 1):
            out += 2.0 * np.real(spectrum[n] * response(1j * n * omega) * np.exp(1j * n * phase))
        return out


def lookup_table(jitter: float, count: float) -> float:
    """Standard deviation with a right table: edges that jitter by `jitter` rms, beside an encoder of `count` a count.

    At the share x of a sector the error is (1 + x) times the jitter of the last edge less x times that of the one
    before.
    """
    return math.sqrt(jitter**2 * (7.0 / 3.0 + 1.0 / 3.0) + count**2 / 12.0)


def after_acceleration(a: float, omega: float) -> float:
    """Error at the end of a sector that takes its speed from the one before, `a` rad/s2 after a constant `omega` rad/s.

    With T the sector's time the speed is that of T / 2 before its start: a T^2 / 2 by this, and as much by the sector.
    """
    return math.degrees(a * (math.radians(SECTOR) / omega) ** 2)


def after_load_step(a: float, bandwidth: float) -> float:
    """Largest error of three poles at `bandwidth` Hz after an unknown acceleration `a` rad/s2: a t^2 / 2 e^{-w t}."""
    return math.degrees(2.0 * math.exp(-2.0) * a / (2.0 * math.pi * bandwidth) ** 2)


def dead_time(omega: float, amperes: float, volts: float, i_smooth: float, flux: float, k_p: float, k_i: float) -> F64:
    """Error of (3)-(10) at `omega` rad/s by a phase voltage that follows the currents' signs, of `volts` at most.

    The currents, of `amperes`, lie along q; below `i_smooth` A the voltage shrinks. Its d component turns the back-EMF,
    of `flux` V s times omega.
    """
    x = 2.0 * math.pi * np.arange(N) / N
    currents = [-amperes * np.sin(x - phase * 2.0 * math.pi / 3.0) for phase in range(3)]
    v = [volts * np.clip(i / i_smooth, -1.0, 1.0) for i in currents]
    alpha, beta = (2.0 * v[0] - v[1] - v[2]) / 3.0, (v[1] - v[2]) / math.sqrt(3.0)
    across = np.fft.rfft((alpha * np.cos(x) + beta * np.sin(x)) / (flux * omega))
    s = 1j * omega * np.arange(len(across))
    passed = np.fft.irfft(across * (k_p * s + k_i) / (s * s + k_p * s + k_i), N)
    return np.degrees(passed)

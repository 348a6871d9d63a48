"""A motor in its own equations, solved by scipy, and what a drive would stream of it: no part of the simulated drive.

A PI controller holds a current in the frame of an encoder that is off; the shaft has friction of its own for each way,
and may cog. Voltages are integrated over each PWM period, currents sampled with noise, and late, if asked for.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from bench.commission.analysis.flux import Flux
from bench.commission.least_squares import Fit
from bench.commission.quantity import Quantity
from bench.commission.window import Edges, Window, no_edges

CODES = (1, 3, 2, 6, 4, 5)
"""Of sectors I to VI (SPEC, chapter 12)."""
NODES, WEIGHTS = (0.5 * (np.polynomial.legendre.leggauss(3)[0] + 1.0), 0.5 * np.polynomial.legendre.leggauss(3)[1])


@dataclass(frozen=True)
class Motor:
    """SI units; friction in N m of the shaft."""

    n_p: int
    R: float
    L_d: float
    L_q: float
    psi: float
    J: float
    b: float
    up: float
    """Dry friction forward,"""
    down: float
    """and in reverse."""
    cogging: float = 0.0
    cogging_order: int = 12
    R_fe: float = math.inf
    """ohm, of iron loss, beside the voltage of the flux."""
    harmonic: float = 0.0
    """Share of the flux that swings six times a turn."""
    stribeck: float = 0.0
    """Share of dry friction that is there at rest besides, and gone at a few percent of the speed."""

    def shaft(self, omega_m: float, theta_m: float) -> float:
        """N m that hold the shaft back."""
        dry = (self.up if omega_m > 0.0 else -self.down) * math.tanh(abs(omega_m) * 50.0)
        dry *= 1.0 + self.stribeck * math.exp(-((omega_m / 5.0) ** 2))
        return self.b * omega_m + dry + self.cogging * math.sin(self.cogging_order * theta_m)

    def flux(self, i: Any, theta: Any) -> Any:
        """V s, in the rotor's frame."""
        own = self.psi + self.L_d * i.real + 1j * self.L_q * i.imag
        if not self.harmonic:
            return own
        return own + self.psi * self.harmonic * (np.cos(6.0 * theta) + 0.5j * np.sin(6.0 * theta))


@dataclass(frozen=True)
class Drive:
    """What the drive makes of it."""

    T: float
    noise: float = 0.0
    """A rms of each phase."""
    U: float = 0.0
    """V that dead time takes of each phase, against its current."""
    late: float = 0.0
    """s, by which currents are sampled late, while no voltage lies on the winding."""
    ahead: float = 0.0
    """rad, electrical, by which the encoder's angle is ahead."""
    encoder_delay: float = 0.0
    counts: int = 14400
    eccentric: float = 0.0
    """rad of the shaft: once in a turn of the encoder."""
    places: np.ndarray = field(default_factory=lambda: np.zeros((6, 1)))
    """(6, n_p) rad: places of the edges less their ideal ones."""
    ring: float = 0.0
    hysteresis: float = 0.0
    hall_delay: float = 0.0
    jitter: float = 0.0
    """rad rms of single edges."""
    wiring: Callable[[int], int] = lambda code: code


@dataclass
class Bench:
    """A motor on a drive; it keeps its angle and speed, and counts PWM periods."""

    motor: Motor
    drive: Drive
    rng: np.random.Generator
    theta: float = 0.0
    """rad, electrical."""
    w: float = 0.0
    period: int = 0

    def hold(self, kind: str, i_ref: complex, seconds: float, until: float = 0.0, settled: bool = False) -> Window:
        """The current i_ref, A, in the encoder's frame, for so long, or until a speed in rad/s, electrical.

        It comes up as the controller lets it, or is there from the beginning on.
        """
        m, T = self.motor, self.drive.T
        bw = math.tau * 250.0
        k_d, k_q, k_i = bw * m.L_d, bw * m.L_q, bw * m.R

        def law(i: Any, w: Any, theta: Any, integral: Any, exp: Any) -> tuple[Any, Any, Any]:
            back = exp(-1j * (self.drive.ahead - self.drive.encoder_delay * w))
            seen = self._terminal(i, w, theta)
            wrong = i_ref - seen * back
            u = (k_d * wrong.real + 1j * k_q * wrong.imag + integral) / back
            return u + 1j * w * (m.psi + m.L_d * i.real + 1j * m.L_q * i.imag), wrong, seen

        def rate(_: float, y: np.ndarray) -> list[float]:
            i_d, i_q, w, theta, of_d, of_q = y.tolist()
            i = complex(i_d, i_q)
            u, wrong, seen = law(i, w, theta, complex(of_d, of_q), cmath.exp)
            flux, turn = m.flux(i, theta), self._turn(theta)
            v = u - m.R * seen - 1j * w * flux - w * turn
            torque = 1.5 * m.n_p * ((flux.conjugate() * i).imag + (turn.conjugate() * i).real)
            accelerates = m.n_p / m.J * (torque - m.shaft(w / m.n_p, theta / m.n_p))
            return [v.real / m.L_d, v.imag / m.L_q, accelerates, w, k_i * wrong.real, k_i * wrong.imag]

        def reached(_: float, y: np.ndarray) -> float:
            return abs(y[2]) - until

        reached.terminal = True  # type: ignore[attr-defined]
        first = i_ref * cmath.exp(1j * self.drive.ahead) if settled else 0j
        begin = (first.real, first.imag)
        events = reached if until else None
        found = solve_ivp(
            rate, (0.0, seconds), [*begin, self.w, self.theta, m.R * i_ref.real, m.R * i_ref.imag], method="LSODA",
            dense_output=True, rtol=1e-7, atol=1e-9, events=events,
        )  # fmt: skip
        n = int(found.t[-1] / T)
        t = np.arange(n) * T
        y = found.sol(t)
        u = np.zeros(n, complex)
        lost, moment = np.zeros(n, complex), np.zeros(n, complex)
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            at = found.sol(np.clip(t + (node - 1.0) * T, 0.0, None))
            turn = np.exp(1j * at[3])
            voltage, _, current = law(at[0] + 1j * at[1], at[2], at[3], at[4] + 1j * at[5], np.exp)
            u += weight * turn * voltage
            moment += weight * (1.0 - node) * turn * voltage
            lost += weight * _signs(turn * current)
        # the drive holds the mean over the period: the current then lies beside its smooth course, and R takes of that
        middle = np.exp(1j * (y[3] - 0.5 * T * y[2]))
        beside = T * (0.5 * u - moment) / middle
        u += m.R * middle * (beside.real / m.L_d + 1j * beside.imag / m.L_q)
        i = self._terminal(y[0] + 1j * y[1], y[2], y[3])
        sampled = i + self.drive.late * self._without_voltage(i, y[2])
        return self._window(kind, i_ref, y[3], y[2], sampled * np.exp(1j * y[3]), u + self.drive.U * lost)

    def turned_by(self, i_ref: complex, seconds: float, until: float) -> Window:
        """Like "up" of `hold`, with a current that an ideal controller holds; without voltages."""
        m, d = self.motor, self.drive

        def current(w: Any, exp: Any) -> Any:
            return i_ref * exp(1j * (d.ahead - d.encoder_delay * w)) - 1j * w * m.psi / m.R_fe

        def rate(_: float, y: np.ndarray) -> list[float]:
            w, theta = y.tolist()
            i = current(w, cmath.exp)
            torque = 1.5 * m.n_p * (m.psi * i.imag + (m.L_d - m.L_q) * i.real * i.imag)
            return [m.n_p / m.J * (torque - m.shaft(w / m.n_p, theta / m.n_p)), w]

        y = self._solved(rate, seconds, lambda _, y: abs(y[0]) - until)
        i = current(y[0], np.exp)
        at_terminals = i + 1j * y[0] * m.psi / m.R_fe + d.late * self._without_voltage(i, y[0])
        return self._window("up", i_ref, y[1], y[0], at_terminals * np.exp(1j * y[1]), np.zeros(y.shape[1], complex))

    def _solved(self, rate: Callable[..., list[float]], seconds: float, reached: Callable[..., float]) -> np.ndarray:
        """Speed and angle at each sample, (2, n), until something is reached."""
        reached.terminal = True  # type: ignore[attr-defined]
        found = solve_ivp(
            rate, (0.0, seconds), [self.w, self.theta], method="LSODA", dense_output=True, rtol=1e-7, atol=1e-8,
            events=reached,
        )  # fmt: skip
        n = int(found.t[-1] / self.drive.T)
        return np.asarray(found.sol(np.arange(n) * self.drive.T))

    def coast(self, seconds: float, until: float) -> Window:
        """The outputs off, for so long, or until a speed in rad/s, electrical."""
        m = self.motor
        loss = 1.5 * m.n_p * m.psi**2 / m.R_fe

        def rate(_: float, y: np.ndarray) -> list[float]:
            return [m.n_p / m.J * (-loss * y[0] - m.shaft(y[0] / m.n_p, y[1] / m.n_p)), y[0]]

        y = self._solved(rate, seconds, lambda _, y: abs(y[0]) - until)
        none = np.zeros(y.shape[1], complex)
        return self._window("off", 0j, y[1], y[0], none, none)

    def drag(self, current: float, hz: float, turns: float) -> Window:
        """A d current, A, in an angle that turns by `hz`, electrical, below 0 in reverse; for turns of the shaft."""
        m, T = self.motor, self.drive.T
        start = self.theta

        def rate(t: float, y: np.ndarray) -> list[float]:
            behind = start + math.tau * hz * t - y[1]
            i = current * np.exp(1j * behind)
            torque = 1.5 * m.n_p * (m.psi * i.imag + (m.L_d - m.L_q) * i.real * i.imag)
            damped = 0.3 * m.n_p * math.sqrt(1.5 * m.psi * current * m.J) * (y[0] - math.tau * hz) / m.n_p
            return [m.n_p / m.J * (torque - damped - m.shaft(y[0] / m.n_p, y[1] / m.n_p)), y[0]]

        seconds = turns * m.n_p / abs(hz)
        found = solve_ivp(
            rate, (0.0, seconds), [math.tau * hz, start], method="LSODA", dense_output=True, rtol=1e-6, atol=1e-8
        )
        t = np.arange(int(seconds / T)) * T
        y = found.sol(t)
        control = start + math.tau * hz * t
        window = self._window(
            "forced", current + 0j, y[1], y[0], current * np.exp(1j * control), np.zeros(len(t), complex)
        )
        return replace(window, control=(control + math.pi) % math.tau - math.pi)

    def _turn(self, theta: float) -> complex:
        """d flux / d theta of the magnet's harmonics, in the rotor's frame."""
        m = self.motor
        if not m.harmonic:
            return 0j
        return m.psi * m.harmonic * (-6.0 * math.sin(6.0 * theta) + 3j * math.cos(6.0 * theta))

    def _terminal(self, i: Any, w: Any, theta: Any) -> Any:
        """Current at the terminals by that which makes torque: iron loss takes some."""
        m = self.motor
        return i if math.isinf(m.R_fe) else i + 1j * w * m.flux(i, theta) / m.R_fe

    def _without_voltage(self, i: np.ndarray, w: np.ndarray) -> np.ndarray:
        """A/s in the stator's frame, by the rotor's axes, of a winding that is shorted."""
        m = self.motor
        v = -m.R * i - 1j * w * (m.psi + m.L_d * i.real + 1j * m.L_q * i.imag)
        return v.real / m.L_d + 1j * v.imag / m.L_q + 1j * w * i

    def _window(
        self, kind: str, i_ref: complex, theta: np.ndarray, w: np.ndarray, i: np.ndarray, u: np.ndarray
    ) -> Window:
        drive, n = self.drive, len(theta)
        index = self.period + np.arange(n)
        self.period += n
        self.theta, self.w = float(theta[-1] + w[-1] * drive.T), float(w[-1])
        phases = np.real(i[None, :] * np.exp(-1j * math.tau / 3.0 * np.arange(3)[:, None]))
        phases = phases + drive.noise * self.rng.standard_normal(phases.shape)
        streamed = self._encoder(theta, w)[1]
        streamed = np.round((streamed + math.pi) % math.tau * 65536 / math.tau) * math.tau / 65536 - math.pi
        edges = self._edges(theta, w, index)
        return Window(
            drive.T, phases, u, np.full(n, 24.0), streamed, streamed, index, np.zeros(n, bool), edges, kind, i_ref
        )

    def _encoder(self, theta: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Counts, and the angle as streamed, not wrapped."""
        n_p, counts = self.motor.n_p, self.drive.counts
        shaft = (theta - self.drive.encoder_delay * w + self.drive.ahead) / n_p
        shaft = shaft + self.drive.eccentric * np.sin(shaft)
        count = np.floor(shaft * counts / math.tau)
        return count.astype(np.int64) % counts, (count + 0.5) * math.tau / counts * n_p

    def _edges(self, theta: np.ndarray, w: np.ndarray, index: np.ndarray) -> Edges:
        """Of a rotor that turns one way."""
        drive, n_p = self.drive, self.motor.n_p
        if drive.places.shape[1] != n_p or len(theta) < 2 or theta[0] == theta[-1]:
            return no_edges()
        way = 1.0 if theta[-1] > theta[0] else -1.0
        low, high = sorted((float(theta[0]), float(theta[-1])))
        found = []
        for turn in range(math.floor((low - drive.ring) / math.tau) - 1, math.ceil((high - drive.ring) / math.tau) + 1):
            for s in range(6):
                at = drive.ring + s * math.pi / 3.0 + math.tau * turn + drive.places[s, turn % n_p]
                at += way * 0.5 * drive.hysteresis + drive.jitter * self.rng.standard_normal()
                if low < at < high:
                    found.append((at, s))
        if not found:
            return no_edges()
        found.sort(reverse=way < 0.0)
        at, sector = np.array([each[0] for each in found]), np.array([each[1] for each in found])
        moment = np.interp(way * at, way * theta, index)
        speed = np.interp(moment, index, w)
        codes = np.array([drive.wiring(code) for code in CODES])
        before, after = codes[(sector - 1) % 6], codes[sector]
        old, new = (before, after) if way > 0.0 else (after, before)
        moment = moment + drive.hall_delay / drive.T
        count = self._encoder(np.interp(moment, index, theta), speed)[0]
        return Edges(old, new, moment, count)


def _signs(i: np.ndarray) -> np.ndarray:
    """Vector of the signs of three phase currents, amplitude invariant."""
    signs = np.sign(np.real(i[None, :] * np.exp(-1j * math.tau / 3.0 * np.arange(3)[:, None])))
    return 2.0 / 3.0 * np.sum(signs * np.exp(1j * math.tau / 3.0 * np.arange(3)[:, None]), axis=0)


def along_d(bench: Bench, I: float, top: float, held: float = 0.065) -> list[Window]:
    """+I and -I on d, from a speed on, both ways."""
    windows = []
    for way in (1.0, -1.0):
        bench.w = way * top
        windows += [bench.hold(kind, way_i + 0j, held, settled=True) for kind, way_i in (("d+", I), ("d-", -I))]
    return windows


def noisy(windows: Sequence[Window], sd: float, rng: np.random.Generator) -> list[Window]:
    """The same with other noise of the phase currents, A rms."""
    return [replace(window, i=window.i + sd * rng.standard_normal(window.i.shape)) for window in windows]


def drawn(rng: np.random.Generator, **more: float) -> tuple[Motor, float, float]:
    """A motor of the size of the eleven of the simulated drive, its rated current, A, and a speed, electrical rad/s."""
    psi, i_max = float(np.exp(rng.uniform(math.log(2.5e-3), math.log(15e-3)))), float(rng.uniform(2.0, 12.0))
    n_p = int(rng.integers(2, 9))
    R = float(rng.uniform(0.03, 0.12)) * 24.0 / i_max
    L = R * float(np.exp(rng.uniform(math.log(5e-4), math.log(2e-3))))
    k_t = 1.5 * n_p * psi
    top = 0.55 * 13.8 / psi if psi > 4e-3 else 2000.0
    top = min(top, 2200.0)
    J = k_t * i_max * 0.35 * n_p / (top / float(rng.uniform(0.25, 0.5)))
    dry = k_t * i_max * float(rng.uniform(0.01, 0.04))
    values = {"J": J, "b": dry / (top / n_p) * float(rng.uniform(0.3, 1.0)), "up": dry, "down": dry} | more
    return Motor(n_p, R, L * float(rng.uniform(0.8, 1.0)), L, psi, **values), i_max, top


def known_flux(bench: Bench, psi_wrong: float = 0.0) -> Flux:
    """Flux and angle as they are; psi wrong by a share, as late currents make it."""
    m, d = bench.motor, bench.drive
    psi = m.psi * (1.0 + psi_wrong)
    return Flux(
        Quantity("psi_f", "V s", psi, {"noise": 1e-4 * psi}, 1.0),
        Quantity("L_d_run", "H", m.L_d, {"noise": 5e-3 * m.L_d}),
        None,
        Quantity("encoder_zero", "rad", 0.0, {"noise": 1e-4}),
        Quantity("encoder_delay", "s", d.encoder_delay, {"noise": 1e-8}),
        d.ahead,
        0.0,
        Fit(np.zeros(0), np.zeros((0, 0)), np.zeros(0)),
    )

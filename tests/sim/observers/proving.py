"""Where an observer is proved: the simulated drive with the control on its own angle, on benches unlike the kind one.

Speeds and currents are shares of the drive's largest, so that any motor runs. Errors are against the rotor itself,
electrical degrees, actual less estimated.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

import sim
from bench.device.simulator import motors
from sim.config.params import BenchParams, Value, load_params
from sim.config.unkind import unkind
from sim.drive.machine import SOURCES, Recorded, SimulatedBench
from sim.observers import edge_lessons
from tests.sim.drive.rig import RPM, Rig

BENCH_24V = Path(sim.__file__).parent / "bench24v.toml"
TAUGHT = (
    *((0.16, 0.125, 0.6), (0.32, 0.5, 0.6), (0.64, 0.125, 0.6), (0.32, 1.0, 0.6), (0.1, 0.5, 0.8)),
    *((0.64, 0.5, 0.6), (0.16, 1.0, 0.6), (0.32, 0.0625, 0.6)),
)
"""Lessons at mixed speeds and loads, 5 s: shares of the largest speed and current, s with the paper's motor."""
PAPER_OMEGA = 1980.0  # rad/s, its largest electrical speed: lessons last as many turns with every motor
SPEEDS = (100, 200, 500, 1000, 2000, 3000)  # r/min of the paper's motor
SLOW = (20, 35, 50, 75)
AMPS = (1, 4, 8)
ALTERED: dict[str, Mapping[str, Value]] = {
    "nothing": {},
    "dead time saturates at 0.05 A": {"inverter.i_smooth": 0.05, "clock.substeps": 2},
    "at 0.1 A": {"inverter.i_smooth": 0.1},
    "at 1 A": {"inverter.i_smooth": 1.0},
    "by the current at each edge": {"inverter.dead_time_by_edges": 1},
    "current offset 10 mA": {"current_sensor.offset": [0.01, -0.01, 0.0]},
    "20 mA": {"current_sensor.offset": [0.02, -0.02, 0.0]},
    "50 mA": {"current_sensor.offset": [0.05, -0.05, 0.0]},
    "gain of two current sensors 0.5 %": {"current_sensor.gain_error": [0.005, -0.005, 0.0]},
    "1 %": {"current_sensor.gain_error": [0.01, -0.01, 0.0]},
    "3 %": {"current_sensor.gain_error": [0.03, -0.03, 0.0]},
    "device drop 0.1 V": {"inverter.u_device": 0.1},
    "0.3 V": {"inverter.u_device": 0.3},
    "L_s_hat halved": {"L_s_hat": 0.5},
    "back-EMF with 5 % of 5th harmonic": {"motor.emf_harmonics": [0.05, 0.0, 0.0, 0.0]},
    "edges of each pole pair 1.5 deg": {"hall.pole_pair_deg": 1.5},
    "ideal Hall sensors": {"hall.delta_deg": [0.0] * 6, "hall.hysteresis_deg": 0.0, "hall.jitter_deg": 0.0},
}
"""What is changed of the kind bench, one at a time; a name without a section: a factor of the firmware's parameter."""


class Figures(NamedTuple):
    """Of an error over a stretch, deg."""

    mean: float
    std: float
    largest: float


def figures(error: np.ndarray) -> Figures:
    """Of an error (n,), deg."""
    return Figures(float(error.mean()), float(error.std()), float(np.abs(error).max()))


class Proving(Rig):
    """A bench whose control uses the angle of an observer, outputs on, load machine at work."""

    def __init__(
        self, observer: str, params: BenchParams, seed: int, factors: Mapping[str, float] | None = None
    ) -> None:
        SimulatedBench.__init__(self, params, seed)
        self.columns = {entry.name: next(iter(entry.channels)) for entry in SOURCES.values()}
        self.columns["encoder"] = "theta_true"
        sources = {entry.name: source for source, entry in SOURCES.items()} | {"encoder": 0}
        self.observer = observer
        self.set_param("observer", sources[observer])
        for name, factor in (factors or {}).items():
            self.set_param(name, factor * self.parameters[name])
        self.start()
        self.top = params.firmware.omega_m_max / RPM
        """Largest speed, r/min."""
        self.i_max = params.motor.i_max
        self.torque = 1.5 * params.motor.n_p * params.motor.psi_f
        """N m by A."""
        self.longer = max(1.0, PAPER_OMEGA / (params.firmware.omega_m_max * params.motor.n_p))
        """How much longer a turn takes than with the paper's motor, at the largest speed."""

    def run(self, seconds: float) -> Recorded:
        """Go on. AssertionError if the drive trips."""
        recorded = self.advance(round(seconds * self.params.clock.pwm_hz))
        assert not self.faults, self.faults
        return recorded

    def spin(self, rpm: float, seconds: float, load: float = 0.0) -> Recorded:
        """Speed by the drive's own loop, against the torque of so many A."""
        return super().spin(rpm, seconds, load * self.torque)

    def teach(self, lessons: Iterable[tuple[float, float, float]] = TAUGHT) -> None:
        """Turn it at mixed speeds and loads."""
        for speed, current, seconds in lessons:
            self.forced(speed * self.top, current * self.i_max, seconds * self.longer)

    def error(self, recorded: Recorded, observer: str = "") -> np.ndarray:
        """(n,) of the observer in control, or of another, deg."""
        off = recorded["theta_true"] - recorded[self.columns[observer or self.observer]]
        return (np.degrees(off) + 180.0) % 360.0 - 180.0

    def figures(self, recorded: Recorded, observer: str = "") -> Figures:
        """Of that error."""
        return figures(self.error(recorded, observer))

    def at(self, rpm: float, i_q: float) -> Recorded:
        """A turn of the shaft and more at a forced speed, settled."""
        self.forced(rpm, i_q, 0.3 * self.longer + 30.0 / abs(rpm))
        return self.forced(rpm, i_q, max(0.2, 60.0 / abs(rpm)))


class Left(NamedTuple):
    """Of the back-EMF in the rotor's own frame, less psi omega, sample by sample, V (n,)."""

    before: np.ndarray
    """d + j q, by the drive's R_s_hat and L_s_hat alone."""
    after: np.ndarray
    """Less all that the Kalman filter on edges knows of it."""


def left_of_emf(bench: Proving, recorded: Recorded) -> Left:
    """What e is wrong by, told by the rotor's true angle and speed; with what the filter knows now."""
    observing = next(of for of in bench._observers.values() if of.entry.name == "edge_kalman")
    scale, lessons = observing.params.scale, observing.state.first.lessons
    i = recorded["i_alpha_true"] + 1j * recorded["i_beta_true"]
    u = (recorded["u_alpha"] + 1j * recorded["u_beta"])[1:]
    theta, omega = recorded["theta_true"], recorded["omega_true"][1:]
    mean, turn = 0.5 * (i[1:] + i[:-1]), np.exp(-0.5j * (theta[1:] + theta[:-1]))
    e = u - scale.R_s * mean - scale.L_s / scale.T_s * np.diff(i)
    before = e * turn - 1j * lessons.drop[0] * omega
    lost = [edge_lessons.lost(lessons, scale, abs(u[k]), v.real, v.imag) for k, v in enumerate(mean)]
    legs = [lessons.lost[0] * complex(*each.full) + lessons.lost[1] * complex(*each.whole) for each in lost]
    six = np.array([edge_lessons.six_of(lessons, scale, w) for w in omega])
    harmonics = (six[:, 0] + 1j * six[:, 1]) * turn**6 + (six[:, 2] + 1j * six[:, 3]) * turn**-6
    i_q = (mean * turn).imag
    drop = lessons.drop[1] * np.clip(i_q / scale.i_fade, -1, 1) + lessons.drop[2] * i_q
    return Left(before, before - np.array(legs) * turn - harmonics - 1j * drop)


class Compared(NamedTuple):
    """An observer beside vector tracking, on the same samples."""

    own: Figures
    other: Figures


def altered(observer: str, what: str, seed: int) -> Proving:
    """The kind bench of the paper's motor with one thing changed."""
    changes = ALTERED[what]
    factors = {name: value for name, value in changes.items() if "." not in name and isinstance(value, float)}
    return Proving(observer, load_params(None, {k: v for k, v in changes.items() if "." in k}), seed, factors)


def bench_24v(observer: str, seed: int) -> Proving:
    """The unkind bench of the paper's motor."""
    return Proving(observer, load_params(BENCH_24V, {}), seed)


def of_motor(observer: str, motor: str, kind: bool, seed: int) -> Proving:
    """A shipped motor on a bench that is kind to it, or not."""
    file = motors()[motor]
    return Proving(observer, load_params(file, {} if kind else unkind(load_params(file))), seed)


def sweep(
    bench: Proving, speeds: Sequence[float] = SPEEDS, amps: Sequence[float] = AMPS
) -> dict[tuple[float, float], Compared]:
    """Figures by speed (r/min) and current (A)."""
    found = {}
    for rpm in speeds:
        for i_q in amps:
            run = bench.at(rpm, i_q)
            found[rpm, i_q] = Compared(bench.figures(run), bench.figures(run, "vector_tracking"))
    return found


def worst(found: Iterable[Figures]) -> Figures:
    """Each figure where it is worst, the mean without its sign."""
    each = list(found)
    return Figures(max(abs(f.mean) for f in each), max(f.std for f in each), max(f.largest for f in each))


def steps(bench: Proving) -> dict[str, Compared]:
    """Figures over steps of speed and load, the shaft free; the paper's motor."""
    found = {}

    def keep(name: str, run: Recorded, first: int = 0) -> None:
        found[name] = Compared(*(figures(bench.error(run, seen)[first:]) for seen in ("", "vector_tracking")))

    bench.spin(1000, 0.8)
    bench.spin(500, 0.6)
    keep("500 to 1000 r/min", bench.spin(1000, 0.5))
    bench.spin(500, 0.6)
    keep("0 to 4 A at 500 r/min", bench.spin(500, 0.5, 4))
    bench.spin(500, 0.6)
    keep("reversal from 500 r/min", bench.spin(-500, 0.6))
    keep("reversal to 500 r/min", bench.spin(500, 0.6))
    bench.forced(100, 1, 0.8)
    keep("1 to 4 A at 100 r/min, forced", bench.forced(100, 4, 0.4))
    bench.spin(100, 0.8, 1)
    keep("1 to 4 A at 100 r/min", bench.spin(100, 0.5, 4))
    bench.spin(500, 0.5)
    bench.spin(0, 0.8)
    before = bench.tick
    run = bench.spin(500, 0.5)
    second = math.ceil((int(run.captured["tick"][1]) - before) / bench.params.clock.period_ticks)
    keep("start from rest, after the second edge", run, second + 3)
    return found


def thd(recorded: Recorded) -> float:
    """(20) of the current i_alpha over whole turns, in %, by the rotor's angle."""
    theta = recorded["theta_true"]
    turns = int((theta[-1] - theta[0]) / math.tau)
    grid = np.linspace(theta[0], theta[0] + turns * math.tau, 512 * turns, endpoint=False)
    size = np.abs(np.fft.rfft(np.interp(grid, theta, recorded["i_alpha_true"])))
    return float(100.0 * np.sqrt((size[1:] ** 2).sum() / size[turns] ** 2 - 1.0))

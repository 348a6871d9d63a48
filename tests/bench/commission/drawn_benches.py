"""Simulated benches around the motors that are shipped, as configurations, with what a commissioning should find."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.device.simulator import motors
from sim.config.params import load_params
from sim.config.saturation import least_i_cross
from sim.config.sections import BenchParams
from sim.config.unkind import unkind
from sim.plant.warming import COPPER

PAPER = "paper"
NAMES = (PAPER, *motors())
UNKNOWN = {
    "firmware.R_s_hat": 1.0, "firmware.L_s_hat": 1e-3, "firmware.psi_f_hat": 1e-5, "firmware.J_hat": 1e-3,
    "firmware.n_p": 1, "firmware.dead_time.dead_time_hat": 0.0, "firmware.hall_offset": 0.0,
}  # fmt: skip
"""What a drive assumes that knows no motor."""


@dataclass(frozen=True)
class MadeBench:
    """A configuration as nested tables, the agreed current in A, and the truth in the drive's own units."""

    config: dict[str, Any]
    i_max: float
    truth: Mapping[str, float] = field(default_factory=dict)
    """What a shaft at rest shows,"""
    turning: Mapping[str, float] = field(default_factory=dict)
    """and one that turns."""
    n_p: int = 1
    rpm: float = 0.0
    """The drive's own limit."""
    encoder_zero: float = 0.0
    """rad: what that parameter should be."""
    places: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """rad, of six edges `up` and `down`, the mean of the pole pairs."""
    encoder: bool = True


def made(name: str, hard: bool, **overrides: Any) -> MadeBench:
    """The bench of a motor, kind or with every effect that is usual; more settings as `section__name=value`."""
    return _bench(name, hard, {key.replace("__", "."): value for key, value in overrides.items()})


def drawn(name: str, seed: int, hard: bool = True, rare: bool = False, encoder: bool = True) -> MadeBench:
    """A bench of which all that is to be found is drawn around the motor's figures.

    `rare`: with effects that the equations of a commissioning do not have.
    """
    rng, base = np.random.default_rng([seed, NAMES.index(name), hard]), _base(name)
    u, motor = rng.uniform, base.motor
    i = motor.i_max / 8.0
    settings: dict[str, Any] = {
        "motor.R_s": motor.R_s * u(0.85, 1.15), "motor.psi_f": motor.psi_f * u(0.85, 1.15),
        "motor.L_q": (L := u(0.85, 1.15) * motor.L_q), "motor.L_d": L * u(0.85, 1.0),
        "mechanics.J": (J := base.mechanics.J * u(0.3, 1.5)), "mechanics.theta_0_deg": u(0, 360),
        "inverter.dead_time": u(0.5e-6, 1.5e-6), "encoder.offset_deg": u(-179, 179),
        "mechanics.b": base.mechanics.b * u(0.5, 2.0), "hall.delta_deg": [float(x) for x in u(-9, 9, 6)],
        "hall.offset_deg": float(rng.choice([0.0, 120.0, -120.0, 180.0, 47.0])), "encoder.present": int(encoder),
    }  # fmt: skip
    if hard:
        effects = unkind(base)
        gains = rng.normal(0, 0.005, 3)
        settings |= {
            "current_sensor.gain_error": [float(g) for g in gains],
            "current_sensor.offset": [float(x) for x in rng.normal(0, 0.02 * i, 3)],
            "thermal.drift_offset": [float(x) for x in rng.normal(0, 0.01 * i, 3)],
            "thermal.drift_gain": [float(x) for x in rng.normal(0, 0.002, 3)],
            "thermal.ambient": u(15, 35), "motor.i_sat": motor.i_max * u(1.8, 4),
            "coupling.stiffness": float(effects["coupling.stiffness"]) * J / base.mechanics.J,  # type: ignore[arg-type]
            "coupling.damping": float(effects["coupling.damping"]) * J / base.mechanics.J,  # type: ignore[arg-type]
            "inverter.u_device": u(0.02, 0.08), "hall.latency": u(1e-6, 1e-5),
            "motor.emf_harmonics": [float(x) for x in np.array([0.03, -0.015, 0.006, 0.004]) * u(-1.5, 1.5, 4)],
            "motor.cogging": [float(x) for x in np.array(effects["motor.cogging"]) * u(0.3, 1.5, 2)],
            "mechanics.tau_coulomb": float(effects["mechanics.tau_coulomb"]) * u(0.5, 1.5),  # type: ignore[arg-type]
        }  # fmt: skip
    if rare:
        settings |= _rare(base, settings, np.random.default_rng([seed, NAMES.index(name), 7]))
    return _bench(name, hard, settings)


def _rare(base: BenchParams, settings: Mapping[str, Any], rng: np.random.Generator) -> dict[str, float]:
    """Iron loss, more friction at rest, skin effect, and axes that saturate one another."""
    u, motor = rng.uniform, base.motor
    dry = settings.get("mechanics.tau_coulomb", base.mechanics.tau_coulomb)
    least = least_i_cross(settings["motor.L_d"], settings["motor.L_q"], settings["motor.psi_f"], motor.i_max)
    return {
        "motor.iron_hysteresis": u(0.0, 0.5) * dry, "motor.iron_eddy": u(0.0, 1.0) * settings["mechanics.b"],
        "mechanics.stribeck": u(0.0, 0.5) * dry, "mechanics.omega_stribeck": u(2.0, 8.0),
        "motor.skin_R": u(0.0, 0.1) * motor.R_s, "motor.i_cross": max(u(4.0, 12.0) * motor.i_max, 1.1 * least),
    }  # fmt: skip


def _base(name: str) -> BenchParams:
    return load_params(motors().get(name))


def _bench(name: str, hard: bool, settings: Mapping[str, Any]) -> MadeBench:
    file = motors().get(name)
    base = load_params(file)
    overrides: dict[str, Any] = {**(unkind(base) if hard else {}), **UNKNOWN, **settings}
    config: dict[str, Any] = {} if file is None else tomllib.loads(file.read_text(encoding="utf-8"))
    for key, value in overrides.items():
        section = config
        *sections, last = key.split(".")
        for part in sections:
            section = section.setdefault(part, {})
        section[last] = value
    p = load_params(file, overrides)
    return MadeBench(
        config, base.motor.i_max, _truth(p), _turning(p), p.motor.n_p, p.firmware.omega_m_max * 60.0 / math.tau,
        -math.radians(p.encoder.offset_deg), _places(p), bool(p.encoder.present),
    )  # fmt: skip


def _truth(p: BenchParams) -> dict[str, float]:
    """By the drive's amperes, which are the mean of its three sensors'; R as the winding is when nothing has flown."""
    gain = 1.0 + float(np.mean(p.current_sensor.gain_error))
    warm = p.thermal.ambient - 20.0 if p.thermal.R_th_winding else 0.0
    u_dc = p.inverter.u_dc + (2 * p.inverter.u_diode if p.inverter.dead_time_by_edges else 0.0)
    L_d, L_q = incremental(p, 0.5 * p.motor.i_max)
    absolute = {
        "R_s": p.motor.R_s * (1.0 + COPPER * warm), "L_d": p.motor.L_d, "L_q": p.motor.L_q,
        "L_d_half": L_d, "L_q_half": L_q,
    }  # fmt: skip
    dead = u_dc * p.inverter.dead_time * p.clock.pwm_hz + p.inverter.u_device
    return {name: value / gain for name, value in absolute.items()} | {"U_dead": dead}


def _turning(p: BenchParams) -> dict[str, float]:
    """Torques by the drive's amperes, too; the magnet as warm as the air."""
    gain = 1.0 + float(np.mean(p.current_sensor.gain_error))
    warm = p.thermal.ambient - 20.0 if p.thermal.R_th_winding else 0.0
    shaft, magnet = p.mechanics, 1.0 + p.thermal.magnet * warm
    return {
        "psi_f": p.motor.psi_f * magnet, "J": shaft.J * gain, "b": (shaft.b + p.motor.iron_eddy * magnet**2) * gain,
        "tau_c": (shaft.tau_coulomb + p.motor.iron_hysteresis * magnet**2) * gain,
    }  # fmt: skip


def _places(p: BenchParams) -> dict[str, list[float]]:
    """Where the six edges are passed, with the mean of what each pole pair adds, as `sim.plant.hall_sensor` says."""
    own, around = lambda n: 2.0 * math.modf(math.sin(12.9898 * (n + 1)) * 43758.5453)[0], 6 * p.motor.n_p
    places: dict[str, list[float]] = {"up": [], "down": []}
    for s, delta in enumerate(p.hall.delta_deg):
        each = [own((s + 6 * q) % around) for q in range(p.motor.n_p)]
        more = float(np.mean([(x if x >= 0.0 else x + 2.0) - 1.0 for x in each])) * p.hall.pole_pair_deg
        for way, sign in (("up", 0.5), ("down", -0.5)):
            places[way].append(math.radians(p.hall.offset_deg + 60 * s - delta + more + sign * p.hall.hysteresis_deg))
    return places


def incremental(p: BenchParams, i: float) -> tuple[float, float]:
    """dpsi_d/di_d and dpsi_q/di_q beside a d current of i A: by the plant's law, i = i_0 (1 + c i_0^2), solved.

    Where the axes saturate one another, 1/L_q grows by (psi_d^2 - psi_f^2) / (2 L_d L_q psi_f i_cross).
    """
    motor = p.motor
    c = 0.5 * (1.0 / motor.L_d + 1.0 / motor.L_q) * motor.L_d / motor.i_sat**2 if motor.i_sat else 0.0
    roots = np.roots([c, 0.0, 1.0, -i]) if c else np.array([i])
    (i_0,) = (root.real for root in roots if abs(root.imag) < 1e-9)
    crossed = 0.0
    if motor.i_cross:
        grown = (motor.psi_f + motor.L_d * i_0) ** 2 - motor.psi_f**2
        crossed = grown / (2.0 * motor.L_d * motor.L_q * motor.psi_f * motor.i_cross)
    return motor.L_d / (1.0 + 3.0 * c * i_0**2), 1.0 / ((1.0 + c * i_0**2) / motor.L_q + crossed)

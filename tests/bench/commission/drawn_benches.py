"""Simulated benches around the motors that are shipped, as configurations, with what a commissioning should find."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bench.device.simulator import motors
from sim.config.params import load_params
from sim.config.sections import BenchParams
from sim.config.unkind import unkind
from sim.plant.warming import COPPER

PAPER = "paper"
NAMES = (PAPER, *motors())
UNKNOWN = {"firmware.R_s_hat": 1.0, "firmware.L_s_hat": 1e-3, "firmware.psi_f_hat": 1e-5}
"""What a drive assumes that knows no motor."""


@dataclass(frozen=True)
class MadeBench:
    """A configuration as nested tables, the agreed current in A, and the truth in the drive's own units."""

    config: dict[str, Any]
    i_max: float
    truth: Mapping[str, float] = field(default_factory=dict)


def made(name: str, hard: bool, **overrides: Any) -> MadeBench:
    """The bench of a motor, kind or with every effect that is usual; more settings as `section__name=value`."""
    return _bench(name, hard, {key.replace("__", "."): value for key, value in overrides.items()})


def drawn(name: str, seed: int, hard: bool = True) -> MadeBench:
    """A bench of which all that a standstill shows is drawn around the motor's figures."""
    rng, base = np.random.default_rng([seed, NAMES.index(name), hard]), _base(name)
    u, motor = rng.uniform, base.motor
    i = motor.i_max / 8.0
    settings: dict[str, Any] = {
        "motor.R_s": motor.R_s * u(0.85, 1.15), "motor.psi_f": motor.psi_f * u(0.85, 1.15),
        "motor.L_q": (L := u(0.85, 1.15) * motor.L_q), "motor.L_d": L * u(0.85, 1.0),
        "mechanics.J": (J := base.mechanics.J * u(0.3, 1.5)), "mechanics.theta_0_deg": u(0, 360),
        "inverter.dead_time": u(0.5e-6, 1.5e-6), "encoder.offset_deg": u(-179, 179),
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
            "inverter.u_device": u(0.02, 0.08),
        }  # fmt: skip
    return _bench(name, hard, settings)


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
    return MadeBench(config, base.motor.i_max, _truth(p))


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


def incremental(p: BenchParams, i: float) -> tuple[float, float]:
    """dpsi_d/di_d and dpsi_q/di_q beside a d current of i A: by the plant's law, i = i_0 (1 + c i_0^2), solved."""
    motor = p.motor
    if not motor.i_sat:
        return motor.L_d, motor.L_q
    c = 0.5 * (1.0 / motor.L_d + 1.0 / motor.L_q) * motor.L_d / motor.i_sat**2
    (i_0,) = (root.real for root in np.roots([c, 0.0, 1.0, -i]) if abs(root.imag) < 1e-9)
    return motor.L_d / (1.0 + 3.0 * c * i_0**2), motor.L_q / (1.0 + c * i_0**2)

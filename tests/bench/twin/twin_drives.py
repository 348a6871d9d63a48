"""Drives that differ from what they assume of themselves in more than twelve figures, and recordings of them."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import bench
from bench.device.simulator import motors
from sim.config.params import load_params
from sim.config.unkind import unkind
from sim.plant.hall_sensor import _own

PAPER = "paper"
NAMES = (PAPER, *motors())
ELSEWHERE = ("coupling.", "thermal.")
"""What an unkind bench has here not: the recordings are short, and truth is that of one temperature."""


@dataclass(frozen=True)
class TwinDrive:
    """Nested tables of a configuration, and the truth in the drive's own amperes, by names of a twin's quantities."""

    config: dict[str, Any]
    truth: dict[str, float]
    top_rpm: float
    """r/min, half of the drive's own limit."""
    seed: int


def drawn(seed: int, hard: bool = False, **settings: Any) -> TwinDrive:
    """One of the motors by its turn, with figures drawn around its own; the firmware knows nothing of that."""
    rng, name = np.random.default_rng([seed, hard]), NAMES[seed % len(NAMES)]
    file = motors().get(name)
    base = load_params(file)
    motor, u = base.motor, rng.uniform
    torque = 1.5 * motor.n_p * motor.psi_f * motor.i_max
    values: dict[str, Any] = {
        "motor.R_s": motor.R_s * u(0.75, 1.25), "motor.L_d": motor.L_d * u(0.75, 1.25),
        "motor.L_q": motor.L_q * u(0.75, 1.25), "motor.psi_f": motor.psi_f * u(0.9, 1.1),
        "motor.emf_harmonics": [u(-0.03, 0.03), u(-0.02, 0.02), u(-0.01, 0.01), u(-0.005, 0.005)],
        "motor.cogging": [u(0, 4e-3) * torque, u(0, 1.5e-3) * torque], "mechanics.J": base.mechanics.J * u(0.7, 1.3),
        "mechanics.b": base.mechanics.b * u(0.6, 1.4),
        "mechanics.tau_coulomb": base.mechanics.tau_coulomb * u(0.6, 1.4),
        "inverter.dead_time": u(0.6e-6, 1.3e-6), "hall.delta_deg": [u(-5, 5) for _ in range(6)],
        "hall.latency": u(0, 2e-5), "hall.hysteresis_deg": u(0.3, 1.2), "encoder.offset_deg": u(-5, 5),
        "current_sensor.offset": [u(-1, 1) * 2e-3 * motor.i_max for _ in range(3)],
        "current_sensor.gain_error": [u(-0.01, 0.01) for _ in range(3)],
    }  # fmt: skip
    if hard:
        values = {k: v for k, v in unkind(base).items() if not k.startswith(ELSEWHERE)} | values
    values |= {key: value for key, value in settings.items() if key in values}
    assumed = {
        "firmware.R_s_hat": motor.R_s, "firmware.L_s_hat": motor.L_q, "firmware.psi_f_hat": motor.psi_f,
        "firmware.J_hat": base.mechanics.J, "firmware.dead_time.dead_time_hat": base.inverter.dead_time,
        "firmware.omega_m_max": base.firmware.omega_m_max,
    }  # fmt: skip
    config: dict[str, Any] = tomllib.loads(file.read_text()) if file is not None else {}
    for dotted, value in (values | assumed | settings).items():
        table: Any = config
        *sections, key = dotted.split(".")
        for section in sections:
            table = table.setdefault(section, {})
        table[key] = value
    top = 0.5 * base.firmware.omega_m_max * 60.0 / math.tau
    return TwinDrive(config, _truth(values, motor.n_p, base.inverter.u_dc * base.clock.pwm_hz), top, seed)


def _truth(values: dict[str, Any], n_p: int, volts: float) -> dict[str, float]:
    """By the drive's own amperes: the mean gain of the sensors is none."""
    truth: dict[str, float] = {}
    for key, value in values.items():
        many = value if isinstance(value, list) else [value]
        truth |= {f"{key}[{k}]" if isinstance(value, list) else key: one for k, one in enumerate(many, 1)}
    gains = 1.0 + np.array(values["current_sensor.gain_error"])
    mean = float(gains.mean())
    for k, gain in enumerate(gains, 1):
        truth[f"current_sensor.gain_error[{k}]"] = float(gain) / mean - 1.0
        truth[f"current_sensor.offset[{'abc'[k - 1]}]"] = truth.pop(f"current_sensor.offset[{k}]")
    for name in ("motor.R_s", "motor.L_d", "motor.L_q"):
        truth[name] /= mean
    for name in ("mechanics.J", "mechanics.b", "mechanics.tau_coulomb", "motor.cogging[1]", "motor.cogging[2]"):
        truth[name] *= mean
    truth["inverter.dead_time"] += values.get("inverter.u_device", 0.0) / volts
    own = [float(np.mean([_own(6 * pair + edge) for pair in range(n_p)])) for edge in range(6)]
    delta = np.array(values["hall.delta_deg"]) - values.get("hall.pole_pair_deg", 0.0) * np.array(own)
    truth["hall.offset_deg"] = -float(delta.mean())
    truth |= {f"hall.delta_deg[{k}]": float(one - delta.mean()) for k, one in enumerate(delta, 1)}
    return truth


def steps(drive: TwinDrive, save: Path, **given: Any) -> Path:
    """Recorded at rest, at steps of the speed both ways, and while it coasts."""
    with bench.connect("sim", config=drive.config, seed=drive.seed, save=save, **given) as rig:
        rig.wait(0.3)
        rig.drive.start("average-speed")
        for share in (0.3, 0.6, 1.0, 0.3, 0.8, -0.5, -1.0, -0.35, 0.6):
            rig.drive.speed(rpm=share * drive.top_rpm)
            rig.wait(0.5)
        rig.drive.stop()
        rig.wait(0.3)
    return save


def reversal(drive: TwinDrive, save: Path, seed: int) -> Path:
    """Another manoeuvre, with other noise: a step, a reversal on the encoder, and steps on two observers' angles.

    A start or a reversal on an observer's angle is another one each time: where the rotor stands by chance decides.
    """
    with bench.connect("sim", config=drive.config, seed=seed, save=save) as rig:
        rig.wait(0.1)
        rig.drive.start("encoder")
        for share in (0.45, 0.9, -0.7):
            rig.drive.speed(rpm=share * drive.top_rpm)
            rig.wait(0.6)
        for observer, share in (("vector-tracking", -0.9), ("average-speed", -0.5)):
            rig.drive.observe(observer)
            rig.wait(0.3)
            rig.drive.speed(rpm=share * drive.top_rpm)
            rig.wait(0.5)
    return save

"""Configurations of the simulated bench as TOML: a motor, shipped or drawn, with overrides, on an unkind bench."""

from __future__ import annotations

import random
import tomllib
from collections.abc import Mapping
from typing import Any

from bench.device.simulator import motors
from sim.config.params import Value, load_params
from sim.config.unkind import unkind


def configured(motor: str, overrides: Mapping[str, Value]) -> str:
    """A motor's file, or nothing where `motor` is "", with these values by dotted key."""
    sections: dict[str, dict[str, Any]] = tomllib.loads(motors()[motor].read_text()) if motor else {}
    for dotted, value in overrides.items():
        section, _, key = dotted.rpartition(".")
        sections.setdefault(section, {})[key] = value
    lines = []
    for section, values in sections.items():
        lines += [f"[{section}]", *(f"{key} = {value!r}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def drawn(number: int) -> dict[str, Value]:
    """A motor that nobody has looked at, between two of the shipped ones, Hall edges up to 6 deg from their places."""
    draw = random.Random(number)
    one, other = (load_params(motors()[name]).motor for name in draw.sample(sorted(motors()), 2))
    share = draw.uniform(0.25, 0.75)

    def between(a: float, b: float) -> float:
        return float(f"{a * (b / a) ** share:.4g}")

    L_d = between(one.L_d, other.L_d)
    return {
        "motor.n_p": draw.randint(*sorted((one.n_p, other.n_p))),
        "motor.R_s": between(one.R_s, other.R_s),
        "motor.L_d": L_d,
        "motor.L_q": float(f"{L_d * draw.choice((1.0, 1.0, 1.1, 1.3, 1.5)):.4g}"),
        "motor.psi_f": between(one.psi_f, other.psi_f),
        "motor.i_max": between(one.i_max, other.i_max),
        "hall.delta_deg": [round(draw.uniform(-6.0, 6.0), 1) for _ in range(6)],
    }


def on_an_unkind_bench(motor: str, own: Mapping[str, Value]) -> str:
    """A motor, with overrides, with every effect that a real bench has."""
    kind = load_params(motors()[motor] if motor else None, own)
    return configured(motor, {**own, **unkind(kind)})

"""Configurations of the simulated bench as TOML: a motor that is shipped, with overrides, or on an unkind bench."""

from __future__ import annotations

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


def on_an_unkind_bench(motor: str) -> str:
    """A motor with every effect that a real bench has."""
    return configured(motor, unkind(load_params(motors()[motor] if motor else None)))

"""Parameters of the simulated bench: read from TOML, checked, frozen.

`sim/default.toml` holds every figure; a user's file and overrides replace single keys of it. A
value outside its range, a key that does not exist and a file that cannot be read are a `ConfigError`: one
line with the name, the value, what is allowed, and the file and key.

The figures are those of `sim.config.sections`. This module knows no kernel and imports no numba.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from protocol.signals import AngleSource
from sim.config.ranges import ConfigError, check
from sim.config.sections import (
    Clock,
    CurrentLoop,
    CurrentSensor,
    DeadTime,
    Encoder,
    Firmware,
    Hall,
    HallEdges,
    HallSpeed,
    HallVector,
    Injection,
    Inverter,
    Load,
    Mechanics,
    Motor,
    Protection,
    Section,
    SpeedLoop,
    VectorTracking,
    Wiring,
    parameters_of,
)

__all__ = ["BenchParams", "ConfigError", "Firmware", "Value", "check", "load_params"]

DEFAULTS = Path(__file__).parents[1] / "default.toml"
Value = bool | int | float | str | list[Any] | tuple[float, ...]


@dataclass(frozen=True)
class BenchParams(Section):
    """Everything about a simulated bench."""

    motor: Motor
    mechanics: Mechanics
    load: Load
    hall: Hall
    wiring: Wiring
    encoder: Encoder
    inverter: Inverter
    current_sensor: CurrentSensor
    clock: Clock
    firmware: Firmware

    def __post_init__(self) -> None:
        super().__post_init__()
        h = 1.0 / (self.clock.pwm_hz * self.clock.substeps)
        motor, inverter = self.motor, self.inverter
        lost = inverter.u_dc * inverter.dead_time * self.clock.pwm_hz + inverter.u_device
        # Runge-Kutta steps are stable up to 2.78 of these time constants, and good up to about one
        for name, value, least, unit in (
            ("motor.L_d", motor.L_d, motor.R_s * h, "H"),
            ("motor.L_q", motor.L_q, motor.R_s * h, "H"),
            ("mechanics.J", self.mechanics.J, self.mechanics.b * h, "kg m2"),
            ("inverter.i_smooth", inverter.i_smooth, lost * h / min(motor.L_d, motor.L_q) / 2.0, "A"),
        ):
            if value < least:
                raise ConfigError(
                    f"{name} must be >= {least:.3g} {unit} for integration steps of {h:.3g} s, got {value:g}; "
                    f"take more clock.substeps"
                )
        if self.firmware.observer == AngleSource.ENCODER and not self.encoder.present:
            raise ConfigError("firmware.observer must be 1 or 2 where encoder.present = 0, got 0")

    def drive_parameters(self) -> dict[str, float]:
        """The initial values of the drive's `DRIVE_PARAMETERS` by name."""
        return parameters_of(self.firmware) | {"i_range": self.current_sensor.range}

    def load_parameters(self) -> dict[str, float]:
        """The initial values of the load machine's `LOAD_PARAMETERS` by name."""
        placement = {f"hall_delta_{s}": math.radians(delta) for s, delta in enumerate(self.hall.delta_deg, 1)}
        return parameters_of(self.load) | parameters_of(self.wiring) | placement


_SECTIONS: dict[str, type[Section]] = {
    c.__name__: c
    for c in (
        Motor, Mechanics, Load, Hall, Wiring, Encoder, Inverter, CurrentSensor, Clock, Firmware,
        HallSpeed, HallEdges, HallVector, VectorTracking, Injection, CurrentLoop, SpeedLoop, DeadTime, Protection,
    )
}  # fmt: skip

S = TypeVar("S", bound=Section)


def load_params(path: str | Path | None = None, overrides: Mapping[str, Value] | None = None) -> BenchParams:
    """The bench of `default.toml`, with the keys of the TOML file `path` and then `overrides` in their place.

    `overrides`: dotted keys such as `motor.R_s` or `firmware.vector_tracking.k_p_vt`. Raises `ConfigError`.
    """
    values: dict[str, tuple[object, str]] = {}
    _collect(_read(DEFAULTS), "", DEFAULTS.name, BenchParams, values)
    if path is not None:
        file = Path(path)
        _collect(_read(file), "", file.name, BenchParams, values)
    for key, value in (overrides or {}).items():
        nested: dict[str, Any] = {}
        *sections, leaf = key.split(".")
        inner = nested
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[leaf] = value
        _collect(nested, "", "overrides", BenchParams, values)
    return _build(BenchParams, "", values)


def _read(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except FileNotFoundError:
        raise ConfigError(f"no configuration file {path}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigError(f"{path} is nested too deeply") from None
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None


def _collect(
    table: Mapping[str, Any],
    prefix: str,
    source: str,
    section: type[Section],
    values: dict[str, tuple[object, str]],
) -> None:
    """Put the leaves of `table` into `values` by dotted key, each with its source; refuse unknown keys."""
    known = {f.name: f for f in fields(section)}
    for key, value in table.items():
        dotted = prefix + key
        if key not in known:
            raise ConfigError(_unknown(dotted, key, prefix, source, known))
        inner = _SECTIONS.get(str(known[key].type))
        if inner is None:
            values[dotted] = (value, source)
        elif isinstance(value, Mapping):
            _collect(value, f"{dotted}.", source, inner, values)
        else:
            raise ConfigError(f"{dotted} is a section, got {value!r} (in {source})")


def _unknown(dotted: str, key: str, prefix: str, source: str, known: Mapping[str, Any]) -> str:
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    if not near:  # upper and lower case alone can put a short name out of reach
        near = [name for name in known if name.lower() == key.lower()]
    hint = f"did you mean {prefix}{near[0]}?" if near else f"allowed here: {', '.join(known)}"
    return f"unknown key {dotted} in {source}; {hint}"


def _build(section: type[S], prefix: str, values: Mapping[str, tuple[object, str]]) -> S:
    arguments: dict[str, Any] = {}
    sources = set()
    for f in fields(section):
        dotted = prefix + f.name
        inner = _SECTIONS.get(str(f.type))
        if inner is not None:
            arguments[f.name] = _build(inner, f"{dotted}.", values)
            continue
        value, source = values[dotted]
        sources.add(source)
        arguments[f.name] = check(f.name, value, f.metadata["range"], f"{dotted} in {source}")
    try:
        return section(**arguments)
    except ConfigError as error:  # a rule between several keys
        if not prefix:  # between sections: any source may be to blame
            sources = {source for _, source in values.values()}
        given = ", ".join(sorted(sources - {DEFAULTS.name})) or DEFAULTS.name
        section_name = f"{prefix.rstrip('.')} in " if prefix else "in "
        raise ConfigError(f"{error} ({section_name}{given})") from None

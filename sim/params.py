"""Parameters of the simulated bench: read from TOML, checked, frozen.

`default.toml` beside this file holds every figure; a user's file and overrides replace single keys of it. A
value outside its range, a key that does not exist and a file that cannot be read are a `ConfigError`: one
line with the name, the value, what is allowed, and the file and key.

Fields carry the names and units of the TOML's keys. This module knows no kernel and imports no numba.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from protocol.signals import DRIVE_PARAMETERS, LOAD_PARAMETERS, Flag, Parameter
from sim.ranges import ConfigError, Range, check

__all__ = ["BenchParams", "ConfigError", "Firmware", "check", "load_params"]

DEFAULTS = Path(__file__).with_name("default.toml")
Value = bool | int | float | str | list[Any] | tuple[float, ...]


def _any(unit: str = "", *, length: int = 0) -> Any:
    return field(metadata={"range": Range(unit, length=length)})


def _positive(unit: str) -> Any:
    return field(metadata={"range": Range(unit, lo=0.0, open_lo=True)})


def _not_negative(unit: str) -> Any:
    return field(metadata={"range": Range(unit, lo=0.0)})


def _between(lo: float, hi: float, unit: str = "", *, open_lo: bool = False, length: int = 0) -> Any:
    return field(metadata={"range": Range(unit, lo, hi, open_lo, length=length)})


def _whole(lo: int, hi: int, unit: str = "") -> Any:
    return field(metadata={"range": Range(unit, lo, hi, whole=True)})


def _range_of(parameter: Parameter) -> Range:
    unit = parameter.unit.symbol.replace("Ω", "ohm")
    return Range(unit, parameter.lo, parameter.hi, whole=bool(parameter.flags & Flag.WHOLE))


_DRIVE_RANGES = {p.name: _range_of(p) for p in DRIVE_PARAMETERS}
_LOAD_RANGES = {p.name: _range_of(p) for p in LOAD_PARAMETERS}


def _drive(name: str) -> Any:
    return field(metadata={"range": _DRIVE_RANGES[name], "parameter": True})


def _load(name: str) -> Any:
    return field(metadata={"range": _LOAD_RANGES[name], "parameter": True})


class _Checked:
    """A section whose fields are checked whenever one is made, also by `dataclasses.replace`."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __post_init__(self) -> None:
        for f in fields(self):
            if (allowed := f.metadata.get("range")) is not None:
                object.__setattr__(self, f.name, check(f.name, getattr(self, f.name), allowed))


@dataclass(frozen=True)
class Motor(_Checked):
    """The machine, amplitude-invariant quantities."""

    R_s: float = _positive("ohm")
    L_d: float = _positive("H")
    L_q: float = _positive("H")
    psi_f: float = _positive("V s")
    n_p: int = _whole(1, 64)


@dataclass(frozen=True)
class Mechanics(_Checked):
    """The shaft."""

    J: float = _positive("kg m2")
    b: float = _not_negative("N m s/rad")
    tau_coulomb: float = _not_negative("N m")
    theta_0_deg: float = _between(-360.0, 360.0, "deg")


@dataclass(frozen=True)
class Load(_Checked):
    """The load machine."""

    tau_max: float = _load("tau_max")
    omega_m_max: float = _load("omega_m_max")
    watchdog: float = _load("watchdog")
    alpha_m_max: float = _not_negative("rad/s2")

    def parameters(self) -> dict[str, float]:
        """The load machine's `LOAD_PARAMETERS` by name."""
        return _parameters(self)


@dataclass(frozen=True)
class Hall(_Checked):
    """The three Hall sensors, electrical degrees."""

    delta_deg: tuple[float, ...] = _between(-29.0, 29.0, "deg", length=6)
    hysteresis_deg: float = _between(0.0, 10.0, "deg")
    jitter_deg: float = _between(0.0, 3.0, "deg")

    def __post_init__(self) -> None:
        super().__post_init__()
        # Neighbouring edges must stay apart by more than hysteresis and 4 sigma of jitter on both take up.
        margin = self.hysteresis_deg + 8.0 * self.jitter_deg
        for s in range(6):
            width = 60.0 - self.delta_deg[(s + 1) % 6] + self.delta_deg[s]
            if width <= margin:
                raise ConfigError(
                    f"delta_deg leaves sector {s + 1} only {width:g} deg wide; it must be wider "
                    f"than hysteresis_deg + 8 jitter_deg = {margin:g} deg"
                )


@dataclass(frozen=True)
class Encoder(_Checked):
    """The incremental encoder."""

    pulses_per_rev: int = _whole(1, 16383)
    offset_deg: float = _between(-360.0, 360.0, "deg")
    bw_speed: float = _between(0.1, 1000.0, "Hz")


@dataclass(frozen=True)
class Inverter(_Checked):
    """DC link and inverter."""

    u_dc: float = _between(0.0, 63.9, "V", open_lo=True)
    dead_time: float = _between(0.0, 1e-5, "s")
    u_device: float = _between(0.0, 5.0, "V")
    i_smooth: float = _between(1e-3, 10.0, "A")
    u_diode: float = _between(0.0, 5.0, "V")


@dataclass(frozen=True)
class CurrentSensor(_Checked):
    """Phase current measurement."""

    noise_rms: float = _not_negative("A")
    offset: tuple[float, ...] = _any("A", length=3)
    gain_error: tuple[float, ...] = _between(-0.9, 10.0, length=3)
    range: float = _between(0.1, 31.9, "A")
    bits: int = _whole(4, 24)


@dataclass(frozen=True)
class Clock(_Checked):
    """Timers and steps."""

    tick_hz: int = _whole(1_000_000, 1_000_000_000, "Hz")
    pwm_hz: int = _whole(1000, 100_000, "Hz")
    substeps: int = _whole(1, 100)
    start_tick: int = _whole(0, 2**62)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tick_hz % self.pwm_hz:
            raise ConfigError(f"tick_hz must be a whole multiple of pwm_hz = {self.pwm_hz} Hz, got {self.tick_hz}")

    @property
    def period_ticks(self) -> int:
        """Timer ticks in a PWM period."""
        return self.tick_hz // self.pwm_hz


@dataclass(frozen=True)
class HallSpeed(_Checked):
    """Front end of the Hall sensors in the firmware."""

    hall_timeout: float = _drive("hall_timeout")


@dataclass(frozen=True)
class VectorTracking(_Checked):
    """The vector-tracking observer in the firmware."""

    k_p_vt: float = _drive("k_p_vt")
    k_i_vt: float = _drive("k_i_vt")
    tau_max: float = _drive("tau_max")
    omega_on: float = _drive("omega_on")
    omega_off: float = _drive("omega_off")
    bw_omega_lpf: float = _drive("bw_omega_lpf")
    load_angle_comp: int = _drive("load_angle_comp")
    k_pc: float = _drive("k_pc")
    k_ic: float = _drive("k_ic")
    literal_sgn: int = _drive("literal_sgn")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.omega_off > self.omega_on:
            raise ConfigError(f"omega_off must be <= omega_on = {self.omega_on:g} rad/s, got {self.omega_off:g}")


@dataclass(frozen=True)
class CurrentLoop(_Checked):
    """Current loop in the firmware."""

    bw_current: float = _drive("bw_current")


@dataclass(frozen=True)
class SpeedLoop(_Checked):
    """Speed loop in the firmware."""

    k_p_speed: float = _drive("k_p_speed")
    k_i_speed: float = _drive("k_i_speed")


@dataclass(frozen=True)
class DeadTime(_Checked):
    """Dead-time compensation in the firmware."""

    dead_time_hat: float = _drive("dead_time_hat")
    dead_time_comp: float = _drive("dead_time_comp")


@dataclass(frozen=True)
class Protection(_Checked):
    """Limits at which the firmware opens the outputs."""

    i_trip: float = _positive("A")
    omega_m_trip: float = _positive("rad/s")
    u_dc_min: float = _not_negative("V")
    u_dc_max: float = _positive("V")
    hall_fault_time: float = _positive("s")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.u_dc_min >= self.u_dc_max:
            raise ConfigError(f"u_dc_min must be < u_dc_max = {self.u_dc_max:g} V, got {self.u_dc_min:g}")


@dataclass(frozen=True, kw_only=True)
class Firmware(_Checked):
    """What the drive's firmware assumes and does; the initial values of its parameters."""

    n_p: int = _drive("n_p")
    R_s_hat: float = _drive("R_s_hat")
    L_s_hat: float = _drive("L_s_hat")
    psi_f_hat: float = _drive("psi_f_hat")
    i_max: float = _drive("i_max")
    omega_m_max: float = _drive("omega_m_max")
    alpha_m_max: float = _drive("alpha_m_max")
    observer: int = _drive("observer")
    watchdog: float = _drive("watchdog")
    hall_speed: HallSpeed
    vector_tracking: VectorTracking
    current_loop: CurrentLoop
    speed_loop: SpeedLoop
    dead_time: DeadTime
    protection: Protection

    def parameters(self) -> dict[str, float]:
        """The drive's `DRIVE_PARAMETERS` by name."""
        return _parameters(self)


@dataclass(frozen=True)
class BenchParams(_Checked):
    """Everything about a simulated bench."""

    motor: Motor
    mechanics: Mechanics
    load: Load
    hall: Hall
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


_SECTIONS: dict[str, type[_Checked]] = {
    c.__name__: c
    for c in (
        Motor, Mechanics, Load, Hall, Encoder, Inverter, CurrentSensor, Clock, Firmware,
        HallSpeed, VectorTracking, CurrentLoop, SpeedLoop, DeadTime, Protection,
    )
}  # fmt: skip

S = TypeVar("S", bound=_Checked)


def _parameters(section: _Checked) -> dict[str, float]:
    values: dict[str, float] = {}
    for f in fields(section):
        value = getattr(section, f.name)
        if isinstance(value, _Checked):
            values.update(_parameters(value))
        elif f.metadata.get("parameter"):
            values[f.name] = float(value)
    return values


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
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None


def _collect(
    table: Mapping[str, Any],
    prefix: str,
    source: str,
    section: type[_Checked],
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

"""The sections of a bench's configuration: every figure with its unit and range, checked whenever one is made.

Fields carry the names and units of the TOML's keys. Those that are parameters of the drive or of the load machine
take their range from `protocol.signals`. This module reads no file (that is `sim.config.params`), knows no kernel and
imports no numba.
"""

from __future__ import annotations

from dataclasses import Field, dataclass, field, fields, replace
from typing import Any, ClassVar

from protocol.signals import DRIVE_PARAMETERS, LOAD_PARAMETERS, Flag, Parameter
from sim.config.ranges import ConfigError, Range, check


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


def _drive_six(name: str) -> Any:
    """Six parameters of one range, `name`_1 to `name`_6."""
    return field(metadata={"range": replace(_DRIVE_RANGES[f"{name}_1"], length=6), "parameter": True})


def _load(name: str) -> Any:
    return field(metadata={"range": _LOAD_RANGES[name], "parameter": True})


class Section:
    """A section whose fields are checked whenever one is made, also by `dataclasses.replace`."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __post_init__(self) -> None:
        for f in fields(self):
            if (allowed := f.metadata.get("range")) is not None:
                object.__setattr__(self, f.name, check(f.name, getattr(self, f.name), allowed))


@dataclass(frozen=True)
class Motor(Section):
    """The machine, amplitude-invariant quantities."""

    R_s: float = _positive("ohm")
    L_d: float = _positive("H")
    L_q: float = _positive("H")
    psi_f: float = _positive("V s")
    n_p: int = _whole(1, 64)


@dataclass(frozen=True)
class Mechanics(Section):
    """The shaft."""

    J: float = _positive("kg m2")
    b: float = _not_negative("N m s/rad")
    tau_coulomb: float = _not_negative("N m")
    theta_0_deg: float = _between(-360.0, 360.0, "deg")


@dataclass(frozen=True)
class Load(Section):
    """The load machine."""

    tau_max: float = _load("tau_max")
    omega_m_max: float = _load("omega_m_max")
    watchdog: float = _load("watchdog")
    alpha_m_max: float = _not_negative("rad/s2")


@dataclass(frozen=True)
class Hall(Section):
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
class Wiring(Section):
    """What is wrong with the wires of the Hall sensors; the load machine's parameters put it there and take it away."""

    hall_swap: int = _load("hall_swap")
    hall_open: int = _load("hall_open")
    hall_invert: int = _load("hall_invert")
    hall_short: int = _load("hall_short")
    hall_glitch: float = _load("hall_glitch")


@dataclass(frozen=True)
class Encoder(Section):
    """The incremental encoder."""

    present: int = _whole(0, 1)
    pulses_per_rev: int = _whole(1, 16383)
    offset_deg: float = _between(-360.0, 360.0, "deg")
    bw_speed: float = _between(0.1, 1000.0, "Hz")


@dataclass(frozen=True)
class Inverter(Section):
    """DC link and inverter."""

    u_dc: float = _between(0.0, 63.9, "V", open_lo=True)
    dead_time: float = _between(0.0, 1e-5, "s")
    u_device: float = _between(0.0, 5.0, "V")
    i_smooth: float = _between(1e-3, 10.0, "A")
    u_diode: float = _between(0.0, 5.0, "V")


@dataclass(frozen=True)
class CurrentSensor(Section):
    """Phase current measurement."""

    noise_rms: float = _not_negative("A")
    offset: tuple[float, ...] = _any("A", length=3)
    gain_error: tuple[float, ...] = _between(-0.9, 10.0, length=3)
    range: float = _between(0.1, 31.9, "A")
    bits: int = _whole(4, 24)


@dataclass(frozen=True)
class Clock(Section):
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
class HallSpeed(Section):
    """Front end of the Hall sensors in the firmware."""

    hall_timeout: float = _drive("hall_timeout")


@dataclass(frozen=True)
class HallEdges(Section):
    """Where the firmware takes the Hall edges to lie: ideal minus actual angle, sectors I..VI."""

    edge_up: tuple[float, ...] = _drive_six("edge_up")
    edge_down: tuple[float, ...] = _drive_six("edge_down")
    learn_edges: int = _drive("learn_edges")


@dataclass(frozen=True)
class HallVector(Section):
    """Observers on the Hall vector in the firmware."""

    bw_hall_vector: float = _drive("bw_hall_vector")


@dataclass(frozen=True)
class VectorTracking(Section):
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
class Injection(Section):
    """The sine that the firmware adds inside the vector-tracking observer, to measure its frequency response."""

    inject: int = _drive("inject")
    inject_amplitude: float = _drive("inject_amplitude")
    inject_hz: float = _drive("inject_hz")


@dataclass(frozen=True)
class CurrentLoop(Section):
    """Current loop in the firmware."""

    bw_current: float = _drive("bw_current")


@dataclass(frozen=True)
class SpeedLoop(Section):
    """Speed loop in the firmware."""

    k_p_speed: float = _drive("k_p_speed")
    k_i_speed: float = _drive("k_i_speed")


@dataclass(frozen=True)
class DeadTime(Section):
    """Dead-time compensation in the firmware."""

    dead_time_hat: float = _drive("dead_time_hat")
    dead_time_comp: float = _drive("dead_time_comp")


@dataclass(frozen=True)
class Protection(Section):
    """Limits at which the firmware opens the outputs."""

    i_trip: float = _positive("A")
    omega_m_trip: float = _positive("rad/s")
    u_dc_min: float = _not_negative("V")
    u_dc_max: float = _positive("V")
    omega_trip_time: float = _positive("s")
    hall_fault_time: float = _positive("s")
    hall_fault_count: int = _whole(2, 1000)
    hall_fault_leak: float = _positive("s")
    hall_turns: float = _between(1.0, 100.0)
    hall_emf: float = _positive("V")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.u_dc_min >= self.u_dc_max:
            raise ConfigError(f"u_dc_min must be < u_dc_max = {self.u_dc_max:g} V, got {self.u_dc_min:g}")


@dataclass(frozen=True, kw_only=True)
class Firmware(Section):
    """What the drive's firmware assumes and does; the initial values of its parameters."""

    n_p: int = _drive("n_p")
    R_s_hat: float = _drive("R_s_hat")
    L_s_hat: float = _drive("L_s_hat")
    psi_f_hat: float = _drive("psi_f_hat")
    J_hat: float = _drive("J_hat")
    i_max: float = _drive("i_max")
    omega_m_max: float = _drive("omega_m_max")
    alpha_m_max: float = _drive("alpha_m_max")
    observer: int = _drive("observer")
    watchdog: float = _drive("watchdog")
    hall_speed: HallSpeed
    hall_edges: HallEdges
    hall_vector: HallVector
    vector_tracking: VectorTracking
    injection: Injection
    current_loop: CurrentLoop
    speed_loop: SpeedLoop
    dead_time: DeadTime
    protection: Protection


def parameters_of(section: Section) -> dict[str, float]:
    """The drive's or load machine's parameters in a section and those within it, by name."""
    values: dict[str, float] = {}
    for f in fields(section):
        value = getattr(section, f.name)
        if isinstance(value, Section):
            values.update(parameters_of(value))
        elif f.metadata.get("parameter"):
            if isinstance(value, tuple):
                values.update({f"{f.name}_{k}": one for k, one in enumerate(value, 1)})
            else:
                values[f.name] = float(value)
    return values

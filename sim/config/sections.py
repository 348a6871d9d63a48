"""The sections of a bench's configuration: every figure with its unit and range, checked whenever one is made.

Fields carry the names and units of the TOML's keys. Those that are parameters of the drive or of the load machine
take their range from `protocol.signals`. This module reads no file (that is `sim.config.params`), knows no kernel and
imports no numba.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Self, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from protocol.signals import DRIVE_PARAMETERS, LOAD_PARAMETERS, AngleSource, Flag, Parameter
from sim.config.derive import rounded
from sim.config.errors import explain
from sim.config.saturation import least_i_cross

T = TypeVar("T")
Two = Annotated[tuple[T, ...], Field(strict=False, min_length=2, max_length=2, description="a list of 2 numbers")]
Three = Annotated[tuple[T, ...], Field(strict=False, min_length=3, max_length=3, description="a list of 3 numbers")]
Four = Annotated[tuple[T, ...], Field(strict=False, min_length=4, max_length=4, description="a list of 4 numbers")]
Six = Annotated[tuple[T, ...], Field(strict=False, min_length=6, max_length=6, description="a list of 6 numbers")]
Whole = Annotated[int, BeforeValidator(lambda x: int(x) if isinstance(x, float) and x.is_integer() else x)]

_SIGNS = {"gt": ">", "ge": ">=", "le": "<="}


def _number(unit: str = "", **limits: float) -> Any:
    """A number in `unit` within limits: gt, ge, le."""
    if limits.keys() == {"ge", "le"}:
        words = f"between {limits['ge']:g} and {limits['le']:g}"
    else:
        words = " and ".join(f"{_SIGNS[sign]} {limit:g}" for sign, limit in limits.items()) or "a number"
    return Field(description=f"{words} {unit}".rstrip(), **limits)  # type: ignore[call-overload]


def _like(parameter: Parameter) -> Any:
    """A number within the range of a parameter."""
    number = int if parameter.flags & Flag.WHOLE else float
    unit = parameter.unit.symbol.replace("Ω", "ohm")
    return _number(unit, ge=number(parameter.lo), le=number(parameter.hi))


_DRIVE = {p.name: _like(p) for p in DRIVE_PARAMETERS}
_LOAD = {p.name: _like(p) for p in LOAD_PARAMETERS}
AT_BOOT = {
    "forced": 0.0,
    "forced_speed": 0.0,
    "forced_angle": 0.0,
    "forced_slope": 100.0,
    "test": 0.0,
    "test_voltage": 0.0,
    "test_current": 0.0,
    "test_speed": 0.0,
    "test_periods": 8.0,
    "test_length": 0.0,
}
"""Parameters of the drive that no configuration has: each boot begins with these."""


class Section(BaseModel):
    """A section of the configuration. Its numbers are checked whenever one is made, and finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @classmethod
    def of(cls, values: Mapping[str, object], sources: Mapping[str, str] | None = None) -> Self:
        """The section with these values; `sources` names the file of each dotted key. Raises `ConfigError`."""
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise explain(error, cls, sources or {}) from None

    def replace(self, **values: object) -> Self:
        """The section with other values for some keys. Raises `ConfigError`."""
        return self.of(dict(self) | values)

    def leaves(self) -> Iterator[tuple[str, float]]:
        """Name and value of each number, in sections within it too; those of a list as `name_1` and so on."""
        for name, value in self:
            if isinstance(value, Section):
                yield from value.leaves()
            elif isinstance(value, tuple):
                yield from ((f"{name}_{k}", one) for k, one in enumerate(value, 1))
            else:
                yield name, float(value)


class Motor(Section):
    """The machine, amplitude-invariant quantities."""

    R_s: float = _number("ohm", gt=0)
    L_d: float = _number("H", gt=0)
    L_q: float = _number("H", gt=0)
    psi_f: float = _number("V s", gt=0)
    n_p: Whole = _number(ge=1, le=64)
    i_max: float = _number("A", gt=0, le=200)
    emf_harmonics: Four[Annotated[float, _number(ge=-0.5, le=0.5)]]
    cogging: Two[Annotated[float, _number("N m", ge=-10, le=10)]]
    i_sat: float = _number("A", ge=0)
    i_cross: float = _number("A", ge=0)
    iron_hysteresis: float = _number("N m", ge=0)
    iron_eddy: float = _number("N m s/rad", ge=0)
    skin_R: float = _number("ohm", ge=0)
    skin_hz: float = _number("Hz", ge=10, le=1e5)

    @property
    def L_skin(self) -> float:
        """The inductance that quick currents do not see, H."""
        return self.skin_R / (2.0 * math.pi * self.skin_hz)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        most = rounded(math.pi * self.skin_hz * min(self.L_d, self.L_q), 3)
        if self.skin_R > most:
            raise ValueError(
                f"skin_R must be <= {most:g} ohm at skin_hz = {self.skin_hz:g} Hz, "
                f"where half of the inductance is gone, got {self.skin_R:g}"
            )
        least = rounded(least_i_cross(self.L_d, self.L_q, self.psi_f, self.i_max), 3) if self.i_cross else 0.0
        if self.i_cross < least:
            raise ValueError(
                f"i_cross must be >= {least:g} A, or 0 for none: below, a current of up to twice i_max "
                f"has more than one flux linkage, or none; got {self.i_cross:g}"
            )
        return self


class Mechanics(Section):
    """The shaft."""

    J: float = _number("kg m2", gt=0)
    b: float = _number("N m s/rad", ge=0)
    tau_coulomb: float = _number("N m", ge=0)
    stribeck: float = _number("N m", ge=0)
    omega_stribeck: float = _number("rad/s", ge=0.01, le=1e3)
    theta_0_deg: float = _number("deg", ge=-360, le=360)


class Thermal(Section):
    """What gets warm: the motor, by two bodies, and the electronics of the current sensors."""

    ambient: float = _number("degrees C", ge=-40, le=120)
    R_th_winding: float = _number("K/W", ge=0, le=1e3)
    R_th_housing: float = _number("K/W", gt=0, le=1e3)
    tau_winding: float = _number("s", ge=0.5, le=1e5)
    tau_housing: float = _number("s", ge=0.5, le=1e6)
    magnet: float = _number("1/K", ge=-0.01, le=0)
    drift_offset: Three[Annotated[float, _number("A")]]
    drift_gain: Three[Annotated[float, _number(ge=-0.2, le=0.2)]]
    tau_drift: float = _number("s", ge=0.1, le=1e5)

    @property
    def on(self) -> bool:
        """Whether anything changes."""
        return bool(self.R_th_winding or any(self.drift_offset) or any(self.drift_gain))


class Coupling(Section):
    """What joins the motor's shaft to the load machine's."""

    stiffness: float = _number("N m/rad", ge=0, le=1e5)
    damping: float = _number("N m s/rad", ge=0, le=10)
    backlash_deg: float = _number("deg", ge=0, le=30)
    load_share: float = _number(ge=0.05, le=0.95)
    bandwidth: float = _number("Hz", ge=1, le=500)


class DcLink(Section):
    """What is between the source and the inverter."""

    R_source: float = _number("ohm", ge=0, le=10)
    C: float = _number("F", ge=1e-5, le=1)
    regenerates: Whole = _number(ge=0, le=1)
    u_brake: float = _number("V", ge=0, le=63.9)
    R_brake: float = _number("ohm", ge=0.1, le=1e3)
    i_limit: float = _number("A", ge=0)


class Load(Section):
    """The load machine."""

    tau_max: float = _LOAD["tau_max"]
    omega_m_max: float = _LOAD["omega_m_max"]
    watchdog: float = _LOAD["watchdog"]
    alpha_m_max: float = _number("rad/s2", ge=0)


class Hall(Section):
    """The three Hall sensors, electrical degrees."""

    delta_deg: Six[Annotated[float, _number("deg", ge=-29, le=29)]]
    offset_deg: float = _number("deg", ge=-360, le=360)
    hysteresis_deg: float = _number("deg", ge=0, le=10)
    pole_pair_deg: float = _number("deg", ge=0, le=10)
    latency: float = _number("s", ge=0, le=1e-3)
    jitter_deg: float = _number("deg", ge=0, le=3)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        self.fits()
        return self

    def fits(self, faults: float = 0.0) -> None:
        """Raise ValueError where a sector has no room left, with so many degrees of faults."""
        # Neighbouring edges must be further apart than hysteresis plus pole pairs plus 4 sigma of jitter on both.
        margin = self.hysteresis_deg + 2.0 * self.pole_pair_deg + 8.0 * self.jitter_deg + faults
        also = f", with {faults:.3g} deg by [faults]," if faults else ""
        for s in range(6):
            width = 60.0 - self.delta_deg[(s + 1) % 6] + self.delta_deg[s]
            if width <= margin:
                raise ValueError(
                    f"delta_deg leaves sector {s + 1} only {width:g} deg wide; it must be wider "
                    f"than hysteresis_deg + 2 pole_pair_deg + 8 jitter_deg{also} = {margin:.6g} deg"
                )


class Wiring(Section):
    """What is wrong with the wires of the Hall sensors; the load machine's parameters put it there and take it away."""

    hall_swap: Whole = _LOAD["hall_swap"]
    hall_open: Whole = _LOAD["hall_open"]
    hall_invert: Whole = _LOAD["hall_invert"]
    hall_short: Whole = _LOAD["hall_short"]
    hall_glitch: float = _LOAD["hall_glitch"]


class HallFaults(Section):
    """What is wrong with the Hall sensors a, b, c and their inputs."""

    rise_delay: Three[Annotated[float, _number("s", ge=0, le=0.01)]]
    fall_delay: Three[Annotated[float, _number("s", ge=0, le=0.01)]]
    bounce: Three[Annotated[float, _number(ge=0, le=1)]]
    bounce_returns: Whole = _number(ge=1, le=20)
    bounce_spacing: float = _number("s", ge=1e-6, le=0.01)
    pulse_rate: Three[Annotated[float, _number("1/s", ge=0, le=1e4)]]
    pulse_min: float = _number("s", ge=1e-6, le=0.01)
    pulse_max: float = _number("s", ge=1e-6, le=0.01)
    pulse_by: Whole = _number(ge=0, le=2)
    contact_open: Three[Annotated[float, _number(ge=0, le=0.999)]]
    contact_stretch: float = _number("s", ge=5e-5, le=1)
    hysteresis_deg: Three[Annotated[float, _number("deg", ge=0, le=20)]]
    drift_deg: Three[Annotated[float, _number("deg/K", ge=-0.5, le=0.5)]]

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.pulse_min > self.pulse_max:
            raise ValueError(f"pulse_min must be <= pulse_max = {self.pulse_max:g} s, got {self.pulse_min:g}")
        width = 0.5 * (self.pulse_min + self.pulse_max)
        if max(self.pulse_rate) * width > 0.9:
            raise ValueError(
                f"pulse_rate must be <= {0.9 / width:.3g} 1/s for pulses of {width:g} s, got {max(self.pulse_rate):g}"
            )
        return self


class MagnetFaults(Section):
    """What is wrong with the magnets that the Hall sensors see."""

    pole_pair: Whole = _number(ge=1, le=64)
    pole_pair_off_deg: float = _number("deg", ge=-40, le=40)
    eccentricity_deg: float = _number("deg", ge=0, le=40)


class ShaftFaults(Section):
    """What moves the shaft at rest."""

    rock_deg: float = _number("deg", ge=0, le=360)
    rock_hz: float = _number("Hz", ge=0.1, le=100)


class MotorFaults(Section):
    """What is wrong with the wires of the motor."""

    open: Whole = _number(ge=0, le=7)
    swap: Whole = _number(ge=0, le=5)
    short: Whole = _number(ge=0, le=3)
    short_R: float = _number("ohm", ge=1e-3, le=1e3)
    short_L: float = _number("H", ge=1e-7, le=1e-2)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.short and self.open:
            raise ValueError(f"open must be 0 where short = {self.short}, got {self.open}")
        return self


class EncoderFaults(Section):
    """What is wrong with the encoder."""

    slip_deg: float = _number("deg", ge=-360, le=360)
    slip_at: float = _number("s", ge=0)
    slip_alpha: float = _number("rad/s2", ge=0)
    lost_per_rev: float = _number(ge=-1000, le=1000)
    pulses_hat: Whole = _number(ge=0, le=16383)
    reversed: Whole = _number(ge=0, le=1)


class Faults(Section):
    """What goes wrong, and when: from `begin` on until `end`, s since boot."""

    begin: float = _number("s", ge=0)
    end: float = _number("s", ge=0)
    hall: HallFaults
    magnets: MagnetFaults
    shaft: ShaftFaults
    motor: MotorFaults
    encoder: EncoderFaults

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.end and self.end <= self.begin:
            raise ValueError(f"end must be > begin = {self.begin:g} s, or 0 for never, got {self.end:g}")
        return self

    def without(self) -> Self:
        """The same with nothing in force: the size of each fault is zero."""
        return self.replace(**{name: _zeroed(getattr(self, name), sizes) for name, sizes in FAULTS.items()})


FAULTS = {
    "hall": (
        "rise_delay", "fall_delay", "bounce", "pulse_rate", "contact_open", "hysteresis_deg", "drift_deg"
    ),
    "magnets": ("pole_pair_off_deg", "eccentricity_deg"),
    "shaft": ("rock_deg",),
    "motor": ("open", "swap", "short"),
    "encoder": ("slip_deg", "slip_alpha", "lost_per_rev", "pulses_hat", "reversed"),
}  # fmt: skip
"""Keys of the sections of [faults] that say how large a fault is, zero: none; the others say of what kind."""


def _zeroed(section: Section, names: Sequence[str]) -> Section:
    return section.replace(**{name: (0.0,) * 3 if isinstance(getattr(section, name), tuple) else 0 for name in names})


class Encoder(Section):
    """The incremental encoder."""

    present: Whole = _number(ge=0, le=1)
    index_search: Whole = _number(ge=0, le=1)
    index_resets: Whole = _number(ge=0, le=1)
    pulses_per_rev: Whole = _number(ge=1, le=16383)
    offset_deg: float = _number("deg", ge=-360, le=360)
    bw_speed: float = _number("Hz", ge=0.1, le=1000)
    eccentricity_deg: float = _number("deg", ge=0, le=5)
    unevenness: float = _number(ge=0, le=0.6)
    latency: float = _number("s", ge=0, le=1e-3)


class Inverter(Section):
    """DC link and inverter."""

    u_dc: float = _number("V", gt=0, le=63.9)
    dead_time: float = _number("s", ge=0, le=1e-5)
    u_device: float = _number("V", ge=0, le=5)
    i_smooth: float = _number("A", ge=1e-3, le=10)
    u_diode: float = _number("V", ge=0, le=5)
    dead_time_by_edges: Whole = _number(ge=0, le=1)


class CurrentSensor(Section):
    """Phase current measurement."""

    noise_rms: float = _number("A", ge=0)
    offset: Three[Annotated[float, _number("A")]]
    gain_error: Three[Annotated[float, _number(ge=-0.9, le=10)]]
    range: float = _number("A", ge=0.1, le=1000)
    bits: Whole = _number(ge=4, le=24)
    delay: float = _number("s", ge=0, le=2e-5)


class LinkSensor(Section):
    """Measurement of the DC link voltage."""

    gain_error: float = _number(ge=-0.5, le=0.5)


class Clock(Section):
    """Timers and steps."""

    tick_hz: Whole = _number("Hz", ge=1_000_000, le=1_000_000_000)
    pwm_hz: Whole = _number("Hz", ge=1000, le=100_000)
    substeps: Whole = _number(ge=1, le=100)
    start_tick: Whole = _number(ge=0, le=2**62)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.tick_hz % self.pwm_hz:
            raise ValueError(f"tick_hz must be a whole multiple of pwm_hz = {self.pwm_hz} Hz, got {self.tick_hz}")
        return self

    @property
    def period_ticks(self) -> int:
        """Timer ticks in a PWM period."""
        return self.tick_hz // self.pwm_hz


class Memory(Section):
    """The drive's memory."""

    capture: Whole = _number("bytes", ge=0, le=1 << 28)


class HallSpeed(Section):
    """Front end of the Hall sensors in the firmware."""

    hall_timeout: float = _DRIVE["hall_timeout"]


class HallEdges(Section):
    """Where the firmware takes the Hall edges to lie: ideal minus actual angle, sectors I..VI."""

    edge_up: Six[Annotated[float, _DRIVE["edge_up_1"]]]
    edge_down: Six[Annotated[float, _DRIVE["edge_down_1"]]]
    edge_sd: float = _DRIVE["edge_sd"]
    learn_edges: Whole = _DRIVE["learn_edges"]


class HallVector(Section):
    """Observers on the Hall vector in the firmware."""

    bw_hall_vector: float = _DRIVE["bw_hall_vector"]


class VectorTracking(Section):
    """The vector-tracking observer in the firmware."""

    k_p_vt: float = _DRIVE["k_p_vt"]
    k_i_vt: float = _DRIVE["k_i_vt"]
    tau_max: float = _DRIVE["tau_max"]
    omega_on: float = _DRIVE["omega_on"]
    omega_off: float = _DRIVE["omega_off"]
    bw_omega_lpf: float = _DRIVE["bw_omega_lpf"]
    load_angle_comp: Whole = _DRIVE["load_angle_comp"]
    k_pc: float = _DRIVE["k_pc"]
    k_ic: float = _DRIVE["k_ic"]
    literal_sgn: Whole = _DRIVE["literal_sgn"]

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.omega_off > self.omega_on:
            raise ValueError(f"omega_off must be <= omega_on = {self.omega_on:g} rad/s, got {self.omega_off:g}")
        return self


class Injection(Section):
    """The sine that the firmware adds inside the vector-tracking observer, to measure its frequency response."""

    inject: Whole = _DRIVE["inject"]
    inject_amplitude: float = _DRIVE["inject_amplitude"]
    inject_hz: float = _DRIVE["inject_hz"]


class CurrentLoop(Section):
    """Current loop in the firmware."""

    bw_current: float = _DRIVE["bw_current"]


class SpeedLoop(Section):
    """Speed loop in the firmware."""

    k_p_speed: float = _DRIVE["k_p_speed"]
    k_i_speed: float = _DRIVE["k_i_speed"]


class DeadTime(Section):
    """Dead-time compensation in the firmware."""

    dead_time_hat: float = _DRIVE["dead_time_hat"]
    dead_time_comp: float = _DRIVE["dead_time_comp"]
    dead_time_learn: Whole = _DRIVE["dead_time_learn"]


class Protection(Section):
    """Limits at which the firmware opens the outputs."""

    i_trip: float = _DRIVE["i_trip"]
    omega_m_trip: float = _DRIVE["omega_m_trip"]
    u_dc_min: float = _DRIVE["u_dc_min"]
    u_dc_max: float = _DRIVE["u_dc_max"]
    i_cont: float = _DRIVE["i_cont"]
    i2t_max: float = _DRIVE["i2t_max"]
    u_test_max: float = _DRIVE["u_test_max"]
    omega_trip_time: float = _number("s", gt=0)
    hall_fault_time: float = _number("s", gt=0)
    hall_fault_count: Whole = _number(ge=2, le=1000)
    hall_fault_leak: float = _number("s", gt=0)
    hall_turns: float = _number(ge=1, le=100)
    hall_emf: float = _number("V", gt=0)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.u_dc_min >= self.u_dc_max:
            raise ValueError(f"u_dc_min must be < u_dc_max = {self.u_dc_max:g} V, got {self.u_dc_min:g}")
        return self


class Firmware(Section):
    """What the drive's firmware assumes and does; the initial values of its parameters."""

    n_p: Whole = _DRIVE["n_p"]
    R_s_hat: float = _DRIVE["R_s_hat"]
    L_s_hat: float = _DRIVE["L_s_hat"]
    psi_f_hat: float = _DRIVE["psi_f_hat"]
    J_hat: float = _DRIVE["J_hat"]
    i_max: float = _DRIVE["i_max"]
    omega_m_max: float = _DRIVE["omega_m_max"]
    alpha_m_max: float = _DRIVE["alpha_m_max"]
    hall_offset: float = _DRIVE["hall_offset"]
    hall_swap_hat: Whole = _DRIVE["hall_swap_hat"]
    hall_invert_hat: Whole = _DRIVE["hall_invert_hat"]
    encoder_lines: Whole = _DRIVE["encoder_lines"]
    encoder_reverse: Whole = _DRIVE["encoder_reverse"]
    encoder_zero: float = _DRIVE["encoder_zero"]
    observer: Whole = _DRIVE["observer"]
    watchdog: float = _DRIVE["watchdog"]
    hall_speed: HallSpeed
    hall_edges: HallEdges
    hall_vector: HallVector
    vector_tracking: VectorTracking
    injection: Injection
    current_loop: CurrentLoop
    speed_loop: SpeedLoop
    dead_time: DeadTime
    protection: Protection


class BenchParams(Section):
    """Everything about a simulated bench."""

    motor: Motor
    thermal: Thermal
    mechanics: Mechanics
    coupling: Coupling
    load: Load
    hall: Hall
    wiring: Wiring
    faults: Faults
    encoder: Encoder
    dc_link: DcLink
    inverter: Inverter
    current_sensor: CurrentSensor
    link_sensor: LinkSensor
    clock: Clock
    memory: Memory
    firmware: Firmware

    @model_validator(mode="after")
    def _fits(self) -> Self:
        h = 1.0 / (self.clock.pwm_hz * self.clock.substeps)
        motor, inverter = self.motor, self.inverter
        L, R = min(motor.L_d, motor.L_q) - motor.L_skin, motor.R_s + motor.skin_R
        friction = self.mechanics.b + motor.iron_eddy + self.mechanics.stribeck / self.mechanics.omega_stribeck
        lost = inverter.u_dc * inverter.dead_time * self.clock.pwm_hz + inverter.u_device
        # the integrator's iteration ends up to four of the last of these time constants, and is good up to about one
        for name, value, least, unit in (
            ("motor.L_d", motor.L_d, R * h + motor.L_skin, "H"),
            ("motor.L_q", motor.L_q, R * h + motor.L_skin, "H"),
            ("mechanics.J", self.mechanics.J, friction * h, "kg m2"),
            ("inverter.i_smooth", inverter.i_smooth, lost * h / L / 2.0, "A"),
        ):
            if value < rounded(least, 3):
                raise ValueError(
                    f"{name} must be >= {least:.3g} {unit} for integration steps of {h:.3g} s, got {value:g}; "
                    f"take more clock.substeps"
                )
        coupling = self.coupling
        if coupling.stiffness:
            least = self.mechanics.J * min(coupling.load_share, 1.0 - coupling.load_share)
            # a tenth of what Verlet's method bears, with either side alone
            for name, value, most, unit in (
                ("stiffness", coupling.stiffness, min(0.1 * least / h**2, 1e5), "N m/rad"),
                ("damping", coupling.damping, 0.1 * least / h, "N m s/rad"),
            ):
                if value > rounded(most, 3):
                    raise ValueError(
                        f"coupling.{name} must be <= {most:.3g} {unit} for integration steps of {h:.3g} s and "
                        f"{least:.3g} kg m2, the lesser of two inertias, got {value:g}; take more clock.substeps"
                    )
        link = self.dc_link
        if link.i_limit and not link.R_source:
            raise ValueError(f"dc_link.i_limit must be 0 where dc_link.R_source = 0, got {link.i_limit:g}")
        if link.R_source and link.u_brake and link.u_brake <= inverter.u_dc:
            raise ValueError(f"dc_link.u_brake must be > inverter.u_dc = {inverter.u_dc:g} V, got {link.u_brake:g}")
        magnets, n_p = self.faults.magnets, motor.n_p
        if magnets.pole_pair_off_deg and magnets.pole_pair > n_p:
            raise ValueError(f"faults.magnets.pole_pair must be <= motor.n_p = {n_p}, got {magnets.pole_pair}")
        more = max(self.faults.hall.hysteresis_deg) + abs(magnets.pole_pair_off_deg)
        self.hall.fits(more + 2.0 * magnets.eccentricity_deg * math.sin(math.pi / (6.0 * n_p)))
        if self.firmware.observer == AngleSource.ENCODER and not self.encoder.present:
            raise ValueError("firmware.observer must be 1 or 2 where encoder.present = 0, got 0")
        return self

    def drive_parameters(self) -> dict[str, float]:
        """The initial values of the drive's `DRIVE_PARAMETERS` by name."""
        own = {name: value for name, value in self.firmware.leaves() if name in _DRIVE}
        return own | AT_BOOT | {"i_range": self.current_sensor.range}

    def load_parameters(self) -> dict[str, float]:
        """The initial values of the load machine's `LOAD_PARAMETERS` by name."""
        own = {name: value for section in (self.load, self.wiring) for name, value in section.leaves() if name in _LOAD}
        own |= {f"hall_delta_{s}": math.radians(delta) for s, delta in enumerate(self.hall.delta_deg, 1)}
        return own | {"faults": float(self.faults.begin == 0.0)}

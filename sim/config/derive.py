"""What a configuration does not say follows from the motor, the shaft, the inverter and the clock.

A motor, its largest current and its DC link make a drive: load machine, current sensors, the firmware's parameters,
gains and thresholds. Each rule is a proportion whose factor gives the paper's motor the paper's value, or ours, rounded
as a person would round it. What is given stays, and what follows from it follows from the given value.

`sim/default.toml` has each rule beside its key, for people.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import Any

from protocol.signals import DRIVE_PARAMETERS, LOAD_PARAMETERS
from sim.config.errors import DERIVED, ConfigError

HELD = 30.0  # s for which a cold winding is let have i_max
PAPER_E = 1980.0  # rad/s, electrical speed of the paper's motor at its omega_m_max of 330 rad/s
RANGES = {
    section: {p.name: (p.lo, p.hi) for p in parameters}
    for section, parameters in (("firmware", DRIVE_PARAMETERS), ("load", LOAD_PARAMETERS))
}
"""What parameters of the drive and of the load machine can be, by section and name."""


class Design:
    """The figures that rules start from. `design[dotted]`: a value of the configuration, given or derived so far."""

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values

    def section(self, dotted: str) -> tuple[dict[str, Any], str]:
        """The section that a dotted key is in, and its name there."""
        *sections, key = dotted.split(".")
        table = self._values
        for section in sections:
            table = table.setdefault(section, {})
        return table, key

    def __getitem__(self, dotted: str) -> float:
        table, key = self.section(dotted)
        return float(table[key])

    @property
    def u_max(self) -> float:
        """The largest voltage vector of linear modulation, V."""
        return self["inverter.u_dc"] / math.sqrt(3.0)

    @property
    def k_tau(self) -> float:
        """Torque constant, N m by A of q current."""
        return 1.5 * self["motor.n_p"] * self["motor.psi_f"]

    @property
    def tau(self) -> float:
        """Torque at the motor's largest current, N m."""
        return self.k_tau * self["motor.i_max"]

    @property
    def i_max(self) -> float:
        """The largest current that the firmware asks for, A."""
        return self["firmware.i_max"] or self["motor.i_max"]

    @property
    def w(self) -> float:
        """The top speed, electrical, by that of the paper's motor."""
        return self["motor.n_p"] * self.top / PAPER_E

    @property
    def e_on(self) -> float:
        """V that dead time and an error of the resistance can leave of a back-EMF."""
        return max(0.00546 * self["inverter.u_dc"], 0.1 * self["motor.R_s"] * self["motor.i_max"])

    @cached_property
    def top(self) -> float:
        """The top speed, mechanical rad/s: 99 % of what the voltage allows with half the current, down to 2 digits."""
        half = 0.5 * self["motor.i_max"]
        if not (speed := 0.99 * self.reachable(half)):
            raise ConfigError(
                f"motor.i_max = {2 * half:g} A is too much for motor.R_s = {self['motor.R_s']:g} ohm: half of it takes "
                f"{half * self['motor.R_s']:.3g} V, and of inverter.u_dc = {self['inverter.u_dc']:g} V a phase gets "
                f"{self.u_max:.3g} V"
            )
        step = 10.0 ** (math.floor(math.log10(speed)) - 1)
        return rounded(math.floor(speed / step) * step, 2)

    def reachable(self, i_q: float) -> float:
        """Mechanical speed, rad/s, at which `i_q` (A) takes all of `u_max`; 0 where it does at standstill."""
        psi_f, drop, u_L = self["motor.psi_f"], self["motor.R_s"] * i_q, self["motor.L_q"] * i_q
        if drop >= self.u_max:
            return 0.0
        # (psi_f omega + drop)^2 + (u_L omega)^2 = u_max^2
        square = psi_f * psi_f + u_L * u_L
        root = math.sqrt((psi_f * drop) ** 2 + square * (self.u_max**2 - drop**2))
        return (root - psi_f * drop) / square / self["motor.n_p"]


RULES: dict[str, tuple[int, Callable[[Design], float]]] = {
    # the firmware knows the motor
    "firmware.n_p": (0, lambda d: d["motor.n_p"]),
    "firmware.R_s_hat": (0, lambda d: d["motor.R_s"]),
    "firmware.L_s_hat": (0, lambda d: d["motor.L_q"]),
    "firmware.psi_f_hat": (0, lambda d: d["motor.psi_f"]),
    "firmware.i_max": (0, lambda d: d["motor.i_max"]),
    "firmware.omega_m_max": (0, lambda d: d.top),
    "firmware.hall_offset": (0, lambda d: math.remainder(math.radians(d["hall.offset_deg"]), math.tau)),
    "firmware.encoder_lines": (0, lambda d: d["encoder.pulses_per_rev"]),
    "current_sensor.range": (2, lambda d: max(2.5 * d["motor.i_max"], 0.1)),
    "current_sensor.noise_rms": (2, lambda d: d["current_sensor.range"] / 1000.0),
    # the shaft and its load machine, by rated torque and speed
    "mechanics.J": (2, lambda d: 0.14 * d.tau / d.top),
    "mechanics.b": (2, lambda d: 0.07 * d.tau / d.top),
    "mechanics.tau_coulomb": (2, lambda d: 0.0106 * d.tau),
    "firmware.alpha_m_max": (2, lambda d: 0.425 * d.tau / d["mechanics.J"]),
    "load.tau_max": (2, lambda d: 2.12 * d.tau),
    "load.omega_m_max": (2, lambda d: 1.06 * d.top),
    "load.alpha_m_max": (2, lambda d: 5.0 * d["firmware.alpha_m_max"]),
    # loops
    "firmware.J_hat": (0, lambda d: d["mechanics.J"]),
    "firmware.speed_loop.k_p_speed": (3, lambda d: 58.95 * d["firmware.J_hat"] / d.k_tau),
    "firmware.speed_loop.k_i_speed": (3, lambda d: 15.0 * d["firmware.speed_loop.k_p_speed"]),
    "firmware.current_loop.bw_current": (
        2,
        lambda d: min(d["clock.pwm_hz"] / 20.0, d.u_max / (math.tau * d["motor.L_q"] * d["motor.i_max"])),
    ),
    # observers: rates and times go with the electrical frequency
    "firmware.vector_tracking.k_p_vt": (4, lambda d: 1268.0 * d.w),
    "firmware.vector_tracking.k_i_vt": (5, lambda d: 54289.0 * d.w**2),
    "firmware.vector_tracking.tau_max": (2, lambda d: 0.5e-3 / d.w),
    "firmware.hall_speed.hall_timeout": (2, lambda d: 0.2 / d.w),
    "firmware.hall_vector.bw_hall_vector": (2, lambda d: 10.0 * d.w),
    "firmware.vector_tracking.k_ic": (
        2,
        lambda d: (
            11.0
            * (d["firmware.current_loop.bw_current"] / 800.0 * d["motor.R_s"] / 0.158)
            * (24.0 / d["inverter.u_dc"])
        ),
    ),
    # thresholds are voltages
    "firmware.vector_tracking.omega_on": (2, lambda d: d.e_on / d["motor.psi_f"]),
    "firmware.vector_tracking.omega_off": (
        2,
        lambda d: min(0.6 * d.e_on / d["motor.psi_f"], d["firmware.vector_tracking.omega_on"]),
    ),
    "firmware.protection.hall_emf": (2, lambda d: 0.0125 * d["inverter.u_dc"]),
    "firmware.protection.u_dc_min": (3, lambda d: 0.5 * d["inverter.u_dc"]),
    "firmware.protection.u_dc_max": (3, lambda d: 4.0 / 3.0 * d["inverter.u_dc"]),
    "firmware.protection.i_trip": (2, lambda d: 2.0 * d.i_max),
    "firmware.protection.i_cont": (2, lambda d: 0.7 * d.i_max),
    "firmware.protection.i2t_max": (
        2,
        lambda d: HELD * (d.i_max**2 - d["firmware.protection.i_cont"] ** 2),
    ),
    "firmware.protection.u_test_max": (
        2,
        lambda d: min(1.5 * d["motor.R_s"] * d.i_max, d.u_max),
    ),
    "firmware.protection.omega_m_trip": (2, lambda d: 1.2 * (d["firmware.omega_m_max"] or d.top)),
    # the inverter: its dead-time error reaches as far as the ripple
    "inverter.i_smooth": (
        2,
        lambda d: clip(
            0.0352 * d["inverter.u_dc"] / (min(d["motor.L_d"], d["motor.L_q"]) * d["clock.pwm_hz"]), 1e-3, 10.0
        ),
    ),
    "firmware.dead_time.dead_time_hat": (0, lambda d: d["inverter.dead_time"]),
}
"""By dotted key: significant digits that are kept, 0 for all, and the value. In order: some start from others."""


def fill(values: dict[str, Any], sources: dict[str, str]) -> None:
    """Put what follows where `values`, the sections of a configuration, have nothing; `sources` are told.

    What `values` have must be within its range. A parameter goes as far as its range does. ConfigError for a motor that
    cannot turn.
    """
    design = Design(values)
    for dotted, (digits, rule) in RULES.items():
        table, key = design.section(dotted)
        if key not in table:
            value = rule(design)
            lo, hi = RANGES.get(dotted.partition(".")[0], {}).get(key, (-math.inf, math.inf))
            table[key] = clip(rounded(value, digits) if digits else value, lo, hi)
            sources[dotted] = DERIVED


def clip(value: float, lo: float, hi: float) -> float:
    """The value, or the limit that it is beyond."""
    return min(max(value, lo), hi)


def rounded(value: float, digits: int) -> float:
    """The value with so many significant digits."""
    return float(f"{value:.{digits}g}")

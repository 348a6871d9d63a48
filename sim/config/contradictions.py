"""What in a configuration does not go together: allowed, because drives are like that, but said with both values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from sim.config.errors import DEFAULTS
from sim.config.sections import BenchParams

OFF = 0.25  # of a motor's value, by which the firmware's may differ
A_TURN = 20.0  # PWM periods in an electrical revolution, at least
MOTOR = ("R_s", "L_d", "L_q", "psi_f", "n_p", "i_max")
"""Keys that make another motor of it, all or none."""


def contradictions(p: BenchParams, sources: Mapping[str, str]) -> Iterator[str]:
    """One line each; `sources`: where each dotted key is from."""
    yield from _mixed(sources)
    yield from _assumptions(p)
    yield from _limits(p)
    yield from _faults(p)


def _mixed(sources: Mapping[str, str]) -> Iterator[str]:
    own = [key for key in MOTOR if sources.get(f"motor.{key}", DEFAULTS) != DEFAULTS]
    left = [key for key in MOTOR if key not in own]
    if left and {"n_p", "psi_f"} <= set(own):
        yield f"[motor] sets {', '.join(own)} but not {', '.join(left)}: those of the paper's motor are used"


def _assumptions(p: BenchParams) -> Iterator[str]:
    motor, firmware = p.motor, p.firmware
    if firmware.n_p != motor.n_p:
        yield f"firmware.n_p = {firmware.n_p}, but motor.n_p = {motor.n_p}"
    lines = p.encoder.pulses_per_rev
    if p.encoder.present and firmware.encoder_lines != lines:
        yield f"firmware.encoder_lines = {firmware.encoder_lines}, but encoder.pulses_per_rev = {lines}"
    for name, assumed, true, least, most, unit in (
        ("R_s_hat", firmware.R_s_hat, "motor.R_s", motor.R_s, motor.R_s, "ohm"),
        ("L_s_hat", firmware.L_s_hat, "motor.L_q", min(motor.L_d, motor.L_q), max(motor.L_d, motor.L_q), "H"),
        ("psi_f_hat", firmware.psi_f_hat, "motor.psi_f", motor.psi_f, motor.psi_f, "V s"),
        ("J_hat", firmware.J_hat, "mechanics.J", p.mechanics.J, p.mechanics.J, "kg m2"),
    ):
        if not (1.0 - OFF) * least <= assumed <= (1.0 + OFF) * most:
            value = motor.L_q if name == "L_s_hat" else least
            yield f"firmware.{name} = {assumed:g} {unit}, but {true} = {value:g} {unit}"


def _limits(p: BenchParams) -> Iterator[str]:
    motor, firmware, u_dc = p.motor, p.firmware, p.inverter.u_dc
    if firmware.i_max > motor.i_max:
        yield f"firmware.i_max = {firmware.i_max:g} A, but motor.i_max = {motor.i_max:g} A"
    for name, current in (("i_max", firmware.i_max), ("protection.i_trip", firmware.protection.i_trip)):
        if current > p.current_sensor.range:
            yield f"firmware.{name} = {current:g} A is beyond current_sensor.range = {p.current_sensor.range:g} A"
    show = 0.5 * firmware.i_max * 1.5 * firmware.n_p * firmware.psi_f_hat
    if p.load.tau_max < show:
        yield f"load.tau_max = {p.load.tau_max:g} N m, but the show of bench live brakes with {show:.3g} N m"
    fastest = u_dc / math.sqrt(3.0) / (motor.n_p * motor.psi_f)
    if firmware.omega_m_max > fastest:
        yield (
            f"firmware.omega_m_max = {firmware.omega_m_max:g} rad/s, but inverter.u_dc = {u_dc:g} V turns the motor at "
            f"{fastest:.3g} rad/s at most"
        )
    periods = p.clock.pwm_hz * math.tau / max(motor.n_p * firmware.omega_m_max, 1e-9)
    if periods < A_TURN:
        yield (
            f"clock.pwm_hz = {p.clock.pwm_hz} Hz makes only {periods:.3g} periods of an electrical revolution at "
            f"firmware.omega_m_max = {firmware.omega_m_max:g} rad/s"
        )


def _faults(p: BenchParams) -> Iterator[str]:
    wrong = [name for name, value in p.wiring if value]
    if p.faults.begin and wrong:
        yield f"faults.begin = {p.faults.begin:g} s, but wiring.{wrong[0]} is in force from the start"
    if any(p.faults.hall.drift_deg) and not p.thermal.R_th_winding:
        yield "faults.hall.drift_deg moves nothing: with thermal.R_th_winding = 0 K/W nothing gets warm"

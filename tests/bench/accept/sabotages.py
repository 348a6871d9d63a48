"""Deliberate faults of the simulated drive, by kind and size: in its configuration, and in one expression of its code.

A kind says what it does by the number of an effect (`effects`) that it must change, and by how much, by a formula of
the motor's data. A fault without its effect is an error of this table, never a fault that was missed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from operator import attrgetter
from typing import Any, NamedTuple

from sim.config.derive import RULES
from sim.config.params import Value, load_params
from tests.bench.accept.effects import K_I, N_P, PSI, T_S, L, R
from tests.bench.accept.switched import Change
from tests.sim.drive.rig import RPM

Size = float
SLOW, FAST = 500.0 * RPM * N_P, 2000.0 * RPM * N_P  # electrical rad/s
EDGE_DEG = 1000.0 * RPM * N_P * 180.0 / math.pi  # deg/s at 1000 r/min
DEAD_VOLTS = 24.0 * 1e-6 * 16e3  # that a leg loses by 1 us
ALPHA = 2.0 * math.pi * 800.0  # rad/s, of the current loop


class Kind(NamedTuple):
    """One kind of fault; `about` says what is wrong, with {size} for people."""

    about: str
    sizes: tuple[Size, ...]
    effect: str
    expected: Callable[[Size], float]
    """By how much the effect's number differs from the healthy drive's."""
    config: Callable[[Size], Mapping[str, Value]] | None = None
    change: Change | None = None
    within: float = 0.25
    """Of what is expected, that it may differ; `LEAST`: it only has to be as much, either way."""
    unit: str = "%"


LEAST = math.inf


class Fault(NamedTuple):
    """A kind in one size."""

    name: str
    kind: Kind
    size: Size

    @property
    def about(self) -> str:
        return self.kind.about.format(size=told(self.size, self.kind.unit))

    @property
    def config(self) -> dict[str, Any]:
        """Values by dotted key: the fault's own, and what else would follow from them as for a healthy drive."""
        if self.kind.config is None:
            return {}
        own = {key: list(x) if isinstance(x, tuple) else x for key, x in self.kind.config(self.size).items()}
        return {**healthy(), **own}

    def shown(self, healthy: float, found: float) -> bool:
        """Whether the effect is there."""
        wanted = self.kind.expected(self.size)
        if self.kind.within == LEAST:
            return abs(found - healthy) >= abs(wanted)
        return abs(found - healthy - wanted) <= self.kind.within * abs(wanted)


@cache
def healthy() -> dict[str, Value]:
    """What follows from the default motor, so that another one changes nothing of the firmware."""
    return {key: attrgetter(key)(load_params()) for key in RULES}


def told(size: Size, unit: str) -> str:
    """A size for people."""
    scale = {"%": 100.0, "us": 1e6, "mA": 1e3}.get(unit, 1.0)
    return f"{scale * size:g} {unit}".strip()


def _first(size: Size) -> list[float]:
    return [size, 0.0, 0.0]


def _moved(size: Size) -> list[float]:
    own = list(load_params().hall.delta_deg)
    return [own[0] - size, *own[1:]]  # an ideal less an actual angle


def _answer(hz: float, k_p: float = 1.0, k_i: float = 1.0) -> float:
    """(11) of the paper, with shares of its gains: real part."""
    s = 2j * math.pi * hz
    top = 1268.0 * k_p * s + 54289.0 * k_i
    return float((top / (s * s + top)).real)


def _lag(share: float) -> float:
    return N_P * 1000.0 / (2.0 * math.pi * 50.0 * share)


SENSORS = {
    "gain of one current sensor": Kind(
        "the current sensor of phase a reads {size} too much", (0.005, 0.01, 0.03), "current_gain",
        lambda s: s, lambda s: {"current_sensor.gain_error": _first(s)},
    ),
    "gain of all current sensors": Kind(
        "all current sensors read {size} too much", (0.005, 0.01, 0.03), "current_gain_c",
        lambda s: s, lambda s: {"current_sensor.gain_error": [s] * 3},
    ),
    "offset of a current sensor": Kind(
        "the current sensor of phase a has an offset of {size}", (0.02, 0.04, 0.08), "current_offset",
        lambda s: s, lambda s: {"current_sensor.offset": _first(s)}, unit="mA",
    ),
    "late current samples": Kind(
        "the converter samples {size} after the middle of the low state", (1e-6, 5e-6), "current_error_q",
        lambda s: -s / L * (R * 4.0 + 1000.0 * RPM * N_P * PSI), lambda s: {"current_sensor.delay": s}, unit="us",
    ),
    "noise of the current sensors": Kind(
        "the current sensors have {size} rms of noise, and should have 20 mA", (0.025, 0.05),
        "current_noise", lambda s: s - 0.02, lambda s: {"current_sensor.noise_rms": s}, unit="mA",
    ),
    "late Hall sensors": Kind(
        "all Hall edges come {size} late", (1e-6, 2e-6, 20e-6), "edges_late",
        lambda s: s * EDGE_DEG, lambda s: {"hall.latency": s}, unit="us",
    ),
    "one falling edge late": Kind(
        "the falling edge of Hall sensor c comes {size} late", (5e-6, 20e-6), "edge_I_late",
        lambda s: s * EDGE_DEG, lambda s: {"faults.hall.fall_delay": [0.0, 0.0, s]}, unit="us",
    ),
    "one Hall edge moved": Kind(
        "the edge that opens sector I lies {size} later", (0.1, 0.2, 1.0), "edge_I_late",
        lambda s: s, lambda s: {"hall.delta_deg": _moved(s)}, unit="deg",
    ),
    "Hall ring turned": Kind(
        "the ring of Hall sensors is turned by {size}", (0.1, 0.2, 1.0), "edges_late",
        lambda s: s, lambda s: {"hall.offset_deg": s, "firmware.hall_offset": 0.0}, unit="deg",
    ),
    "jitter of the Hall edges": Kind(
        "Hall edges scatter by {size} rms, and should by 0.05 deg", (0.1, 0.4), "edge_jitter",
        lambda s: s - 0.0536, lambda s: {"hall.jitter_deg": s}, unit="deg",
    ),
    "a pole pair of the ring": Kind(
        "one pole pair of the ring lies {size} off", (0.5, 2.0), "edge_spread",
        lambda s: s - 0.0527, lambda s: {"faults.magnets.pole_pair_off_deg": s}, unit="deg",
    ),
    "ring off its centre": Kind(
        "edges lie later by a sine of {size} once a turn", (0.2, 1.0), "edge_spread",
        lambda s: 1.866 * s - 0.0527, lambda s: {"faults.magnets.eccentricity_deg": s}, unit="deg",
    ),
    "bouncing Hall sensor": Kind(
        "{size} of the edges of Hall sensor b bounce", (0.02, 0.3), "edges_per_second",
        lambda s: 400.0 * s, lambda s: {"faults.hall.bounce": [0.0, s, 0.0]},
    ),
    "false Hall pulses": Kind(
        "{size} false pulses come on a Hall wire", (10.0, 100.0), "edges_per_second",
        lambda s: 2.0 * s, lambda s: {"faults.hall.pulse_rate": _first(s)}, within=0.6, unit="1/s",
    ),
    "open contact of a Hall wire": Kind(
        "the contact of Hall wire c is open for {size} of the time", (0.005, 0.05), "wrong_codes",
        lambda s: s / 3.0, lambda s: {"faults.hall.contact_open": [0.0, 0.0, s]}, within=0.8,
    ),
    "exchanged Hall wires": Kind(
        "Hall wires a and b are exchanged (1), b and c (2), all rotated (4): {size}", (1, 4), "wrong_codes",
        lambda s: 0.3, lambda s: {"wiring.hall_swap": int(s)}, within=LEAST, unit="",
    ),
    "encoder turned": Kind(
        "the encoder's zero is off by {size}", (0.15, 0.3), "encoder_error",
        lambda s: s, lambda s: {"encoder.offset_deg": s}, unit="deg",
    ),
    "late encoder": Kind(
        "the encoder's angle is {size} old", (2e-6, 20e-6), "encoder_error",
        lambda s: -s * EDGE_DEG, lambda s: {"encoder.latency": s}, unit="us",
    ),
    "encoder off its centre": Kind(
        "the encoder's error has a sine of {size} (of the shaft) once a turn", (0.02, 0.05),
        "encoder_once_a_turn", lambda s: N_P * s, lambda s: {"encoder.eccentricity_deg": s}, unit="deg",
    ),
    "lost encoder counts": Kind(
        "the encoder loses {size} counts a turn", (0.1, 1.0), "encoder_drift",
        lambda s: -s, lambda s: {"faults.encoder.lost_per_rev": s}, within=0.8, unit="",
    ),
}  # fmt: skip

PLANT = {
    "weak magnets": Kind(
        "the magnets are {size} weaker than the firmware knows", (0.03, 0.05, 0.07), "torque_per_ampere",
        lambda s: -s * 1.5 * N_P * PSI, lambda s: {"motor.psi_f": PSI * (1.0 - s)},
    ),
    "uneven back-EMF": Kind(
        "the back-EMF has a fifth harmonic of {size}", (0.01, 0.03), "torque_ripple",
        lambda s: s, lambda s: {"motor.emf_harmonics": [s, 0.0, 0.0, 0.0]}, within=0.35,
    ),
    "winding resistance": Kind(
        "the winding has {size} more resistance than the firmware knows", (0.1, 0.3), "resistance",
        lambda s: s * R, lambda s: {"motor.R_s": R * (1.0 + s)},
    ),
    "winding inductance": Kind(
        "the winding has {size} less inductance than the firmware knows", (0.05, 0.2), "inductance",
        lambda s: -s * L, lambda s: {"motor.L_d": L * (1.0 - s), "motor.L_q": L * (1.0 - s)}, within=0.35,
    ),
    "friction": Kind(
        "dry friction is {size} more", (0.2, 0.5, 2.0), "friction",
        lambda s: 5e-3 * s, lambda s: {"mechanics.tau_coulomb": 5e-3 * (1.0 + s)},
    ),
    "inertia": Kind(
        "the shaft has {size} more inertia than the firmware knows", (0.05, 0.1, 0.3), "inertia",
        lambda s: 2e-4 * s, lambda s: {"mechanics.J": 2e-4 * (1.0 + s)},
    ),
    "dead time of the inverter": Kind(
        "the inverter's dead time is {size} longer than the firmware knows", (0.1e-6, 0.5e-6),
        "lost_by_all", lambda s: DEAD_VOLTS * s * 1e6, lambda s: {"inverter.dead_time": 1e-6 + s}, unit="us",
    ),
    "drop of the switches": Kind(
        "a switch drops {size}, and should drop nothing", (0.05, 0.2), "lost_by_all",
        lambda s: s, lambda s: {"inverter.u_device": s}, unit="V",
    ),
    "low link voltage": Kind(
        "the DC link has {size} less", (0.005, 0.02), "link_voltage",
        lambda s: -24.0 * s, lambda s: {"inverter.u_dc": 24.0 * (1.0 - s)},
    ),
}  # fmt: skip

LOOPS = {
    "control's angle": Kind(
        "the control's angle is {size} ahead above 500 rad/s", (0.5, 2.0), "control_angle",
        lambda s: s,
        change=Change("drive/tick_firmware", "cos_sin(theta)",
                     "cos_sin(theta + (SIZE * DEG if abs(angle.omega) > 500.0 else 0.0))", "step"),
        unit="deg",
    ),
    "control's speed": Kind(
        "the speed loop takes the speed for {size} more", (0.002, 0.02), "true_speed",
        lambda s: 1.0 / (1.0 + s) - 1.0,
        change=Change("drive/tick_firmware",
                     "speed_loop.step(limits, speed, command.omega_m, omega / params.n_p - added)",
                     "speed_loop.step(limits, speed, command.omega_m, (1.0 + SIZE) * omega / params.n_p - added)"),
    ),
    "torque command": Kind(
        "a current that is asked for is taken for {size} less", (0.01, 0.05), "true_current",
        lambda s: -s, change=Change("drive/tick_firmware", "command.i_q", "command.i_q * (1.0 - SIZE)"),
    ),
    "d current": Kind(
        "a d current of {size} flows that nobody asked for", (0.05, 0.2), "true_d_current",
        lambda s: s, change=Change("drive/tick_firmware", "quantised(i_d_ref, params.ampere, params.per_ampere)",
                                  "quantised(i_d_ref + SIZE, params.ampere, params.per_ampere)"),
        unit="A",
    ),
    "delay of the voltage": Kind(
        "the voltage's angle is turned {size} periods too little", (0.25, 1.5), "d_area_speeding",
        lambda s: PSI * (FAST**2 - SLOW**2) * s * T_S / K_I,
        change=Change("drive/tick_firmware", "1.5 * params.T_s * smooth", "(1.5 - SIZE) * params.T_s * smooth"),
        within=0.35, unit="",
    ),
    "decoupling of d": Kind(
        "the decoupling of the d axis is {size} less (200 %: its sign is wrong)", (0.5, 1.0, 2.0),
        "d_error_area", lambda s: s * FAST * L * 4.0 / K_I,
        change=Change("control/current_loop", "omega_e * params.L_s * i_q",
                      "omega_e * params.L_s * i_q * (1.0 - SIZE)", "step"),
    ),
    "fed back-EMF": Kind(
        "the current loop feeds {size} less of the back-EMF forward", (0.1, 1.0), "q_area_speeding",
        lambda s: -s * PSI * (FAST - SLOW) / K_I,
        change=Change("control/current_loop", "params.L_s * i_d + params.psi_f",
                     "params.L_s * i_d + params.psi_f * (1.0 - SIZE)", "step"),
    ),
    "gain of the current loop": Kind(
        "k_p of the current loop is {size} less than it says", (0.05, 0.2, 0.4), "rise_time",
        lambda s: 0.5 * math.log(2.0) / ALPHA * (1.0 / (1.0 - s) - 1.0),
        change=Change("control/current_loop", "alpha * float(L_s_hat)", "alpha * float(L_s_hat) * (1.0 - SIZE)"),
        within=0.9,
    ),
    "integral of the current loop": Kind(
        "k_i of the current loop is {size} less than it says", (0.1, 0.5), "q_error_area",
        lambda s: R * 4.0 / K_I * (1.0 / (1.0 - s) - 1.0),
        change=Change("control/current_loop", "alpha * float(R_s_hat) / float(pwm_hz)",
                     "alpha * float(R_s_hat) / float(pwm_hz) * (1.0 - SIZE)"),
        within=0.5,
    ),
    "windup of the current loop": Kind(
        "the current loop's anti-windup takes back {size} less", (0.9, 1.0), "current_after_the_limit",
        lambda s: 0.2,
        change=Change("control/current_loop", "(1.0 - share) * min(params.k_i_T, params.k_p) / params.k_p",
                     "(1.0 - SIZE) * (1.0 - share) * min(params.k_i_T, params.k_p) / params.k_p"),
        within=LEAST,
    ),
    "voltage limit": Kind(
        "the voltage's limit is {size} lower than the link allows", (0.05, 0.15), "largest_voltage",
        lambda s: -s / math.sqrt(3.0),
        change=Change("control/modulation", "LINEAR * u_dc", "LINEAR * u_dc * (1.0 - SIZE)"),
    ),
    "dead-time compensation": Kind(
        "dead time is compensated {size} less", (0.1, 0.4, 1.0), "lost_by_all",
        lambda s: 0.9 * s * DEAD_VOLTS,
        change=Change("control/dead_time", "float(dead_time_hat) * float(dead_time_comp) * float(pwm_hz)",
                     "float(dead_time_hat) * float(dead_time_comp) * float(pwm_hz) * (1.0 - SIZE)"),
    ),
    "dead-time compensation of one sign": Kind(
        "dead time is compensated {size} less where the current is negative", (0.25, 0.5, 1.0),
        "lost_when_negative", lambda s: 0.9 * s * DEAD_VOLTS,
        change=Change("control/dead_time", "params.duty * clip(current * params.per_fade, 1.0)",
                     "params.duty * clip(current * params.per_fade, 1.0) * (1.0 - SIZE if current < 0.0 else 1.0)"),
    ),
    "learning of the dead time": Kind(
        "what is learned of the dead time has the wrong sign", (1.0,), "learned_dead_time", lambda s: 0.01,
        change=Change("control/dead_time", "left.full * full + left.near * near",
                     "-SIZE * (left.full * full + left.near * near)"),
        within=LEAST, unit="",
    ),
    "current limit": Kind(
        "the speed loop allows {size} more than i_max", (0.005, 0.15), "largest_current",
        lambda s: 8.0 * s, change=Change("control/speed_loop", "float(i_max)", "float(i_max) * (1.0 + SIZE)"),
    ),
    "ramp of the speed": Kind(
        "the ramp of the speed is {size} flatter than it says", (0.05, 0.2), "acceleration",
        lambda s: -1000.0 * s,
        change=Change("control/speed_loop", "float(alpha_m_max) * T_s", "float(alpha_m_max) * T_s * (1.0 - SIZE)"),
        within=0.5,
    ),
    "gain of the speed loop": Kind(
        "k_p of the speed loop is {size} less than it says", (0.05, 0.4), "speed_dip",
        lambda s: 0.4 * 13.45 * s,
        change=Change("control/speed_loop", "float(k_p_speed)", "float(k_p_speed) * (1.0 - SIZE)"), within=LEAST,
    ),
    "integral of the speed loop": Kind(
        "k_i of the speed loop is {size} less than it says", (0.1, 0.5), "speed_dip_area",
        lambda s: 0.2 / (1.5 * N_P * PSI * 3.0) * (1.0 / (1.0 - s) - 1.0),
        change=Change("control/speed_loop", "float(k_i_speed) * T_s", "float(k_i_speed) * T_s * (1.0 - SIZE)"),
    ),
    "windup of the speed loop": Kind(
        "the speed loop's integral goes on at the current limit", (1.0,), "overshoot", lambda s: 20.0,
        change=Change("control/speed_loop", "(i_q_ref - limited) * error", "-SIZE"), within=LEAST, unit="",
    ),
}  # fmt: skip

OBSERVERS = {
    "Hall edges late in the firmware": Kind(
        "the firmware takes each Hall edge for {size} later", (1e-6, 2e-6, 20e-6), "avg_error",
        lambda s: -s * EDGE_DEG,
        change=Change("observers/hall_speed", "passed.tick", "passed.tick + int(SIZE / params.tick_period + 0.5)"),
        unit="us",
    ),
    "average speed": Kind(
        "the average speed is {size} too much", (0.005, 0.02), "average_speed", lambda s: s,
        change=Change("observers/hall_speed", "params.sector_rate / age", "params.sector_rate / age * (1.0 + SIZE)",
                     "_entered"),
    ),
    "travel since the edge": Kind(
        "the average-speed estimate goes on {size} too little from an edge", (0.02, 0.5), "avg_error",
        lambda s: -30.0 * s,
        change=Change("observers/average_speed", "abs(hall.omega) * hall.age",
                      "abs(hall.omega) * hall.age * (1.0 - SIZE)"),
    ),
    "angle of vector tracking": Kind(
        "the vector-tracking estimate is {size} ahead above 500 rad/s", (0.2, 2.0), "vt_error",
        lambda s: s,
        change=Change("observers/vector_tracking", "Estimate(theta, omega_lpf, delta, f_alpha, f_beta, on, sync)",
                     "Estimate(theta + (SIZE * DEG if omega_h > 500.0 else 0.0), "
                     "omega_lpf, delta, f_alpha, f_beta, on, sync)"),
        unit="deg",
    ),
    "vector tracking backwards": Kind(
        "the vector-tracking estimate is {size} ahead while it turns backwards", (0.2, 5.0),
        "vt_error_back", lambda s: s,
        change=Change("observers/vector_tracking", "Estimate(theta, omega_lpf, delta, f_alpha, f_beta, on, sync)",
                     "Estimate(theta + (SIZE * DEG if omega_h < 0.0 else 0.0), "
                     "omega_lpf, delta, f_alpha, f_beta, on, sync)"),
        unit="deg",
    ),
    "half a period of vector tracking": Kind(
        "(8) compares angles {size} less than half a period later", (0.1, 1.0), "vt_error_fast",
        lambda s: math.degrees(s * 0.5 * T_S * 2500.0 * RPM * N_P),
        change=Change("observers/vector_tracking", "0.5 * params.T_s * (omega + state.omega_corr_i)",
                     "(1.0 - SIZE) * 0.5 * params.T_s * (omega + state.omega_corr_i)"),
    ),
    "k_p of vector tracking": Kind(
        "k_p of the vector-tracking observer is {size} less than it says", (0.01, 0.1),
        "answer_200_hz", lambda s: _answer(200.0, k_p=1.0 - s) - _answer(200.0),
        change=Change("observers/vector_tracking", "float(drive.k_p_vt)", "float(drive.k_p_vt) * (1.0 - SIZE)"),
        within=0.7,
    ),
    "k_i of vector tracking": Kind(
        "k_i of the vector-tracking observer is {size} less than it says", (0.1, 0.25, 0.5), "answer_10_hz",
        lambda s: _answer(10.0, k_i=1.0 - s) - _answer(10.0),
        change=Change("observers/vector_tracking", "float(drive.k_i_vt) * T_s",
                      "float(drive.k_i_vt) * T_s * (1.0 - SIZE)"),
        within=0.7,
    ),
    "resistance of vector tracking": Kind(
        "the vector-tracking observer's resistance is {size} less than it says", (0.1, 0.2, 0.5),
        "vt_with_d_current", lambda s: -math.degrees(s * R * 4.0 / (SLOW * PSI)),
        change=Change("observers/vector_tracking", "drive.R_s_hat", "drive.R_s_hat * (1.0 - SIZE)"), within=0.4,
    ),
    "inductance of vector tracking": Kind(
        "the vector-tracking observer's inductance is {size} less than it says", (0.05, 0.1, 0.5),
        "vt_error", lambda s: math.degrees(s * L * 4.0 / PSI),
        change=Change("observers/vector_tracking", "drive.L_s_hat", "drive.L_s_hat * (1.0 - SIZE)"), within=0.4,
    ),
    "load angle": Kind(
        "the load angle counts {size} less (200 %: its sign is wrong)", (0.25, 0.5, 2.0), "with_load_angle",
        lambda s: -s,
        change=Change("observers/vector_tracking", "delta - cross * direction",
                     "(1.0 - SIZE) * delta - cross * direction"),
    ),
    "filter of the speed": Kind(
        "the filter of the estimated speed has {size} less bandwidth than it says", (0.1, 0.5), "speed_lag",
        lambda s: _lag(1.0 - s) - _lag(1.0),
        change=Change("observers/vector_tracking", "float(drive.bw_omega_lpf)",
                      "float(drive.bw_omega_lpf) * (1.0 - SIZE)"),
    ),
    "speed at which the correction begins": Kind(
        "the vector-tracking observer's correction begins at {size} more speed than it says", (0.25, 1.0),
        "correction_from", lambda s: 20.0 * s,
        change=Change("observers/vector_tracking", "params.omega_on", "params.omega_on * (1.0 + SIZE)"),
        within=0.6,
    ),
    "angle of the Kalman filter on edges": Kind(
        "the Kalman filter's angle is {size} ahead", (0.1, 0.2, 0.4), "ek_error", lambda s: s,
        change=Change("observers/edge_kalman",
                     "wrap(theta + (0.0 if stands else state.watch.pull) + sample.hall_offset)",
                     "wrap(theta + (0.0 if stands else state.watch.pull) + sample.hall_offset + SIZE * DEG)"),
        unit="deg",
    ),
    "belief in sensors of the Kalman filter": Kind(
        "the Kalman filter on edges doubts a broken Hall sensor {size} times as long", (100.0,), "kalman_believes",
        lambda s: 0.2,
        change=Change("observers/hall_levels", "doubt >= DISBELIEF", "doubt >= SIZE * DISBELIEF"),
        within=LEAST, unit="",
    ),
    "angle of the look-up table": Kind(
        "the look-up table's angle is {size} ahead", (0.2, 0.5), "lut_error", lambda s: s,
        change=Change("observers/lookup_table", "wrap(theta + sample.hall_offset)",
                     "wrap(theta + sample.hall_offset + SIZE * DEG)"),
        unit="deg",
    ),
    "centre of the sector": Kind(
        "the centre of the sector lies {size} ahead", (0.5, 2.0), "sc_error", lambda s: s,
        change=Change("observers/sector_centre", "centre(hall.sector, sample.hall_offset)",
                     "centre(hall.sector, sample.hall_offset) + SIZE * DEG"),
        unit="deg",
    ),
    "harmonics of the Hall vector": Kind(
        "{size} less of the harmonics is taken from the Hall vector (200 %: they are added)", (0.25, 1.0, 2.0),
        "hvd_ripple", lambda s: 0.02,
        change=Change("observers/hall_vector", "_harmonics(predicted - sample.hall_offset)",
                     "(1.0 - SIZE) * _harmonics(predicted - sample.hall_offset)"),
        within=LEAST,
    ),
    "programmable filter": Kind(
        "the programmable filter's angle is {size} ahead", (0.2, 0.5), "plf_error", lambda s: s,
        change=Change("observers/programmable_filter", "math.atan2(y3_beta, y3_alpha)",
                     "math.atan2(y3_beta, y3_alpha) + SIZE * DEG"),
        unit="deg",
    ),
    "vector tracking in integers": Kind(
        "the estimate in 16-bit integers is {size} ahead", (0.2, 0.5), "q15_error", lambda s: s,
        change=Change("observers/vector_tracking_q15", "_signed(state.theta) * (TWO_PI / TURN)",
                     "_signed(state.theta) * (TWO_PI / TURN) + SIZE * DEG"),
        unit="deg",
    ),
}  # fmt: skip

PROTECTION = {
    "over-current": Kind(
        "over-current trips at {size} more than i_trip", (0.05, 0.15), "current_at_trip",
        lambda s: 4.0 * s, change=Change("drive/tick_protection", "drive['i_trip']", "drive['i_trip'] * (1.0 + SIZE)"),
    ),
    "over-speed": Kind(
        "over-speed trips at {size} more than omega_m_trip", (0.05, 0.15), "speed_at_trip",
        lambda s: 200.0 * s,
        change=Change("drive/tick_protection", "drive['omega_m_trip'] * drive['n_p']",
                     "drive['omega_m_trip'] * drive['n_p'] * (1.0 + SIZE)"),
    ),
    "over-voltage": Kind(
        "over-voltage trips at {size} more than u_dc_max", (0.05, 0.15), "over_voltage",
        lambda s: 24.0 / (1.0 + s) - 24.0,
        change=Change("drive/tick_protection", "drive['u_dc_max']", "drive['u_dc_max'] * (1.0 + SIZE)"),
    ),
    "under-voltage": Kind(
        "under-voltage trips at {size} less than u_dc_min", (0.05, 0.15), "under_voltage",
        lambda s: 24.0 / (1.0 - s) - 24.0,
        change=Change("drive/tick_protection", "drive['u_dc_min']", "drive['u_dc_min'] * (1.0 - SIZE)"),
    ),
    "belief in broken Hall wires": Kind(
        "broken Hall wires are believed {size} times as long", (2.0, 100.0), "turns_open",
        lambda s: min(s - 1.0, 4.0),
        change=Change("drive/tick_protection", "_doubt(params, state.doubt, sensed.hall, sensed.edges)",
                     "state.doubt + (_doubt(params, state.doubt, sensed.hall, sensed.edges) - state.doubt) / SIZE"),
        within=LEAST, unit="",
    ),
    "belief in exchanged Hall wires": Kind(
        "it takes {size} more turns against the Hall sensors", (0.5, 10.0), "turns_exchanged",
        lambda s: min(2.5 * s, 5.0),
        change=Change("drive/tick_protection", "limits.hall_turns", "limits.hall_turns * (1.0 + SIZE)"),
        within=LEAST,
    ),
}  # fmt: skip

TOLD = {
    "flux linkage told wrongly": Kind(
        "the firmware is told {size} less flux linkage", (0.05, 0.1), "q_area_speeding",
        lambda s: -s * PSI * (FAST - SLOW) / K_I, lambda s: {"firmware.psi_f_hat": PSI * (1.0 - s)},
    ),
    "resistance told wrongly": Kind(
        "the firmware is told {size} less resistance", (0.1, 0.25), "q_error_area",
        lambda s: R * 4.0 / K_I * (1.0 / (1.0 - s) - 1.0), lambda s: {"firmware.R_s_hat": R * (1.0 - s)}, within=0.5,
    ),
}  # fmt: skip

GROUPS: dict[str, dict[str, Kind]] = {
    "Sensors": SENSORS, "Motor, inverter, shaft": PLANT, "Control": LOOPS, "Observers": OBSERVERS,
    "Protection": PROTECTION, "Parameters": TOLD,
}  # fmt: skip
KINDS: dict[str, Kind] = {name: kind for group in GROUPS.values() for name, kind in group.items()}
FAULTS: dict[str, Fault] = {
    f"{name} {told(size, kind.unit)}".strip(): Fault(f"{name} {told(size, kind.unit)}".strip(), kind, size)
    for name, kind in KINDS.items()
    for size in kind.sizes
}
CHANGES: list[Change] = [kind.change for kind in KINDS.values() if kind.change]


def number_of(kind: Kind) -> int:
    """Of its change in the copy of all `CHANGES`; 0: it has none."""
    return CHANGES.index(kind.change) + 1 if kind.change else 0

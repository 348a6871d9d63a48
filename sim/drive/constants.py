"""The compiled loop's constants, from a configuration, the firmware's parameters and those of the load machine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from protocol.signals import hall_map
from sim.config.params import BenchParams
from sim.control import current_loop, dead_time, speed_loop
from sim.drive import tick, tick_commission, tick_firmware
from sim.drive import tick_protection as protection
from sim.drive.channels import ampere
from sim.observers import average_speed, sample
from sim.observers.entry import chosen
from sim.plant import (
    coupling,
    current_sensor,
    dc_link,
    encoder,
    hall_input,
    hall_sensor,
    hall_wiring,
    integrator,
    inverter,
    mechanics,
    motor_wires,
    pmsm,
    skin_effect,
    warming,
)

SHOWN = 0.98  # of the largest speed that the Hall sensors show


def of_bench(
    p: BenchParams, drive: Mapping[str, float], load: Mapping[str, float], special: tick_commission.Params
) -> tick.Params:
    """The kernels' constants for a bench whose firmware has the parameters `drive`, and its load machine `load`."""
    period = 1.0 / p.clock.pwm_hz
    shaft_encoder = encoder.make_params(
        **p.encoder.model_dump(exclude={"present", "index_search", "index_resets", "latency"}),
        n_p=p.motor.n_p,
        n_p_hat=drive["n_p"],
        T_s=period,
    )._replace(latency=p.encoder.latency, resets=p.encoder.index_resets)
    shaft_encoder = encoder.read_as(
        shaft_encoder, drive["encoder_lines"], drive["encoder_reverse"], drive["encoder_zero"]
    )
    shaft_encoder = encoder.make_faulty(shaft_encoder, **p.faults.encoder.model_dump(exclude={"slip_at"}))
    motor = of_motor(p)
    h = period / p.clock.substeps
    broken = p.faults.motor
    wires = motor_wires.make_params(**broken.model_dump(exclude={"open"}))
    J = p.mechanics.J * (1.0 - p.coupling.load_share) if p.coupling.stiffness else p.mechanics.J
    return tick.Params(
        integrator.Params(
            motor,
            inverter.make_params(**dict(p.inverter), T_s=period),
            of_shaft(p, J),
            *integrator.decays(motor, h),
            motor_wires.open_phase(broken.open, broken.swap),
            (broken.short + 1) % 3 + 1 if broken.short else 0,
            wires.R,
        ),
        skin_effect.make_params(p.motor.skin_R, p.motor.skin_hz, h),
        wires,
        dc_link.make_params(p.inverter.u_dc, **dict(p.dc_link), T_s=period),
        1.0 + p.link_sensor.gain_error,
        coupling.make_params(**dict(p.coupling), J=p.mechanics.J, **_some(dict(p.load), "tau_max", "alpha_m_max")),
        of_hall(p),
        hall_input.make_params(p.clock.tick_hz, p.motor.i_max, of_hall_input(p)),
        hall_wiring.make_params(p.clock.tick_hz, **_some(load, *hall_wiring.PARAMETERS)),
        mechanics.make_rock(**dict(p.faults.shaft), n_p=p.motor.n_p),
        hall_map(drive["hall_swap_hat"], drive["hall_invert_hat"]),
        current_sensor.make_params(**dict(p.current_sensor)),
        sample.make_params(p.clock.tick_hz, chosen(sample.Settings, drive)),
        shaft_encoder,
        p.encoder.present,
        p.encoder.index_search,
        tick_firmware.Params(
            current_loop.make_params(p.clock.pwm_hz, **_some(drive, "bw_current", "R_s_hat", "L_s_hat", "psi_f_hat")),
            speed_loop.make_params(p.clock.pwm_hz, **_some(drive, "k_p_speed", "k_i_speed", "i_max", "alpha_m_max")),
            dead_time.make_params(
                p.clock.pwm_hz,
                **_some(drive, "dead_time_hat", "dead_time_comp", "dead_time_learn", "L_s_hat", "R_s_hat", "omega_on"),
            ),
            _protection(p, drive),
            special,
            period,
            drive["n_p"],
            ampere(p),
            1.0 / ampere(p),
            1.0 - math.exp(-math.tau * drive["bw_omega_lpf"] * period),
        ),
        p.clock.period_ticks,
        p.clock.substeps,
        h,
    )


def of_shaft(p: BenchParams, J: float) -> mechanics.Params:
    """The shaft's constants, with this inertia (kg m2); the iron's losses are those at the flux of a cold magnet."""
    iron = p.motor.iron_hysteresis / p.motor.psi_f**2, p.motor.iron_eddy / p.motor.psi_f**2
    shaft = p.mechanics.model_dump(exclude={"J", "theta_0_deg"})
    return mechanics.make_params(J, **shaft, alpha_m_max=p.load.alpha_m_max, iron=iron)


def of_hall(p: BenchParams, warmer: float = 0.0) -> hall_sensor.Params:
    """The constants of the Hall sensors, with the magnet so many K above 20 degrees C."""
    hall = hall_sensor.make_params(**dict(p.hall), n_p=p.motor.n_p)
    faults = p.faults.hall
    drifted = [warmer * drift for drift in faults.drift_deg]
    return hall_sensor.make_faulty(hall, faults.hysteresis_deg, drifted, dict(p.faults.magnets))


def of_hall_input(p: BenchParams) -> hall_input.Settings:
    """What may be wrong with the inputs of the Hall sensors."""
    return hall_input.Settings(**p.faults.hall.model_dump(include=set(hall_input.Settings._fields)))


def of_motor(p: BenchParams, now: warming.Factors = warming.COLD) -> pmsm.Params:
    """The motor's constants, as warm as it is."""
    own = p.motor
    figures = own.model_dump(exclude={"i_max", "i_cross", "iron_hysteresis", "iron_eddy", "skin_R", "skin_hz"})
    figures |= {"R_s": now.R_s * own.R_s + own.skin_R, "psi_f": now.psi_f * own.psi_f}
    figures |= {"L_d": own.L_d - own.L_skin, "L_q": own.L_q - own.L_skin}
    return pmsm.with_crossing(pmsm.make_params(**figures), own.i_cross)


def _protection(p: BenchParams, drive: Mapping[str, float]) -> protection.Params:
    """The limits of the protection; without an encoder no speed trips that the Hall sensors cannot show."""
    limits = protection.make_params(p.clock.pwm_hz, drive, bool(p.encoder.present), p.firmware.protection)
    if p.encoder.present:
        return limits
    shown = SHOWN * average_speed.FASTEST * drive["omega_m_max"] * drive["n_p"]
    return limits._replace(omega_trip=min(limits.omega_trip, shown))


def placed_deg(own: Sequence[float], load: Mapping[str, float]) -> tuple[float, ...]:
    """Placement of the Hall edges, degrees: the configuration's own figures as long as nobody has moved them."""
    given = [load[f"hall_delta_{s}"] for s in range(1, 7)]
    return tuple(
        delta if moved == float(np.float32(math.radians(delta))) else math.degrees(moved)
        for delta, moved in zip(own, given, strict=True)
    )


def _some(values: Mapping[str, float], *names: str) -> dict[str, float]:
    return {name: values[name] for name in names}

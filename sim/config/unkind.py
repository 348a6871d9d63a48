"""What makes a bench unkind, effect by effect, in the size that it has for a motor.

`sim/bench24v.toml` writes these figures out for the paper's motor, with where each is from. For another motor they go
with its torque, current, flux and inertia: cogging is a share of the rated torque, an offset one of the rated current,
and a winding gets as warm as that motor's does. This module reads no file.
"""

from __future__ import annotations

from collections.abc import Mapping

from sim.config.derive import rounded
from sim.config.sections import BenchParams

Overrides = Mapping[str, float | list[float]]


def effects(p: BenchParams) -> dict[str, Overrides]:
    """The overrides of each effect for the bench `p`, which is a kind one, by the effect's name."""
    motor, u_dc = p.motor, p.inverter.u_dc
    i = motor.i_max / 8.0  # by the paper's motor
    tau = 1.5 * motor.n_p * motor.psi_f * motor.i_max / 0.4716
    loss = motor.R_s * motor.i_max**2 / (0.158 * 64.0)
    power = u_dc / 24.0 * i
    step = 1.0 / (p.clock.pwm_hz * p.clock.substeps)
    stiffness = min(300.0 * p.mechanics.J / 2e-4, 0.05 * 0.5 * p.mechanics.J / step**2)

    def of(size: float, *shares: float) -> list[float]:
        return [rounded(size * share, 3) for share in shares]

    return {
        "back-EMF harmonics": {"motor.emf_harmonics": [0.03, -0.015, 0.006, 0.004]},
        "cogging": {"motor.cogging": of(tau, 4e-3, 1.5e-3)},
        "saturation": {"motor.i_sat": rounded(20.0 * i, 3)},
        "warm winding and magnet": {
            "thermal.ambient": 25.0,
            "thermal.R_th_winding": rounded(1.5 / loss, 3),
            "thermal.R_th_housing": rounded(3.0 / loss, 3),
            "thermal.tau_winding": 15.0,
            "thermal.tau_housing": 600.0,
            "thermal.magnet": -0.0011,
        },
        "drift of current sensors": {
            "thermal.drift_offset": of(i, 0.015, -0.010, 0.005),
            "thermal.drift_gain": [0.003, -0.002, 0.001],
            "thermal.tau_drift": 45.0,
        },
        "more friction": {"mechanics.tau_coulomb": rounded(8e-3 * tau, 3)},
        "soft coupling": {
            "coupling.stiffness": rounded(stiffness, 3),
            "coupling.damping": rounded(0.01 * (stiffness / 300.0 * p.mechanics.J / 2e-4) ** 0.5, 3),
            "coupling.backlash_deg": 0.05,
            "coupling.load_share": 0.5,
            "coupling.bandwidth": 100.0,
        },
        "more Hall hysteresis and jitter": {"hall.hysteresis_deg": 1.0, "hall.jitter_deg": 0.15},
        "edges of each pole pair": {"hall.pole_pair_deg": 1.0},
        "Hall latency": {"hall.latency": 6e-6},
        "uneven encoder": {"encoder.eccentricity_deg": 0.02, "encoder.unevenness": 0.2},
        "weak DC link": {
            "dc_link.R_source": rounded(0.08 * u_dc / 24.0 / i, 3),
            "dc_link.C": rounded(1.0e-3 * i * 24.0 / u_dc, 3),
            "dc_link.regenerates": 0,
            "dc_link.u_brake": rounded(28.0 / 24.0 * u_dc, 3),
            "dc_link.R_brake": rounded(4.7 * (u_dc / 24.0) ** 2 / power, 3),
        },
        "dead time by edges": {"inverter.dead_time_by_edges": 1},
        "drop of the switches": {"inverter.u_device": 0.05},
        "offsets of current sensors": {"current_sensor.offset": of(i, 0.020, -0.015, 0.010)},
        "gains of current sensors": {"current_sensor.gain_error": [0.007, -0.005, 0.002]},
        "late converter": {"current_sensor.delay": 1.0e-6},
    }


def unkind(p: BenchParams) -> dict[str, float | list[float]]:
    """The overrides of all effects at once for the bench `p`, which is a kind one."""
    return {key: value for overrides in effects(p).values() for key, value in overrides.items()}

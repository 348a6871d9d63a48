"""The simulated bench as an object: motor, shaft, sensors, firmware and load machine, without a protocol.

`advance` runs control periods in one compiled call and returns what they recorded. Commands and parameters take effect
from the next call on. Nothing here knows frames, links or the real clock.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.messages import DriveState, Fault, SetpointMode
from protocol.streams import pack_edges
from sim.control import current_loop, dead_time, speed_loop
from sim.drive import tick, tick_firmware
from sim.drive.tick_record import LOAD_DTYPE, SAMPLE_DTYPE
from sim.observers import bank
from sim.params import BenchParams
from sim.plant import current_sensor, encoder, hall_sensor, integrator, inverter, mechanics, noise, pmsm

__all__ = ["Recorded", "SimulatedBench", "Truth"]

_EDGES_PER_PERIOD = 4  # places reserved; a shaft that fast has tripped long before


class Recorded(NamedTuple):
    """What some periods recorded, as raw telemetry: n samples of drive and load machine, m edges (EDGE_RECORD)."""

    index: int  # PWM period of the first sample
    tick: int  # of the first sample
    samples: NDArray[np.void]
    load_samples: NDArray[np.void]
    edges: NDArray[np.void]
    log: NDArray[np.float64]  # shape (n, len(tick.LOG_FIELDS)), unrounded; (0, ...) unless asked for


class Truth(NamedTuple):
    """The plant's state: electrical angle (unwrapped) and speed, mechanical speed, dq currents; SI units."""

    theta_e: float
    omega_e: float
    omega_m: float
    i_d: float
    i_q: float


class SimulatedBench:
    """A bench with these figures; `seed` decides noise and jitter. Raises ConfigError for figures out of range."""

    def __init__(self, params: BenchParams, seed: int = 0) -> None:
        self.params = params
        self.parameters = {name: _f32(value) for name, value in params.firmware.parameters().items()}
        self.load_parameters = {name: _f32(value) for name, value in params.load.parameters().items()}
        self._quantiles = noise.table()
        self._params = self._make()
        self._drive = tick_firmware.Command(int(DriveState.IDLE), 0, 0.0, 0.0, 0.0)
        self._load = mechanics.Load(mechanics.OFF, 0.0, 0.0)
        self._load_state = int(DriveState.IDLE)
        self._reset = False
        theta_e = math.radians(params.mechanics.theta_0_deg)
        self._state = tick.init(
            self._params, theta_e, params.clock.start_tick, self._quantiles, noise.seeded(seed)
        )

    # -- what it is doing ---------------------------------------------------------------------------------------

    @property
    def n(self) -> int:
        """Samples taken: the index of the next one."""
        return int(self._state.k)

    @property
    def tick(self) -> int:
        """Device tick of the next sample."""
        return int(self._state.tick)

    @property
    def faults(self) -> Fault:
        """Faults that the firmware has latched."""
        return Fault(int(self._state.firmware.faults))

    @property
    def outputs_on(self) -> bool:
        """Whether the power stage switches."""
        return self._drive.state == DriveState.RUNNING and not self.faults

    @property
    def truth(self) -> Truth:
        """The plant's state at the last sample."""
        plant, motor = self._state.plant, self._params.plant.motor
        i_alpha, i_beta = pmsm.currents(motor, plant.psi_alpha, plant.psi_beta, plant.cos, plant.sin)
        return Truth(
            plant.theta_e,
            motor.n_p * plant.omega_m,
            plant.omega_m,
            plant.cos * i_alpha + plant.sin * i_beta,
            plant.cos * i_beta - plant.sin * i_alpha,
        )

    # -- commands -----------------------------------------------------------------------------------------------

    def enter_state(self, state: DriveState) -> None:
        """Follow the drive's state: outputs on in RUNNING only, at zero current until a setpoint; ARMED resets observers."""
        if state == DriveState.ARMED:
            self._reset = True
        self._drive = tick_firmware.Command(int(state), 0, 0.0, 0.0, 0.0)

    def setpoint(self, mode: SetpointMode, value: float, value2: float = 0.0) -> None:
        """Drive: SPEED in mechanical rad/s, or CURRENT i_q, i_d in A."""
        state = self._drive.state
        if mode == SetpointMode.SPEED:
            self._drive = tick_firmware.Command(state, int(mode), value, 0.0, 0.0)
        else:
            self._drive = tick_firmware.Command(state, int(mode), 0.0, value2, value)

    def clear_faults(self) -> None:
        """Forget the latched faults; what still has a cause comes back at the next sample."""
        self._state = self._state._replace(firmware=self._state.firmware._replace(faults=0))

    def load_enter_state(self, state: DriveState) -> None:
        """Follow the load machine's state: torque only in RUNNING, none until a setpoint."""
        self._load_state = int(state)
        self._load = mechanics.Load(mechanics.OFF, 0.0, 0.0)

    def load_setpoint(self, mode: SetpointMode, value: float) -> None:
        """Load machine: TORQUE in N·m against the positive direction, or SPEED, forced, in mechanical rad/s."""
        torque, speed = (value, 0.0) if mode == SetpointMode.TORQUE else (0.0, value)
        self._load = mechanics.Load(int(mode), torque, speed)

    def set_param(self, name: str, value: float) -> None:
        """Set a firmware parameter, as a float32; in use from the next period."""
        self.parameters[name] = _f32(value)
        self._params = self._make()

    def get_param(self, name: str) -> float:
        """A firmware parameter as it is used."""
        return self.parameters[name]

    # -- time ---------------------------------------------------------------------------------------------------

    def advance(self, n: int, log: bool = False) -> Recorded:
        """Run `n` control periods."""
        places = _EDGES_PER_PERIOD * n + 4
        arrays = tick.Arrays(
            np.zeros(n, SAMPLE_DTYPE),
            np.zeros(n, LOAD_DTYPE),
            np.zeros(places, np.int64),
            np.zeros(places, np.uint8),
            np.zeros(places, np.uint8),
            np.zeros(places, np.uint16),
            np.zeros((n if log else 0, len(tick.LOG_FIELDS))),
        )
        index, first_tick = self.n, self.tick
        command = tick.Command(self._drive, self._load, self._load_state, self._reset)
        self._state, m = tick.advance(self._params, self._state, command, n, self._quantiles, arrays)
        self._reset = self._reset and n == 0
        old, new = arrays.edge_old[:m], arrays.edge_new[:m]
        edges = pack_edges(arrays.edge_tick[:m], old, new, _illegal(old, new), arrays.edge_encoder[:m])
        return Recorded(index, first_tick, arrays.samples, arrays.load_samples, edges, arrays.log)

    def _make(self) -> tick.Params:
        p = self.params
        firmware = p.firmware
        drive = self.parameters
        period = 1.0 / p.clock.pwm_hz
        shaft_encoder = encoder.make_params(
            p.encoder.pulses_per_rev, p.encoder.offset_deg, p.encoder.bw_speed, p.motor.n_p, period
        )
        return tick.Params(
            integrator.Params(
                pmsm.make_params(p.motor.R_s, p.motor.L_d, p.motor.L_q, p.motor.psi_f, p.motor.n_p),
                inverter.make_params(
                    p.inverter.u_dc,
                    p.inverter.dead_time,
                    p.inverter.u_device,
                    p.inverter.i_smooth,
                    p.inverter.u_diode,
                    period,
                ),
                mechanics.make_params(p.mechanics.J, p.mechanics.b, p.mechanics.tau_coulomb, p.load.alpha_m_max),
            ),
            hall_sensor.make_params(p.hall.delta_deg, p.hall.hysteresis_deg, p.hall.jitter_deg),
            current_sensor.make_params(
                p.current_sensor.noise_rms,
                p.current_sensor.offset,
                p.current_sensor.gain_error,
                p.current_sensor.range,
                p.current_sensor.bits,
            ),
            tick_firmware.Params(
                bank.make_params(p.clock.tick_hz, p.clock.pwm_hz, **{name: drive[name] for name in bank.PARAMETERS}),
                current_loop.make_params(p.clock.pwm_hz, **_some(drive, "bw_current R_s_hat L_s_hat psi_f_hat")),
                speed_loop.make_params(p.clock.pwm_hz, **_some(drive, "k_p_speed k_i_speed i_max alpha_m_max")),
                dead_time.make_params(p.clock.pwm_hz, **_some(drive, "dead_time_hat dead_time_comp")),
                shaft_encoder,
                period,
                drive["n_p"],
                int(drive["observer"]),
                firmware.protection.i_trip,
                firmware.protection.omega_m_trip * drive["n_p"],
                firmware.protection.u_dc_min,
                firmware.protection.u_dc_max,
                max(1, round(firmware.protection.hall_fault_time * p.clock.pwm_hz)),
            ),
            p.clock.period_ticks,
            p.clock.substeps,
            period / p.clock.substeps,
        )


def _some(values: dict[str, float], names: str) -> dict[str, float]:
    return {name: values[name] for name in names.split()}


def _f32(value: float) -> float:
    return float(np.float32(value))


def _illegal(old: NDArray[np.uint8], new: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where an edge leads to 000 or 111, or changes more than one sensor."""
    changed = old ^ new
    return (new == 0) | (new == 7) | (changed & (changed - 1) != 0)

"""The simulated bench as an object: motor, shaft, sensors, firmware and load machine, without a protocol.

`advance` runs control periods in one compiled call and returns what they recorded. Commands and parameters
take effect from the next call on. The same seed, commands and periods give the same bits, in whatever portions.

Nothing here knows frames, links, watchdogs or the real clock; limits of setpoints are kept by `sim.drive.apps`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.messages import DriveState, Fault, SetpointMode
from protocol.signals import DRIVE_CHANNELS, SHORT, AngleSource
from protocol.streams import EDGE_RECORD
from sim.config.params import BenchParams
from sim.control import current_loop, dead_time, speed_loop
from sim.drive import tick, tick_firmware
from sim.drive import tick_protection as protection
from sim.drive.tick import Params as BenchConstants
from sim.drive.tick_record import LOAD_DTYPE, SAMPLE_DTYPE
from sim.interrupts import Held
from sim.numba_cache import settled
from sim.observers import average_speed, bank
from sim.plant import current_sensor, encoder, hall_sensor, hall_wiring, integrator, inverter, mechanics, noise, pmsm

__all__ = ["Recorded", "SimulatedBench", "Truth"]

OBSERVED_BY = {
    channel.id: 1 << source - 1
    for source, short in SHORT.items()
    for channel in DRIVE_CHANNELS
    if source and channel.name in (f"theta_{short}", f"omega_{short}", f"sensors_{short}")
}
"""Bit of the observer, as `bank.Params.active` counts them, by the id of a channel that carries its estimate."""
ALWAYS = 1 << AngleSource.AVERAGE_SPEED - 1 | 1 << AngleSource.VECTOR_TRACKING - 1  # observers that run in any case
WARM_UP = 0.1  # s for which an observer runs before the control of a running motor takes its angle
SHOWN = 0.98  # of the largest speed that the Hall sensors show
_FASTEST = 1200.0  # rad/s, twice what any parameter allows: so many edges find room


@dataclass(frozen=True, slots=True)
class Recorded:
    """What n periods recorded, as raw telemetry: a sample each, and m edges."""

    index: int  # PWM period of the first sample
    tick: int  # of the first sample
    samples: NDArray[np.void]  # SAMPLE_DTYPE
    load_samples: NDArray[np.void]  # LOAD_DTYPE
    edges: NDArray[np.void]  # EDGE_RECORD, as on the wire
    edge_tick: NDArray[np.int64]  # their ticks, not cut to 32 bits
    log: NDArray[np.float64]  # shape (n, len(LOG_FIELDS)), unrounded; (0, ...) unless asked for


class Truth(NamedTuple):
    """The plant's state at the last sample."""

    theta_e: float  # electrical rad, unwrapped
    omega_e: float  # electrical rad/s
    omega_m: float  # mechanical rad/s
    i_d: float  # A
    i_q: float
    tau_e: float  # N m


class SimulatedBench:
    """A bench with these figures, just booted: IDLE, the rotor at rest, nothing sampled yet.

    Args:
        params: the bench.
        seed: of noise and jitter; any integer.
    """

    def __init__(self, params: BenchParams, seed: int = 0) -> None:
        self.params = params
        self.parameters = {name: _f32(value) for name, value in params.drive_parameters().items()}
        self.load_parameters = {name: _f32(value) for name, value in params.load_parameters().items()}
        self._quantiles = noise.table()
        self._watched: frozenset[int] = frozenset()
        self._used = 0  # observers that the control has used since it began to run, a bit each
        self._source_from, self._source_before = 0, int(self.parameters["observer"])
        self._params = self._made(self.load_parameters)
        self._drive = tick_firmware.Command(int(DriveState.IDLE), 0, 0.0, 0.0, 0.0)
        self._load = mechanics.Load(mechanics.OFF, 0.0, 0.0)
        self._load_state = int(DriveState.IDLE)
        self._reset = False
        self._edges_per_period = 3 + math.ceil(_FASTEST * params.motor.n_p * 3.0 / math.pi / params.clock.pwm_hz)
        self._pulse_edges_per_period = 2 * math.ceil(1.0 / (hall_wiring.PULSE_MIN * params.clock.pwm_hz))
        theta_e = math.radians(params.mechanics.theta_0_deg)
        rng = noise.seeded(seed)
        with Held():  # as in `settled`
            self._state = tick.init(self._params, theta_e, params.clock.start_tick, self._quantiles, rng)

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
        """Faults that the firmware has latched; the outputs are off while there is one."""
        return Fault(int(self._state.firmware.faults))

    @property
    def fault_causes(self) -> Fault:
        """Faults whose cause was there at the last sample."""
        return Fault(int(self._state.firmware.protection.causes))

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
            pmsm.torque(motor, plant.psi_alpha, plant.psi_beta, i_alpha, i_beta),
        )

    def watch(self, channels: frozenset[int]) -> None:
        """From the next period on run the observers whose estimates are among these channels (ids), and no others.

        The average-speed and the vector-tracking observer run always, and so does the one that the control uses.
        """
        if channels != self._watched:
            self._watched = channels
            self._params = self._made(self.load_parameters)

    def _made(self, load_parameters: Mapping[str, float]) -> BenchConstants:
        source = int(self.parameters["observer"])
        self._used |= 1 << source >> 1
        active = self._used
        for channel in self._watched:
            active |= OBSERVED_BY.get(channel, 0)
        made = _make(self.params, self.parameters, load_parameters, active)
        return made._replace(source=source, source_from=self._source_from, source_before=self._source_before)

    def _observe(self, source: int) -> None:
        """Let the control use another angle: at once, or, where that is not known yet, when it has warmed up."""
        before = self._params
        self._source_before = before.source if self.n >= before.source_from else before.source_before
        known = ALWAYS | before.firmware.bank.active
        cold = self.outputs_on and source and not known >> source - 1 & 1
        self._source_from = self.n + round(WARM_UP * self.params.clock.pwm_hz) if cold else 0

    def enter_state(self, state: DriveState) -> None:
        """Follow the drive's state; without a setpoint yet.

        Outputs are on in RUNNING only, at zero current until a setpoint. ARMED initialises the observers.
        """
        if state == DriveState.ARMED:
            self._reset = True
        if state != DriveState.RUNNING:
            self._used = self._source_from = 0
            self._params = self._made(self.load_parameters)
        self._drive = tick_firmware.Command(int(state), 0, 0.0, 0.0, 0.0)

    def setpoint(self, mode: SetpointMode, value: float, value2: float = 0.0) -> None:
        """Drive: SPEED in mechanical rad/s, or CURRENT: i_q and i_d in A."""
        command = tick_firmware.Command(self._drive.state, int(mode), 0.0, 0.0, 0.0)
        if mode == SetpointMode.SPEED:
            self._drive = command._replace(omega_m=float(value))
        else:
            self._drive = command._replace(i_q=float(value), i_d=float(value2))

    def clear_faults(self) -> None:
        """Forget the latched faults; what still has a cause comes back as soon as the drive is ARMED."""
        firmware = self._state.firmware
        forgiven = firmware._replace(faults=0, protection=protection.forgiven(firmware.protection))
        self._state = self._state._replace(firmware=forgiven)

    def load_enter_state(self, state: DriveState) -> None:
        """Follow the load machine's state: torque only in RUNNING, none until a setpoint."""
        self._load_state = int(state)
        self._load = mechanics.Load(mechanics.OFF, 0.0, 0.0)

    def load_setpoint(self, mode: SetpointMode, value: float) -> None:
        """Load machine: TORQUE in N·m against the positive direction, or SPEED, forced, in mechanical rad/s."""
        torque, speed = (float(value), 0.0) if mode == SetpointMode.TORQUE else (0.0, float(value))
        self._load = mechanics.Load(int(mode), torque, speed)

    def set_param(self, name: str, value: float) -> None:
        """Set a firmware parameter, as a float32; in use from the next period.

        `observer`: while the motor runs, an observer that has not been running takes over after `WARM_UP`.
        """
        if name not in self.parameters:
            raise KeyError(f"no parameter {name!r}; there are: {', '.join(self.parameters)}")
        if name == "observer":
            self._observe(int(value))
        self.parameters[name] = _f32(value)
        self._params = self._made(self.load_parameters)

    def set_load_param(self, name: str, value: float) -> None:
        """Set a parameter of the load machine, as a float32; a fault on the wires is there from the next period on.

        An edge of a Hall sensor that moves is met at its new place once the rotor has passed another. Raises
        ConfigError where no room is left for a sector.
        """
        if name not in self.load_parameters:
            raise KeyError(f"no parameter {name!r}; there are: {', '.join(self.load_parameters)}")
        changed = self.load_parameters | {name: _f32(value)}
        self._params = self._made(changed)
        self.load_parameters = changed

    def get_param(self, name: str) -> float:
        """A firmware parameter as it is used."""
        return self.parameters[name]

    def advance(self, n: int, log: bool = False) -> Recorded:
        """Run `n` control periods; `log`: also keep estimates and truth unrounded."""
        disturbed = self.load_parameters["hall_glitch"] > 0.0
        places = (self._edges_per_period + (self._pulse_edges_per_period if disturbed else 0)) * n
        arrays = tick.Arrays(
            np.empty(n, SAMPLE_DTYPE),
            np.empty(n, LOAD_DTYPE),
            np.empty(places, EDGE_RECORD),
            np.empty(places, np.int64),
            np.empty(places, np.uint8),
            np.empty((n if log else 0, len(tick.LOG_FIELDS))),
        )
        index, first_tick = self.n, self.tick
        command = tick.Command(self._drive, self._load, self._load_state, self._reset)
        # numba hands a uint64 back as an int, and takes that for another type
        state = self._state._replace(rng=np.uint64(self._state.rng))
        self._state, m = _advance(self._params, state, command, n, self._quantiles, arrays)
        self._reset = self._reset and n == 0
        return Recorded(
            index,
            first_tick,
            arrays.samples,
            arrays.load_samples,
            arrays.edges[:m],
            arrays.edge_tick[:m],
            arrays.log,
        )


_advance = settled(tick.advance)


def _make(p: BenchParams, drive: Mapping[str, float], load: Mapping[str, float], active: int) -> BenchConstants:
    """The kernels' constants for a bench whose firmware has the parameters `drive`, and its load machine `load`.

    `active`: the observers that run (see `bank.Params`).
    """
    has_encoder = bool(p.encoder.present)
    hall = p.hall.replace(delta_deg=_delta_deg(p.hall.delta_deg, load))
    period = 1.0 / p.clock.pwm_hz
    shaft_encoder = encoder.make_params(
        p.encoder.pulses_per_rev, p.encoder.offset_deg, p.encoder.bw_speed, p.motor.n_p, drive["n_p"], period
    )
    return BenchConstants(
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
        hall_sensor.make_params(hall.delta_deg, hall.hysteresis_deg, hall.jitter_deg),
        hall_wiring.make_params(p.clock.tick_hz, **_some(load, *hall_wiring.PARAMETERS)),
        current_sensor.make_params(
            p.current_sensor.noise_rms,
            p.current_sensor.offset,
            p.current_sensor.gain_error,
            p.current_sensor.range,
            p.current_sensor.bits,
        ),
        tick_firmware.Params(
            bank.make_params(p.clock.tick_hz, p.clock.pwm_hz, active=active, **_some(drive, *bank.PARAMETERS)),
            current_loop.make_params(p.clock.pwm_hz, **_some(drive, "bw_current", "R_s_hat", "L_s_hat", "psi_f_hat")),
            speed_loop.make_params(p.clock.pwm_hz, **_some(drive, "k_p_speed", "k_i_speed", "i_max", "alpha_m_max")),
            dead_time.make_params(p.clock.pwm_hz, **_some(drive, "dead_time_hat", "dead_time_comp")),
            shaft_encoder,
            _protection(p, drive),
            period,
            drive["n_p"],
            has_encoder,
        ),
        int(drive["observer"]),
        0,
        0,
        p.clock.period_ticks,
        p.clock.substeps,
        period / p.clock.substeps,
    )


def _protection(p: BenchParams, drive: Mapping[str, float]) -> protection.Params:
    """The limits of the protection; without an encoder no speed trips that the Hall sensors cannot show."""
    limits = protection.make_params(p.clock.pwm_hz, drive["n_p"], bool(p.encoder.present), p.firmware.protection)
    if p.encoder.present:
        return limits
    shown = SHOWN * average_speed.FASTEST * drive["omega_m_max"] * drive["n_p"]
    return limits._replace(omega_trip=min(limits.omega_trip, shown))


def _delta_deg(own: Sequence[float], load: Mapping[str, float]) -> tuple[float, ...]:
    """Placement of the Hall edges, degrees: the configuration's own figures as long as nobody has moved them."""
    given = [load[f"hall_delta_{s}"] for s in range(1, 7)]
    return tuple(
        delta if moved == _f32(math.radians(delta)) else math.degrees(moved)
        for delta, moved in zip(own, given, strict=True)
    )


def _some(values: Mapping[str, float], *names: str) -> dict[str, float]:
    return {name: values[name] for name in names}


def _f32(value: float) -> float:
    return float(np.float32(value))

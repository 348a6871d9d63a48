"""The simulated bench as an object: motor, shaft, sensors, firmware and load machine, without a protocol.

`advance` runs control periods in one compiled call and returns what they recorded. Commands and parameters
take effect from the next call on. The same seed, commands and periods give the same bits, in whatever portions.

Nothing here knows frames, links, watchdogs or the real clock; limits of setpoints are kept by `sim.drive.apps`.
"""

from __future__ import annotations

import ctypes
import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.messages import DriveState, Fault, SetpointMode
from protocol.signals import AngleSource
from protocol.streams import EDGE_RECORD
from sim.config.params import BenchParams, ConfigError
from sim.config.sections import AT_BOOT
from sim.drive import constants, tick, tick_commission, tick_firmware
from sim.drive import tick_protection as protection
from sim.drive.channels import SOURCES
from sim.drive.recorded import Recorded, Sections
from sim.interrupts import Held
from sim.native import Cells, layout, value
from sim.observers.entry import Observing
from sim.observers.hall_speed import Edge
from sim.observers.sample import Sample
from sim.plant import (
    current_sensor,
    encoder,
    hall_input,
    hall_wiring,
    integrator,
    mechanics,
    noise,
    warming,
)

__all__ = ["SOURCES", "Recorded", "SimulatedBench", "Truth"]

FRONT_END = AngleSource.AVERAGE_SPEED  # whose estimate the loop makes in any case
ALWAYS = {AngleSource.VECTOR_TRACKING}  # observers that run in any case
WARM_UP = 0.1  # s for which an observer runs before the control of a running motor takes its angle
ENCODER_READING = {"encoder_lines", "encoder_reverse", "encoder_zero"}
HALL_RING = ("hall_offset", "hall_swap_hat", "hall_invert_hat")
PORTION = 2048  # periods that run at most before the observers do: what they see is still near
_FASTEST = 1200.0  # rad/s, twice what any parameter allows: so many edges find room


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
        """The firmware's, as they are used."""
        self.load_parameters = {name: _f32(value) for name, value in params.load_parameters().items()}
        self.n = 0
        """Samples taken: the index of the next one."""
        self.tick = params.clock.start_tick
        """Device tick of the next sample."""
        quantiles = noise.table()
        self._quantiles = Cells(float, len(quantiles))
        self._quantiles.array[:] = quantiles
        self.waveform = np.zeros(tick_commission.SAMPLES, np.int16)
        """Samples of the test signal, of which 32767 is its amplitude; they are read when `test` is set."""
        self._waveform = Cells(float, tick_commission.SAMPLES)
        self._watched: frozenset[str] = frozenset()
        self._observers: dict[int, Observing] = {}  # by source, those that run
        self._sections = Sections(())
        self._used: set[int] = set()  # observers that the control has used since it began to run
        self._source = self._source_before = int(self.parameters["observer"])
        self._source_from = 0  # the first sample at which the control uses `_source`, and not `_source_before`
        self._params, self._state, self._command = Cells(tick.Params), Cells(tick.State), Cells(tick.Command)
        self._inputs = Cells(hall_input.State)
        self._told: tick.Command | None = None  # what the loop's command is
        cells = self._params, self._state, self._inputs, self._command, self._quantiles, self._waveform
        self._bench = [cell.at for cell in cells]
        self._drive = _command(DriveState.IDLE)
        self._commissioning = False  # the loop has been the one that can commission since the outputs went on
        self._angle_set = False  # the forced angle has been told where to go at rest
        self._load = mechanics.Load(mechanics.OFF, 0.0, 0.0)
        self._load_state = int(DriveState.IDLE)
        self._reset = False
        inputs = constants.of_hall_input(params)
        bounces = 1 + 2 * inputs.bounce_returns if any(inputs.bounce) else 1
        edges_per_period = 3 + math.ceil(_FASTEST * params.motor.n_p * 3.0 / math.pi / params.clock.pwm_hz)
        self._edges_per_period = bounces * edges_per_period + 2.0 * inputs.busy / params.clock.pwm_hz  # twice the mean
        self._pulse_edges_per_period = 2 * math.ceil(1.0 / (hall_wiring.PULSE_MIN * params.clock.pwm_hz))
        self._edges, self._wire, self._flags = Cells(Edge, 0), Cells(tick.WireEdge, 0), Cells(np.uint8, 0)
        self._count = Cells(int)
        self._room(0)
        thermal = warming.Params(**dict(params.thermal))
        self._warming = warming.Warming(thermal, warming.EVERY / params.clock.pwm_hz) if params.thermal.on else None
        self._period_ticks = params.clock.period_ticks
        self._squares: list[NDArray[np.float64]] = []  # of the current since the last stretch of warming, A2
        self._samples = Cells(Sample, PORTION)
        firmware = self._state.array["firmware"]
        self._faults, self._causes = firmware["faults"], firmware["protection"]["causes"]
        faults, pwm_hz = params.faults, params.clock.pwm_hz
        begin, end, self._slips = (_sample(at, pwm_hz) for at in (faults.begin, faults.end, faults.encoder.slip_at))
        self._moments = {self._slips: None, begin: 1.0, end: 0.0}  # by sample: what `faults` becomes before it
        self._moments.pop(0, None)
        self._set_params()
        boot, world = self._state.array, self._state.array["world"]
        boot["k"], boot["tick"], world["rng"] = tick.NOT_BOOTED, self.tick, noise.seeded(seed)
        world["plant"]["theta_e"] = math.radians(params.mechanics.theta_0_deg)
        self._run(self._source, 0, np.empty(1), 0, 0)

    @property
    def faults(self) -> Fault:
        """Faults that the firmware has latched; the outputs are off while there is one."""
        return Fault(int(self._faults[0]))

    @property
    def fault_causes(self) -> Fault:
        """Faults whose cause was there at the last sample."""
        return Fault(int(self._causes[0]))

    @property
    def outputs_on(self) -> bool:
        """Whether the power stage switches."""
        return self._drive.state == DriveState.RUNNING and not self.faults

    @property
    def truth(self) -> Truth:
        """The plant's state at the last sample."""
        world, motor = self._state.array["world"][0], self._constants.plant.motor
        plant, electric = value(integrator.State, world["plant"]), value(tick.Electric, world["electric"])
        return Truth(
            plant.theta_e,
            motor.n_p * plant.omega_m,
            plant.omega_m,
            plant.cos * electric.i_alpha + plant.sin * electric.i_beta,
            plant.cos * electric.i_beta - plant.sin * electric.i_alpha,
            electric.tau,
        )

    def watch(self, channels: frozenset[str]) -> None:
        """From the next period on run the observers whose estimates are among these channels (names), and no others.

        The average-speed and the vector-tracking observer run always, and so does the one that the control uses.
        """
        if channels != self._watched:
            self._watched = channels
            self._choose()

    def _choose(self) -> None:
        """Run the observers that are to run: those that did before go on, others begin with the next sample."""
        wanted = self._used | ALWAYS | ({self._source, self._source_before} - {AngleSource.ENCODER, FRONT_END})
        wanted |= {source for source, entry in SOURCES.items() if not self._watched.isdisjoint(entry.channels)}
        pwm_hz = self.params.clock.pwm_hz
        self._observers = {
            source: self._observers.get(source)
            or SOURCES[source].start(SOURCES[source].make_params(pwm_hz, self.parameters))
            for source in sorted(wanted - {FRONT_END})
        }
        self._sections = _sections(tuple(self._observers))

    def _set_constants(self) -> None:
        """Use the bench as it is now, with the faults that are in force."""
        p, hall, faults = self.params, self.params.hall, self.params.faults
        if (moved := constants.placed_deg(hall.delta_deg, self.load_parameters)) != hall.delta_deg:
            p = p.replace(hall=hall.replace(delta_deg=moved))  # refused also where faults to come leave no room
        if not self.load_parameters["faults"]:
            faults = faults.without()
        elif self.n < self._slips:
            faults = faults.replace(encoder=faults.encoder.replace(slip_deg=0.0))
        self._now = p if faults is p.faults else p.replace(faults=faults)
        drive = self.parameters
        special = tick_commission.make_params(drive, p.clock.pwm_hz, self._commissioning, self._angle_set)
        if not special.on:
            self._state.array["firmware"]["commission"] = np.zeros(1, layout(tick_commission.State))
        self._constants = self._params.first = constants.of_bench(self._now, drive, self.load_parameters, special)
        self._advance = tick.loop(self._constants)
        self._warm()

    def _set_params(self) -> None:
        """Use the parameters as they are now."""
        self._set_constants()
        pwm_hz = self.params.clock.pwm_hz
        for source, observing in self._observers.items():
            observing.params = SOURCES[source].make_params(pwm_hz, self.parameters)
        self._choose()

    def _warm(self) -> None:
        """Use motor and current sensors as warm as they are now."""
        if not self._warming:
            return
        p, now = self._now, self._warming.factors
        motor = constants.of_motor(p, now)
        plant = self._constants.plant
        decay, half_decay = integrator.decays(motor, plant.decay.h)
        plant = plant._replace(motor=motor, decay=decay, half_decay=half_decay)
        drifted = self._warming.drifted(p.current_sensor.offset, p.current_sensor.gain_error)
        sensor = current_sensor.make_params(**(dict(p.current_sensor) | drifted))
        hall = constants.of_hall(p, self._warming.magnet)
        self._constants = self._params.first = self._constants._replace(plant=plant, current_sensor=sensor, hall=hall)

    def _observe(self, source: int) -> None:
        """Let the control use another angle: at once, or, where that is not known yet, when it has warmed up."""
        if self.n >= self._source_from:
            self._source_before = self._source
        self._source = source
        cold = self.outputs_on and source not in {AngleSource.ENCODER, FRONT_END, *self._observers}
        self._source_from = self.n + round(WARM_UP * self.params.clock.pwm_hz) if cold else 0
        self._used |= {source} - {AngleSource.ENCODER}

    def enter_state(self, state: DriveState) -> None:
        """Follow the drive's state; without a setpoint yet.

        Outputs are on in RUNNING only, at zero current until a setpoint. ARMED initialises the observers.
        """
        if state == DriveState.ARMED:
            self._reset = True
        if state != DriveState.RUNNING:
            self._angle_set &= self._drive.state != DriveState.RUNNING
            self._used, self._source_from, self._source_before = set(), 0, self._source
            self._choose()
            if self._commissioning:
                self._commissioning = False
                self._set_params()
        self._drive = _command(state)

    def setpoint(self, mode: SetpointMode, value: float, value2: float = 0.0) -> None:
        """Drive: SPEED in mechanical rad/s and i_d in A; CURRENT: i_q and i_d in A; or VOLTAGE: u_q and u_d in V."""
        command = _command(self._drive.state)._replace(mode=int(mode))
        if mode == SetpointMode.SPEED:
            self._drive = command._replace(omega_m=float(value), i_d=float(value2))
        elif mode == SetpointMode.VOLTAGE:
            self._drive = command._replace(u_q=float(value), u_d=float(value2))
        else:
            self._drive = command._replace(i_q=float(value), i_d=float(value2))
        if mode == SetpointMode.VOLTAGE or (mode == SetpointMode.SPEED and value2):
            self._commission()

    def _commission(self) -> None:
        """Run the loop that can commission until the outputs are off: what has been in use has to end smoothly, too."""
        if not self._commissioning:
            self._commissioning = True
            self._set_params()

    @property
    def mode(self) -> int:
        """SetpointMode that is in use; 0: none."""
        return self._drive.mode if self.outputs_on else 0

    @property
    def voltage(self) -> complex:
        """What the control computed last, without its test signal: u_d + j u_q in its own frame, V."""
        firmware = self._state.array["firmware"][0]
        out, special, angle = firmware["driving"]["next"], firmware["commission"], firmware["angle"]
        u = complex(out["u_alpha"] - special["u_alpha"], out["u_beta"] - special["u_beta"])
        theta = angle["theta"] + 1.5 * angle["omega"] / self.params.clock.pwm_hz
        return u * complex(math.cos(theta), -math.sin(theta))

    def clear_faults(self) -> None:
        """Forget the latched faults; what still has a cause comes back as soon as the drive is ARMED."""
        firmware = self._state.array["firmware"][0]
        firmware["faults"] = 0
        firmware["protection"] = protection.forgiven(value(protection.State, firmware["protection"]))

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
        self._reset |= name in HALL_RING  # what observers remember was in another frame
        before, self.parameters[name] = self.parameters[name], _f32(value)
        self._commissioning |= name in AT_BOOT and self.outputs_on and self.parameters[name] != before
        if name == "forced_angle":  # that it is put back to its default when RUNNING has ended sets nothing
            self._angle_set = bool(value) or self.outputs_on or before == value
        elif name == "test":
            self._begin_test()
        self._set_params()
        if name in ENCODER_READING:
            self._begin_tracking()

    def _begin_test(self) -> None:
        """The test signal begins anew, with the waveform as it is now."""
        self._waveform.array[:] = self.waveform / tick_commission.FULL
        self._state.array["firmware"]["commission"]["begun"] = 0

    def _begin_tracking(self) -> None:
        """The encoder's filter begins anew, at rest: it remembers a counter of another length."""
        index = value(encoder.Index, self._state.array["counter"][0])
        counter = encoder.counted(self._constants.encoder, index, index.last)
        self._state.array["encoder"][0] = encoder.init(counter)

    def set_load_param(self, name: str, value: float) -> None:
        """Set a parameter of the load machine, as a float32; a fault on the wires is there from the next period on.

        An edge of a Hall sensor that moves is met at its new place once the rotor has passed another. Raises
        ConfigError where no room is left for a sector.
        """
        if name not in self.load_parameters:
            raise KeyError(f"no parameter {name!r}; there are: {', '.join(self.load_parameters)}")
        before = self.load_parameters
        self.load_parameters = before | {name: _f32(value)}
        self._enough = -1
        try:
            self._set_params()
        except ConfigError:
            self.load_parameters = before
            raise

    def advance(self, n: int) -> Recorded:
        """Run `n` control periods."""
        sections, index, first_tick = self._sections, self.n, self.tick
        block = np.empty(n * sections.words + 1)  # never empty: `_at`
        if n > self._enough:
            self._room(n)
        if n:  # the others are always 0
            self._flags.array[0] = self._reset or not index
            self._reset = False
        self._count.array[0] = 0
        waits = min(n, max(0, self._source_from - index))
        with Held():  # a handler that raises would leave some of it behind
            begin = 0
            while begin < n:
                if self._moments and self.n in self._moments:
                    self._switch(self._moments.pop(self.n))
                source, upto = (self._source_before, waits) if begin < waits else (self._source, n)
                end = min(upto, begin + PORTION)
                if self._warming:
                    end = min(end, begin + warming.EVERY - self.n % warming.EVERY)
                for at in self._moments:
                    end = min(end, begin + at - self.n)
                self._run(source, n, block, begin, end)
                begin = end
        m = self._count.array[0]
        edges, wire = _copied(self._edges.array[:m]), _copied(self._wire_records[:m])
        return Recorded(index, first_tick, n, sections, block, edges, wire, self._load_state)

    def _switch(self, faults: float | None) -> None:
        """A moment has come at which faults begin or end, or the encoder slips (None)."""
        if faults is not None:
            self.load_parameters["faults"] = faults
        self._set_constants()

    def _run(self, source: int, n: int, block: NDArray[np.float64], begin: int, end: int) -> None:
        """Run the periods from `begin` up to `end` of the `n` that `block` is for, then the observers over them."""
        command = tick.Command(self._drive, self._load, source)
        if command != self._told:
            self._command.first = self._told = command
        at, words, reset = _at(block), self._sections.at, self._flags.at + begin
        control, by = self._observers.get(source), (0, 0, 0, 0, 0)
        if control:
            by = control.loop(at + 8 * n * words[control.entry.name] + begin * control.dtype.itemsize)
        records = [at + n * before + begin * size for before, size in self._sections.loop]
        self._advance(*self._bench, end - begin, reset, *records, self._samples.at, *self._log, *by)
        for other, observing in self._observers.items():
            if other != source:
                found = at + 8 * n * words[observing.entry.name] + begin * observing.dtype.itemsize
                observing.step_over(self._samples.at, reset, end - begin, found)
        self.n += end - begin
        self.tick += (end - begin) * self._period_ticks
        if self._warming and end > begin:
            alpha, beta = (self._sections.column(block, n, name)[begin:end] for name in ("i_alpha_true", "i_beta_true"))
            self._squares.append(alpha**2 + beta**2)
            if self.n % warming.EVERY == 0:
                R_s = self._constants.plant.motor.R_s - self._constants.skin.R
                self._warming.heat(R_s, float(np.concatenate(self._squares).mean()))
                self._squares.clear()
                self._warm()

    def _room(self, n: int) -> None:
        """Make room for the edges of n periods, and their flags."""
        self._enough = n
        disturbed = self.load_parameters["hall_glitch"] > 0.0
        room = 100 + math.ceil((self._edges_per_period + (self._pulse_edges_per_period if disturbed else 0)) * n)
        if room > self._edges.array.size:
            self._edges, self._wire = Cells(Edge, room), Cells(tick.WireEdge, room)
        if n > self._flags.array.size:
            self._flags = Cells(np.uint8, n)
        self._wire_records = self._wire.array.view(EDGE_RECORD)
        self._log = self._edges.at, self._wire.at, self._edges.array.size, self._count.at


@lru_cache(64)
def _sections(sources: tuple[int, ...]) -> Sections:
    """How a block is divided where these observers run."""
    return Sections([SOURCES[source] for source in sources])


def _command(state: int) -> tick_firmware.Command:
    """Nothing is asked for in this state."""
    return tick_firmware.Command(int(state), 0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _at(block: NDArray[np.float64]) -> int:
    """`address` of what is not empty, in a quarter of its time."""
    memory: Any = block
    return ctypes.addressof(ctypes.c_char.from_buffer(memory))


def _copied(records: NDArray[np.void]) -> NDArray[np.void]:
    """A copy, by bytes: by fields it takes twice as long."""
    return np.frombuffer(bytearray(records.tobytes()), records.dtype) if len(records) else records


def _sample(at: float, pwm_hz: int) -> int:
    """The first sample at a moment, s since boot, or after it."""
    return math.ceil(at * pwm_hz - 1e-6)


def _f32(value: float) -> float:
    return float(np.float32(value))

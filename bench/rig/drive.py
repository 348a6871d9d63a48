"""The drive of a rig: start, setpoints, parameters that are restored.

It keeps to what was announced (its `Envelope`), because that is what a person agreed to: setpoints are checked here,
and the drive's own `i_max` is lowered meanwhile, so that no speed controller goes beyond it. Nothing here looks at
samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from bench.device.client import WATCHDOG
from bench.device.heard import ParameterSet
from bench.device.node import Node
from bench.errors import BenchError, DriveFailed, ExitCode
from bench.rig.envelope import Envelope
from bench.rig.machine import Machine, require_announced, require_announced_speed
from bench.rig.restore import try_all
from bench.rig.runaway import RunawayGuard
from bench.rig.tuning import Tuning
from bench.signal.sources import source_names, source_number
from bench.signal.units import RPM, pole_pairs, shaft_speed
from bench.signal.waveforms.excitation import Waveform
from protocol.codes import Fault, TestSignal, fault_names
from protocol.errors import HbpError
from protocol.messages import DriveState
from protocol.signals import AngleSource, Flag

OBSERVER = "observer"
"""The parameter that chooses the angle source of the control."""
AMPLITUDES = {
    TestSignal.U_D: "test_voltage",
    TestSignal.U_Q: "test_voltage",
    TestSignal.I_D: "test_current",
    TestSignal.I_Q: "test_current",
    TestSignal.SPEED: "test_speed",
}
"""The parameter that is the amplitude of a test signal."""


class DriveTripped(BenchError):
    """The drive switched itself off, and the test did not expect that."""

    exit_code = ExitCode.FAILED


class RanAway(DriveTripped):
    """The motor ran away, and was switched off."""


class Drive(Machine):
    """Node `node`, within `envelope`."""

    title = "the drive"
    advice = "; compute after drive.stop(), not while the drive runs"
    starts_by_itself = False
    """Whether a setpoint starts it, as it does in a notebook."""

    def __init__(self, node: Node, envelope: Envelope) -> None:
        super().__init__(node, envelope)
        self.parameters: dict[str, float] = {}
        """As they are now, by name, in their units."""
        self.changed: dict[str, float] = {}
        """Those that were set, as they were last set."""
        self._initial: dict[str, float] = {}
        self.marked: Callable[[str, int], object] = lambda name, tick: None
        """What marks a moment in the recording, by name and device tick."""
        self.guard: RunawayGuard | None = None
        """What sees that the motor runs away, once it is known what is streamed."""
        self.ran_away = False
        """Whether its motor ran away, and was switched off."""
        self.on_course = False
        """Whether speeds follow each other as points of one course: what was seen of the shaft still counts then."""
        self._may_trip = False
        self._expected = Fault(0)  # faults that a test was about
        self._told = Fault(0)  # faults that a DriveTripped was raised for
        self._left = Fault(0)  # faults that stay latched

    def learn(self, parameters: dict[str, float]) -> None:
        """These are its parameters before anything is set."""
        self.parameters, self._initial = dict(parameters), dict(parameters)

    def follow(self, change: ParameterSet) -> None:
        """One of its parameters has another value, whoever has set it."""
        self.parameters[change.name] = change.value

    # -- what it is ---------------------------------------------------------------------------------------------

    @property
    def n_p(self) -> int:
        """Pole pairs. BenchError if the drive does not tell them."""
        n_p = pole_pairs(self.parameters)
        if n_p is None:
            raise BenchError("the drive has no valid parameter n_p: the number of pole pairs is unknown")
        return n_p

    @property
    def torque_constant(self) -> float:
        """N·m per A of q current, peak-valued: 1.5 n_p psi_f, by the drive's parameters. BenchError without them."""
        if "psi_f_hat" not in self.parameters:
            raise BenchError("the drive has no parameter psi_f_hat: its torque per ampere is unknown")
        return 1.5 * self.n_p * self.parameters["psi_f_hat"]

    @property
    def faults(self) -> tuple[str, ...]:
        """Names of the faults that it has reported since they were last forgotten."""
        return tuple(fault_names(self._faults))

    @property
    def _faults(self) -> Fault:
        return self.node.client.faults.get(self.node.number, Fault(0))

    # -- what it does -------------------------------------------------------------------------------------------

    def start(self, observer: str | None = None) -> None:
        """Arm and start, with this angle source: `encoder`, `average-speed`, `vector-tracking`; None leaves it."""
        if observer is not None:
            self.observe(observer)
        with self._trips_first():
            self.energise()

    def observe(self, observer: str) -> None:
        """Change the angle source that the control uses; also while it runs."""
        source = source_number(observer)
        if source is None:
            raise BenchError(f"no angle source '{observer}'; available: {', '.join(source_names())}")
        self.set(OBSERVER, float(source))

    def energise(self) -> None:
        """See `Machine.energise`. BenchError where its control would go by an encoder that is not mounted."""
        self._require_encoder(self.parameters.get(OBSERVER, math.nan))
        super().energise()

    def _require_encoder(self, observer: float) -> None:
        if observer == AngleSource.ENCODER and not self.node.encoder:
            words = "the control would go by the encoder, and bench.toml says that none is mounted ([rig] encoder)"
            raise BenchError(f"{words}: choose another angle source, such as average-speed")

    def speed(
        self,
        *,
        rpm: float | None = None,
        rad_s: float | None = None,
        unless: Callable[[], bool] = lambda: False,
        i_d: float = 0.0,
    ) -> None:
        """Set the speed reference, mechanical, in one of two units; its confirmation is awaited unless `unless`.

        `i_d`, A: the d current beside it, of a drive with the feature COMMISSION. Raises BenchError beyond what was
        announced, DriveTripped, and TypeError unless just one unit is given.
        """
        omega_m = shaft_speed(rpm, rad_s)
        require_announced_speed("speed", omega_m, self.envelope)
        require_announced("current", abs(i_d), self.envelope.current, "A", "current")
        self._start_by_itself()
        with self._trips_first():
            self._ask(omega_m)  # before it is: it may run away while the setpoint is confirmed
            self.node.speed(omega_m, lambda: bool(self.runs_away) or unless(), i_d)
            self._stop_runaway()

    def current(self, i_q: float, i_d: float = 0.0) -> None:
        """Set current references, A, peak-valued."""
        require_announced("current", math.hypot(i_q, i_d), self.envelope.current, "A", "current")
        self._start_by_itself()
        self._ask(None)
        with self._trips_first():
            self.node.current(i_q, i_d)

    def voltage(self, u_q: float, u_d: float = 0.0) -> None:
        """Give the voltage vector itself, V, of a drive with the feature COMMISSION; no loop controls the current.

        Whoever calls it looks at the currents: the announced current cannot be held against a voltage. BenchError above
        the drive's `u_test_max`, and where its control's angle is neither forced nor the encoder's.
        """
        most = self.parameters.get("u_test_max", 0.0)
        if math.hypot(u_q, u_d) > most * (1 + 1e-6):
            raise BenchError(
                f"a voltage of {math.hypot(u_q, u_d):.4g} V is beyond the drive's u_test_max, {most:.4g} V"
            )
        self._ask(None)
        with self._trips_first():
            self.node.voltage(u_q, u_d)

    def force_angle(self, angle: float) -> None:
        """Have the control use a made angle, electrical rad, which goes there by the shorter way at 2 pi rad/s at most.

        Of a drive with the feature COMMISSION; STOP ends it.
        """
        self.set("forced", 1.0)
        self.set("forced_speed", 0.0)
        with self._trips_first():  # also where it has this value: only what is set moves the angle
            self._set("forced_angle", math.remainder(angle, math.tau))

    def force_speed(self, omega: float, slope: float | None = None) -> None:
        """Have the control's made angle turn, electrical rad/s; `slope`: its ramp, rad/s2, None leaves it.

        BenchError if a shaft with the drive's pole pairs would turn faster by it than was announced.
        """
        require_announced_speed("forced speed", omega / self.n_p, self.envelope)
        if slope is not None:
            self.set("forced_slope", slope)
        self.set("forced", 1.0)
        self.set("forced_speed", omega)

    def may_turn_freely(self, rpm: float | None) -> None:
        """Switch off a motor that turns faster than so many r/min, either way, while a current is asked for."""
        if self.guard is not None:
            self.guard.most_free = None if rpm is None else rpm * RPM

    def _start_by_itself(self) -> None:
        if self.starts_by_itself and not self.on:
            self.start()

    def stop(self) -> DriveState:
        """See `Machine.stop`."""
        self.ran_away |= bool(self.runs_away)
        self.on_course = False
        self.may_turn_freely(None)
        self._ask(None)
        try:
            return super().stop()
        except DriveFailed:
            self._expected |= self._faults  # what its watchdog did is no news of its own
            raise
        finally:
            volatile = (p.name for p in self.node.descriptor.parameters if p.flags & Flag.VOLATILE)
            self.parameters |= {name: self._initial[name] for name in volatile if name in self._initial}

    def set(self, name: str, value: float) -> None:
        """Set a parameter; the test's end puts back what it was."""
        if self.parameters.get(name) == value:
            return
        if name == "i_max":
            require_announced(name, value, self.envelope.current, "A", "current")
        if name == OBSERVER:
            self._require_encoder(value)
        with self._trips_first():
            self._set(name, value)
        self.changed[name] = self.parameters[name]

    @contextmanager
    def excited(self, reference: str, wave: Waveform, amplitude: float) -> Iterator[None]:
        """Within this the drive, which runs, adds a waveform that repeats to one of its references or voltages.

        `reference`: `u_d`, `u_q` (V), `i_d`, `i_q` (A) or `speed` (mechanical rad/s), and `amplitude` in its unit. It
        begins with its first sample, in step with the PWM; the channel `status` marks each begin. Needs the features
        COMMISSION and WAVEFORM. BenchError for what is beyond the announced current or speed, KeyError for another
        reference.
        """
        test = TestSignal[reference.upper()]
        self.node.write_waveform(wave.raw().tobytes())
        with self._excited(test, amplitude, wave.hold, len(wave.values)):
            yield

    @contextmanager
    def square(self, reference: str, amplitude: float, periods: int) -> Iterator[None]:
        """The same with a square wave: + `amplitude` for so many PWM periods, - for as many. Needs COMMISSION only."""
        with self._excited(TestSignal[reference.upper()], amplitude, periods, 0):
            yield

    @contextmanager
    def _excited(self, test: TestSignal, amplitude: float, periods: int, length: int) -> Iterator[None]:
        if test in (TestSignal.I_D, TestSignal.I_Q):
            require_announced("amplitude", amplitude, self.envelope.current, "A", "current")
        elif test is TestSignal.SPEED:
            require_announced_speed("amplitude", amplitude, self.envelope)
        self.set(AMPLITUDES[test], amplitude)
        self.set("test_periods", float(periods))
        if length or self.node.has_parameter("test_length"):
            self.set("test_length", float(length))
        self.set("test", float(test))
        try:
            yield
        finally:
            if self.on and not self.faults:
                self.set("test", float(TestSignal.OFF))

    @contextmanager
    def tuning(self, *names: str, **values: float) -> Iterator[Tuning]:
        """Within this, parameters of these names are tuned: each change is marked, and the end puts all back.

        `values` are set at once. NodeError for a name that the drive does not have, or does not let one tune.
        """
        tuning = Tuning(self, tuple(dict.fromkeys([*names, *values])))
        try:
            for name, value in values.items():
                tuning[name] = value
            yield tuning
        finally:
            tuning.put_back()

    @contextmanager
    def may_trip(self) -> Iterator[None]:
        """Within this a trip is no failure of the test: it is what the test is about. `faults` tells which."""
        self._may_trip = True
        try:
            yield
        finally:
            self._may_trip = False
            self._expected |= self._faults

    def forget_faults(self) -> None:
        """STOP and clear what is latched. BenchError if a cause persists."""
        self.stop()
        if self._faults:
            self.node.clear_faults()
            self.node.next_heartbeat()
            self.node.client.faults.pop(self.node.number, None)
            self._expected = self._told = Fault(0)

    def leave_faults(self) -> None:
        """What is latched stays, because its cause persists: no news any more, and not for the rig to clear."""
        self._left = self._faults
        self._expected |= self._left

    @property
    def runs_away(self) -> str:
        """What was seen of it, if the motor has run away from the speed that was asked for; to follow `title`."""
        verdict = "" if self.guard is None or self._faults else self.guard.verdict
        return f"{verdict}; it was switched off" if verdict else ""

    def _ask(self, omega_m: float | None) -> None:
        if self.guard is not None and self.on_course:
            self.guard.follow(omega_m)
        elif self.guard is not None:
            self.guard.ask(omega_m)

    def _stop_runaway(self) -> None:
        """Switch off a motor that runs away, and raise RanAway; what is wrong with STOP is raised instead."""
        if words := self.runs_away:
            self.node.stopped_for = f"{self.title} {words.partition(';')[0]}"
            self.stop()
            raise RanAway(f"{self.title} {words}")

    # -- for the rig --------------------------------------------------------------------------------------------

    def limit_current(self) -> None:
        """Of an idle drive: lower its `i_max`, if it has one, to the announced current; `restore` puts it back."""
        if self.envelope.current < self.parameters.get("i_max", -math.inf):
            self._set("i_max", self.envelope.current)

    @property
    def watchdog(self) -> float:
        """s that it waits for ALIVE."""
        return self.parameters.get("watchdog", WATCHDOG)

    def trouble(self) -> str:
        """See `Machine.trouble`: a trip against expectation, on or off, and a motor that runs away."""
        if self._faults & ~self._expected and not self._may_trip:
            self._told |= self._faults
            return self.tripped()
        if self.on and self.runs_away:
            return f"{self.title} {self.runs_away}"
        return f"{self.title}: {why}" if (why := self.node.astray()) else ""

    def look(self) -> None:
        """Raise DriveTripped for `trouble`; RanAway if the motor has run away, which is switched off."""
        words = self.trouble()
        self._stop_runaway()
        if words:
            raise DriveTripped(words)

    def untold(self) -> str:
        """A trip against expectation that nothing was said of yet."""
        return self.trouble() if self._faults & ~self._told else ""

    def restore(self, clear_faults: bool = True) -> None:
        """Of a stopped drive: faults of this test cleared, every parameter as it was before.

        All of it is tried; the first error is raised at the end.
        """
        clear = [self.node.clear_faults] if clear_faults and self._faults & ~self._left else []
        try_all([*clear, self.put_back])

    def _set(self, name: str, value: float) -> None:
        if name in self._initial:
            self._before.setdefault(name, self._initial[name])  # before it is: whatever happens, it is put back
        self.parameters[name] = self.node.set(name, value)

    @contextmanager
    def _trips_first(self) -> Iterator[None]:
        """A tripped drive refuses much: that it has tripped is the news."""
        try:
            yield
        except (BenchError, HbpError):
            self.look()
            raise

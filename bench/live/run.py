"""`bench live` without the command line: connect, look, stream, spin on request, end with the outputs off.

Every way out of a run passes `make_safe`, which sends STOP; where that cannot arrive (the link is gone, the process
was killed) the drive's own watchdog switches off, because only this process feeds it.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.analysis.sources import source_number, source_short
from bench.analysis.units import RPM, pole_pairs
from bench.device.bus import BusMeter
from bench.device.client import POLL, WATCHDOG, Sink
from bench.device.node import LOAD, ClockFit
from bench.device.simulator import EmbeddedDrive
from bench.errors import BenchError, DoesNotFit, DriveFailed, Interrupted, OutputsMayBeOn, RecordingError
from bench.files import check_output
from bench.live.gathered import Gathered
from bench.live.manoeuvres import Act, show, timed
from bench.live.plausible import Plausibility
from bench.live.summary import CpuMeter, RunStatistics, Summary, as_markdown, summarise
from bench.live.triggers import Condition, Triggers
from bench.recording.ring import Stored
from bench.rig.consent import check_limits, require_consent
from bench.rig.envelope import Envelope
from bench.rig.interrupts import signals_as_exceptions, undisturbed
from bench.rig.lock import alone_on
from bench.rig.metadata import run_info
from bench.rig.needs import NEEDS, require
from bench.rig.outputs import Outputs, load_beside
from bench.rig.restore import failures_of
from bench.rig.rig import Plan, Rig
from bench.rig.screen import Screen
from bench.rig.settings import Settings
from bench.rig.streams import decimation_of
from protocol.codes import fault_names
from protocol.descriptor import Channel
from protocol.errors import HbpError, LinkError
from protocol.links import Link, open_link
from protocol.streams import StreamConfig

RECONNECT = 30.0  # s that a lost link is waited for
CLOCK_PERIOD = 2.0  # s between looks at the drive's clock
PROGRESS_PERIOD = 0.5  # s
SILENCE = 2.0  # s without samples after which a note says so
IMPLAUSIBLE = "implausible"
WATCHING = Act("watching", math.inf, 0.0, 0.0, None)


@dataclass(frozen=True)
class LiveOptions:
    """What `bench live` was asked for; r/min, A and Hz as on the command line."""

    target: str | None = None
    speed_rpm: float | None = None
    load_a: float | None = None
    current_a: float | None = None
    """Most that the motor may get, A peak; None: what bench.toml says that it is rated for, else the drive's limit."""
    observer: str | None = None
    duration: float | None = None
    save: Path | None = None
    overwrite: bool = False
    viewer: str = "auto"
    channels: tuple[str, ...] | None = None
    rate_hz: float | None = None
    fit: bool = False
    yes: bool = False
    clear_faults: bool = False
    host_observers: bool = False
    keep: float | None = None
    """Record as a ring of so many s, see `bench.recording.ring`."""
    split: float | None = None
    """Begin a new run after so many s."""
    note: str = ""
    """What the run is about, for the recording."""
    trigger: tuple[str, ...] = ()
    """Conditions that mark the run, see `bench.live.triggers`."""
    estimate: tuple[str, ...] = ()
    """Observers to run on the host, whose estimates are shown and recorded beside the drive's."""
    web_port: int | None = None
    settings: Settings = field(default_factory=Settings)
    """Of the station: who and where it is, the rated current, and the simulated drive's configuration."""

    @property
    def current(self) -> float:
        """A that the motor may get at most; inf: as much as the drive lets one ask for."""
        if self.current_a is not None:
            return self.current_a
        return math.inf if self.embedded else self.settings.rated.get("current", math.inf)

    @property
    def embedded(self) -> bool:
        """Whether the simulated drive is started as a child."""
        return self.target in (None, "sim")

    @property
    def show(self) -> bool:
        """Whether the scripted show is played: nothing but the simulated drive was asked for."""
        return self.target is None and self.speed_rpm is None and self.load_a is None

    @property
    def passive(self) -> bool:
        """Whether the drive is only watched."""
        return not self.show and self.speed_rpm is None and self.load_a is None


class _ScreenNotes(Sink):
    """Sink that puts the notes of client and run on the screen."""

    def __init__(self, screen: Screen) -> None:
        self._screen = screen

    def note(self, text: str, level: str = "INFO") -> None:
        """Show it."""
        self._screen.note(text)


@dataclass(frozen=True)
class Ended:
    """How a run ended."""

    summary: Summary
    exit_code: int


class LiveRun:
    """One run of `bench live` on an open link."""

    def __init__(self, options: LiveOptions, link: Link, target: str, screen: Screen) -> None:
        self.options = options
        self.target = target
        self.screen = screen
        self._notes = _ScreenNotes(screen)
        self.rig = Rig(Plan(lambda: link, target, passive=options.passive))
        self.client, self.drive = self.rig.client, self.rig.drive.node
        self.client.reconnect = RECONNECT
        self.tripped = ""  # why the motor was let go, if it was
        self._not_restored = ""  # parameters that are not as they were, and why
        self.unsafe = ""  # why outputs may still be on, if they may
        self._clock: ClockFit | None = None  # of this boot of the drive
        self._outputs: Outputs | None = None
        self._next_clock = 0.0
        self._next_progress = 0.0
        self._last_samples = (0, 0.0)
        self._silent = False
        self._rebooted: set[int] = set()
        self._pole_pairs: int | None = None
        self._watchdog = WATCHDOG  # s
        self._judge: Plausibility | None = None  # of a run that turns the motor
        self._gathered = Gathered(())  # what counts and judges
        self._bus: dict[str, Any] | None = None
        self._signal = 0  # the first that came

    # -- before anything moves ----------------------------------------------------------------------------------

    def look(self) -> None:
        """Say what is there and, where a load is asked for, find the load machine. Leaves the motor alone."""
        hello = self.drive.identity
        self.client.on_reboot = self._rebooted.add
        self.rig.require_rest(or_fault=self.options.clear_faults)
        self.drive.stop_streams()
        self.screen.note(
            f"{hello.name} {hello.firmware} on {self.target}: boot {hello.boot_id:08x}, "
            f"HBP {hello.major}.{hello.minor}, PWM {hello.pwm_hz} Hz, "
            f"{len(self.drive.descriptor.channels)} channels, state {hello.state.name}"
        )
        if self.options.load_a is not None or self.options.show:
            load = self.rig.load_machine()
            if load is None:
                raise BenchError(f"--load needs a load machine (node {LOAD}), and {self.target} has none")
            self.rig.load = load

    def acts(self) -> tuple[Act, ...]:
        """What will be done to the motor; empty when it is only watched. NodeError for what a drive lacks."""
        options = self.options
        if options.show:
            require(self.drive, "the show", NEEDS["the show"])
            return show(*(self.drive.parameter(name).value for name in ("omega_m_max", "i_max")))
        if options.passive:
            return ()
        source = source_number(options.observer) if options.observer else None
        title = f"{options.speed_rpm or 0:g} r/min, {options.load_a or 0:g} A"
        return (Act(title, math.inf, options.speed_rpm or 0.0, options.load_a or 0.0, source),)

    def check(self, acts: tuple[Act, ...], confirm: Callable[[str], bool] | None) -> None:
        """What the drive lacks (NodeError), limits and consent: raises before anything is energised."""
        options = self.options
        if acts:
            if options.load_a is not None:
                require(self.drive, "--load", NEEDS["--load"])
            if options.observer:
                require(self.drive, "--observer", [f"observer:{options.observer}"])
            envelope = self.rig.drive.envelope
            check_limits(self.drive, envelope)
            if envelope.load > envelope.current:
                load, current = f"load {envelope.load:g} A", f"the {envelope.current:g} A that the motor may get"
                raise BenchError(f"{load} is beyond {current}: --current, or [rated] current in bench.toml")
            require_consent(self.drive, self.target, envelope, options.yes, confirm)
        if options.clear_faults:
            self.drive.clear_faults()

    # -- streaming ----------------------------------------------------------------------------------------------

    def configure(self, acts: tuple[Act, ...]) -> StreamConfig:
        """Configure samples and edges for what will be done; returns the stream of samples that will come."""
        options, identity = self.options, self.drive.identity
        if acts:
            speed, load = (max(abs(getattr(act, of)) for act in acts) for of in ("speed_rpm", "load_a"))
            self.rig.drive.envelope = Envelope(speed, options.current, load)
        decimation = decimation_of(identity.pwm_hz, options.rate_hz)
        channels = self.drive.channels(self._channel_names())
        needed: tuple[str, ...] = ()
        on_host = "--host-observers" if options.host_observers else "--estimate"  # the option that runs observers here
        if options.host_observers or options.estimate:
            needed = self._inputs(channels)
            missing = [name for name in needed if name not in {channel.name for channel in channels}]
            if missing or decimation != 1:
                raise BenchError(
                    f"{on_host} needs every PWM period" + (f" and the channels {', '.join(missing)}" if missing else "")
                )
        if not self.drive.offers_edges:
            self.screen.note("no Hall edges: the drive does not offer them (feature EDGES)")
        try:
            self.rig.configure([channels], decimation, slower=options.fit and not needed)
        except DoesNotFit as error:
            if needed:
                few = ",".join(needed)
                raise BenchError(f"{error}; {on_host} needs every PWM period: --channels {few}") from None
            raise
        assert self.rig.samples is not None
        if self.rig.samples.decimation != decimation:
            self.screen.note(f"--fit: {len(channels)} channels at {self.rig.rate:g} Hz")
        return self.rig.samples

    def _inputs(self, channels: tuple[Channel, ...]) -> tuple[str, ...]:
        """What observers here must be given. BenchError for a name that is wrong, and where there is nothing to do."""
        from bench.observers.estimators import CHECKED, compared_inputs, entry_of

        names = {channel.name for channel in channels}
        if self.options.host_observers and not names & CHECKED.keys():
            raise BenchError("--host-observers has nothing to compare: add an estimate to --channels, such as theta_vt")
        names |= {f"theta_{entry_of(name).short}" for name in self.options.estimate}
        switch = "load_angle_comp"
        on = self.drive.has_parameter(switch) and self.drive.parameter(switch).value != 0.0
        return compared_inputs(names, on)

    def _channel_names(self) -> tuple[str, ...] | None:
        """The channels that were asked for; without a list of its own a run also gets what its control works with."""
        names = self.options.channels
        if not self.options.observer or not all(name.startswith("+") for name in names or ()):
            return names
        short = source_short(source_number(self.options.observer) or 0)
        offered = {channel.name for channel in self.drive.descriptor.channels}
        return (*(names or ()), *(f"+{n}" for n in (f"theta_{short}", f"omega_{short}") if n in offered))

    def go(self, stream: StreamConfig, acts: tuple[Act, ...], report: Callable[[Summary], None], hold: bool) -> Ended:
        """Stream, perform the acts, switch off, sum up."""
        options, identity = self.options, self.drive.identity
        parameters = self.drive.parameters()
        self.rig.drive.learn(parameters)
        self._pole_pairs = pole_pairs(parameters)
        self._watchdog = parameters.get("watchdog", WATCHDOG)
        if acts:
            self._judge = Plausibility(stream, self.drive.offers_edges, parameters)
        observers = None
        if options.host_observers:
            from bench.observers.estimators import HostObservers

            observers = HostObservers(parameters, stream)
        augmenter = None
        if options.estimate:
            from bench.observers.augment import Augmenter

            augmenter = Augmenter(options.estimate, parameters, stream)
        stats = RunStatistics(self.drive.number, observers)
        streamed = (*stream.channels, *(augmenter.channels if augmenter else ()))
        triggers = [Condition.parse(text) for text in options.trigger]
        for condition in triggers:
            condition.check([channel.name for channel in streamed])
        about = {"note": options.note} if options.note else {}
        info = run_info(self.drive, self.target, streamed, parameters, options.settings, **about)
        self._clock = self.drive.clock_fit()
        outputs = self._outputs = Outputs(
            info,
            options.save,
            options.overwrite,
            options.viewer,
            options.web_port,
            stored=Stored(options.keep, options.split),
            sector=self._sector(acts),
        )
        outputs.time_by(lambda tick: None if self._clock is None else self._clock.host_time(tick))
        try:
            if outputs.view is not None:
                self.screen.note(f"dashboard: {outputs.view.url}")
            watching: list[Sink] = [stats, *([self._judge] if self._judge else [])]
            if triggers:
                watching.append(Triggers(triggers, self.drive.number, self._triggered))
            self._gathered = Gathered(watching)
            if augmenter is not None:
                self.client.change = augmenter.take
            guards = [self.rig.guard()] if acts else []
            self.client.sinks = [self._notes, *guards, self._gathered, *outputs.sinks]
            self.drive.next_heartbeat()  # the drive's own counts start from this one
            result, exit_code, duration, cpu = self._run_acts(acts, stats)
            summary = summarise(self.target, self.client, stats, identity, duration, cpu, outputs.latency, self._bus)
            summary.result, ended = self._with_recording(result, exit_code)
            if acts:
                summary.outputs = "MAY STILL BE ON" if self.unsafe else "off, by the drive's heartbeat"
            summary.asked = self._judge.came() if self._judge else []
            summary.live_view = outputs.viewed()
            with suppress(RecordingError):  # `outputs.failure` tells
                self._uninterrupted(lambda: outputs.end_recording(as_markdown(summary)))
            if self._signal:
                ended = ended or 128 + self._signal
            if outputs.failure is not None:  # at the latest now
                summary.result, ended = self._with_recording(result, exit_code)
            summary.recording = outputs.recorded()
            report(summary)
            if hold and ended == 0 and outputs.view is not None:
                self.screen.note(f"the dashboard stays at {outputs.view.url} until Ctrl-C")
                with suppress(KeyboardInterrupt, Interrupted):
                    outputs.view.process.wait()
            return Ended(summary, ended)
        finally:
            with undisturbed():
                outputs.close()

    def _sector(self, acts: tuple[Act, ...]) -> float | None:
        """How long a Hall sector lasts at the highest speed that is asked for, s."""
        speed = max((abs(act.speed_rpm) for act in acts), default=0.0)
        return math.tau / (6.0 * self._pole_pairs * speed * RPM) if speed and self._pole_pairs else None

    def _run_acts(self, acts: tuple[Act, ...], stats: RunStatistics) -> tuple[str, int, float, float]:
        """All between start and stop of the streams. Returns result, exit code, duration in s, CPU in percent."""
        options = self.options
        cpu, started = CpuMeter(), self.client.now()
        self.client.longest_pause = 0.0
        meter = BusMeter(self.client)
        result, exit_code = "ok", 0
        try:
            self.drive.start_streams()
            if acts:
                self.rig.drive.limit_current()
                for machine in reversed(self.rig.machines):  # the load machine first, so that it holds the shaft
                    machine.energise()
            end = self.client.now()
            for act in timed(acts or (WATCHING,), options.duration):
                end += act.seconds
                self.perform(act, end, stats)
        except (KeyboardInterrupt, Interrupted) as interrupt:
            self._remember(interrupt)
        except LinkError as error:
            result, exit_code = f"link lost: {error}", 1
        except DriveFailed as error:
            self._trip(str(error))
        except RecordingError as error:
            self.client.note(str(error), "ERROR")  # the result: see `_with_recording`
        finally:
            duration, percent = self.client.now() - started, cpu.percent()
            self._bus = meter.report(self.drive.load)
            self._uninterrupted(self.make_safe)
        self._uninterrupted(self._put_back)
        with suppress(HbpError):
            self._uninterrupted(self.drive.stop_streams)
        self._gathered.flush()
        if acts and stats.faults and not self.tripped:  # in the last moment
            why = self.rig.drive.starved(self._watchdog)
            self.tripped = f"the drive tripped: {', '.join(fault_names(stats.faults))}{why}"
        if self.tripped and exit_code == 0:
            causes = self._judge.causes() if self._judge else []
            result, exit_code = "; ".join([self.tripped, *causes]), 1
            if self.rig.drive.ran_away:
                result = f"{result}. {self._advice}"
        if exit_code == 0:
            result, exit_code = self._judged(stats)
            if self._signal:
                ended = f"ended by {signal.Signals(self._signal).name}"
                result = f"{result} ({ended})" if result.startswith(IMPLAUSIBLE) else ended
                exit_code = 128 + self._signal
        if self._not_restored:
            words = self._not_restored
            if not exit_code:
                words, exit_code = f"the bench could not be restored: {words}", BenchError.exit_code
            result = words if result == "ok" else f"{result}; {words}"
        if self.unsafe:
            result = self.unsafe if result == "ok" else f"{self.unsafe} ({result})"
            exit_code = OutputsMayBeOn.exit_code
        return result, exit_code, duration, percent

    def _judged(self, stats: RunStatistics) -> tuple[str, int]:
        """Result and exit code of a run that came to its end: nothing that was not seen is called ok."""
        if not stats.samples_seen:
            return "no samples came", 1
        if self._silent:
            return f"no samples came in the last {self.client.now() - self._last_samples[1]:.1f} s", 1
        if self.drive.number not in self.client.heartbeats:
            return "no heartbeat came", 1
        if misdated := stats.misdated(self.drive.identity.tick_hz):
            return f"{IMPLAUSIBLE}: {misdated}", 1
        if self._judge is None:
            return "ok", 0
        if implausible := self._judge.implausible(stats.errors):
            return f"{IMPLAUSIBLE}: {'; '.join(implausible)}. {self._advice}", 1
        unseen = self._judge.unverified()
        return f"ok as far as was seen; unverified: {'; '.join(unseen)}" if unseen else "ok", 0

    @property
    def _advice(self) -> str:
        again = self.target
        if self.options.embedded:  # that address is of a child of this command
            again = "sim" + (f" --config {config}" if (config := self.options.settings.config) else "")
        return f"`bench hall check {again}` looks for the cause"

    def _with_recording(self, result: str, exit_code: int) -> tuple[str, int]:
        """Result and exit code of the run, or those of a recording that failed; a run that failed itself says both."""
        failure = None if self._outputs is None else self._outputs.failure
        if failure is None:
            return result, exit_code
        words = f"recording failed: {str(failure).removeprefix('recording ')}"
        return (f"{result}; {words}", exit_code) if exit_code else (words, failure.exit_code)

    def _uninterrupted(self, action: Callable[[], object]) -> None:
        """Do it undisturbed, once. A signal that comes before, meanwhile or after is remembered."""
        begun = False
        while not begun:
            try:
                with undisturbed():
                    begun = True
                    action()
            except (KeyboardInterrupt, Interrupted) as interrupt:
                self._remember(interrupt)

    def _remember(self, interrupt: BaseException) -> None:
        self._signal = self._signal or (interrupt.signum if isinstance(interrupt, Interrupted) else signal.SIGINT)

    # -- the motor ----------------------------------------------------------------------------------------------

    def perform(self, act: Act, end: float, stats: RunStatistics) -> None:
        """One act: angle source, load and speed, then watch until the client's clock says `end`."""
        self._gathered.flush()
        stats.segment = act.title
        if not self.tripped:
            self.client.note(act.title)
            if self._judge is not None and self.rig.drive.on:  # before it shows in the samples of the act before
                self._judge.ask(act.speed_rpm, act.load_a, act.title)
            try:
                if act.source is not None:
                    self.rig.drive.set("observer", act.source)
                if self.rig.load.abilities:
                    n_p, psi_f = (self.drive.parameter(name).value for name in ("n_p", "psi_f_hat"))
                    self.rig.load.torque(1.5 * n_p * psi_f * act.load_a)  # N·m per A of q current, peak-valued
                if self.rig.drive.on:
                    self.rig.drive.speed(rpm=act.speed_rpm)
            except (HbpError, BenchError) as error:
                self._trip(str(error))
        while (left := end - self.client.now()) > 0:
            self.client.poll(min(POLL, left))
            self._look(stats)

    def _put_back(self) -> None:
        """Every parameter of the drive as it was before the run; not in one whose outputs may still be on."""
        drive = self.rig.drive
        failures = [] if self.unsafe else failures_of([drive.put_back])
        words = [str(failure) for failure in failures] + [drive.not_put_back().removeprefix("; ")]
        self._not_restored = "; ".join(filter(None, words))
        if self._not_restored:
            self.client.note(self._not_restored, "ERROR")

    def make_safe(self) -> None:
        """Outputs off, and seen to be off, on every node that was energised; `unsafe` says where that was not seen.

        Nothing keeps a node from being told; what a sink raises meanwhile is raised when all have been.
        """
        failure: Exception | None = None
        for error in () if self.unsafe else self.rig.off():
            match error:
                case OutputsMayBeOn():
                    self.unsafe = self.unsafe or str(error)
                    self.client.note(str(error), "CRITICAL")
                case DriveFailed():
                    self.tripped = self.tripped or str(error)
                    self.client.note(str(error), "ERROR")
                case _:  # of a sink: the outputs were seen to be off all the same
                    failure, self.client.sinks = failure or error, [self._notes]
        if failure is not None:
            raise failure

    # -- what is looked at while it runs ------------------------------------------------------------------------

    def _look(self, stats: RunStatistics) -> None:
        now = self.client.now()
        if self._outputs is not None:
            for text, level in self._outputs.news():
                self.client.note(text, level)
            self._outputs.check()
        if self.client.health.down_since is None:
            while self._rebooted:
                node = self._rebooted.pop()
                if node == self.drive.number:
                    self._clock, self._next_clock = None, now
                    self._trip("the drive has rebooted")
                    self.drive.resume_streams()
                elif any(node == machine.node.number for machine in self.rig.machines):
                    self._trip("the load machine has rebooted")
            self._look_at_samples(now, stats)
            for machine in () if self.unsafe else reversed(self.rig.machines):
                watchdog = self._watchdog if machine is self.rig.drive else WATCHDOG
                if why := machine.trouble(watchdog):
                    self._trip(f"{machine.title}{why}")
            if now >= self._next_clock and not self.client.session.busy:
                self._next_clock = now + CLOCK_PERIOD
                try:
                    self._clock = self.drive.clock_fit(tries=1)
                except HbpError as error:
                    self.client.note(f"no clock: {error}", "WARN")
        if now >= self._next_progress:
            self._next_progress = now + PROGRESS_PERIOD
            self.screen.progress(self._status(stats))

    def _triggered(self, condition: Condition, tick: int, value: float) -> None:
        """Mark the run where a condition began to hold."""
        if self._outputs is not None:
            self._outputs.mark(f"trigger {condition.text}", tick, tick)
        at = tick / self.drive.identity.tick_hz
        self.client.note(f"trigger {condition.text}: {condition.channel} was {value:.6g} at {at:.3f} s", "WARN")

    def _look_at_samples(self, now: float, stats: RunStatistics) -> None:
        seen, since = self._last_samples
        if stats.samples_seen != seen or since == 0.0:
            self._last_samples = (stats.samples_seen, now)
            self._silent = False
        elif now - since > SILENCE and not self._silent:
            self._silent = True
            self.client.note(f"no DATA for {now - since:.2f} s on {self.client.link.name}", "ERROR")

    def _status(self, stats: RunStatistics) -> str:
        if self.client.health.down_since is not None:
            return f"{self.client.link.name} is gone, waiting for it to come back"
        losses = self.client.losses(self.drive.number).samples
        motor = [self.drive.state.name]
        if (omega := stats.mean.get("omega_enc")) is not None:
            n_p = self._pole_pairs
            motor.append(f"{omega / RPM / n_p:.0f} r/min" if n_p else f"{omega:.0f} rad/s (electrical)")
        if (i_q := stats.mean.get("i_q")) is not None:
            motor.append(f"i_q {i_q:.2f} A")
        return (
            f"{stats.segment} | {', '.join(motor)} | "
            f"{stats.samples_seen} samples, {stats.edges_seen} edges, {losses.lost_by_index} lost"
        )

    def _trip(self, why: str) -> None:
        self.tripped = why
        self.client.note(why, "ERROR")
        self.make_safe()


def run(
    options: LiveOptions,
    screen: Screen,
    confirm: Callable[[str], bool] | None,
    report: Callable[[Summary], None],
    hold: bool = False,
) -> Ended:
    """Run `bench live`.

    `confirm` asks a person, None where there is nobody; `report` gets the summary when the motor is off; `hold` keeps
    the live view up after that. Raises BenchError and HbpError for what the user can mend. However this is left, STOP
    was sent, or could not be sent and the note says so.
    """
    if options.save is not None:
        check_output(options.save, str(options.save), options.overwrite, recording=True)
    if options.estimate:
        from bench.observers.estimators import entry_of

        for name in options.estimate:
            entry_of(name)
    with ExitStack() as stack:
        stack.enter_context(signals_as_exceptions())
        target = "sim" if options.target is None else options.target
        if options.embedded:
            if options.save is not None or options.viewer != "none":
                load_beside(options.viewer != "none")
            target = stack.enter_context(EmbeddedDrive(options.settings.config, screen.note)).target
        else:
            stack.enter_context(alone_on(target))
        link = open_link(target)
        stack.callback(link.close)
        if target.startswith("can:") and "/" not in target:  # which bus that is, python-can's files say
            target = link.name
        live = LiveRun(options, link, target, screen)
        try:
            live.look()
            acts = live.acts()
            stream = live.configure(acts)
            live.check(acts, confirm)
            return live.go(stream, acts, report, hold)
        except BaseException as error:
            with undisturbed():
                live.make_safe()  # in case a second signal came before STOP
            if live.unsafe:
                raise OutputsMayBeOn(f"{live.unsafe} ({error or type(error).__name__})") from error
            raise

"""`bench live` without the command line: watch a drive, or play a motion profile on it, in a `Rig`, and sum up.

The rig looks, energises, watches, and ends with the outputs off; where STOP cannot arrive (the link is gone, the
process was killed) the drive's own watchdog switches off, because only this process feeds it.
"""

from __future__ import annotations

import math
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from typing import Any

from bench.device.bus import BusMeter
from bench.device.client import PAUSE
from bench.device.heard import Changes, Heard, Note, Sink
from bench.device.node import LOAD
from bench.device.simulator import EmbeddedDrive
from bench.errors import BenchError, DoesNotFit, DriveFailed, Interrupted, RecordingError
from bench.files import check_output, run_folder
from bench.findings.motor import CODES as OF_MOTOR
from bench.findings.thresholds import LOST_SHARE
from bench.live.at_fault import AtFault
from bench.live.distrust import Distrust
from bench.live.gathered import Gathered
from bench.live.options import LiveOptions
from bench.live.plausible import Plausibility
from bench.live.summary import CpuMeter, RunStatistics, Summary, as_markdown, summarise
from bench.live.triggers import Condition, Triggers
from bench.live.tuner import KEYS, Tuner
from bench.motion import profile
from bench.motion.profile import Act, Course, Profile
from bench.record.layout import fault_run
from bench.record.ring import Stored
from bench.rig.consent import check_limits, require_consent
from bench.rig.interrupts import signals_as_exceptions
from bench.rig.lock import alone_on
from bench.rig.needs import NEEDS, require
from bench.rig.outcome import RunOutcome
from bench.rig.outputs import Recording, load_beside, require_viewable
from bench.rig.play import Player
from bench.rig.played import Span
from bench.rig.profile import check_profile, envelope_of, set_first
from bench.rig.rig import Plan, Rig
from bench.rig.screen import Screen
from bench.rig.streams import decimation_of
from bench.rig.tuning import Tuning
from bench.signal.sources import source_number, source_short
from bench.signal.units import RPM, pole_pairs
from bench.signal.verdict import Verdict
from protocol.descriptor import Channel
from protocol.errors import LinkError
from protocol.host import HeartbeatReceived
from protocol.links import open_link
from protocol.streams import StreamConfig

__all__ = ["LiveOptions", "LiveOutcome", "run"]

RECONNECT = 30.0  # s that a lost link is waited for
PROGRESS_PERIOD = 0.5  # s
SILENCE = 2.0  # s without samples after which a note says so


class _ScreenNotes:
    """Sink that puts the notes of client and run on the screen."""

    def __init__(self, screen: Screen) -> None:
        self._screen = screen

    def take(self, item: Heard) -> None:
        """Show it, if it is one."""
        if isinstance(item, Note):
            self._screen.note(item.text)


@dataclass(frozen=True)
class LiveOutcome(RunOutcome):
    """How a run ended, with its figures."""

    summary: Summary | None = None


class LiveRun:
    """One run of `bench live` in a rig that has done nothing to the drive yet."""

    def __init__(self, options: LiveOptions, rig: Rig, target: str, screen: Screen) -> None:
        self.options, self.rig, self.target, self.screen = options, rig, target, screen
        self.client, self.node = rig.client, rig.drive.node
        self.asked: Profile | None = None
        """What is done to the motor; None: it is only watched."""
        self._stats = RunStatistics(self.node.number)
        self._judge: Plausibility | None = None
        self._distrust = Distrust(self.node.number, self._doubted)
        self._gathered = Gathered(())  # what counts and judges
        self._tuning: Tuning | None = None
        self._tuner: Tuner | None = None
        self._next_progress = 0.0
        self._last_samples = (0, 0.0)
        self._silent = False
        self._pauses = 0  # of this program, when it last looked
        self._at_fault = AtFault(self.node, target, options.settings, screen, options.save, not options.embedded)

    # -- before anything moves ----------------------------------------------------------------------------------

    def look(self) -> None:
        """Say what is there and, where a load is asked for, find the load machine. Leaves the motor alone."""
        hello, options = self.node.identity, self.options
        self.rig.take(or_fault=options.clear_faults)
        self.screen.note(
            f"{hello.name} {hello.firmware} on {self.target}: boot {hello.boot_id:08x}, "
            f"HBP {hello.major}.{hello.minor}, PWM {hello.pwm_hz} Hz, "
            f"{len(self.node.descriptor.channels)} channels, state {hello.state.name}"
        )
        self._at_fault.look()
        if options.tune:
            self._tuning = Tuning(self.rig.drive, options.tune)
        self.asked = options.asked(self.node)
        if self.asked is None:
            return
        envelope = self.rig.drive.envelope = envelope_of(self.asked, options.current, self.node)
        if self.asked.loads:
            load = self.rig.load_machine()
            if load is None:
                what = "--load" if options.profile is None else options.profile.source
                raise BenchError(f"{what} needs a load machine (node {LOAD}), and {self.target} has none")
            load.envelope = envelope
            self.rig.load = load

    def agree(self, confirm: Callable[[str], bool] | None) -> None:
        """What the drive lacks (NodeError), limits and consent: raises before anything is energised."""
        options, envelope = self.options, self.rig.drive.envelope
        if self.asked is not None:
            if options.load_a is not None:
                require(self.node, "--load", NEEDS["--load"])
            if options.observer:
                require(self.node, "--observer", [f"observer:{options.observer}"])
            if options.profile is not None:
                for words in check_profile(self.asked, self.rig.drive, self.rig.load):
                    self.screen.note(words)
            check_limits(self.node, envelope)
            if envelope.load > envelope.current:
                load, current = f"load {envelope.load:g} A", f"the {envelope.current:g} A that the motor may get"
                raise BenchError(f"{load} is beyond {current}: --current, or [rated] current in bench.toml")
            require_consent(self.node, self.target, envelope, options.yes, confirm)
            for machine in self.rig.machines:
                machine.node.client.listen(machine.node.number)
        if options.clear_faults:
            self.node.clear_faults()

    # -- streaming ----------------------------------------------------------------------------------------------

    def configure(self) -> StreamConfig:
        """Configure samples and edges for what will be done; returns the stream of samples that will come."""
        options = self.options
        decimation = decimation_of(self.node.identity.pwm_hz, options.rate_hz)
        channels = self.node.channels(self._channel_names())
        needed: tuple[str, ...] = ()
        on_host = "--host-observers" if options.host_observers else "--estimate"  # the option that runs observers here
        if options.host_observers or options.estimate:
            needed = self._inputs(channels)
            missing = [name for name in needed if name not in {channel.name for channel in channels}]
            lacks = ["every PWM period"] if len(needed) > 1 and (missing or decimation != 1) else []
            lacks += [f"the channels {', '.join(missing)}"] if missing else []
            if lacks:
                raise BenchError(f"{on_host} needs {' and '.join(lacks)}")
            needed = needed if len(needed) > 1 else ()  # edges alone come at any rate
        if not self.node.offers_edges:
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
        """What observers here must be given, `hall` alone or at every PWM period with voltages and currents.

        BenchError for a name that is wrong, and where there is nothing to do.
        """
        from bench.replay.estimators import CHECKED, compared_inputs, entry_of

        names = {channel.name for channel in channels}
        if self.options.host_observers and not names & CHECKED.keys():
            raise BenchError("--host-observers has nothing to compare: add an estimate to --channels, such as theta_vt")
        asked = [entry_of(name) for name in self.options.estimate]
        if not self.options.host_observers and not any(entry.needs.required for entry in asked):
            return ("hall",)
        names |= {f"theta_{entry.short}" for entry in asked}
        switch = "load_angle_comp"
        on = self.node.has_parameter(switch) and self.node.parameter(switch).value != 0.0
        return compared_inputs(names, on)

    def _channel_names(self) -> tuple[str, ...] | None:
        """The channels that were asked for; without a list of its own a run also gets what its control works with."""
        names = self.options.channels
        if not self.options.observer or not all(name.startswith("+") for name in names or ()):
            return names
        short = source_short(source_number(self.options.observer) or 0)
        offered = {channel.name for channel in self.node.descriptor.channels}
        return (*(names or ()), *(f"+{n}_{short}" for n in ("theta", "omega", "sensors") if f"{n}_{short}" in offered))

    def record(self, stream: StreamConfig) -> None:
        """Read the drive's parameters; prepare what judges, counts, records and shows."""
        options, rig = self.options, self.rig
        rig.learn()
        parameters = rig.drive.parameters
        self._judge = Plausibility(stream, self.node.offers_edges, parameters, threaded=True)
        if options.host_observers:
            from bench.replay.estimators import HostObservers

            self._stats = RunStatistics(self.node.number, HostObservers(parameters, stream))
        augmenter = None
        if options.estimate:
            from bench.replay.augment import Augmenter
            from bench.replay.estimators import done_without

            augmenter = Augmenter(options.estimate, parameters, stream)
            for words in done_without([entry.name for entry in augmenter.estimators.entries], stream):
                self.screen.note(f"--estimate: {words}")
        added = augmenter.channels if augmenter else ()
        triggers = [Condition.parse(text) for text in options.trigger]
        for condition in triggers:
            condition.check([channel.name for channel in (*stream.channels, *added)])
        watching: list[Sink] = [self._stats, self._judge, self._distrust]
        if triggers:
            watching.append(Triggers(triggers, self.node.number, self._triggered))
        if augmenter is not None:
            watching.append(Changes(self.node.number, augmenter.change))
        self._gathered = Gathered(watching)
        rig.clock = self.node.clock_fit()
        profile_file = "" if options.profile is None else options.profile.source
        about = {name: words for name, words in (("note", options.note), ("profile", profile_file)) if words}
        recording = Recording(
            options.save, about, options.viewer, options.overwrite, options.web_port,
            Stored(options.keep, options.split),
        )  # fmt: skip
        sinks: list[Sink] = [_ScreenNotes(self.screen), self._stats.dates, self._gathered]
        outputs = rig.record_to(recording, sinks, added)
        if outputs.view is not None:
            self.screen.note(f"dashboard: {outputs.view.url}")
        if augmenter is not None:
            self.client.change = augmenter.take
        if self._tuning is not None:
            self._tuner = self._at_the_keyboard(self._tuning)
        self._begin_counts()

    def _at_the_keyboard(self, tuning: Tuning) -> Tuner:
        """What does what is typed; BenchError without standard input."""
        if sys.__stdin__ is None:
            raise BenchError("--tune needs standard input: keys of a terminal, or lines NAME=VALUE")
        keys = sys.__stdin__.isatty()
        self.screen.note(f"tuning {', '.join(tuning)}: {KEYS if keys else 'by lines NAME=VALUE on standard input'}")
        return Tuner(tuning, sys.__stdin__.fileno(), keys, lambda words: self.client.note(words, "WARN"))

    def _begin_counts(self) -> None:
        """The drive's own counts start from a heartbeat: the next one before anything is energised.

        Else one that has just come will do, if nothing was streamed then.
        """
        beat = None if self.asked or self.client.unasked else self.node.recent_heartbeat()
        if beat is None:
            self.node.next_heartbeat()
        else:
            self.client.tell(HeartbeatReceived(self.node.number, beat))

    def _mark(self, name: str, first: int, last: int, verdict: Verdict | None = None) -> float:
        """Mark the run from tick `first` to `last`, which is returned in s."""
        if self.rig.outputs is not None:
            self.rig.outputs.mark(name, first, last, verdict)
        return last / self.node.identity.tick_hz

    def _triggered(self, condition: Condition, tick: int, value: float) -> None:
        """Mark the run where a condition began to hold."""
        at = self._mark(f"trigger {condition.text}", tick, tick)
        self.client.note(f"trigger {condition.text}: {condition.channel} was {value:.6g} at {at:.3f} s", "WARN")

    def _doubted(self, words: str, tick: int, now: bool) -> None:
        """Mark the run where the drive began or ceased to doubt a Hall sensor, or its own angle."""
        self.client.note(f"{words}, from {self._mark(words, tick, tick):.3f} s on", "WARN" if now else "INFO")

    def _tell_findings(self) -> None:
        """Note what is wrong with Hall sensors, encoder and the motor's parameters, and mark the run there."""
        assert self._judge is not None
        for found, first, last in self._judge.news():
            at = self._mark(found.cause, first, last, Verdict.FAIL)
            of = "motor" if found.code in OF_MOTOR else "Hall sensors"
            self.client.note(f"{of}, until {at:.1f} s: {found.line}", "WARN")

    # -- the motor ----------------------------------------------------------------------------------------------

    def go(self, report: Callable[[Summary], None], hold: bool) -> LiveOutcome:
        """Play what was asked for, switch off, sum up."""
        rig, outputs = self.rig, self.rig.outputs
        assert outputs is not None
        cpu, started, meter = CpuMeter(), self.client.now(), BusMeter(self.client)
        self.client.longest_pause = 0.0
        lost = ""
        try:
            lost = self._perform_all()
        finally:
            self._gathered.flush()
            self._tell_tuned()
            self._commands(self.asked is None)
            duration, percent = self.client.now() - started, cpu.percent()
            bus = meter.report(self.node.load)
            rig.finish()
        self._gathered.flush()
        if self._judge is not None:
            rig.signal.uninterrupted(self._judge.hall.findings)
            self._tell_findings()
        ended = self._outcome(lost)
        held = {} if lost else self._fetch()
        summary = summarise(
            self.target, self.client, self._stats, self.node.identity, duration, percent, outputs.latency, bus
        )
        summary.result = self._with_recording(ended).words
        if self.asked is not None:
            summary.outputs = "MAY STILL BE ON" if rig.unsafe else "off, by the drive's heartbeat"
        summary.at_fault = held
        summary.asked = self._judge.speed.came() if self._judge else []
        summary.motor = self._judge.motor.told() if self._judge else {}
        doubts = self._distrust
        summary.distrusted, summary.moved, summary.angle_lost = doubts.shares, doubts.moved, doubts.lost
        summary.live_view = outputs.viewed()
        with suppress(RecordingError):  # `outputs.failure` tells
            rig.signal.uninterrupted(lambda: outputs.end_recording(as_markdown(summary)))
        ended = self._with_recording(ended)  # at the latest now
        if rig.signal.number and not ended.exit_code:
            ended = RunOutcome.of(Verdict.ABORTED, ended.words, ended.findings, signum=rig.signal.number)
        summary.result = ended.words
        summary.recording = outputs.recorded()
        report(summary)
        if hold and ended.exit_code == 0 and outputs.view is not None:
            self.screen.note(f"the dashboard stays at {outputs.view.url} until Ctrl-C")
            with suppress(KeyboardInterrupt, Interrupted):
                outputs.view.process.wait()
        return LiveOutcome(ended.exit_code, ended.verdict, ended.words, ended.findings, summary)

    def _tell_tuned(self) -> None:
        """What has been tuned, which the end puts back, and how it is kept."""
        if self._tuning is not None and (changes := self._tuning.changes()):
            new = " ".join(f"{n}={v:.7g}" for n, v in self._tuning.items() if v != self._tuning.before[n])
            self.client.note(f"tuned: {changes}; now put back; to keep it: bench param set {self.target} {new}")

    def _fetch(self) -> dict[str, Any]:
        """What the drive held at a fault, kept beside the recording; a signal leaves it in the drive."""
        try:
            return self._at_fault.keep()
        except (KeyboardInterrupt, Interrupted) as interrupt:
            self.rig.signal.remember(interrupt)
            self.screen.note("the drive still holds what came before the fault: bench capture --at-fault fetches it")
            return {}

    def _commands(self, now: bool) -> None:
        """Whether the drive is told what to do in what comes from now on: its samples need not say."""
        self._stats.commanded = now
        if self._judge is not None:
            self._judge.commanded = now

    def _perform_all(self) -> str:
        """All between start and stop of the streams; why the link was lost for good, if it was."""
        with self._tuner or nullcontext():
            return self._play_all()

    def _play_all(self) -> str:
        rig, seconds = self.rig, self.options.duration
        try:
            self.node.start_streams()
            if self.asked is None:
                self._begun("watching")
                rig.until(self._look, math.inf if seconds is None else seconds)
                return ""
            rig.drive.limit_current()
            set_first(self.asked, rig.drive)
            for machine in reversed(rig.machines):  # the load machine first, so that it holds the shaft
                machine.energise()
            player = Player(rig, self.asked.max_speed, self._act_begun, self._act_over, self._look)
            player.play(self.asked.timed(seconds))
        except (KeyboardInterrupt, Interrupted) as interrupt:
            rig.signal.remember(interrupt)
        except LinkError as error:
            return f"link lost: {error}"
        except DriveFailed as error:
            rig.let_go(str(error))
        except RecordingError as error:
            self.client.note(str(error), "ERROR")  # the result: see `_with_recording`
        return ""

    def _begun(self, title: str) -> None:
        """From now on, this is what goes on."""
        self._gathered.flush()
        self._stats.segment = title
        if not self.rig.tripped:
            self.client.note(title)

    def _act_begun(self, act: Act) -> None:
        self._begun(act.title)
        if self._judge is not None and self.rig.drive.on:  # before it shows in the samples that come from now on
            speed = act.drive.last if act.drive.quantity == profile.SPEED and act.settles else math.nan
            self._judge.speed.ask(speed, self._load_current(act), act.title)

    def _load_current(self, act: Act) -> float:
        """A of q current that the load takes at the end of an act; NaN where nobody knows."""
        match act.load:
            case Course(quantity=profile.LOAD_CURRENT, last=last):
                return last
            case Course(quantity=profile.LOAD_TORQUE, last=last):
                with suppress(BenchError):  # a drive that does not tell what it takes
                    return last / self.rig.drive.torque_constant
                return math.nan
            case Course(quantity=profile.LOAD_SPEED):
                return math.nan
        return 0.0

    def _act_over(self, span: Span) -> None:
        if self.options.speed_rpm is None and self.options.load_a is None:
            self.rig.mark_step(span)

    def _look(self) -> bool:
        """See whether samples come, and show where the run is; it is never over."""
        now = self.client.now()
        if self.client.health.down_since is None:
            seen, since = self._last_samples
            paused = self.client.pauses != self._pauses or self.client.behind
            if self._stats.samples_seen != seen or since == 0.0 or paused:
                self._last_samples, self._pauses = (self._stats.samples_seen, now), self.client.pauses
                self._silent = False
            elif now - since > SILENCE and not self._silent:
                self._silent = True
                self.client.note(f"no DATA for {now - since:.2f} s on {self.client.link.name}", "ERROR")
        if self._tuner is not None and self._tuner.poll():
            self._next_progress = now
        if now >= self._next_progress:
            self._next_progress = now + PROGRESS_PERIOD
            self._tell_findings()
            self.screen.progress(self._status())
        return False

    def _status(self) -> str:
        stats = self._stats
        if self.client.health.down_since is not None:
            return f"{self.client.link.name} is gone, waiting for it to come back"
        losses = self.client.losses(self.node.number).samples
        motor = [self.node.state.name]
        if (omega := stats.mean.get("omega_enc")) is not None:
            n_p = pole_pairs(self.rig.drive.parameters)
            motor.append(f"{omega / RPM / n_p:.0f} r/min" if n_p else f"{omega:.0f} rad/s (electrical)")
        if (i_q := stats.mean.get("i_q")) is not None:
            motor.append(f"i_q {i_q:.2f} A")
        knobs = "" if self._tuner is None else f"{self._tuner.knobs.words()} | "
        return (
            f"{knobs}{stats.segment} | {', '.join(motor)} | "
            f"{stats.samples_seen} samples, {stats.edges_seen} edges, {losses.lost_by_index} lost"
        )

    # -- how it ended -------------------------------------------------------------------------------------------

    def _outcome(self, lost: str) -> RunOutcome:
        """Of a run that is over, but for its recording; `lost`: why the link is, if it is."""
        rig, signum = self.rig, self.rig.signal.number
        verdict, words = Verdict.FAIL, lost
        findings: tuple[str, ...] = (lost,)
        if not lost and rig.tripped:
            findings = (rig.tripped, *(found.line for found in (self._judge.causes() if self._judge else ())))
            words = "; ".join(findings) + (f". {self._advice}" if rig.drive.ran_away else "")
        elif not lost:
            verdict, words, findings = self._judged()
            if signum:
                ended = f"ended by {signal.Signals(signum).name}"
                verdict, words = Verdict.ABORTED, f"{words} ({ended})" if findings else ended
        if rig.not_restored and verdict is Verdict.PASS:
            verdict, words = Verdict.ERROR, f"the bench could not be restored: {rig.not_restored}"
        elif rig.not_restored:
            words = f"{words}; {rig.not_restored}"
        return RunOutcome.of(verdict, words, findings, unsafe=rig.unsafe, signum=signum)

    def _judged(self) -> tuple[Verdict, str, tuple[str, ...]]:
        """Verdict, words and findings of a run that came to its end: nothing that was not seen is called ok."""
        stats = self._stats
        missing = ""
        if not stats.samples_seen:
            missing = "no samples came"
        elif self._silent:
            missing = f"no samples came in the last {self.client.now() - self._last_samples[1]:.1f} s"
        elif self.node.number not in self.client.heartbeats:
            missing = "no heartbeat came"
        if missing:
            return Verdict.FAIL, missing, ()
        misdated = stats.misdated(self.node.identity.tick_hz)
        if misdated and self.client.longest_pause < PAUSE:  # else they may have waited here
            return Verdict.FAIL, f"implausible: {misdated}", (misdated,)
        judge = self._judge
        if judge is None:
            return Verdict.PASS, "ok", ()
        wrong = judge.implausible(stats.errors) if self.asked else judge.at_rest()
        if found := tuple(finding.line for finding in wrong):
            return Verdict.FAIL, f"implausible: {'; '.join(found)}. {self._advice}", found
        unseen = [*(judge.unverified() if self.asked else []), *self._lost()]
        return Verdict.PASS, f"ok as far as was seen; unverified: {'; '.join(unseen)}" if unseen else "ok", ()

    def _lost(self) -> Iterator[str]:
        """What is not known of the run because it did not come, where that is much."""
        losses = self.client.losses(self.node.number)
        for count, noun in ((losses.samples, "samples"), (losses.edges, "Hall edges")):
            made = count.samples + count.lost_by_index
            if count.lost_by_index > LOST_SHARE * made:
                share = f"{100 * count.lost_by_index / made:.0f} %"
                yield f"what {share} of the {noun} would have shown ({count.lost_by_index} of {made} were lost)"

    @property
    def _advice(self) -> str:
        again = self.target
        if self.options.embedded:  # that address is of a child of this command
            again = "sim" + (f" --config {config}" if (config := self.options.settings.config) else "")
        return f"`bench hall check {again}` looks for the cause"

    def _with_recording(self, ended: RunOutcome) -> RunOutcome:
        """How the run ended, or how its recording failed; a run that failed itself says both."""
        failure = None if self.rig.outputs is None else self.rig.outputs.failure
        if failure is None:
            return ended
        words = f"recording failed: {str(failure).removeprefix('recording ')}"
        if ended.exit_code:
            return replace(ended, words=f"{ended.words}; {words}")
        return RunOutcome(failure.exit_code, Verdict.ERROR, words, (words,))


def run(
    options: LiveOptions,
    screen: Screen,
    confirm: Callable[[str], bool] | None,
    report: Callable[[Summary], None],
    hold: bool = False,
    drive: EmbeddedDrive | None = None,
) -> LiveOutcome:
    """Run `bench live`.

    `confirm` asks a person, None where there is nobody; `report` gets the summary when the motor is off; `hold` keeps
    the live view up after that; `drive`: the embedded one, if it was started already. Raises BenchError and HbpError
    for what the user can mend. However this is left, STOP was sent, or could not be sent and the note says so.
    """
    require_viewable(options.save, options.viewer)
    if options.save is not None:
        for each in (options.save, fault_run(run_folder(options.save))):
            check_output(each, str(each), options.overwrite, recording=True)
    if options.estimate:
        from bench.replay.estimators import entry_of

        for name in options.estimate:
            entry_of(name)
    with ExitStack() as stack:
        stack.enter_context(signals_as_exceptions())
        target = "sim" if options.target is None else options.target
        if options.embedded:
            load_beside(options.save is not None, options.viewer != "none")
            drive = drive or EmbeddedDrive(options.settings.config)
            drive.note = screen.note
            target = stack.enter_context(drive).target
        held = nullcontext() if options.embedded else alone_on(target)
        plan = Plan(
            lambda: open_link(target), target, options.settings,
            reconnect=RECONNECT, goes_on=True, passive=options.passive, held=held, private=options.embedded,
        )  # fmt: skip
        rig = stack.enter_context(Rig(plan))
        if target.startswith("can:") and "/" not in target:  # which bus that is, python-can's files say
            target = rig.client.link.name
            rig.plan = replace(plan, target=target)
        live = LiveRun(options, rig, target, screen)
        live.look()
        stream = live.configure()
        live.agree(confirm)
        live.record(stream)
        return live.go(report, hold)

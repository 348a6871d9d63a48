"""A bench at work: drive, load, streams, recording; and the end of it, with everything off.

A `Rig` is opened for a run and closed after it, on a simulated drive in virtual time as on hardware. However a run
ends, `finish` stops what may turn and puts back what was changed, and tells what could not be done when all of that
has been tried; `close` gives back recording, link and lock after it, and raises what was told to nobody. A rig never
waits without polling: what turns is watched, and its watchdog fed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Self

from bench.capture.memory import CaptureMemory
from bench.capture.trigger import Trigger
from bench.capture.wanted import Wanted
from bench.device.client import LISTEN, POLL, Client
from bench.device.heard import Changes, Sink
from bench.device.node import ClockFit, Node
from bench.device.safety import is_off, says
from bench.errors import BenchError, DriveFailed, OutputsMayBeOn, SeveralDevices
from bench.motion.profile import Profile
from bench.motion.read import read_profile
from bench.record.info import RunInfo
from bench.rig.connection import find_drive, load_target, open_load_machine, second_node
from bench.rig.drive import OBSERVER, Drive, DriveTripped
from bench.rig.envelope import Envelope
from bench.rig.interrupts import FirstSignal, undisturbed
from bench.rig.loads import Load, NodeLoad, NoLoad, OwnLoads, PersonLoad
from bench.rig.machine import Machine
from bench.rig.metadata import changed_keys, run_info
from bench.rig.needs import NEEDS, require
from bench.rig.outputs import Outputs, Recording
from bench.rig.person import Ask
from bench.rig.play import Player
from bench.rig.played import Played, Span
from bench.rig.profile import check_profile, start_for
from bench.rig.quality import ParameterValue, Quality
from bench.rig.recorder import Recorder
from bench.rig.rest import require_rest
from bench.rig.restore import failures_of
from bench.rig.runaway import RunawayGuard
from bench.rig.settings import Settings
from bench.rig.shots import SHARE, FullRate, Held, Shot
from bench.rig.streams import configure, edge_rate, most_channels
from bench.signal.capture import Capture
from bench.signal.channels import reference_angle, speed_channel
from bench.signal.chunks import no_edge_stream
from bench.signal.verdict import Verdict
from protocol.descriptor import Channel
from protocol.errors import HbpError
from protocol.links import Link
from protocol.messages import Role
from protocol.signals import Signal
from protocol.streams import MAX_DECIMATION, StreamConfig

SILENCE = 2.0  # s without samples after which waiting for more is given up
CLOCK_PERIOD = 2.0  # s between looks at the drive's clock
LATE = 1.0  # s that samples of a stretch may come after its end
FEW = 4  # samples that are waited for, however short a stretch is


@dataclass(frozen=True)
class Plan:
    """How a rig is to be made."""

    link: Callable[[], Link]
    target: str
    settings: Settings = field(default_factory=Settings)
    envelope: Envelope = field(default_factory=Envelope)
    ask: Ask | None = None
    """None where nobody can be asked."""
    virtual: bool = False
    """Time passes as fast as it can be computed."""
    find: Callable[[Client, str], Node] = find_drive
    """What finds, on a link, the drive of a target."""
    reconnect: float = 0.0
    """s that a lost link is waited for."""
    goes_on: bool = False
    """Whether a run goes on that cannot turn its motor any more: what lets it go, and how it ends, is told, not raised.

    Faults stay latched then, for somebody to look at.
    """
    passive: bool = False
    """Nothing is energised, and state, faults and parameters are left alone."""
    held: AbstractContextManager[object] = field(default_factory=nullcontext)
    """What is held as long as the rig is open: the lock on its target."""
    private: bool = False
    """No device but this program's own child can be on the link."""
    own_loads: OwnLoads = field(default_factory=OwnLoads)
    """What outlives the rig: objects of the user's load classes."""


class Rig:
    """See the module. Raises BenchError and HbpError; use it as a context manager.

    A new one is connected to the drive, and has done nothing to it. `prepare` does what most runs begin with.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.at_end: list[Callable[[], None]] = []
        """What is done when the drive has been stopped."""
        self.samples: StreamConfig | None = None
        """The stream of samples, once it is configured."""
        self.full_rate: FullRate | None = None
        """What holds in the drive what the link is too slow for; None where it carries all."""
        self._edges = False  # whether Hall edges are streamed
        self.load: Load = NoLoad()
        self.before: tuple[ParameterValue, ...] = ()
        """The drive's parameters before the run."""
        self.outputs: Outputs | None = None
        self.tripped = ""
        """Why the motor was let go, or stopped by itself; empty as long as that was raised."""
        self.unsafe = ""
        """Why outputs may still be on."""
        self.not_restored = ""
        """What is not as it was before, and why."""
        self.signal = FirstSignal()
        """That came to a run that goes on, or to the end of any."""
        self.clock: ClockFit | None = None
        """Of this boot of the drive, in a run that goes on, and while a profile is played."""
        self._next_clock = 0.0
        self._rebooted: set[int] = set()
        self._prepared = False
        self._taken = False
        self._failures: list[Exception] | None = None  # of the end; None before it
        with ExitStack() as stack:
            stack.enter_context(plan.held)
            link = plan.link()
            stack.callback(link.close)
            self.client = Client(link, plan.reconnect, plan.private)
            self.client.on_reboot = self._rebooted.add
            node = plan.find(self.client, plan.target)
            node.encoder = plan.settings.encoder
            self.drive = Drive(node, plan.envelope)
            if plan.goes_on:
                self.drive.advice = ""  # nobody computes here
            self.recorder = Recorder(node.number)
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close()
        if self.unsafe and error is not None and self.plan.goes_on:
            unsafe = isinstance(error, OutputsMayBeOn)  # it is told once, with its cause if that is known
            raise OutputsMayBeOn(
                str(error) if unsafe else f"{self.unsafe} ({error or type(error).__name__})"
            ) from error

    # -- before anything moves ----------------------------------------------------------------------------------

    def prepare(
        self,
        channels: Sequence[tuple[Channel, ...]] | None = None,
        recording: Recording | None = None,
        needed: frozenset[str] = frozenset(),
        held: bool = False,
        full: bool = False,
    ) -> Self:
        """Find the load, stream `channels` (see `configure`; None: what a drive has, with those `needed`) and record.

        `held`: where the link carries less than the PWM rate, what is measured comes out of the drive's memory, if it
        has one; with `full` always at the PWM rate. The drive must be at rest, but in a passive rig. Closed where that
        fails. Raises BenchError and HbpError.
        """
        try:
            self.take()
            self.learn()
            if not self.plan.passive:
                self.load = self._find_load()
            choices = channels or most_channels(self.drive.node, needed)
            edges = self.configure(choices, slower=True)
            if held and self.rate < self.drive.node.identity.pwm_hz and self.drive.node.offers_capture:
                edges = self._hold(choices[-1], full)
            self.recorder.expect(edges, self.drive.parameters)
            self.record_to(recording or Recording(), [self.recorder])
            self.drive.node.start_streams()
            self.wait(2 * POLL)
            self._prepared = True
            if not self.plan.passive:
                self.drive.limit_current()
        except BaseException:
            failures_of([self.finish, self._stack.close])  # why it is closed matters more
            self._failures = []
            raise
        return self

    def take(self, or_fault: bool = False) -> None:
        """Begin to use the drive, if it is free: see `require_rest`. Streams that somebody has left are stopped."""
        self.client.require_alone(self.drive.node.number)
        self.require_rest(or_fault)
        self.drive.node.require_boot()
        self._taken = True
        self.drive.node.stop_streams()

    def learn(self) -> None:
        """Read the drive's parameters, which its end puts back."""
        node = self.drive.node
        told = [(record, node.parameter(record.name)) for record in node.descriptor.parameters]
        self.before = tuple(ParameterValue(r.name, v.value, v.default, r.unit.symbol) for r, v in told)
        self.drive.learn({p.name: p.value for p in self.before})

    def require(self, *applications: str) -> None:
        """Raise NodeError unless the drive has what these applications of `bench.rig.needs` need."""
        for what in applications:
            require(self.drive.node, what, NEEDS[what])

    def require_rest(self, or_fault: bool = False) -> None:
        """Raise BenchError unless the drive says that its outputs are off and, unless `or_fault`, that it has no fault.

        Nothing is changed in the drive. In a passive rig its state does not matter: BenchError only where another host
        has its outputs on and gets its streams.
        """
        node, target = self.drive.node, self.plan.target
        if not self.plan.passive:
            require_rest(node, target, or_fault)
        elif (
            (beat := node.recent_heartbeat() or node.next_heartbeat())
            and not is_off(beat)
            and any(s.running for s in node.configured_streams())
        ):
            other = f"streams to another host, which has its outputs on ({says(beat)})"
            raise BenchError(f"{target} {other}: watching it would take these streams away")

    def configure(
        self, choices: Sequence[tuple[Channel, ...]], decimation: int = 1, slower: bool = False, edges: bool = True
    ) -> StreamConfig:
        """Configure edges, if they are wanted, and samples as `bench.rig.streams.configure` does.

        Returns the stream of edges.
        """
        node, identity = self.drive.node, self.drive.node.identity
        self._edges = edges and node.offers_edges
        none = no_edge_stream(node.number, identity.tick_hz, identity.pwm_hz)
        stream = node.set_edges() if self._edges else none
        edges_per_s = edge_rate(node, self.drive.envelope) if slower and self._edges else 0.0
        self.samples = configure(node, choices, decimation, slower, edges_per_s)
        return stream

    def _hold(self, channels: tuple[Channel, ...], full: bool) -> StreamConfig:
        """Have the drive hold what is measured, and the link carry the less: what is read goes beside its streams.

        Hall edges are held, too; at high speeds they would take all of a slow link.
        """
        node = self.drive.node
        self.full_rate = FullRate(self.drive, self.until, self.plan.target, channels, full)
        self.at_end.append(self.full_rate.close)
        node.stop_streams()
        edges = self.configure([channels], slower=True, edges=False)
        assert self.samples is not None
        if node.load > SHARE and (slower := math.ceil(self.samples.decimation * node.load / SHARE)) <= MAX_DECIMATION:
            self.samples = node.set_samples(channels, slower)
        return edges

    def load_machine(self) -> NodeLoad | None:
        """The load machine at node 2 of the drive's link, if there is one; BenchError for a node of another kind."""
        node = second_node(self.client)
        if node is None:
            return None
        if node.identity.role != Role.LOAD:
            where = f"node {node.number} on {self.plan.target}"
            raise BenchError(f"{where} is {node.identity.name}, not a load machine")
        return NodeLoad(node, self.plan.envelope)

    def _find_load(self) -> Load:
        kind, settings = self.plan.settings.load, self.plan.settings
        if kind == "none" or (kind == "person" and self.plan.ask is None):
            return NoLoad()
        if kind == "node":
            return self.load_machine() or NoLoad()
        if kind == "person":
            return PersonLoad(self.ask)
        if target := load_target(settings):
            node = open_load_machine(target, self._stack)
            self.client.beside.append(node.client)
            node.client.beside.append(self.client)
            return NodeLoad(node, self.plan.envelope)
        directory = settings.path.parent if settings.path else Path()
        return self.plan.own_loads.get(kind, directory, self.plan.envelope)

    def record_to(
        self, recording: Recording, watching: Sequence[Sink], more: Sequence[Channel | Signal] = ()
    ) -> Outputs:
        """From now on what comes is recorded and shown, and handed to `watching` first.

        `more`: channels that the host adds to those that are streamed. Raises RecordingError or ViewerError.
        """
        plan, streamed = self.plan, () if self.samples is None else self.samples.channels
        channels = (*streamed, *more)
        outputs = self.outputs = Outputs(self._info(channels, **recording.about), recording, plan.virtual)
        self._stack.callback(outputs.close)
        self.drive.marked = lambda name, tick: outputs.mark(name, tick, tick, None)
        if outputs.file is not None and not plan.goes_on:
            self._stack.callback(outputs.file.close)
        if plan.goes_on:
            outputs.time_by(lambda tick: None if self.clock is None else self.clock.host_time(tick))
        following = Changes(self.drive.node.number, self.drive.follow)
        self.client.sinks = [*watching, following, *([] if plan.passive else [self.guard()]), *outputs.sinks]
        self.client.tell_misdated()
        return outputs

    def _info(self, channels: tuple[Channel | Signal, ...], **about: str) -> RunInfo:
        """What a run of these channels says of itself."""
        plan = self.plan
        return run_info(self.drive.node, plan.target, channels, self.drive.parameters, plan.settings, **about)

    def guard(self) -> RunawayGuard:
        """A sink by which `drive` sees that its motor runs away; the streams are configured, the parameters known."""
        assert self.samples is not None
        forced = lambda: getattr(self.load, "forced", None)  # noqa: E731
        self.drive.guard = RunawayGuard(self.samples, self._edges, self.drive.parameters, forced)
        return self.drive.guard

    # -- the end ------------------------------------------------------------------------------------------------

    @property
    def machines(self) -> list[Machine]:
        """What has a watchdog: the drive, and a load that is a node."""
        return [self.drive, *([self.load] if isinstance(self.load, NodeLoad) else [])]

    def let_go(self, why: str) -> None:
        """Of a run that goes on: outputs off, and seen to be off, of all that is on, and tell why.

        Nothing keeps a node from being told; what a sink raises meanwhile is raised when all have been.
        """
        self.tripped = why
        self.client.note(why, "ERROR")
        for machine in self.machines:
            machine.node.stopped_for = why
        self._tell(failures_of(machine.stop for machine in self.machines if machine.on))

    def rest(self) -> None:
        """Off at once what has a watchdog. What cannot be done is told by `finish`, which tries again."""
        with undisturbed():
            failures_of([self.drive.stop, *([self.load.off] if isinstance(self.load, NodeLoad) else [])])

    def finish(self) -> None:
        """The end, once: all off, and seen to be off, everything as it was, streams ended. No signal gets in between.

        All of it is tried, whatever of it cannot be done; `tripped`, `unsafe` and `not_restored` tell that. A drive
        whose outputs may still be on keeps its lowered limits. What a sink raises meanwhile is raised at the end.
        """
        if self._failures is None:
            self._failures = []
            self.signal.uninterrupted(self._finish)

    def _finish(self) -> None:
        drive, passive, tells = self.drive, self.plan.passive, self.plan.goes_on
        ours = self._prepared and not passive
        off = failures_of([drive.stop] if drive.on or ours else [])
        stopped = not off
        if stopped and self._taken and not passive and (late := drive.untold()):
            self.tripped = self.tripped or late
        off += failures_of([self.load.off])
        restored = failures_of([*self.at_end, partial(drive.restore, clear_faults=ours and stopped and not tells)])
        streams = failures_of([drive.node.stop_streams] if self._taken else [])
        if not (passive or tells):
            restored += streams
        self._failures = off + restored
        left = "".join(machine.not_put_back() for machine in self.machines)
        self.not_restored = "; ".join(filter(None, [*map(str, restored), left.removeprefix("; ")]))
        self.unsafe = ""  # but by its last STOP
        self._note(self.not_restored, "ERROR")
        self._tell(off)

    def _tell(self, failures: list[Exception]) -> None:
        """What could not be switched off as it should; of a run that goes on, raise what else happened, in a sink."""
        other: Exception | None = None
        for failure in failures:
            match failure:
                case OutputsMayBeOn():
                    self.unsafe = self.unsafe or str(failure)
                    self._note(str(failure), "CRITICAL")
                case DriveFailed() if self.plan.goes_on:
                    self.tripped = self.tripped or str(failure)
                    self._note(str(failure), "ERROR")
                case _ if self.plan.goes_on:
                    other, self.client.sinks = other or failure, self.client.sinks[:1]
        if other is not None:
            raise other

    def _note(self, text: str, level: str) -> None:
        """Tell it, in a run that goes on; who gets it raised knows it."""
        if text and self.plan.goes_on:
            self.note(text, level)

    def close(self) -> None:
        """The end, as `finish` makes it, of recording, link and lock too; what was told to nobody is raised after it.

        It is OutputsMayBeOn where something was not seen to be off, and DriveTripped, which tells both, where the drive
        had tripped and nothing had said so yet. A signal that came meanwhile takes effect afterwards, with it as cause.
        """
        failures: list[Exception] = []
        before = self.signal.interrupt
        self.signal.uninterrupted(lambda: failures.extend(failures_of([self.finish, self._stack.close])))
        failure = self._failure(failures)
        self._prepared, self._failures = False, []
        if before is None and self.signal.interrupt is not None:
            raise self.signal.interrupt from failure
        if failure is not None:
            raise failure

    def _failure(self, failures: list[Exception]) -> Exception | None:
        """What `close` raises, where these things happened in it."""
        if self.plan.goes_on:
            return failures[0] if failures else None
        failures = [*(self._failures or []), *failures]
        if not failures:
            return DriveTripped(self.tripped) if self.tripped else None
        left = "".join(machine.not_put_back() for machine in self.machines)
        if self.unsafe:
            return OutputsMayBeOn(f"{self.unsafe}{left}")
        words = f"the bench could not be restored: {failures[0]}{left}"
        failure = DriveTripped(f"{self.tripped}; then {words}") if self.tripped else BenchError(words)
        failure.__cause__ = failures[0]
        return failure

    # -- time ---------------------------------------------------------------------------------------------------

    def tick(self) -> int:
        """Device tick now."""
        return round(self.drive.node.clock_fit(1).tick)

    def wait(self, seconds: float) -> None:
        """Let the bench go on for `seconds` of its clock. Raises DriveTripped."""
        self.until(lambda: False, seconds)

    def until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Go on until `condition()` holds; False when it does not within `timeout` s. Raises DriveTripped."""
        return self.client.wait(condition, timeout, self.turn)

    def play(self, profile: Profile | Mapping[str, Any] | str | Path) -> Played:
        """Play a motion profile: the path of its TOML, what that says as a mapping, or as `read_profile` gives it.

        All of it is checked before anything turns; then the drive is started, if it is off. At the end parameters but
        the angle source are as they were, and the drive goes on with what the last step asked for. Raises BenchError
        for what the profile, the drive or what was announced do not allow, and DriveTripped.
        """
        asked = profile if isinstance(profile, Profile) else read_profile(profile)
        for words in check_profile(asked, self.drive, self.load):
            self.note(words, "WARN")
        changed = {name for act in asked.acts for name in act.sets}
        changed.discard(OBSERVER)  # a running motor keeps its angle source
        before = {name: self.drive.parameters[name] for name in sorted(changed)}
        start_for(asked, self.drive, self.load)
        spans: list[Span] = []

        def marked(span: Span) -> None:
            spans.append(span)
            self.mark_step(span)

        first, sets = self.tick(), self.recorder.sets
        Player(self, asked.max_speed, lambda act: self.note(act.title), marked).play(asked.acts)
        for name, value in before.items():
            self.drive.set(name, value)
        last = max(self.tick(), *(span.last for span in spans))
        self.until(lambda: self.recorder.newest >= last or self._silent(first), LATE)
        return Played(self.received(first, last, sets), tuple(spans))

    def record(self, seconds: float) -> Capture:
        """The next `seconds` of device time. Raises DriveTripped, and BenchError when no samples come.

        Where the link is too slow they come out of the drive's memory, at the PWM rate: that takes longer.
        """
        return self.streamed(seconds) if self.full_rate is None else self.full_rate.record(seconds)

    def streamed(self, seconds: float) -> Capture:
        """The same as the link carries it, whatever its rate: to see whether something has settled.

        At least some samples are waited for.
        """
        seconds = max(seconds, FEW / self.samples.rate if self.samples is not None else 0.0)
        first, sets = self.tick(), self.recorder.sets
        last = first + round(seconds * self.recorder.tick_hz)
        self.until(lambda: self.recorder.newest >= last or self._silent(first), seconds + LATE)
        return self.received(first, last, sets)

    @contextmanager
    def recording(self, seconds: float | None = None) -> Iterator[Stretch]:
        """What happens inside becomes `Stretch.capture`, also when it ends in an exception.

        `seconds`: how long it will last about, for a drive that has to hold it in its memory; None: 2.5 s at most.
        """
        held = None if self.full_rate is None else self.full_rate.begin(seconds)
        stretch = Stretch(self, self.tick(), self.recorder.sets, held=held)
        try:
            yield stretch
        finally:
            stretch.end()
        if self.recorder.newest < stretch.last:
            self.until(lambda: self.recorder.newest >= stretch.last, LATE)

    def keep(self, before: float, after: float, edges_per_s: float | None = None) -> Stretch:
        """Where the link is too slow, of a drive that runs: what comes until its `end`, after the outputs went off.

        See `FullRate.keep` for what the drive's memory keeps of it.
        """
        held = None if self.full_rate is None else self.full_rate.keep(before, after, edges_per_s)
        return Stretch(self, self.tick(), self.recorder.sets, held=held)

    def see_clock(self) -> None:
        """Look at the drive's clock, unless that was done in the last moment. Raises HbpError."""
        if self.clock is None or self.client.now() - self.clock.host > CLOCK_PERIOD:
            self.clock = self.drive.node.clock_fit(1)

    def device_tick(self, host: float) -> int | None:
        """The device's tick at `host` s of the link's clock, by the last look at its clock; None before the first."""
        return None if self.clock is None else self.clock.device_tick(host)

    def gave_up(self, error: BenchError | HbpError) -> None:
        """What is asked of the motor cannot be had: it is let go in a run that goes on, and `error` is raised else."""
        if not self.plan.goes_on:
            raise error
        self.let_go(str(error))

    def capture(
        self,
        trigger: str,
        seconds: float = 0.1,
        pre: float = 0.2,
        *,
        channels: Sequence[str] | None = None,
        decimation: int = 1,
        edges: int | None = None,
        timeout: float = 10.0,
    ) -> Shot:
        """A capture in the drive's own memory, at the PWM rate whatever the link carries.

        Use it as a context manager: it is armed when the block is entered, and read when it is left.

        Args:
            trigger: what freezes it: `i_q > 4`, `i_q rises 4`, `status changes`, `pulse < 5 us`, `fault`, `state`,
                `illegal` or `now`.
            seconds: its length, of which the share `pre` (0 to 1) lies before the trigger.
            channels: names, as for `bench.connect`; None: all but those on request.
            decimation: PWM periods from sample to sample.
            edges: Hall edges for which room is kept; None: as many as the highest speed makes.
            timeout: s that the trigger is waited for at the block's end.

        Returns:
            The shot: `.capture` after the block, `.t0` the device time of the trigger, `.save(path)` writes a run.

        Raises:
            BenchError: a drive that holds no captures, a trigger or a channel that there is not, more than fits; at the
                block's end no trigger in time.
        """
        wanted = Wanted(Trigger.parse(trigger), seconds, pre, channels, decimation, edges)
        return Shot(self.drive, self.until, wanted, timeout, self._info)

    def at_fault(self) -> Capture:
        """What the drive held at its last fault, without having been asked; it is given up then.

        Raises BenchError where it holds nothing.
        """
        memory = CaptureMemory(self.drive.node)
        captured = memory.read(memory.frozen())
        memory.give_up()
        return captured.capture(self.drive.parameters)

    def between(self, first: int, last: int) -> Capture:
        """What came by the link between two device ticks. BenchError if nothing did."""
        return self.received(first, last)

    def received(self, first: int, last: int, sets: int | None = None) -> Capture:
        """The same; `sets`: see `Recorder.capture`."""
        if self.recorder.newest < first:
            raise BenchError(f"no DATA for {SILENCE:g} s on {self.client.link.name}")
        return self.recorder.capture(first, last, sets)

    def latest(self, channel: str) -> float:
        """The newest value of a channel, in its unit. BenchError before the first sample, or without that channel."""
        return self.recorder.latest(channel)

    def ask(self, words: str) -> None:
        """Ask a person to do something, and go on until it is done; virtual time stands still meanwhile.

        Raises DriveTripped; BenchError where nobody can be asked, or when a signal comes while the rig is closed.
        """
        if self.plan.ask is None:
            raise BenchError(f"no terminal to ask: {words}")
        with self.plan.ask(words) as answered:
            while not answered(POLL if self.plan.virtual else 0.0):
                if self.signal.came:
                    raise BenchError(f"not waited for: {words}")
                if self.plan.virtual:
                    continue
                if self._failures is None:
                    self.turn(POLL)
                else:
                    self._turn(POLL)  # whatever the drive has, it is off

    def _silent(self, first: int) -> bool:
        newest = max(self.recorder.newest, first)
        fit = self.client.heartbeats.get(self.drive.node.number)
        return fit is not None and (fit.tick - newest) / self.recorder.tick_hz > SILENCE

    def _turn(self, timeout: float, collect: bool = True) -> None:
        self.client.poll(timeout, collect)
        for other in self.client.beside:
            other.poll(0.0)

    def turn(self, timeout: float, collect: bool = True) -> None:
        """One turn of the link, see `Client.poll`. Raises DriveTripped."""
        self._turn(timeout, collect)
        if self.outputs is not None:
            for text, level in self.outputs.news():
                self.client.note(text, level)
            self.outputs.check()
        if self.plan.goes_on and self.client.health.down_since is None:
            self._look()
        elif not self.plan.goes_on:
            self._require_alone()
            rebooted = self._boots()
            if not self.plan.passive:
                if rebooted:
                    raise DriveTripped(f"{self._title(rebooted[0])} has rebooted")
                for machine in self.machines:
                    machine.look()

    def _title(self, node: int) -> str:
        ours = (machine.title for machine in self.machines if machine.node.number == node)
        return next(ours, f"node {node}")

    def _require_alone(self) -> None:
        """Raise SeveralDevices, with all off, where more than one device answers as a machine of this rig.

        It is DriveFailed in a run that goes on.
        """
        for node in (machine.node for machine in self.machines if machine.node.number in machine.node.client.several):
            self._tell(failures_of(machine.stop for machine in self.machines if machine.on))
            try:
                node.client.require_alone(node.number)
            except SeveralDevices as error:
                raise (DriveFailed(str(error)) if self.plan.goes_on else error) from None

    def _boots(self) -> list[int]:
        """Nodes that have rebooted, with all off; raises as `_require_alone`, whose reason begins in the same way."""
        if not self._rebooted:
            return []
        self._tell(failures_of(machine.stop for machine in self.machines if machine.on))
        self.client.wait(lambda: bool(self.client.several), LISTEN)
        self._require_alone()
        nodes = sorted(self._rebooted)
        self._rebooted.clear()
        for node in nodes:
            self.client.note(f"node {node} has rebooted", "WARN")
        return nodes

    def _look(self) -> None:
        """Of a run that goes on: let go what does not run as it should, and keep the clock fresh."""
        self._require_alone()
        for node in self._boots():
            if any(machine.node.number == node for machine in self.machines):
                self.let_go(f"{self._title(node)} has rebooted")
            if node == self.drive.node.number:
                self.clock, self._next_clock = None, self.client.now()
                self.drive.node.resume_streams()
        now = self.client.now()
        for machine in () if self.unsafe else reversed(self.machines):
            if machine.on and (why := machine.trouble()):
                self.let_go(why)
        if now >= self._next_clock and not self.client.session.busy:
            self._next_clock = now + CLOCK_PERIOD
            try:
                self.clock = self.drive.node.clock_fit(tries=1)
            except HbpError as error:
                self.client.note(f"no clock: {error}", "WARN")

    # -- what it has --------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        machines = ", ".join(map(repr, self.machines))
        streamed = f"{len(self.channels)} channels at {self.rate:g} Hz" if self._prepared else "streams nothing"
        return f"Rig on {self.plan.target}: {machines}, {streamed}"

    @property
    def _measured(self) -> StreamConfig | None:
        """How samples come that `record` gives."""
        return self.samples if self.full_rate is None else self.full_rate.stream

    @property
    def channels(self) -> tuple[Channel | Signal, ...]:
        """Those that are streamed, or held in the drive's memory."""
        return () if self._measured is None else self._measured.channels

    @property
    def rate(self) -> float:
        """Samples a second that `record` gives."""
        return 0.0 if self._measured is None else self._measured.rate

    @property
    def has_encoder(self) -> bool:
        """Whether the drive streams a reference position."""
        return bool(reference_angle(self.channels))

    @property
    def speed_channel(self) -> str:
        """See `bench.signal.channels.speed_channel`."""
        return speed_channel(self.channels, self.drive.parameters)

    def describe(self) -> dict[str, str]:
        """The rig for the report, in words."""
        load = self.load
        return {
            "link": self.client.link.name,
            "time": "virtual" if self.plan.virtual else "real",
            "load": f"{self.plan.settings.load}: {', '.join(sorted(load.abilities))}" if load.abilities else "none",
            "encoder": "yes" if self.has_encoder else "no",
            "streamed": self._streamed(),
            "bench.toml": str(self.plan.settings.path or "none"),
            "configuration": self._configuration() if self.plan.virtual else "of the drive",
        }

    def _streamed(self) -> str:
        words = f"{len(self.channels)} channels at {self.rate:g} Hz"
        if self.full_rate is None or self.samples is None:
            return words
        return f"{words} out of the drive's memory; the link carries {self.samples.rate:g} Hz"

    def _configuration(self) -> str:
        config = self.plan.settings.config
        changed = "" if config is None else ", ".join(f"{key} = {value}" for key, value in changed_keys(config).items())
        return "default" if config is None else f"{config}: {changed or 'nothing changed'}"

    def quality(self) -> Quality:
        """What the data of the whole run are worth."""
        samples, edges = self.recorder.count()
        losses = self.client.losses(self.drive.node.number)
        return Quality(
            samples=samples,
            edges=edges,
            lost_samples=losses.samples.lost_by_index,
            lost_edges=losses.edges.lost_by_index,
            dropped_by_device=self.recorder.device.risen["tx_dropped"],
            damaged_frames=self.client.session.counters.framing.bad,
            outages=self.client.health.outages,
            rate=0.0 if self.samples is None else self.samples.rate,
            seconds=self.recorder.seconds,
            remarks=tuple(words for _, _, words in self.recorder.dropped),
        )

    # -- the recording ------------------------------------------------------------------------------------------

    def mark(self, name: str, span: tuple[float, float], verdict: Verdict) -> None:
        """Show in the recording that `name` was measured in `span`, device time in s, and how that ended."""
        if self.outputs is not None:
            first, last = (round(t * self.recorder.tick_hz) for t in span)
            self.outputs.mark(name, first, last, verdict)

    def mark_step(self, span: Span) -> None:
        """Show in the recording when a step of a profile was."""
        if self.outputs is not None:
            self.outputs.mark(*span, routine=True)

    def note(self, text: str, level: str = "INFO") -> None:
        """A line in the log of recording and dashboard."""
        self.client.note(text, level)

    def summary(self, markdown: str) -> None:
        """The text that a viewer of the recording reads first."""
        if self.outputs is not None:
            self.outputs.summary(markdown)


@dataclass
class Stretch:
    """From a tick on, until the rig says to which."""

    rig: Rig
    first: int
    sets: int
    """How many parameters had been set when it began."""
    last: int = -1
    held: Held | None = None
    """What the drive's memory holds of it, where the link is too slow."""

    def end(self) -> None:
        """It lasted up to now."""
        rig = self.rig
        self.last = rig.tick() if rig.client.health.down_since is None else rig.recorder.newest
        if self.held is not None:
            self.held.end(self.first, self.last, rig.recorder.course(self.sets))

    @property
    def capture(self) -> Capture:
        """What came in it; read at the first call, where the drive holds it. BenchError if nothing did."""
        return self.rig.received(self.first, self.last, self.sets) if self.held is None else self.held.read()

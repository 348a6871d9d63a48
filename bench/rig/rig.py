"""One test's connection to the bench: drive, load, streams, recording; and the end of it, with everything off.

A `Rig` is opened for a test and closed after it, on a simulated drive in virtual time as on hardware. `close` stops
what may turn, puts parameters back and finishes the recording, whatever happened before; it raises what went wrong
only when all of that has been tried. It never waits without polling: what turns is watched, and its watchdog fed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bench import __version__
from bench.analysis.capture import Capture, no_edge_stream
from bench.analysis.channels import flagged, speed_channel
from bench.analysis.verdict import Verdict
from bench.device.client import POLL, Client, Sink
from bench.device.description import describe
from bench.device.node import LOAD, Node
from bench.device.safety import is_off, says
from bench.errors import BenchError, DoesNotFit, Interrupted, OutputsMayBeOn
from bench.rerunio.schema import RunInfo
from bench.rig.drive import Drive, DriveTripped
from bench.rig.envelope import Envelope
from bench.rig.interrupts import undisturbed
from bench.rig.loads import Load, NodeLoad, OwnLoads, PersonLoad, open_load_machine
from bench.rig.needs import NEEDS, require
from bench.rig.person import Ask
from bench.rig.quality import ParameterValue, Quality
from bench.rig.recorder import Recorder
from bench.rig.settings import Settings
from protocol.canmap.host import CanWire
from protocol.descriptor import Channel
from protocol.errors import NoReply
from protocol.links import Link
from protocol.messages import DriveState, Role
from protocol.signals import Flag, Unit

if TYPE_CHECKING:
    from bench.rerunio.sinks import FileSink

SILENCE = 2.0  # s without samples after which waiting for more is given up
LATE = 1.0  # s that samples of a stretch may come after its end
CORE = ("hall", "status", "i_a", "i_d", "i_q")
"""What is streamed, beside reference and estimates, where a link cannot carry everything."""


@dataclass(frozen=True)
class Plan:
    """How a rig is to be made."""

    link: Callable[[], Link]
    target: str
    settings: Settings = field(default_factory=Settings)
    envelope: Envelope = field(default_factory=Envelope)
    ask: Ask | None = None
    """None where nobody can be asked."""
    recording: Path | None = None
    virtual: bool = False
    """Time passes as fast as it can be computed."""
    title: str = ""
    channels: frozenset[str] = frozenset()
    """Channels that the test needs, also such as a drive streams on request only."""
    needs: tuple[str, ...] = ()
    """Applications of `bench.rig.needs`, without whose needs the rig is not made."""
    own_loads: OwnLoads = field(default_factory=OwnLoads)
    """What outlives the rig: objects of the user's load classes."""


class Rig:
    """See the module. Raises BenchError and HbpError; use it as a context manager."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.at_end: list[Callable[[], None]] = []
        """What is done when the drive has been stopped."""
        self._file: FileSink | None = None
        self._signals: list[int] | None = None  # that came while it is closed; None before that
        with ExitStack() as stack:
            link = plan.link()
            stack.callback(link.close)
            self.client = Client(link)
            hello = self.client.connect()
            if hello.role != Role.DRIVE:
                raise BenchError(f"{plan.target} answers as {hello.role.name}, not as a drive")
            node = Node(self.client, hello.node)
            for what in plan.needs:
                require(node, what, NEEDS[what])
            self._require_rest(node)
            self.before = tuple(_parameters(node))
            """The drive's parameters before the test."""
            parameters = {p.name: p.value for p in self.before}
            self.recorder = Recorder(hello.node, hello.tick_hz)
            self.drive = Drive(node, self.recorder, plan.envelope, parameters)
            self.load = self._find_load(stack)
            if self.load is not None:
                self.at_end.append(self.load.off)
            self.channels, self.rate = self._stream(node)
            self.client.sinks = [self.recorder, *self._open_recording(parameters)]
            stack.callback(self._close_recording)
            node.start_streams()
            self.wait(2 * POLL)
            self._stack = stack.pop_all()
        try:
            self.drive.limit_current()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def rest(self) -> None:
        """Off at once what has a watchdog. What cannot be done is told by `close`, which tries again."""
        with undisturbed():
            for off in (self.drive.stop, *([self.load.off] if isinstance(self.load, NodeLoad) else [])):
                with suppress(Exception):
                    off()

    def close(self) -> None:
        """Everything off and put back. Raises the first thing that could not be done, when all was tried.

        It is OutputsMayBeOn where something was not seen to be off, and DriveTripped, which tells both, where the drive
        had tripped and nothing had said so yet. A signal that
        came meanwhile takes effect afterwards; that first thing is then its cause.
        """
        failure: BenchError | None = None
        try:
            with undisturbed() as self._signals:
                failure = self._put_back()
        except (KeyboardInterrupt, Interrupted) as interrupt:
            raise interrupt from failure
        if failure is not None:
            raise failure

    def _put_back(self) -> BenchError | None:
        """Try all of it; returns the first thing that could not be done."""
        failures: list[Exception] = []

        def attempt(step: Callable[[], object]) -> bool:
            try:
                step()
            except Exception as error:
                failures.append(error)
                return False
            return True

        stopped = attempt(self.drive.stop)
        trip = self._late_trip() if stopped else None
        for step in self.at_end:
            attempt(step)
        attempt(lambda: self.drive.restore(clear_faults=stopped))
        attempt(self.drive.node.stop_streams)
        attempt(self._stack.close)
        if not failures:
            return trip
        left = self.drive.not_put_back() + (self.load.not_put_back() if isinstance(self.load, NodeLoad) else "")
        if unsafe := [str(failure) for failure in failures if isinstance(failure, OutputsMayBeOn)]:
            return OutputsMayBeOn(f"{unsafe[0]}{left}")
        words = f"the bench could not be left as it was: {failures[0]}{left}"
        failure = BenchError(words) if trip is None else DriveTripped(f"{trip}; then {words}")
        failure.__cause__ = failures[0]
        return failure

    def _late_trip(self) -> DriveTripped | None:
        """A trip that was seen only when STOP was answered."""
        try:
            self.drive.look_at_the_end()
        except DriveTripped as trip:
            return trip
        return None

    # -- time ---------------------------------------------------------------------------------------------------

    def tick(self) -> int:
        """Device tick now."""
        return round(self.drive.node.clock_fit(1).tick)

    def wait(self, seconds: float) -> None:
        """Let the bench go on for `seconds` of its clock. Raises DriveTripped."""
        self.until(lambda: False, seconds)

    def until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Go on until `condition()` holds; False when it does not within `timeout` s. Raises DriveTripped."""
        end = self.client.now() + timeout
        while not condition():
            left = end - self.client.now()
            if left <= 0:
                return False
            self._poll(min(POLL, left))
        return True

    def record(self, seconds: float) -> Capture:
        """The next `seconds` of device time. Raises DriveTripped, and BenchError when no samples come."""
        first = self.tick()
        last = first + round(seconds * self.recorder.tick_hz)
        self.until(lambda: self.recorder.newest >= last or self._silent(first), seconds + LATE)
        return self.capture(first, last)

    @contextmanager
    def recording(self) -> Iterator[Stretch]:
        """What happens inside becomes `Stretch.capture`, also when it ends in an exception."""
        stretch = Stretch(self, self.tick())
        try:
            yield stretch
        finally:
            stretch.last = self.tick() if self.client.health.down_since is None else self.recorder.newest
        if self.recorder.newest < stretch.last:
            self.until(lambda: self.recorder.newest >= stretch.last, LATE)

    def capture(self, first: int, last: int) -> Capture:
        """What came between two device ticks. BenchError if nothing did."""
        if self.recorder.newest < first:
            raise BenchError(f"no DATA for {SILENCE:g} s on {self.client.link.name}")
        return self.recorder.capture(first, last, self.drive.parameters)

    def ask(self, words: str) -> None:
        """Ask a person to do something, and go on until it is done; virtual time stands still meanwhile.

        Raises DriveTripped; BenchError where nobody can be asked, or when a signal comes while the rig is closed.
        """
        if self.plan.ask is None:
            raise BenchError(f"nobody can be asked: {words}")
        with self.plan.ask(words) as answered:
            while not answered(POLL if self.plan.virtual else 0.0):
                if self._signals:
                    raise BenchError(f"not waited for: {words}")
                if self.plan.virtual:
                    continue
                if self._signals is None:
                    self._poll(POLL)
                else:
                    self._turn(POLL)  # whatever the drive has, it is off

    def _silent(self, first: int) -> bool:
        newest = max(self.recorder.newest, first)
        fit = self.client.heartbeats.get(self.drive.node.number)
        return fit is not None and (fit.tick - newest) / self.recorder.tick_hz > SILENCE

    def _turn(self, timeout: float) -> None:
        self.client.poll(timeout)
        for other in self.client.beside:
            other.poll(0.0)

    def _poll(self, timeout: float) -> None:
        self._turn(timeout)
        if self.client.health.reboots:
            raise DriveTripped("the drive has rebooted")
        self.drive.look()
        if isinstance(self.load, NodeLoad):
            self.load.look()

    # -- what it has --------------------------------------------------------------------------------------------

    @property
    def has_encoder(self) -> bool:
        """Whether the drive streams a reference position."""
        return bool(flagged(self.channels, Unit.RAD, Flag.REFERENCE))

    @property
    def speed_channel(self) -> str:
        """See `bench.analysis.channels.speed_channel`."""
        return speed_channel(self.channels, self.drive.parameters)

    def describe(self) -> dict[str, str]:
        """The rig for the report, in words."""
        load = self.load
        return {
            "link": self.client.link.name,
            "time": "virtual" if self.plan.virtual else "real",
            "load": "none" if load is None else f"{type(load).__name__}: {', '.join(sorted(load.abilities))}",
            "encoder": "yes" if self.has_encoder else "no",
            "streamed": f"{len(self.channels)} channels at {self.rate:g} Hz",
            "bench.toml": str(self.plan.settings.path or "none"),
            "configuration": str(self.plan.settings.config or "default") if self.plan.virtual else "of the drive",
        }

    def quality(self) -> Quality:
        """What the data of the whole test are worth."""
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
            rate=self.rate,
            seconds=samples / self.rate if self.rate else 0.0,
            remarks=tuple(words for _, _, words in self.recorder.dropped),
        )

    # -- the recording ------------------------------------------------------------------------------------------

    def mark(self, name: str, span: tuple[float, float], verdict: Verdict) -> None:
        """Show in the recording that `name` was measured in `span`, device time in s, and how that ended."""
        if self._file is not None:
            first, last = (round(t * self.recorder.tick_hz) for t in span)
            self._file.mark(name, first, last, verdict)

    def note(self, text: str, level: str = "INFO") -> None:
        """A line in the recording's log."""
        for sink in self.client.sinks:
            sink.note(text, level)

    def summary(self, markdown: str) -> None:
        """The text that a viewer of the recording reads first."""
        if self._file is not None:
            self._file.summary(markdown)

    def _open_recording(self, parameters: dict[str, float]) -> list[Sink]:
        if self.plan.recording is None:
            return []
        from bench.rerunio.sinks import FileSink

        identity = self.drive.node.identity
        about = describe(identity) | {"target": self.plan.target, "hallbench": __version__, "test": self.plan.title}
        info = RunInfo(
            tick_hz=identity.tick_hz,
            pwm_hz=identity.pwm_hz,
            channels=self.channels,
            parameters=parameters,
            identity=about,
            node=identity.node,
        )
        self._file = FileSink(self.plan.recording, info, overwrite=True, wait=self.plan.virtual)
        return [self._file]

    def _close_recording(self) -> None:
        if self._file is not None:
            self._file.close()

    # -- before anything moves ----------------------------------------------------------------------------------

    def _require_rest(self, node: Node) -> None:
        heartbeat = node.next_heartbeat()
        if heartbeat is not None and heartbeat.state == DriveState.FAULT:
            raise BenchError(
                f"{self.plan.target} has a latched fault ({node.fault_text()}): look into its cause, then clear it "
                "(bench live --clear-faults)"
            )
        if heartbeat is None:
            raise BenchError(f"{self.plan.target} sends no heartbeat: whether its outputs are off is not known")
        if not is_off(heartbeat):
            raise BenchError(f"{self.plan.target} is not at rest ({says(heartbeat)}): another host is using it")
        node.stop_streams()

    def _find_load(self, stack: ExitStack) -> Load | None:
        kind, settings = self.plan.settings.load, self.plan.settings
        if kind == "none":
            return None
        if kind == "node":
            node = Node(self.client, LOAD)
            return NodeLoad(node, self.plan.envelope) if self._answers(node) else None
        if kind == "person":
            return PersonLoad(self.ask) if self.plan.ask is not None else None
        if ".py:" in kind:
            directory = settings.path.parent if settings.path else Path()
            return self.plan.own_loads.get(kind, directory, self.plan.envelope)
        node = open_load_machine(kind, stack)
        self.client.beside.append(node.client)
        node.client.beside.append(self.client)
        return NodeLoad(node, self.plan.envelope)

    def _answers(self, node: Node) -> bool:
        hello = self.client.hello
        on_can = isinstance(self.client.session.wire, CanWire)
        if hello is not None and hello.nodes < LOAD and not on_can:
            return False
        try:
            return node.identity.role == Role.LOAD
        except NoReply:
            return False

    def _stream(self, node: Node) -> tuple[tuple[Channel, ...], float]:
        """Configure edges and the most channels that fit; returns them and their rate in Hz."""
        self.recorder.expect(node.set_edges() if node.offers_edges else no_edge_stream(node.number))
        needed = self.plan.channels
        unasked = Flag.TRUTH | Flag.ON_REQUEST
        channels = tuple(c for c in node.descriptor.channels if c.name in needed or not c.flags & unasked)
        wanted = needed.union(CORE)
        core = tuple(c for c in channels if c.name in wanted or c.flags & (Flag.REFERENCE | Flag.ESTIMATE))
        decimation = 1
        try:
            node.set_samples(channels, 1)
        except DoesNotFit:
            channels = core
            try:
                node.set_samples(channels, 1)
            except DoesNotFit as error:
                if not error.decimation:
                    raise
                decimation = error.decimation
                node.set_samples(channels, decimation)
        return channels, node.identity.pwm_hz / decimation


@dataclass
class Stretch:
    """From a tick on, until the rig says to which."""

    rig: Rig
    first: int
    last: int = -1

    @property
    def capture(self) -> Capture:
        """What came in it. BenchError if nothing did."""
        return self.rig.capture(self.first, self.last)


def _parameters(node: Node) -> Iterator[ParameterValue]:
    for record in node.descriptor.parameters:
        now = node.parameter(record.name)
        yield ParameterValue(record.name, now.value, now.default, record.unit.symbol)

"""A link and a session joined: the one loop that reads, answers, watches and keeps the watchdog fed.

Everything happens inside `poll`, on the caller's thread: requests wait by polling, so data keeps flowing to the sinks
while they wait. The client never sleeps and reads no clock but the link's, so a simulated drive in virtual time and a
physical drive are the same to it.

ALIVE is sent from here and only while telemetry of the node is fresh: a host that no longer sees the drive lets the
drive's watchdog switch the outputs off.
"""

from __future__ import annotations

import gc
import math
import secrets
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import astuple, dataclass, field
from typing import TypeVar

from bench.device.heard import Chunk, ClockRestarted, Heard, Misdated, Missing, Note, ParameterSet, Sink
from bench.device.losses import Continuity
from bench.errors import SeveralDevices
from protocol.errors import HbpError, LinkClosed, LinkError, NoReply, Refused
from protocol.host import (
    Connected,
    DeviceEventReceived,
    HeartbeatReceived,
    HostSession,
    LogReceived,
    Rebooted,
    ReplyReceived,
    ReplyUnusable,
    RequestRefused,
    RequestTimedOut,
)
from protocol.host import SeveralDevices as SeveralAnswer
from protocol.links.base import Link
from protocol.messages import (
    Alive,
    Command,
    DeviceEvent,
    ErrorCode,
    EventCode,
    Fault,
    Heartbeat,
    Hello,
    HelloReply,
    MessageType,
    Payload,
    Request,
    StateCommand,
    StreamEvent,
)
from protocol.streams import Beat, LossCounters, StreamConfig, WrongTime
from protocol.text import counted
from protocol.wire import Decoder, StreamFrames

R = TypeVar("R", bound=Payload)

ALIVE_PERIOD = 0.04  # s, and up to a turn more
FRESH = 0.3  # s without a frame from a node after which its ALIVE is withheld: three heartbeats
WATCHDOG = 0.2  # s: what a drive waits for ALIVE if it has no parameter that says otherwise
POLL = 0.02  # s: how long one turn waits for bytes
SETTLE = 0.02  # s: how long a turn goes on collecting once bytes come
LATE = 0.01  # s: how much longer that may take on a link of hardware
REOPEN_PERIOD = 0.1  # s between attempts to open a link that went away
QUIET = 1.0  # s without a stream frame after which none is under way; a CAN device gives them up after 0.5 s
PAUSE = 0.1  # s without a turn from which on this program was paused
AFTER_PAUSE = 2.0  # s in which what has waited in the link meanwhile may still be under way
GRACE = 0.5  # s for which a wait goes on after a pause of this program: what came meanwhile is looked at first
LISTEN = 0.4  # s that it takes to see by heartbeats that two devices are one node: A, B, A, B, A
ANSWER = 2.0  # s that a device which is heard is given to answer, however late it was
TRIES = 3  # HELLOs to devices of one number, whose answers may have met on the way
SECOND = 0.03  # s, and two round trips, that a second device may answer HELLO later than the first
FEW = 5  # times that something of one kind is told each time
HEARD = "it is heard, and did not hear this"
FLUSH = 10.0  # s that a device is given to send what waited at STREAM_STOP: 64 KiB at 115200 baud, and some


@dataclass(slots=True)
class LinkHealth:
    """What the link did to us."""

    outages: int = 0
    down_since: float | None = None
    downtime: float = 0.0  # s, of the outages that are over
    reboots: int = 0


@dataclass(slots=True)
class _Watch:
    """What the client knows of one node's freshness, and of its watchdog."""

    last_seen: float = -1e9
    last_alive: float = -1e9
    counter: int = 0
    feed: bool = False
    on: bool = False  # from when feeding began until it was seen to be off after that
    fed: float = 0.0  # when it was last fed, or feeding began
    longest: float = 0.0  # s between two ALIVEs since feeding began
    pause: float = 0.0  # s: the longest time in which `poll` did not get to feed it, since feeding began
    silent: float = 0.0  # s: the longest time in which nothing came of it
    down: float = 0.0  # s: the longest time in which its link was gone


@dataclass(slots=True)
class _Streams:
    """The streams of one node: their decoders, and what says when they were at work."""

    decoders: dict[int, Decoder] = field(default_factory=dict)
    beats: int | None = None  # heartbeats since STREAM_START, None before it
    first: Beat | None = None  # a heartbeat that was made after STREAM_START
    newest: float = 0.0  # when the last frame came, s

    def heard(self, heartbeat: Heartbeat) -> None:
        """Note a heartbeat. The one that follows STREAM_START's reply may have waited since before it."""
        if self.beats is not None and self.first is None:
            self.beats += 1
            if self.beats == 2:
                self.first = _beat(heartbeat)

    def missing(self, last: Beat) -> list[tuple[Decoder, int]]:
        """Return how many records of each stream have not come up to the heartbeat `last`."""
        return [(decoder, decoder.missing(self.first, last)) for decoder in self.decoders.values()]


@dataclass(slots=True)
class _Pending:
    tid: int
    reply: Payload | None = None
    error: Exception | None = None


@dataclass(frozen=True)
class Losses:
    """Account of a node's streams, past and present: samples and edges apart."""

    samples: LossCounters
    edges: LossCounters


class Client:
    """Talks to every node on one link.

    `reconnect` says how long a lost link is waited for, in s; with 0, `poll` raises LinkClosed at once. `private`: no
    other device can be on this link, so that none is waited for at HELLO.
    """

    def __init__(self, link: Link, reconnect: float = 0.0, private: bool = False) -> None:
        self.link = link
        self.reconnect, self.private = reconnect, private
        self.session = HostSession(link.wire())
        self.sinks: list[Sink] = []
        self.change: Callable[[Chunk], Chunk] = lambda chunk: chunk
        """What is done to each chunk before the sinks get it."""
        self.health = LinkHealth()
        self.hello: HelloReply | None = None
        self.heartbeats: dict[int, Heartbeat] = {}
        self.boots: dict[int, dict[int, tuple[float, Heartbeat]]] = {}
        """By node and boot_id, the newest heartbeat, and when it came."""
        self.several: dict[int, frozenset[int]] = {}
        """Nodes as which several devices answer, with the boot_ids of these."""
        self.rejections: dict[int, DeviceEvent] = {}
        """By node, the last event that told why a setpoint was rejected."""
        self.parameters: dict[int, dict[int, str]] = {}
        """By node, the names of its parameters by id, as far as its descriptor was read."""
        self.changed: dict[tuple[int, str], ParameterSet] = {}
        """By node and name, the last change of a parameter, as the node has told it, or as it was set from here."""
        self.faults: dict[int, Fault] = {}
        """By node, all that its heartbeats and events have reported; an event may have been lost with the link."""
        self.bytes_in = 0
        self.unasked = 0
        """Stream frames of streams that were not configured from here, or no longer are."""
        self.longest_pause = 0.0
        """The longest time in s in which this program did not poll, since somebody set this to 0."""
        self.pauses = 0
        """How often it did not for longer than a moment."""
        self._last_pause = (-math.inf, 0.0)  # when it ended, and how long it was, s
        self.misdated: dict[str, int] = {}
        """How often something was dated as it cannot be, by what it was."""
        self._untold: list[Heard] = []  # of that
        self.beside: list[Client] = []
        """Of other links of the same bench."""
        self.on_reboot: Callable[[int], None] | None = None  # argument: the node that has rebooted
        self._clocks: dict[int, dict[int | None, int]] = {}  # the newest tick by node and stream; None: heartbeats
        self._continuity = Continuity()
        self._streams: dict[int, _Streams] = {}
        self._closed: dict[int, Losses] = {}  # of streams that have ended
        self._watches: dict[int, _Watch] = {}
        self._pending: _Pending | None = None
        self._must_open = False  # the link must be opened again
        self._next_reopen = 0.0
        self._polled = self.now()  # when the last turn had read
        self._listened = self.now()  # since when a node may have turned out to be two

    # -- time ---------------------------------------------------------------------------------------------------

    def now(self) -> float:
        """The link's clock in s: monotonic, virtual for a simulated drive in virtual time."""
        return self.link.clock()

    @property
    def behind(self) -> bool:
        """Whether this program has not polled for a moment: it does not know yet what has come."""
        return self.now() - self._polled > PAUSE

    def run_for(self, seconds: float) -> None:
        """Poll for `seconds` of the link's clock."""
        self.wait(lambda: False, seconds)

    def wait(self, condition: Callable[[], bool], timeout: float, poll: Callable[[float], None] | None = None) -> bool:
        """Poll, by `poll` if there is one, until `condition()` holds; False when it does not within `timeout` s.

        After a pause of this program it goes on for a while: what is waited for may have come meanwhile.
        """
        end, pauses = self.now() + timeout, self.pauses
        while not condition():
            left = end - self.now()
            if left <= 0.0 and not self.behind:
                return False
            (poll or self.poll)(min(POLL, max(left, 0.0)))
            if pauses != self.pauses:
                pauses, end = self.pauses, max(end, self.now() + min(timeout, GRACE))
        return True

    # -- connection ---------------------------------------------------------------------------------------------

    @staticmethod
    def nonce() -> int:
        """A number for a HELLO that no earlier traffic can have guessed."""
        return secrets.randbits(32)

    def connect(self, timeout: float | None = None) -> HelloReply:
        """Find the device at the other end. Raises NoReply when nothing that speaks HBP answers within `timeout` s.

        By default that is how long what the link leads to may take to boot. DeviceDefect, VersionError and Refused are
        those of an answer that a host cannot work with; SeveralDevices: more than one device answered.
        """
        wire, before = self.session.wire, self.hello
        patience = wire.patience if timeout is None else timeout
        began = self._listened = self.now() + wire.delay
        pending = self._pending = _Pending(self.session.connect(self.nonce(), self.now(), delay=wire.delay))

        def several() -> list[int]:
            """Of the nodes as which several devices answer, the one that is asked; at a byte link it may be any."""
            return [node for node in self.several if node == getattr(wire, "node", node)]

        def answered() -> bool:
            return self.hello is not before or pending.error is not None or bool(several())

        self.wait(lambda: answered() or bool(self.session.heard), began + patience - self.now())
        late = self.now() + ANSWER if self.session.heard else 0.0
        found = self.wait(answered, max(began + patience, late) - self.now())
        self._pending = None
        if self.hello is not before:
            self._await_second()
        for node in several():
            self.require_alone(node)
        if pending.error is not None:
            raise pending.error
        if not found:
            self.session.cancel()
            raise NoReply(self._nobody(patience))
        assert self.hello is not None
        return self.hello

    def _await_second(self) -> None:
        """Let a second device answer HELLO, too; on a link that takes no time, in virtual time, it has."""
        if self.session.round_trip > 0.0 and not self.private:
            self.run_for(SECOND + 2 * self.session.round_trip)

    def _nobody(self, seconds: float) -> str:
        """That nobody answered HELLO, what was heard instead, and what to look at."""
        framing, advice = self.session.counters.framing, unanswered(self.link, self.session, self.bytes_in)
        return (
            f"no HBP device answered on {self.link.name} within {seconds:g} s ({self.bytes_in} bytes heard, "
            f"{framing.frames} good frames, {framing.bad} damaged): {advice}"
        )

    def listen(self, node: int) -> None:
        """Wait until heartbeats have told whether `node` is one device, as far as they can. Raises SeveralDevices."""
        if self.session.round_trip > 0.0 or len(self.boots.get(node, ())) > 1:  # else both have answered at once
            self.wait(lambda: node in self.several, self._listened + LISTEN - self.now())
        self.require_alone(node)

    def require_alone(self, node: int) -> None:
        """Raise SeveralDevices, which names them, if more than one device has been heard as `node`."""
        if node not in self.several:
            return
        for _ in range(TRIES):
            if self.several[node] <= {reply.boot_id for reply in self._answered(node)}:
                break
            with suppress(HbpError):  # who they are
                self.request(Hello(self.nonce()), node, HelloReply)
                self._await_second()
        raise SeveralDevices(several_devices(node, self.link.name, self._answered(node), self.several[node]))

    def _answered(self, node: int) -> list[HelloReply]:
        """What the devices have said of themselves that answer as `node`."""
        return [reply for reply in self.session.devices.get(node, ()) if reply.boot_id in self.several[node]]

    def _lost(self, error: LinkError) -> None:
        now = self.now()
        if self.reconnect <= 0:
            raise error
        self._must_open = True
        if self.health.down_since is None:
            self.health.down_since = now
            self.health.outages += 1
            self._next_reopen = now
            self.note(f"{error}; waiting up to {self.reconnect:g} s for it to return", "ERROR")
            if self._pending:
                self._pending.error = error

    def _reopen(self, timeout: float) -> None:
        """One turn while the link is down: try to open it again, at most ten times a second."""
        now = self.now()
        if now < self._next_reopen:
            time.sleep(max(0.0, min(timeout, self._next_reopen - now)))  # there is no link to wait on
            return
        self._next_reopen = now + REOPEN_PERIOD
        try:
            self.link.reopen()
        except LinkError as error:
            self._lost(error)
            return
        self._must_open = False
        self.session.connect(self.nonce(), now, delay=self.session.wire.delay)  # until it answers the outage lasts

    @property
    def downtime(self) -> float:
        """For how many seconds the link was down, an outage that goes on included."""
        since = self.health.down_since
        return self.health.downtime + (0.0 if since is None else self.now() - since)

    # -- the loop -----------------------------------------------------------------------------------------------

    def poll(self, timeout: float = POLL, collect: bool = True) -> None:
        """One turn: read for at most `timeout` s, handle what came, retry, feed the watchdog, send.

        Once bytes come it goes on collecting for as long again, and `LATE` more, unless it is not to `collect`.
        The clients beside this one get theirs too, so that no watchdog of theirs runs out while this one waits; what is
        wrong with their links is told when they are polled themselves.
        """
        self._turn(timeout, collect)
        for other in self.beside:
            with suppress(LinkError):
                other._turn(0.0)

    def _turn(self, timeout: float, collect: bool = True) -> None:
        if self.health.down_since is not None and self.now() - self.health.down_since > self.reconnect:
            raise LinkClosed(f"{self.link.name} did not return within {self.reconnect:g} s")
        if self._must_open:
            self._reopen(timeout)
            self._polled = self.now()
            return
        try:
            self._flush()
            settle = 0.0 if self.session.busy or not collect else min(timeout, SETTLE)
            data = self.link.read(timeout, settle)
            now = self.now()
            self._note_pause(now - self._polled - timeout - settle)
            self._polled = now
            if data:
                self.bytes_in += len(data)
                self.session.receive_data(data, now)
            self.session.tick(now)
            while (event := self.session.next_event()) is not None:
                self._dispatch(event, now)
            for node, wrong in self.session.wrong_times():
                self._misdated(node, wrong)
            self._feed_watchdogs(now)
            self._flush()
        except LinkError as error:
            self._lost(error)

    def _flush(self) -> None:
        data = self.session.data_to_send()
        if data:
            self.link.write(data)

    def _dispatch(self, event: object, now: float) -> None:
        match event:
            case StreamFrames(node=node, stream=stream, frames=frames):
                self._seen(node, now)
                streams = self._streams.get(node, _NO_STREAMS)
                decoder = streams.decoders.get(stream)
                if decoder is None:
                    self.unasked += len(getattr(frames, "records", frames))
                else:
                    streams.newest = now
                    self._deliver(decoder.decode(frames))
            case HeartbeatReceived(node=node, heartbeat=heartbeat):
                self._seen(node, now)
                self.boots.setdefault(node, {})[heartbeat.boot_id] = now, heartbeat
                self.heartbeats[node] = heartbeat
                self.faults[node] = self.faults.get(node, Fault(0)) | heartbeat.faults
                self._watches[node].on &= self._watches[node].feed or heartbeat.outputs_on
                self._streams.get(node, _NO_STREAMS).heard(heartbeat)
                self._heard_at(node, None, heartbeat.tick)
                self.tell(event)
            case DeviceEventReceived(node=node, event=happened):
                self.faults[node] = self.faults.get(node, Fault(0)) | happened.faults
                if happened.code == EventCode.SETPOINT_REJECTED:
                    self.rejections[node] = happened
                self.tell(self._parameter_set(node, happened) or event)
            case LogReceived(log=log):
                self.note(log.text, _LOG_LEVELS.get(log.level, "INFO"))
            case ReplyReceived(tid=tid, message=message):
                self._settle(tid, reply=message)
            case RequestRefused(tid=tid, error=error):
                words = f"{MessageType(error.request).name} was refused: {error}"
                self._settle(tid, error=Refused(words, error.code, error.detail))
            case ReplyUnusable(tid=tid, error=error):
                self._settle(tid, error=error)
            case RequestTimedOut(tid=tid, node=node, type=kind, tries=tries):
                self._settle(tid, error=NoReply(self._no_answer(node, kind, tries, now)))
            case Connected(hello=hello):
                self.hello = hello
                if self.health.down_since is not None:
                    down = now - self.health.down_since
                    self.health.downtime += down
                    for watch in self._watches.values():
                        watch.down = max(watch.down, down)
                    self.health.down_since = None
                    self.note("the drive is back", "WARN")
            case SeveralAnswer(node=node, boot_ids=boot_ids, reboots=reboots):
                self.several[node] = boot_ids
                self.health.reboots -= reboots
            case Rebooted(node=node):
                self.health.reboots += 1
                self._listened = now
                self._end(node, self.heartbeats.pop(node, None))  # the last one of the boot before
                self._continuity.restarted(node)
                self.tell(ClockRestarted(node, self.newest(node)))
                self._clocks.pop(node, None)
                if self.on_reboot:
                    self.on_reboot(node)

    def _parameter_set(self, node: int, event: DeviceEvent) -> ParameterSet | None:
        """What an event tells of a parameter, by its name; None for another event, and where the name is not known."""
        number = event.number if event.code == EventCode.PARAM_CHANGED else None
        name = None if number is None else self.parameters.get(node, {}).get(number)
        if name is None:
            return None
        told = self.changed[node, name] = ParameterSet(event.tick, node, name, event.detail, exact=True)
        return told

    def _no_answer(self, node: int, kind: MessageType, tries: int, now: float) -> str:
        """That `node` did not answer, and whether it was heard meanwhile."""
        text = f"node {node} on {self.link.name} did not answer {kind.name} in {tries} tries"
        if node in self.boots or self._streams.get(node):
            silent, (ended, pause) = now - self._watches[node].last_seen, self._last_pause
            late = f"nothing came of it for {silent:.2f} s" if silent > FRESH else HEARD
            if now - ended < AFTER_PAUSE:
                late = f"this host had been paused for {pause:.2f} s, and what waited meanwhile comes first"
            text = f"{text}: {late}"
        return "; ".join([text, *oddities(self.link)])

    def _deliver(self, chunk: Chunk | None) -> None:
        if chunk is not None and len(chunk):
            self._heard_at(chunk.config.node, chunk.config.stream, int(chunk.tick[-1]))
            self.tell(self.change(self._continuity.chunk(chunk)))

    def _heard_at(self, node: int, stream: int | None, tick: int) -> None:
        """Device time has come to `tick`, by a stream or by heartbeats: those of one overlap a little, no more."""
        self._clocks.setdefault(node, {})[stream] = tick

    def _misdated(self, node: int, wrong: WrongTime) -> None:
        """Tell it, of what comes again and again more and more seldom."""
        what = wrong.what.partition(" (")[0]
        count = self.misdated[what] = self.misdated.get(what, 0) + 1
        if self.hello is None or (count > FEW and count & (count - 1)):
            return
        at = wrong.tick / (self.session.tick_reference(node).tick_hz or 1)
        words = f"after {at:.3f} s came what SPEC does not allow: {wrong.what}"
        if not math.isnan(wrong.by):
            way = "ahead of" if wrong.by > 0.0 else "behind"
            words = f"{wrong.what} dated {abs(wrong.by):.3f} s {way} {at:.3f} s, the time that it was"
        text = f"node {node}: {words}" + (f" ({count} times so far)" if count > FEW else "")
        self._untold += [Note(wrong.tick, text, "WARN"), Misdated(wrong.tick, node, text)]
        self.tell_misdated()

    def tell_misdated(self) -> None:
        """Tell the sinks what was dated as it cannot be, also before there were any."""
        while self._untold and self.sinks:
            self.tell(self._untold.pop(0))

    def _seen(self, node: int, now: float) -> None:
        watch = self._watches.setdefault(node, _Watch())
        if watch.feed:
            watch.silent = max(watch.silent, now - watch.last_seen)
        watch.last_seen = now

    def tell(self, item: Heard) -> None:
        """Give an item to every sink."""
        for sink in self.sinks:
            sink.take(item)

    def note(self, text: str, level: str = "INFO") -> None:
        """Tell every sink a line for the log."""
        self.tell(Note(self.newest(self.hello.node) if self.hello else 0, text, level))

    def newest(self, node: int) -> int:
        """The newest device time that was heard of `node`, in ticks; 0 before any."""
        return max(self._clocks.get(node, {}).values(), default=0)

    def late(self, node: int) -> int:
        """By how many ticks samples of `node` that are streamed now come later than its heartbeats; 0 without any."""
        clocks, streams = self._clocks.get(node, {}), self._streams.get(node, _NO_STREAMS)
        sampled = [number for number, decoder in streams.decoders.items() if decoder.config.channels]
        newest = [clocks[number] for number in sampled if number in clocks]
        return max(0, clocks.get(None, 0) - max(newest)) if newest else 0

    # -- streams ------------------------------------------------------------------------------------------------

    def decode(self, config: StreamConfig) -> None:
        """Decode a stream from now on, as it was just configured."""
        decoder = self.session.decoder(config)
        streams = self._streams.setdefault(config.node, _Streams())
        if config.stream in streams.decoders:
            self._closed[config.node] = _added(self._closed.get(config.node), [streams.decoders[config.stream]])
        streams.decoders[config.stream] = decoder
        expect: Callable[[float], None] | None = getattr(self.link, "expect", None)
        if config.channels and expect is not None:  # a link that can be told
            expect(config.rate * config.dtype.itemsize)

    def streams_started(self, node: int) -> None:
        """The streams of `node` have just been started: what it makes from now on is to come."""
        streams = self._streams.setdefault(node, _Streams())
        streams.beats, streams.first = 0, None

    def end_streams(self, node: int, last: Heartbeat | None) -> None:
        """The streams of `node` have been stopped: wait for what is under way, and count what does not come.

        `last` is a heartbeat that came before they were told to stop: what the node had made by then is known. After it
        nothing is. Raises LinkError; all is counted then, too.
        """
        streams = self._streams.get(node, _NO_STREAMS)
        began = self.now()

        def settled() -> bool:
            lacking = [] if last is None else streams.missing(_beat(last))
            return not any(n for _, n in lacking) or self.now() - max(streams.newest, began) > QUIET

        try:
            if self.health.down_since is None:
                self.wait(settled, FLUSH)
        finally:
            self._end(node, last)

    def losses(self, node: int) -> Losses:
        """Account of all that was streamed from `node`; what its last frames were is known when they have ended."""
        return _added(self._closed.get(node), self._streams.get(node, _NO_STREAMS).decoders.values())

    def _end(self, node: int, last: Heartbeat | None) -> None:
        """Nothing more comes of these streams: what they lack up to `last` is lost."""
        streams = self._streams.pop(node, None)
        if streams is None:
            return
        self.session.wire.forget(node)
        samples = edges = 0
        for decoder, n in [] if last is None else streams.missing(_beat(last)):
            decoder.counters.lost_by_index += n
            if decoder.config.event == StreamEvent.EDGES:
                edges += n
            else:
                samples += n
        self._closed[node] = _added(self._closed.get(node), streams.decoders.values())
        if samples or edges:
            what = " and ".join(counted(n, noun) for n, noun in ((samples, "sample"), (edges, "edge")) if n)
            self.note(f"lost at the end of the streams of node {node}: {what}", "WARN")
            self.tell(Missing(self.newest(node), node, samples, edges))

    # -- watchdog -----------------------------------------------------------------------------------------------

    def feed(self, node: int, on: bool) -> None:
        """Start or stop feeding the watchdog of `node`."""
        watch, now = self._watches.setdefault(node, _Watch()), self.now()
        if watch.feed and not on:
            watch.longest = max(watch.longest, now - watch.fed)
            watch.silent = max(watch.silent, now - watch.last_seen)
            self._note_pause(now - self._polled)
        watch.feed, watch.on = on, on or watch.on
        if on:
            watch.last_alive, watch.fed = -1e9, now
            watch.longest = watch.pause = watch.silent = watch.down = 0.0
            watch.last_seen = max(watch.last_seen, now)
            gc.freeze()  # to go through all that is there takes 0.1 to 0.3 s, and a watchdog waits for 0.2 s
        elif not any(each.feed for each in self._watches.values()):
            gc.unfreeze()

    def starved(self, node: int, watchdog: float = WATCHDOG) -> str:
        """Why the watchdog of `node`, which waits `watchdog` s, may have run out, if the reason is here; else ''."""
        watch, longest = self._watches.get(node, _Watch()), self.longest_unfed(node)
        silent = max(watch.silent, self.now() - watch.last_seen if watch.feed else 0.0)
        words = f"this host sent no ALIVE for {longest:.2f} s"
        if longest < watchdog:
            return f"nothing came of it for {silent:.2f} s: the link carried nothing" if silent >= watchdog else ""
        if watch.pause > longest / 2:
            return f"{words} (it was starved of CPU or stopped, or the link is slow)"
        if watch.down > longest / 2:
            return f"{words}, because {self.link.name} was gone for {watch.down:.2f} s"
        if silent > FRESH:
            return f"{words}, because the drive was silent for {silent:.2f} s: the link carried nothing"
        return f"{words}, and its watchdog waits {watchdog:g} s only"

    def longest_unfed(self, node: int) -> float:
        """The longest time in s between two ALIVEs to `node` since feeding began, one that goes on included."""
        watch = self._watches.get(node, _Watch())
        return max(watch.longest, watch.pause, self.now() - watch.fed if watch.feed else 0.0)

    def _note_pause(self, seconds: float) -> None:
        self.longest_pause = max(self.longest_pause, seconds)
        if seconds > PAUSE:
            self.pauses += 1
            self._last_pause = self.now(), seconds
        for watch in self._watches.values():
            if watch.on:
                watch.pause = max(watch.pause, seconds)

    def _feed_watchdogs(self, now: float) -> None:
        for node, watch in self._watches.items():
            if watch.feed and now - watch.last_alive >= ALIVE_PERIOD and now - watch.last_seen <= FRESH:
                watch.longest = max(watch.longest, now - watch.fed)
                watch.last_alive = watch.fed = now
                watch.counter += 1
                self.session.send(Alive(counter=watch.counter & 0xFFFFFFFF), node)

    # -- requests -----------------------------------------------------------------------------------------------

    def request(self, message: Request, node: int, reply: type[R]) -> R:
        """Send a request and poll until its reply, a `reply`. Raises Refused, NoReply, DeviceDefect or LinkError."""
        if self.health.down_since is not None:
            raise LinkClosed(f"{self.link.name} is gone: {message.TYPE.name} was not sent")
        pending = self._pending = _Pending(self.session.request(message, node, self.now()))
        try:
            while pending.reply is None:
                self.poll(POLL)
                if pending.error is not None:
                    raise pending.error
        except (NoReply, Refused) as error:
            self._pending = None
            stop = isinstance(message, StateCommand) and message.command == Command.STOP
            if not stop and not isinstance(message, Hello):  # another device may have answered, or the two at once
                boots = {*self.boots.get(node, ()), *(reply.boot_id for reply in self.session.devices.get(node, ()))}
                if len(boots) > 1 and isinstance(error, Refused) and error.code in _OF_ANOTHER:
                    self.listen(node)
                self.require_alone(node)
            raise
        finally:
            self._pending = None
            self.session.cancel()  # an interrupted request must not block STOP
        assert isinstance(pending.reply, reply)  # the session unpacks by the type of the request
        return pending.reply

    def _settle(self, tid: int, reply: Payload | None = None, error: Exception | None = None) -> None:
        if self._pending and self._pending.tid == tid:
            self._pending.reply, self._pending.error = reply, error


_NO_STREAMS = _Streams()
_OF_ANOTHER = (ErrorCode.BAD_TOKEN, ErrorCode.WRONG_STATE, ErrorCode.BUSY)  # what another device of that number says
_LOG_LEVELS = {3: "ERROR", 4: "WARN", 6: "INFO", 7: "DEBUG"}


def oddities(link: Link) -> list[str]:
    """What a link knows of itself that may be why nothing comes; links in virtual time know nothing."""
    told: Callable[[], list[str]] | None = getattr(link, "oddities", None)
    return [] if told is None else told()


def unanswered(link: Link, session: HostSession, heard: int) -> str:
    """What to look at where nobody has answered HELLO; `heard`: bytes that came all the same."""
    if nodes := sorted(session.heard):
        advice = session.wire.unanswered(nodes)
    elif session.echoes:
        advice = "only what this program sends is heard: TX and RX are joined, or the other end echoes"
    else:
        advice = session.wire.advice(bool(heard))
    return "; ".join([*oddities(link), advice])


def several_devices(node: int, link: str, replies: Iterable[HelloReply], boot_ids: Iterable[int] = ()) -> str:
    """That several devices answer as `node`, named by what they have answered; by boot_id where they have no serial."""
    kind, names = "serial", {reply.serial for reply in replies}
    if len(names) < 2 or "" in names:
        kind, names = "boot", {f"{reply.boot_id:08x}" for reply in replies} | {f"{each:08x}" for each in boot_ids}
    *others, last = sorted(names)
    count = {2: "two"}.get(len(names), str(len(names)))
    who = f"{kind} {', '.join(others)} and {last}"
    return f"{count} devices answer as node {node} on {link} ({who}): give one another number"


def _beat(heartbeat: Heartbeat) -> Beat:
    return Beat(heartbeat.tick, heartbeat.edges)


def _added(account: Losses | None, decoders: Iterable[Decoder]) -> Losses:
    """An account, with what these decoders count."""
    samples, edges = ([account.samples], [account.edges]) if account else ([], [])
    for decoder in decoders:
        (edges if decoder.config.event == StreamEvent.EDGES else samples).append(decoder.counters)
    return Losses(_sum(samples), _sum(edges))


def _sum(counters: Iterable[LossCounters]) -> LossCounters:
    return LossCounters(*map(sum, zip(*map(astuple, counters), strict=True)))

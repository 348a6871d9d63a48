"""The device under check: what it says of itself, its states and streams as checks need them.

What a check builds on and does not get ends it with `Unknown`: only what it is about may fail it. Nothing here
energises anything but `arm` and `run`; whoever calls them leaves by `rest`.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from bench.conform.lines import BusLine, Heard
from bench.conform.probe import TRIES, Answer, Probe, read, state_name
from bench.conform.verdicts import Ended, Failed, NotApplicable, Unknown
from bench.device.safety import is_off
from bench.rig.interrupts import undisturbed
from protocol.canmap.layout import MAX_GROUPS, sample_layout
from protocol.codes import Command, DriveState, ErrorCode, Fault, MessageType, StreamEvent
from protocol.descriptor import Channel, Descriptor
from protocol.errors import DeviceDefect
from protocol.messages import (
    BlobRead,
    BlobReply,
    DeviceEvent,
    Feature,
    Heartbeat,
    HelloReply,
    ParamGet,
    ParamReply,
    ParamSet,
    StreamReply,
    StreamSet,
)
from protocol.signals import Flag
from protocol.streams import MAX_DECIMATION, STREAM_HEADER
from protocol.text import counted

WATCHDOG = 0.2  # s, where there is no parameter that says otherwise
ALIVE = 0.05  # s between two ALIVEs, at most a quarter of the watchdog's time
LIGHT, WELL_LOADED, ALL = 0.45, 0.8, 1.0
"""Shares of the link that all streams take which a check looks at; beyond the second they queue up in the device."""
SLOW_LINK = 3.0  # s in which a slow link brings two frames
PART = 512  # bytes of a blob that are asked for at once
MOST_BLOB = 4096 * 32  # bytes
PATIENCE = 0.5  # s beyond its time that a watchdog is given to end what STOP did not
EDGE_BYTES = 8
NO_FLAGS = Flag(0)
T = TypeVar("T")


class NotAtRest(Exception):
    """No heartbeat showed the outputs off."""


@dataclass(frozen=True)
class Block:
    """A DATA or EDGES frame; `place` is its place among the messages that came."""

    place: int
    at: float
    edges: bool
    stream: int
    flags: int
    n: int
    cfg_id: int
    seq: int
    index: int
    tick: int
    data: bytes

    @classmethod
    def of(cls, place: int, heard: Heard) -> Block:
        """Raises Failed where the frame cannot be read."""
        payload = heard.frame.payload
        if len(payload) <= STREAM_HEADER.size:
            raise Failed(f"a stream frame has {len(payload)} bytes")
        stream, flags, n, cfg_id, seq, index, tick = STREAM_HEADER.unpack_from(payload)
        edges = heard.frame.type == MessageType.EDGES
        if edges and (len(payload) - STREAM_HEADER.size) % EDGE_BYTES:
            raise Failed(f"an EDGES frame has {len(payload)} bytes")
        return cls(place, heard.at, edges, stream, flags, n, cfg_id, seq, index, tick, payload[STREAM_HEADER.size :])


@dataclass
class Device:
    """The device at the other end of `probe`, checked up to `level`, and turned at `speed_rpm` at most."""

    probe: Probe
    level: int
    speed_rpm: float
    hello: HelloReply = field(init=False)
    kept: dict[str, Any] = field(default_factory=dict)
    """What one check has measured and another needs too."""
    held_capture: int = 0
    """Number of the capture that a host had not read when this began, 0: none."""
    not_put_back: list[str] = field(default_factory=list)
    """Parameters that are not restored, in words."""

    # -- what it says of itself -----------------------------------------------------------------------------------

    @property
    def bus(self) -> BusLine:
        """Its line, which must be a CAN bus."""
        line = self.probe.line
        if not isinstance(line, BusLine):
            raise NotApplicable("not a CAN bus")
        return line

    @property
    def hz(self) -> int:
        """Ticks in a second. Unknown where there are none."""
        if not self.hello.tick_hz:
            raise Unknown("tick_hz in HELLO is 0")
        return self.hello.tick_hz

    @property
    def pwm_hz(self) -> int:
        """PWM periods in a second. Unknown where there are none."""
        if not self.hello.pwm_hz:
            raise Unknown("pwm_hz in HELLO is 0")
        return self.hello.pwm_hz

    @property
    def ticks_per_period(self) -> int:
        """Ticks of a PWM period. Unknown where HELLO makes that impossible."""
        hello = self.hello
        if not hello.pwm_hz or not hello.tick_hz or hello.tick_hz % hello.pwm_hz:
            raise Unknown(f"HELLO has tick_hz {hello.tick_hz}, pwm_hz {hello.pwm_hz}")
        return hello.tick_hz // hello.pwm_hz

    @cached_property
    def blob(self) -> bytes:
        """The descriptor as it is read. Raises Unknown where it cannot be."""
        return self.read_blob(0)

    def read_blob(self, number: int, part_bytes: int = PART) -> bytes:
        """A whole blob, read in parts of this length. Raises Unknown where it cannot be."""
        blob, total = b"", 1
        while len(blob) < total:
            part = self.probe.get(BlobRead(number, part_bytes, len(blob)), BlobReply)
            if not part.data and part.total:
                raise Unknown(f"blob {number} ends after {len(blob)} of {part.total} bytes")
            total, blob = part.total, blob + part.data
            if total > MOST_BLOB:
                raise Unknown(f"blob {number} has {total} bytes")
        return blob

    @cached_property
    def descriptor(self) -> Descriptor:
        """Its channels and parameters. Raises Unknown where it cannot be used."""
        try:
            return Descriptor.unpack(self.blob)
        except DeviceDefect as defect:
            raise Unknown(str(defect)) from None

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Those that can be streamed. NotApplicable where there are none."""
        if not self.descriptor.channels:
            raise NotApplicable("the device has no channels")
        return self.descriptor.channels

    def fitting(self, channels: Sequence[Channel]) -> tuple[Channel, ...]:
        """The first of these, as many as a sample can have on this link."""
        most = (self.hello.rx_max - 8) // 2
        for n in range(min(len(channels), most), 1, -1):
            widths = [width(channel) for channel in channels[:n]]
            if isinstance(self.probe.line, BusLine):
                fits = len(sample_layout(widths, self.probe.line.rates.fd, 1).groups) <= MAX_GROUPS
            else:
                fits = sum(widths) <= self.hello.tx_max - STREAM_HEADER.size
            if fits:
                return tuple(channels[:n])
        return tuple(channels[:1])

    def parameters(self, flags: Flag = NO_FLAGS, without: Flag = NO_FLAGS) -> list[Channel]:
        """Those that have these flags and not those. NotApplicable where there are none."""
        found = [p for p in self.descriptor.parameters if p.flags & flags == flags and not p.flags & without]
        if not found:
            names = " and ".join(flag.name or "" for flag in Flag if flag & flags)
            which = " that can be set" if without & Flag.READ_ONLY else ""
            raise NotApplicable(f"the device has no {f'{names} ' if names else ''}parameter{which}")
        return found

    def parameter(self, record: Channel) -> ParamReply:
        """A parameter's value and range. Raises Unknown where it is refused."""
        return self.probe.get(ParamGet(record.id), ParamReply)

    def named(self, name: str) -> Channel | None:
        """The parameter of a name that SPEC gives a meaning."""
        return next((p for p in self.descriptor.parameters if p.name == name), None)

    def channel_named(self, name: str) -> Channel | None:
        """The channel of a name that SPEC gives a meaning. NotApplicable where there are no channels at all."""
        return next((channel for channel in self.channels if channel.name == name), None)

    def put_back(self, record: Channel, value: float) -> None:
        """Restore a parameter if it has changed; `not_put_back` has those that could not be restored."""
        words = f"parameter {record.name} (was {value:g})"
        self.not_put_back.append(words)
        for _ in range(TRIES):  # a request that went unanswered before is sent once only
            with undisturbed(), suppress(Ended):
                if self.parameter(record).value != value:
                    self.set(record, value)
                if self.parameter(record).value == value:
                    self.not_put_back.remove(words)
                    return

    def offers(self, feature: Feature) -> bool:
        """Whether HELLO has the feature."""
        return bool(self.hello.features & feature)

    def require(self, feature: Feature) -> None:
        """Raises NotApplicable where HELLO lacks the feature."""
        if not self.offers(feature):
            raise NotApplicable(f"the device lacks the feature {feature.name}")

    def once(self, name: str, make: Callable[[], T]) -> T:
        """What `make` gives, made once for all checks that need it."""
        if name not in self.kept:
            self.kept[name] = make()
        found: T = self.kept[name]
        return found

    def set(self, record: Channel, value: float) -> Answer:
        """Send a PARAM_SET."""
        return self.probe.ask(MessageType.PARAM_SET, ParamSet(record.id, value).pack())

    # -- streams --------------------------------------------------------------------------------------------------

    def stream_set(
        self, stream: int, channels: Sequence[int], decimation: int = 1, latency_ms: int = 20, event: int = 0
    ) -> Answer:
        """Send a STREAM_SET."""
        payload = struct.pack(
            f"<BBHHH{len(channels)}H", stream, event, decimation, latency_ms, len(channels), *channels
        )
        return self.probe.ask(MessageType.STREAM_SET, payload)

    def configure(
        self,
        stream: int,
        channels: Sequence[int],
        rate: float,
        latency_ms: int = 20,
        share: float = LIGHT,
        event: StreamEvent = StreamEvent.PWM,
    ) -> Configured:
        """Configure samples at about `rate` Hz, or as often as that `share` of the link carries. Raises Unknown."""
        decimation = min(max(1, round(self.pwm_hz / rate)), MAX_DECIMATION)
        while True:
            answer = self.stream_set(stream, channels, decimation, latency_ms, event)
            error = answer.error
            fits = error.detail if error is not None and error.code == ErrorCode.DOES_NOT_FIT else 0.0
            if 1 <= fits <= MAX_DECIMATION and decimation < MAX_DECIMATION:  # of larger ones, some may fit less
                decimation = int(fits) if fits > decimation else min(math.ceil(1.1 * decimation), MAX_DECIMATION)
                continue
            reply = read(require_granted(answer, "STREAM_SET").frame, StreamReply)
            if reply.load <= share or decimation == MAX_DECIMATION:
                break
            decimation = min(math.ceil(decimation * max(1.1, reply.load / share)), MAX_DECIMATION)
        if not reply.block or not reply.sample_bytes:
            raise Unknown(f"STREAM_SET gave sample_bytes {reply.sample_bytes}, block {reply.block}")
        return Configured(reply, StreamSet(stream, event, decimation, latency_ms, tuple(channels)))

    def stream(self, channels: Sequence[Channel], rate: float, latency_ms: int = 20) -> Configured:
        """Configure stream 0 for these channels, see `configure`, and start it. Raises Unknown."""
        told = self.configure(0, ids(channels), rate, latency_ms)
        self.start_streams(1)
        return told

    def configure_edges(self, stream: int, decimation: int = 1, latency_ms: int = 20) -> Configured:
        """Configure a stream of edges. Raises NotApplicable, Unknown."""
        self.require(Feature.EDGES)
        answer = self.stream_set(stream, (), decimation, latency_ms, StreamEvent.EDGES)
        reply = read(require_granted(answer, "STREAM_SET of edges").frame, StreamReply)
        return Configured(reply, StreamSet(stream, StreamEvent.EDGES, decimation, latency_ms))

    def start_streams(self, mask: int) -> None:
        """Start them. Raises Unknown."""
        require_granted(self.probe.ask(MessageType.STREAM_START, struct.pack("<I", mask)), "STREAM_START")

    def stop_streams(self, mask: int = 0xFFFFFFFF) -> None:
        """Stop them, and take what is under way. Raises Unknown."""
        require_granted(self.probe.ask(MessageType.STREAM_STOP, struct.pack("<I", mask)), "STREAM_STOP")
        self.probe.quiet()

    def blocks(self, stream: int | None = None, since: int = 0) -> list[Block]:
        """The stream frames that came, those of one stream or all, after the first `since` messages."""
        kinds = (MessageType.DATA, MessageType.EDGES)
        found = [
            Block.of(place, each)
            for place, each in enumerate(self.probe.heard[since:], since)
            if each.frame.type in kinds and each.frame.node == self.probe.node
        ]
        return [block for block in found if stream is None or block.stream == stream]

    def streamed(self, stream: int, seconds: float) -> list[Block]:
        """Blocks of a stream that come within so many s. Unknown where none did."""
        self.probe.listen(seconds)
        self.probe.until(lambda: len(self.blocks(stream)) > 1, SLOW_LINK)
        blocks = self.blocks(stream)
        if not blocks:
            raise Unknown(f"no frame of stream {stream} received within {seconds:g} s")
        return blocks

    def require_undropped(self, before: int) -> None:
        """Raises Unknown where frames were dropped since tx_dropped was `before`: the link is too slow."""
        self.fresh()
        if words := self.dropped(before):
            raise Unknown(words)

    def dropped(self, before: int | None = None) -> str:
        """What it dropped since tx_dropped was `before`, or since `connect`, in words; empty if nothing."""
        beats = [beat.tx_dropped for _, beat in self.probe.beats]
        dropped = (beats[-1] - (beats[0] if before is None else before)) & 0xFFFFFFFF if beats else 0
        return f"the device dropped {counted(dropped, 'frame')}: the link is too slow" if dropped else ""

    # -- states ---------------------------------------------------------------------------------------------------

    @cached_property
    def watchdog(self) -> float:
        """s that its watchdog waits."""
        record = self.named("watchdog")
        value = math.nan if record is None else self.parameter(record).value
        return value if math.isfinite(value) else WATCHDOG

    @property
    def feed_every(self) -> float:
        """s between two ALIVEs that feed its watchdog."""
        return min(ALIVE, self.watchdog / 4)

    def feed(self) -> None:
        """Feed the watchdog from now on."""
        self.probe.feed_every = self.feed_every

    def unfed(self) -> tuple[int, int]:
        """Feed it a last time; the ticks before and after."""
        self.probe.feed_every = None
        first = self.probe.tick()[1]
        self.probe.alive()
        return first, self.probe.tick()[0]

    def arm(self) -> None:
        """ARMED, fed. Raises Unknown."""
        every = self.feed_every  # asked for before ARM: a slow link takes longer than the watchdog
        require_granted(self.probe.command(Command.ARM, self.hello.boot_id), "ARM")
        self.probe.feed_every = every

    def run(self) -> None:
        """RUNNING at zero current, fed. Raises Unknown."""
        self.arm()
        require_granted(self.probe.command(Command.START), "START")

    def enter(self, state: DriveState) -> None:
        """ARMED or RUNNING, fed; IDLE is where a check begins. Raises Unknown."""
        {DriveState.ARMED: self.arm, DriveState.RUNNING: self.run}.get(state, lambda: None)()

    def fault(self) -> Heartbeat:
        """FAULT, by a watchdog that is not fed in ARMED; the heartbeat that says so. Raises Unknown."""
        self.arm()
        self.trip()
        return self.fresh()

    def trip(self) -> None:
        """Feed the watchdog no longer, until a heartbeat has FAULT. Raises Unknown, Failed, see `wait_state`."""
        self.probe.feed_every = None
        self.wait_state(DriveState.FAULT, 2 * self.watchdog + PATIENCE)

    def fresh(self) -> Heartbeat:
        """A heartbeat that was made from now on."""
        now = self.probe.tick()[1]
        return self.probe.beat(lambda beat: beat.tick > now)

    def wait_state(self, state: DriveState, seconds: float) -> None:
        """Wait for a heartbeat with this state. Raises Unknown, Failed where HELLO has the state."""
        try:
            self.probe.beat(lambda beat: beat.state == state, seconds, f"with {state.name} ")
        except Unknown as nothing:
            if self.probe.hello().state == state:
                raise Failed(f"HELLO has {state.name}, but {nothing}") from None
            raise

    def events(self, code: int) -> list[DeviceEvent]:
        """The events of this code that came since `connect`."""
        return [event for _, event in self.probe.came(DeviceEvent) if event.code == code]

    def stop_anyhow(self) -> None:
        """Every kind of STOP that the link has."""
        if isinstance(self.probe.line, BusLine):
            self.probe.write(self.probe.line.stop(self.probe.node))
        self.probe.stop()

    def rest(self) -> str:
        """IDLE, no fault, outputs off, seen in a heartbeat; what was wrong on the way, in words. Raises NotAtRest."""
        self.probe.feed_every = None
        trouble = ""
        for _ in range(3):
            with suppress(Ended):
                self.stop_anyhow()
            with suppress(Ended):
                beat = self.fresh()
                if is_off(beat) and beat.state == DriveState.FAULT:
                    self.probe.command(Command.FAULT_CLEAR, beat.faults)
                    beat = self.fresh()
                if is_off(beat) and beat.state == DriveState.IDLE:
                    return trouble
                if is_off(beat):
                    trouble = f"its state stays {state_name(beat.state)}"
                    continue
                trouble = f"STOP led to {state_name(beat.state)}, outputs {'on' if beat.outputs_on else 'off'}"
                self.trip()
        raise NotAtRest(trouble or "it sends no heartbeats")


@dataclass(frozen=True)
class Configured:
    """A stream as the device says that it is, and as it was asked for."""

    reply: StreamReply
    asked: StreamSet


def require_granted(answer: Answer, what: str) -> Answer:
    """The answer to what a check builds on. Raises Unknown where that was refused."""
    if answer.error is not None:
        raise Unknown(f"{what} was refused: {answer}")
    return answer


def width(channel: Channel) -> int:
    """Bytes of a channel's raw value."""
    return np.dtype(channel.raw.dtype).itemsize


def ids(channels: Sequence[Channel]) -> tuple[int, ...]:
    """Their numbers."""
    return tuple(channel.id for channel in channels)


def faults_text(faults: int) -> str:
    """A mask in words."""
    return "+".join(fault.name or "" for fault in Fault if fault & faults) or f"0x{faults:x}"

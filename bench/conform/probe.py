"""A host that sends whatever it is told to, valid or not, and keeps every frame received.

Unlike `bench.device.client` it has no session: it repeats a request only when told to, it drops nothing, and
tids, flags and lengths are the caller's. It decides nothing. Time is the link's.
"""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TypeVar

from bench.conform.lines import BusFrame, Heard, Line
from bench.conform.verdicts import Failed, Unknown
from protocol.codes import Command, DriveState, ErrorCode, MessageType
from protocol.framing import (
    MAJOR,
    MAX_PAYLOAD,
    Frame,
    encoded_length,
)
from protocol.links import Link
from protocol.messages import (
    UNACKNOWLEDGED,
    ErrorReply,
    Heartbeat,
    HelloReply,
    Message,
    Payload,
    Request,
    TimeSyncReply,
)
from protocol.payload import PayloadError
from protocol.wire import ByteWire

R = TypeVar("R", bound=Payload)
M = TypeVar("M", bound=Message)

TRIES = 3
PATIENCE = 0.25  # s for which an answer is waited for, before the request is repeated
HELD = 0.05  # s beyond what was asked for that one look at the link may take; else this program was held up
HELLO_TRIES = 10
LOOK_AT_LINK, REQUESTS, ENOUGH = 2.0, 1000, 3  # s, requests, and lost ones, after which one knows what a link loses
SLOWEST = 10 / 28_800  # s a byte of a UART, above which frames wait for one another for longer than HBP's times
GRACE = 0.03  # s in which an answer that must not come would come, once a later request has been answered
SLICE = 0.02  # s that one look at the link waits
BEAT = 0.45  # s in which a heartbeat must come: four of them
QUIET = 0.05  # s without a stream frame after which none is under way
MOST_QUEUED = 10.0  # s that a device is given to send what waited: 64 KiB at 115200 baud, and some
ALL_STREAMS = 0xFFFFFFFF
HELLO = struct.Struct("<IBBH")


class NoAnswer(Failed):
    """A request of the type `kind` was not answered."""

    def __init__(self, words: str, kind: int) -> None:
        super().__init__(words)
        self.kind = kind


class Overdue(Unknown):
    """A check took longer than it may."""


@dataclass(frozen=True)
class Answer:
    """The answer to a request, `after` s after it was sent."""

    heard: Heard
    after: float

    @property
    def frame(self) -> Frame:
        """The answer itself."""
        return self.heard.frame

    @property
    def error(self) -> ErrorReply | None:
        """The refusal, if it is one."""
        return read(self.frame, ErrorReply) if self.frame.is_error else None

    def __str__(self) -> str:
        error = self.error
        words = "answered" if error is None else f"{ErrorCode(error.code).name}, detail {error.detail:.9g}"
        return f"{words} after {1e3 * self.after:.0f} ms"


@dataclass
class Probe:
    """A link with a device at its other end, node `node` once `connect` has found it.

    `idle` lets so many s pass in which the link is not read.
    """

    link: Link
    line: Line
    idle: Callable[[float], None]
    node: int = 0
    heard: list[Heard] = field(default_factory=list)
    """Messages since `connect`, in the order they came."""
    stream_frames: list[BusFrame] = field(default_factory=list)
    """The stream frames among them on CAN, where they are no messages."""
    feed_every: float | None = None
    """s after which ALIVE is sent again while the link is listened to; None: it is not sent."""
    held: float = 0.0
    """s for which this program did not run although it was to look at the link, altogether."""
    deadline: float = math.inf
    """When it raises Overdue."""
    mute: dict[int, str] = field(default_factory=dict)
    """By type of request: which check found that it is not answered."""

    def __post_init__(self) -> None:
        self._tid = random.randrange(1, 0x10000)
        self._alive = 0
        self._watch: Callable[[], None] = lambda: None
        self._fed = -1e9
        self._started = False  # a stream, since `quiet`
        self._looked = self.now()
        wire = self.link.wire()
        baud = wire.baud if isinstance(wire, ByteWire) else math.inf
        self._byte = 10 / baud
        self._longest = encoded_length(MAX_PAYLOAD) * self._byte
        """s that the longest frame is under way on a UART."""

    # -- writing and reading --------------------------------------------------------------------------------------

    def now(self) -> float:
        """s of the link's clock."""
        return self.link.clock()

    def tid(self) -> int:
        """The next one: 1 to 65535."""
        self._tid = self._tid % 0xFFFF + 1
        return self._tid

    def frame(self, kind: int, payload: bytes = b"", *, tid: int | None = None, flags: int = MAJOR) -> Frame:
        """A message to the device; without `tid` with the next one, or 0 for what is not answered."""
        if tid is None:
            tid = 0 if kind in UNACKNOWLEDGED else self.tid()
        return Frame(kind, flags, tid, self.node, payload)

    def write(self, data: bytes) -> None:
        """Write bytes as they are."""
        self._hold(0.0)
        self.link.write(data)
        self._hold(self.takes(len(data)))

    def send(self, frame: Frame) -> None:
        """Write a message."""
        self.write(self.line.encode(frame))

    def takes(self, n: int) -> float:
        """s that `n` bytes are under way on a UART."""
        return n * self._byte

    def pause(self, seconds: float) -> None:
        """Let time pass without a look at the link."""
        self.idle(seconds)
        self._looked = self.now()

    def _hold(self, asked: float) -> None:
        """Count what has passed since the last look at the clock beyond the `asked` s."""
        now = self.now()
        if (late := now - self._looked - asked) > HELD:
            self.held += late
        self._looked = now

    def poll(self, timeout: float) -> None:
        """One look at the link, of `timeout` s at most; ALIVE is sent when it is due."""
        if self.feed_every is not None and self.now() - self._fed >= self.feed_every:
            self.alive()
        self._hold(0.0)
        data = self.link.read(max(0.0, timeout))
        self._hold(max(0.0, timeout))
        if self._looked > self.deadline:
            self.deadline = math.inf  # the device is still to be left at rest
            raise Overdue("not decided in the time that a check may take")
        for each in self.line.feed(data, self.now()) if data else ():
            if isinstance(each, BusFrame):
                self.stream_frames.append(each)
            else:
                self.heard.append(each)
        watch, self._watch = self._watch, lambda: None  # it may poll itself
        try:
            watch()
        finally:
            self._watch = watch

    @contextmanager
    def watched(self, watch: Callable[[], None]) -> Iterator[None]:
        """Inside, `watch` is called whenever the link was looked at."""
        self._watch = watch
        try:
            yield
        finally:
            self._watch = lambda: None

    def listen(self, seconds: float) -> None:
        """Take what comes in so many s."""
        left_of = self._attended(seconds)
        slice_ = SLICE if self.feed_every is None else min(SLICE, self.feed_every)
        while (left := left_of()) > 0:
            self.poll(min(slice_, left))

    def _attended(self, seconds: float) -> Callable[[], float]:
        """What is left of so many s, those not counted in which this program was held up."""
        self._hold(0.0)
        end, held = self._looked + seconds, self.held

        def left() -> float:
            self._hold(0.0)
            return end + self.held - held - self._looked

        return left

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Take what comes until `condition()`, which is of that, holds; whether it did within so many s."""
        left_of = self._attended(seconds)
        looked = -1
        while True:
            if len(self.heard) != looked:
                looked = len(self.heard)
                if condition():
                    return True
            left = left_of()
            if left <= 0:
                return False
            self.poll(min(SLICE, left))

    def alive(self) -> None:
        """Feed the watchdog."""
        self._alive += 1
        self._fed = self.now()
        self.send(self.frame(MessageType.ALIVE, struct.pack("<I", self._alive)))

    # -- requests -------------------------------------------------------------------------------------------------

    def answers(self, frame: Frame, since: int = 0) -> list[Heard]:
        """What has come in answer to a frame, from place `since` of `heard` on."""
        return [
            each
            for each in self.heard[since:]
            if each.frame.is_reply and (each.frame.type, each.frame.tid) == (frame.type, frame.tid)
        ]

    def ask(self, kind: int, payload: bytes = b"", *, tries: int = TRIES) -> Answer:
        """Send a request, again where it is not answered, and return its answer. Raises NoAnswer."""
        return self.ask_frame(self.frame(kind, payload), tries=tries)

    def ask_frame(
        self, frame: Frame, *, tries: int = TRIES, wire: bytes | None = None, patience: float = PATIENCE
    ) -> Answer:
        """The same for any frame; `wire` is written in its place. Each try waits `patience` s.

        What was not answered before is tried but once.
        """
        tries = 1 if frame.type in self.mute else tries
        self._started = self._started or frame.type == MessageType.STREAM_START
        for _ in range(tries):
            since, sent = len(self.heard), self.now()
            self.write(self.line.encode(frame) if wire is None else wire)
            if self.until(lambda since=since: bool(self.answers(frame, since)), patience + self._longest):  # type: ignore[misc]
                first = self.answers(frame, since)[0]
                self.mute.pop(frame.type, None)
                return Answer(first, first.at - sent)
        often = f" in {tries} tries" if tries > 1 else ""
        raise NoAnswer(f"{name_of(frame.type)} was not answered within {patience:g} s{often}", frame.type)

    def ask_again(self, frame: Frame) -> Answer:
        """Repeat a request that has been answered.

        Another request comes between: on CAN, a kept reply of one frame would else repeat that frame, and be ignored.
        """
        self.ask(MessageType.TIME_SYNC)
        return self.ask_frame(frame)

    def refused(self, code: ErrorCode, detail: float | None, kind: int, payload: bytes = b"") -> str:
        """Ask for what must be refused like this; evidence in words. Raises Failed where it is not."""
        return refusal(self.ask(kind, payload), code, detail, name_of(kind))

    def get(self, request: Request, reply: type[R]) -> R:
        """A request that a check builds on: Unknown where it is refused, Failed where its answer cannot be read."""
        answer = self.ask(request.TYPE, request.pack())
        if answer.frame.is_error:
            raise Unknown(f"{request.TYPE.name} was refused: {answer}")
        return read(answer.frame, reply)

    def loses(self) -> str:
        """What the link loses of requests and answers, in words; empty if it seems to lose nothing.

        A device that answers none of them is no such link. On a UART that is hardly quicker than what must pass in
        time, frames wait for one another, and nothing is told from that.
        """
        if self._byte > SLOWEST:
            return f"{10 / self._byte:.0f} baud are too slow for HBP's times: use {10 / SLOWEST:.0f} or more"
        damaged, asked, lost = self.line.damaged, 0, 0
        end = self.now() + LOOK_AT_LINK
        while asked < REQUESTS and self.now() < end and lost < ENOUGH:
            asked += 1
            try:
                self.ask(MessageType.TIME_SYNC, tries=1)
            except NoAnswer:
                lost += 1
        if damaged := self.line.damaged - damaged:
            return f"{damaged} of some {asked} frames came damaged"
        return f"{lost} of {asked} requests, or their answers, were lost" if 0 < lost < asked else ""

    def silence(self, wire: bytes, what: str) -> str:
        """Write what must not be answered, and a request that must be; evidence in words. Raises Failed."""
        since = len(self.heard)
        self.write(wire)
        barrier = self.frame(MessageType.TIME_SYNC)
        try:
            answer = self.ask_frame(barrier)
        except NoAnswer:
            raise Failed(f"after {what}, a valid request was not answered") from None
        self.listen(GRACE)
        for each in self.heard[since:]:
            if each.frame.is_reply and each.frame.tid != barrier.tid:
                raise Failed(
                    f"{what} was answered: {name_of(each.frame.type)} {Answer(each, each.at - answer.heard.at)}"
                )
        return f"{what}: not answered; the next request: {answer}"

    def tick(self) -> tuple[int, int]:
        """rx_tick and tx_tick of a TIME_SYNC."""
        reply = read(self.ask(MessageType.TIME_SYNC).frame, TimeSyncReply)
        return reply.rx_tick, reply.tx_tick

    # -- connecting and state -------------------------------------------------------------------------------------

    def connect(self) -> HelloReply:
        """Be a new host: HELLO with a nonce of its own, all streams stopped, nothing heard. Raises NoAnswer."""
        self.write(self.line.preamble())
        hello = self.hello()
        self.node = self.node or hello.node
        with suppress(NoAnswer):
            self.ask(MessageType.STREAM_STOP, struct.pack("<I", ALL_STREAMS))
        self.quiet()
        self.forget()
        return hello

    def forget(self) -> None:
        """Keep nothing of what came so far."""
        self.heard.clear()
        self.stream_frames.clear()

    def quiet(self) -> None:
        """Where streams have run, take the frames that are still under way."""

        def streamed() -> int:
            kinds = (MessageType.DATA, MessageType.EDGES)
            return len(self.stream_frames) + sum(each.frame.type in kinds for each in self.heard)

        before, end = 0, self.now() + MOST_QUEUED
        if self._started and self._longest > QUIET:
            self.listen(self._longest)
        self._started = False
        while (now := streamed()) != before and self.now() < end:
            before = now
            self.listen(max(QUIET, self._longest))

    def hello(self, nonce: int | None = None, rx_max: int = 1024) -> HelloReply:
        """Say HELLO; without `nonce` with a new one. Raises NoAnswer; Failed where it is refused.

        What a reply that is too short lacks is read as 0: `link.hello` has it as a finding.
        """
        nonce = random.getrandbits(32) if nonce is None else nonce
        answer = self.ask(MessageType.HELLO, HELLO.pack(nonce, 1, 1, rx_max), tries=HELLO_TRIES)
        if answer.frame.is_error:
            raise Failed(f"HELLO was refused: {answer}")
        return HelloReply.unpack(answer.frame.payload.ljust(HelloReply.FIXED_BYTES, b"\0"))

    def came(self, kind: type[M], since: int = 0) -> list[tuple[float, M]]:
        """The device's messages of this kind after the first `since` that came, with the time at which each came."""
        found = [each for each in self.heard[since:] if each.frame.type == kind.TYPE and each.frame.node == self.node]
        return [(each.at, read(each.frame, kind)) for each in found]

    @property
    def beats(self) -> list[tuple[float, Heartbeat]]:
        """The heartbeats of the device since `connect`, with the time at which each came."""
        return self.came(Heartbeat)

    def beat(
        self, wanted: Callable[[Heartbeat], bool] = lambda beat: True, seconds: float = BEAT, words: str = ""
    ) -> Heartbeat:
        """The next heartbeat that is `wanted`, which `words` say. Unknown where there is none within so many s."""
        since = len(self.heard)

        def found() -> list[Heartbeat]:
            return [beat for _, beat in self.came(Heartbeat, since) if wanted(beat)]

        if not self.until(lambda: bool(found()), seconds):
            raise Unknown(f"no heartbeat {words}received within {seconds:.2g} s")
        return found()[0]

    def command(self, command: int, argument: int = 0) -> Answer:
        """Send a STATE_CMD."""
        return self.ask(MessageType.STATE_CMD, struct.pack("<BxxxI", command, argument))

    def stop(self) -> Answer:
        """Send STOP."""
        return self.command(Command.STOP)


def name_of(kind: int) -> str:
    """A type in words."""
    return MessageType(kind).name


def read(frame: Frame, kind: type[R]) -> R:
    """A message's fields. Raises Failed where it cannot be read."""
    try:
        return kind.unpack(frame.payload)
    except PayloadError as error:
        raise Failed(f"{name_of(frame.type)} of {len(frame.payload)} bytes cannot be decoded: {error}") from None


def refusal(answer: Answer, code: ErrorCode, detail: float | None, what: str) -> str:
    """Evidence that `what` was refused like this, whatever `detail` where that is None. Raises Failed."""
    error = answer.error
    wanted = code.name if detail is None else f"{code.name}, detail {detail:.9g}"
    if error is None:
        raise Failed(f"{what}: {answer}, not refused with {wanted}")
    same = detail is None or error.detail == detail or (detail != detail and error.detail != error.detail)
    if error.code != code or not same or error.request != answer.frame.type:
        raise Failed(f"{what}: {answer}, for type {error.request}; expected {wanted}, for type {answer.frame.type}")
    return f"{what}: {answer}"


def accepted(answer: Answer, what: str) -> str:
    """Evidence that `what` was not refused. Raises Failed."""
    if answer.frame.is_error:
        raise Failed(f"{what}: {answer}")
    return f"{what}: {answer}"


def state_name(state: int) -> str:
    """A state in words."""
    return DriveState(state).name


def steps(ticks: list[int]) -> list[int]:
    """Differences of neighbours."""
    return [after - before for before, after in pairwise(ticks)]

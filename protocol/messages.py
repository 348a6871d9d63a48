"""The messages: one frozen dataclass each, with `pack()` to a payload and `unpack()` from one.

Layouts are little-endian with explicit padding, as in SPEC.md. A request must have exactly its length; a
reply or an unsolicited message may be longer than known here, because a later minor version may append
fields. The payloads of DATA and EDGES are in `protocol.streams`. The codes of `protocol.codes` can be
imported from here. This module knows no framing, no session and no time.
"""

from __future__ import annotations

import math
import struct
from dataclasses import astuple
from typing import Annotated, Self

from protocol.codes import (
    CaptureState,
    CaptureTrigger,
    Command,
    DriveState,
    ErrorCode,
    EventCode,
    Fault,
    Feature,
    MessageType,
    Role,
    SetpointMode,
    StreamEvent,
)
from protocol.errors import LocalProtocolError
from protocol.payload import Message, Payload, PayloadError, Request, text_to_wire, whole_from_wire
from protocol.text import printable

__all__ = [
    "Alive", "BlobRead", "BlobReply", "BlobWrite", "CaptureArm", "CaptureReply", "CaptureState", "CaptureStatus",
    "CaptureTrigger", "Command", "DeviceEvent", "DriveState", "Empty", "ErrorCode",
    "ErrorReply", "EventCode", "Fault", "Feature", "Heartbeat", "Hello", "HelloReply", "Log", "Message",
    "MessageType", "ParamCommit", "ParamGet", "ParamReply", "ParamSet", "ParamStored", "Payload",
    "PayloadError", "REPLIES", "REQUESTS", "Request", "Role", "Setpoint", "SetpointMode", "StateCommand",
    "StateReply", "StreamEvent", "StreamGet", "StreamInfo", "StreamReply", "StreamSet", "StreamStart", "StreamStop",
    "TimeSync", "TimeSyncReply", "UNACKNOWLEDGED", "UNSOLICITED",
]  # fmt: skip


MAX_TICK = 1 << 62  # 7000 years at 20 MHz


def _tick(value: int) -> int:
    if value >= MAX_TICK:
        raise ValueError(f"tick {value} is not below 2^62")
    return value


def _load(value: float) -> float:
    return value if 0.0 <= value < math.inf else 0.0  # unknown


Tick = Annotated[int, _tick]
Load = Annotated[float, _load]


class Hello(Request, type=MessageType.HELLO, layout="IBBH"):
    """Who is there? Legal in every state, changes none. `rx_max`: largest payload the host takes.

    The layout is the same in every major version; a later one may append to it.
    """

    _GROWS = True
    nonce: int
    major_min: int = 1
    major_max: int = 1
    rx_max: int = 1024


class HelloReply(Message, type=MessageType.HELLO, layout="IIBBHH2xIIIIBBBB16s16s24s24s"):
    """What the device is. `rx_max`, `tx_max`: payload bytes; `nodes`: the link has nodes 1..nodes.

    `serial`: of its electronics; `build`: of its firmware. Both may be empty: not told.
    """

    nonce: int
    boot_id: int
    major: int
    minor: int
    rx_max: int
    tx_max: int
    features: Feature
    schema_crc: int
    tick_hz: int
    pwm_hz: int
    state: DriveState
    node: int
    role: Role
    nodes: int
    name: str
    firmware: str
    serial: str
    build: str

    @property
    def ticks_per_period(self) -> int:
        """Device ticks in a PWM period."""
        return self.tick_hz // self.pwm_hz


class TimeSync(Request, type=MessageType.TIME_SYNC):
    """Asks for the device's tick counter."""


class TimeSyncReply(Message, type=MessageType.TIME_SYNC, layout="QQ"):
    """Tick when the request had come, tick when the answer went."""

    rx_tick: Tick
    tx_tick: Tick


class Heartbeat(Message, type=MessageType.HEARTBEAT, layout="QIIIIIHHHHBB2xI"):
    """Health, 10 Hz. `watchdog_ms` is 0xFFFF when the watchdog is not at work; `tx_dropped` counts frames."""

    tick: Tick  # below 2**62
    boot_id: int
    faults: Fault
    first_fault: Fault
    tx_dropped: int
    rx_bad: int
    setpoint_counter: int
    setpoints_rejected: int
    last_tid: int
    watchdog_ms: int
    state: DriveState
    outputs_on: bool
    edges: int = 0


class Alive(Request, type=MessageType.ALIVE, layout="I"):
    """Feeds the watchdog; unacknowledged."""

    counter: int


class BlobRead(Request, type=MessageType.BLOB_READ, layout="BxHI"):
    """Asks for `length` bytes of a blob from `offset`; blob 0 is the descriptor."""

    id: int
    length: int
    offset: int


class _WithData(Payload):
    """A payload that ends with bytes of a blob; its field `length` is their number."""

    def pack(self) -> bytes:
        """Return the payload."""
        *values, data = astuple(self)
        return self._pack_fixed(values) + bytes(data)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Return the message; PayloadError if `length` bytes are not there."""
        values = cls._unpack_fixed(payload)
        data = payload[cls.FIXED_BYTES :]
        if len(data) != values["length"]:
            raise PayloadError(f"{cls.__name__} with {len(data)} bytes, says {values['length']}", bad_length=True)
        return cls(**{**values, "data": data})


class BlobReply(_WithData, Message, type=MessageType.BLOB_READ, layout="BxHII"):
    """A part of a blob whose whole length is `total`; it may be shorter than what was asked for."""

    id: int
    length: int
    offset: int
    total: int
    data: bytes


class BlobWrite(_WithData, Request, type=MessageType.BLOB_WRITE, layout="BxHI"):
    """Writes bytes of a blob that can be written, from `offset` on; blob 4 is the waveform of the test signal."""

    id: int
    length: int
    offset: int
    data: bytes = b""


class ParamGet(Request, type=MessageType.PARAM_GET, layout="H2x"):
    """Asks for a parameter."""

    id: int


class ParamReply(Message, type=MessageType.PARAM_GET, layout="H2xffff"):
    """A parameter's value, range and default, all float32 in the parameter's unit."""

    id: int
    value: float
    lo: float
    hi: float
    default: float


class ParamSet(Request, type=MessageType.PARAM_SET, layout="H2xf"):
    """Sets a parameter."""

    id: int
    value: float


class ParamStored(Message, type=MessageType.PARAM_SET, layout="H2xf"):
    """The value that the device now uses."""

    id: int
    stored: float


class ParamCommit(Request, type=MessageType.PARAM_COMMIT):
    """Stores all parameters for the next boot."""


class StateCommand(Request, type=MessageType.STATE_CMD, layout="B3xI"):
    """Asks for a change of state. `argument`: the boot_id for ARM, the fault bits for FAULT_CLEAR, else 0."""

    command: Command
    argument: int = 0


class StateReply(Message, type=MessageType.STATE_CMD, layout="B3x"):
    """The state after the command."""

    state: DriveState


class Setpoint(Request, type=MessageType.SETPOINT, layout="BxHff"):
    """What to do while RUNNING; unacknowledged, counted in the heartbeat."""

    mode: SetpointMode
    counter: int
    value: float
    value2: float = 0.0


class _WithChannels(Payload):
    """A payload that ends with the ids of channels; its fixed part ends with their number."""

    def pack(self) -> bytes:
        """Return the payload."""
        *values, ids = astuple(self)
        fixed = self._pack_fixed([*values, len(ids)])
        try:
            return fixed + struct.pack(f"<{len(ids)}H", *ids)
        except struct.error as error:
            raise LocalProtocolError(f"{self} cannot be sent: {error}") from None

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Return the message; PayloadError if the number of channels disagrees with the length."""
        values = cls._unpack_fixed(payload)
        n = values["channels"]
        ids = payload[cls.FIXED_BYTES :][: 2 * n if cls._GROWS else None]
        if len(ids) != 2 * n:
            raise PayloadError(f"{cls.__name__} with {len(ids)} bytes of ids for {n} channels", bad_length=True)
        return cls(**{**values, "channels": struct.unpack(f"<{n}H", ids)})


class StreamSet(_WithChannels, Request, type=MessageType.STREAM_SET, layout="BBHHH"):
    """Configures a stopped stream: which channels, how often, how late at most."""

    stream: int
    event: StreamEvent
    decimation: int
    max_latency_ms: int
    channels: tuple[int, ...] = ()


class StreamReply(Message, type=MessageType.STREAM_SET, layout="BxHHHfB3xQ"):
    """The stream as configured. `block`: most samples in a frame; `load`: share of the link, 0 = unknown.

    `tick0`: tick of PWM period 0. `slot`: on CAN, the first one of the stream's frames, else 0.
    """

    stream: int
    cfg_id: int
    sample_bytes: int
    block: int
    load: Load
    slot: int = 0
    tick0: Tick = 0


class StreamStart(Request, type=MessageType.STREAM_START, layout="I"):
    """Starts the streams whose bits are set."""

    mask: int


class StreamStop(Request, type=MessageType.STREAM_STOP, layout="I"):
    """Stops the streams whose bits are set and forgets their configuration."""

    mask: int = 0xFFFFFFFF


class StreamGet(Request, type=MessageType.STREAM_GET, layout="B3x"):
    """Asks how a stream is configured."""

    stream: int


class StreamInfo(_WithChannels, Message, type=MessageType.STREAM_GET, layout="BBBBHHHHH2xQH"):
    """A configured stream: what STREAM_SET asked for, and what its reply said."""

    stream: int
    running: bool
    event: StreamEvent
    slot: int
    decimation: int
    max_latency_ms: int
    cfg_id: int
    sample_bytes: int
    block: int
    tick0: Tick
    channels: tuple[int, ...] = ()


class CaptureArm(_WithChannels, Request, type=MessageType.CAPTURE_ARM, layout="BBHIIfHHH"):
    """Gives up what is held and takes samples until `trigger`; see chapter 19 of SPEC.md.

    `before`, `after`: records before the trigger's, and from it on. `channel` and `level` (in its unit, or s) are the
    trigger's. `edges`: Hall edges that are held at most.
    """

    trigger: CaptureTrigger
    flags: int = 0
    decimation: int = 1
    before: int = 0
    after: int = 1
    level: float = 0.0
    channel: int = 0
    edges: int = 0
    channels: tuple[int, ...] = ()


class CaptureStatus(Request, type=MessageType.CAPTURE_STATUS):
    """Asks where the capture is."""


class CaptureReply(_WithChannels, Message, type=MessageType.CAPTURE_STATUS, layout="BBHHHIIIIIIIIIIQIIH"):
    """Where the capture is, what was armed, and what blob 1 is, which is all 0 until the capture is FROZEN.

    Of blob 1: `first`: records before the trigger's; `records`, `edges`: how many it has; `edges_lost`: edges of its
    time that found no room; `first_edge`: number of its first edge since boot; `size`, `crc`; `index`, `tick`: of the
    trigger's record; `faults`: at the trigger. `room`: bytes of memory for captures.
    """

    state: CaptureState
    trigger: CaptureTrigger
    number: int
    decimation: int
    sample_bytes: int
    before: int
    after: int
    first: int
    records: int
    edges: int
    edges_lost: int
    first_edge: int
    size: int
    crc: int
    room: int
    tick: Tick
    index: int
    faults: Fault
    channels: tuple[int, ...] = ()


class Empty(Payload):
    """The reply that says no more than "done"."""


class ErrorReply(Payload, layout="HBxf"):
    """A refusal of a request of type `request`. An unknown code stays a plain number."""

    code: int
    request: int
    detail: float = 0.0

    def __str__(self) -> str:
        """One line for people."""
        return f"{ErrorCode(self.code).name} ({self.detail:g})"


class DeviceEvent(Message, type=MessageType.EVENT, layout="QHBxff"):
    """Something happened at `tick`; `arg` and `detail` go with the code. An unknown code stays a plain number."""

    tick: Tick
    code: int
    node: int
    arg: float
    detail: float = 0.0

    @property
    def number(self) -> int | None:
        """`arg` where it stands for a whole number (a state, fault bits, a code); None if it is none."""
        return whole_from_wire(self.arg)

    @property
    def faults(self) -> Fault:
        """The bits that a FAULT adds, else none. A FAULT whose bits cannot be read is INTERNAL: a fault it is."""
        return Fault(0) if self.code != EventCode.FAULT else Fault(self.number or Fault.INTERNAL)


class Log(Message, type=MessageType.LOG, layout="B"):
    """A line of text; `level` as syslog: 3 error, 4 warning, 6 information, 7 debug."""

    level: int
    text: str

    def pack(self) -> bytes:
        """Return the payload."""
        return self._pack_fixed([self.level]) + text_to_wire(self.text)

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Return the message."""
        return cls(**cls._unpack_fixed(payload), text=printable(payload[1:].decode("utf-8", "replace")))


REQUESTS: dict[int, type[Request]] = {
    cls.TYPE: cls
    for cls in (
        Hello, TimeSync, Alive, BlobRead, BlobWrite, ParamGet, ParamSet, ParamCommit,
        StateCommand, Setpoint, StreamSet, StreamStart, StreamStop, StreamGet, CaptureArm, CaptureStatus,
    )
}  # fmt: skip
UNACKNOWLEDGED = frozenset({MessageType.ALIVE, MessageType.SETPOINT})

_ANSWERS = (
    HelloReply, TimeSyncReply, BlobReply, ParamReply, ParamStored, StateReply, StreamReply, StreamInfo, CaptureReply,
)  # fmt: skip
REPLIES: dict[int, type[Payload]] = {
    **{cls.TYPE: cls for cls in _ANSWERS},
    MessageType.CAPTURE_ARM: CaptureReply,
    **dict.fromkeys(
        (MessageType.PARAM_COMMIT, MessageType.BLOB_WRITE, MessageType.STREAM_START, MessageType.STREAM_STOP), Empty
    ),
}
UNSOLICITED: dict[int, type[Message]] = {cls.TYPE: cls for cls in (Heartbeat, DeviceEvent, Log)}

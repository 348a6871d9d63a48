"""The messages: one frozen dataclass each, with `pack()` to a payload and `unpack()` from one.

Layouts are little-endian with explicit padding, as in SPEC.md. A request must have exactly its length; a
reply or an unsolicited message may be longer than known here, because a later minor version may append
fields. The payloads of DATA and EDGES are in `protocol.streams`. The codes of `protocol.codes` can be
imported from here. This module knows no framing, no session and no time.
"""

from __future__ import annotations

import math
import struct
from dataclasses import astuple, dataclass
from typing import Annotated, Self

from protocol.codes import (
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
    "Alive", "BlobRead", "BlobReply", "Command", "DeviceEvent", "DriveState", "Empty", "ErrorCode",
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


@dataclass(frozen=True, slots=True)
class Hello(Request):
    """Who is there? Legal in every state, changes none. `rx_max`: largest payload the host takes.

    The layout is the same in every major version; a later one may append to it.
    """

    TYPE = MessageType.HELLO
    _GROWS = True
    _LAYOUT = struct.Struct("<IBBH")
    nonce: int
    major_min: int = 1
    major_max: int = 1
    rx_max: int = 1024


@dataclass(frozen=True, slots=True)
class HelloReply(Message):
    """What the device is. `rx_max`, `tx_max`: payload bytes; `nodes`: the link has nodes 1..nodes.

    `serial`: of its electronics; `build`: of its firmware. Both may be empty: not told.
    """

    TYPE = MessageType.HELLO
    _LAYOUT = struct.Struct("<IIBBHH2xIIIIBBBB16s16s24s24s")
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


@dataclass(frozen=True, slots=True)
class TimeSync(Request):
    """Asks for the device's tick counter."""

    TYPE = MessageType.TIME_SYNC


@dataclass(frozen=True, slots=True)
class TimeSyncReply(Message):
    """Tick when the request had come, tick when the answer went."""

    TYPE = MessageType.TIME_SYNC
    _LAYOUT = struct.Struct("<QQ")
    rx_tick: Tick
    tx_tick: Tick


@dataclass(frozen=True, slots=True)
class Heartbeat(Message):
    """Health, 10 Hz. `watchdog_ms` is 0xFFFF when the watchdog is not at work; `tx_dropped` counts frames."""

    TYPE = MessageType.HEARTBEAT
    _LAYOUT = struct.Struct("<QIIIIIHHHHBB2xI")
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


@dataclass(frozen=True, slots=True)
class Alive(Request):
    """Feeds the watchdog; unacknowledged."""

    TYPE = MessageType.ALIVE
    _LAYOUT = struct.Struct("<I")
    counter: int


@dataclass(frozen=True, slots=True)
class BlobRead(Request):
    """Asks for `length` bytes of a blob from `offset`; blob 0 is the descriptor."""

    TYPE = MessageType.BLOB_READ
    _LAYOUT = struct.Struct("<BxHI")
    id: int
    length: int
    offset: int


@dataclass(frozen=True, slots=True)
class BlobReply(Message):
    """A part of a blob whose whole length is `total`; it may be shorter than what was asked for."""

    TYPE = MessageType.BLOB_READ
    _LAYOUT = struct.Struct("<BxHII")
    FIXED_BYTES = _LAYOUT.size  # before the data
    id: int
    length: int
    offset: int
    total: int
    data: bytes

    def pack(self) -> bytes:
        """Return the payload."""
        return self._pack_fixed([self.id, self.length, self.offset, self.total]) + self.data

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Return the message; PayloadError if `length` bytes are not there."""
        values = cls._unpack_fixed(payload)
        data = payload[cls._LAYOUT.size :]
        if len(data) != values["length"]:
            raise PayloadError(f"BlobReply with {len(data)} bytes, says {values['length']}", bad_length=True)
        return cls(**values, data=data)


@dataclass(frozen=True, slots=True)
class ParamGet(Request):
    """Asks for a parameter."""

    TYPE = MessageType.PARAM_GET
    _LAYOUT = struct.Struct("<H2x")
    id: int


@dataclass(frozen=True, slots=True)
class ParamReply(Message):
    """A parameter's value, range and default, all float32 in the parameter's unit."""

    TYPE = MessageType.PARAM_GET
    _LAYOUT = struct.Struct("<H2xffff")
    id: int
    value: float
    lo: float
    hi: float
    default: float


@dataclass(frozen=True, slots=True)
class ParamSet(Request):
    """Sets a parameter."""

    TYPE = MessageType.PARAM_SET
    _LAYOUT = struct.Struct("<H2xf")
    id: int
    value: float


@dataclass(frozen=True, slots=True)
class ParamStored(Message):
    """The value that the device now uses."""

    TYPE = MessageType.PARAM_SET
    _LAYOUT = struct.Struct("<H2xf")
    id: int
    stored: float


@dataclass(frozen=True, slots=True)
class ParamCommit(Request):
    """Stores all parameters for the next boot."""

    TYPE = MessageType.PARAM_COMMIT


@dataclass(frozen=True, slots=True)
class StateCommand(Request):
    """Asks for a change of state. `argument`: the boot_id for ARM, the fault bits for FAULT_CLEAR, else 0."""

    TYPE = MessageType.STATE_CMD
    _LAYOUT = struct.Struct("<B3xI")
    command: Command
    argument: int = 0


@dataclass(frozen=True, slots=True)
class StateReply(Message):
    """The state after the command."""

    TYPE = MessageType.STATE_CMD
    _LAYOUT = struct.Struct("<B3x")
    state: DriveState


@dataclass(frozen=True, slots=True)
class Setpoint(Request):
    """What to do while RUNNING; unacknowledged, counted in the heartbeat."""

    TYPE = MessageType.SETPOINT
    _LAYOUT = struct.Struct("<BxHff")
    mode: SetpointMode
    counter: int
    value: float
    value2: float = 0.0


class _WithChannels(Payload):
    """A payload that ends with the ids of channels; its fixed part ends with their number."""

    __slots__ = ()
    channels: tuple[int, ...]

    def pack(self) -> bytes:
        """Return the payload."""
        n = len(self.channels)
        fixed = self._pack_fixed([*astuple(self)[:-1], n])  # type: ignore[call-overload]
        try:
            return fixed + struct.pack(f"<{n}H", *self.channels)
        except struct.error as error:
            raise LocalProtocolError(f"{self} cannot be sent: {error}") from None

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Return the message; PayloadError if the number of channels disagrees with the length."""
        values = cls._unpack_fixed(payload)
        n = values["channels"]
        ids = payload[cls._LAYOUT.size :][: 2 * n if cls._GROWS else None]
        if len(ids) != 2 * n:
            raise PayloadError(f"{cls.__name__} with {len(ids)} bytes of ids for {n} channels", bad_length=True)
        return cls(**{**values, "channels": struct.unpack(f"<{n}H", ids)})


@dataclass(frozen=True, slots=True)
class StreamSet(_WithChannels, Request):
    """Configures a stopped stream: which channels, how often, how late at most."""

    TYPE = MessageType.STREAM_SET
    _LAYOUT = struct.Struct("<BBHHH")
    FIXED_BYTES = _LAYOUT.size  # before the ids
    stream: int
    event: StreamEvent
    decimation: int
    max_latency_ms: int
    channels: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class StreamReply(Message):
    """The stream as configured. `block`: most samples in a frame; `load`: share of the link, 0 = unknown.

    `tick0`: tick of PWM period 0. `slot`: on CAN, the first one of the stream's frames, else 0.
    """

    TYPE = MessageType.STREAM_SET
    _LAYOUT = struct.Struct("<BxHHHfB3xQ")
    stream: int
    cfg_id: int
    sample_bytes: int
    block: int
    load: Load
    slot: int = 0
    tick0: Tick = 0


@dataclass(frozen=True, slots=True)
class StreamStart(Request):
    """Starts the streams whose bits are set."""

    TYPE = MessageType.STREAM_START
    _LAYOUT = struct.Struct("<I")
    mask: int


@dataclass(frozen=True, slots=True)
class StreamStop(Request):
    """Stops the streams whose bits are set and forgets their configuration."""

    TYPE = MessageType.STREAM_STOP
    _LAYOUT = struct.Struct("<I")
    mask: int = 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class StreamGet(Request):
    """Asks how a stream is configured."""

    TYPE = MessageType.STREAM_GET
    _LAYOUT = struct.Struct("<B3x")
    stream: int


@dataclass(frozen=True, slots=True)
class StreamInfo(_WithChannels, Message):
    """A configured stream: what STREAM_SET asked for, and what its reply said."""

    TYPE = MessageType.STREAM_GET
    _LAYOUT = struct.Struct("<BBBBHHHHH2xQH")
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


@dataclass(frozen=True, slots=True)
class Empty(Payload):
    """The reply that says no more than "done"."""


@dataclass(frozen=True, slots=True)
class ErrorReply(Payload):
    """A refusal of a request of type `request`. An unknown code stays a plain number."""

    _LAYOUT = struct.Struct("<HBxf")
    code: int
    request: int
    detail: float = 0.0

    def __str__(self) -> str:
        """One line for people."""
        return f"{ErrorCode(self.code).name} ({self.detail:g})"


@dataclass(frozen=True, slots=True)
class DeviceEvent(Message):
    """Something happened at `tick`; `arg` and `detail` go with the code. An unknown code stays a plain number."""

    TYPE = MessageType.EVENT
    _LAYOUT = struct.Struct("<QHBxff")
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


@dataclass(frozen=True, slots=True)
class Log(Message):
    """A line of text; `level` as syslog: 3 error, 4 warning, 6 information, 7 debug."""

    TYPE = MessageType.LOG
    _LAYOUT = struct.Struct("<B")
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
        Hello, TimeSync, Alive, BlobRead, ParamGet, ParamSet, ParamCommit,
        StateCommand, Setpoint, StreamSet, StreamStart, StreamStop, StreamGet,
    )
}  # fmt: skip
UNACKNOWLEDGED = frozenset({MessageType.ALIVE, MessageType.SETPOINT})

REPLIES: dict[int, type[Payload]] = {
    MessageType.HELLO: HelloReply,
    MessageType.TIME_SYNC: TimeSyncReply,
    MessageType.BLOB_READ: BlobReply,
    MessageType.PARAM_GET: ParamReply,
    MessageType.PARAM_SET: ParamStored,
    MessageType.PARAM_COMMIT: Empty,
    MessageType.STATE_CMD: StateReply,
    MessageType.STREAM_SET: StreamReply,
    MessageType.STREAM_START: Empty,
    MessageType.STREAM_STOP: Empty,
    MessageType.STREAM_GET: StreamInfo,
}
UNSOLICITED: dict[int, type[Message]] = {cls.TYPE: cls for cls in (Heartbeat, DeviceEvent, Log)}

"""The numbers of protocol/SPEC.md, copied by hand from its tables; nothing here comes from `protocol`."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import NamedTuple

REPLY, ERROR = 0x10, 0x20
MAJOR = 1
MAX_PAYLOAD = 1024


class Type(IntEnum):
    HELLO = 0x01
    TIME_SYNC = 0x02
    HEARTBEAT = 0x04
    ALIVE = 0x05
    BLOB_READ = 0x10
    PARAM_GET = 0x11
    PARAM_SET = 0x12
    PARAM_COMMIT = 0x13
    STATE_CMD = 0x20
    SETPOINT = 0x21
    STREAM_SET = 0x30
    STREAM_START = 0x31
    STREAM_STOP = 0x32
    STREAM_GET = 0x33
    DATA = 0x40
    EDGES = 0x41
    EVENT = 0x42
    LOG = 0x43


class State(IntEnum):
    BOOT = 0
    IDLE = 1
    ARMED = 2
    RUNNING = 3
    FAULT = 4


class Command(IntEnum):
    ARM = 1
    START = 2
    STOP = 3
    FAULT_CLEAR = 4


class Mode(IntEnum):
    SPEED = 1
    CURRENT = 2
    TORQUE = 3


class Code(IntEnum):
    """Codes of refusals."""

    UNKNOWN_TYPE = 1
    BAD_LENGTH = 2
    BAD_VALUE = 3
    OUT_OF_RANGE = 4
    WRONG_STATE = 5
    BAD_TOKEN = 6
    UNKNOWN_ID = 7
    READ_ONLY = 8
    DOES_NOT_FIT = 9
    FAULTS_CHANGED = 10
    BUSY = 12
    BAD_VERSION = 13
    UNKNOWN_NODE = 14
    NOT_SUPPORTED = 15


class Event(IntEnum):
    STATE_CHANGED = 1
    FAULT = 2
    SETPOINT_REJECTED = 3
    ARM_LAPSED = 4


class Fault(IntFlag):
    WATCHDOG = 1


class Feature(IntFlag):
    NONE = 0
    EDGES = 1


class Role(IntEnum):
    DRIVE = 1


class Raw(IntEnum):
    U8 = 1
    I16 = 4
    F32 = 7


DTYPE = {Raw.U8: "u1", Raw.I16: "<i2", Raw.F32: "<f4"}


class Unit(IntEnum):
    NONE = 0
    RAD = 1
    RAD_PER_S = 2
    A = 3
    V = 4
    S = 6
    OHM = 8
    H = 9
    VS = 10
    RAD_PER_S2 = 14


class Flag(IntFlag):
    NONE = 0
    CHANNEL = 1
    PARAMETER = 2
    ESTIMATE = 8
    REFERENCE = 16
    WRAPS = 32
    READ_ONLY = 64
    IDLE_ONLY = 128
    WHOLE = 256


PWM, EDGE_STREAM = 0, 2
"""Events of STREAM_SET."""

HALL_CODES = (1, 3, 2, 6, 4, 5)
"""By sector of the electrical angle."""


class Message(NamedTuple):
    """A frame without its wrapping: what byte links and CAN have in common."""

    type: int
    flags: int
    tid: int
    node: int
    payload: bytes


class Refusal(Exception):
    """A request is refused with this code and detail."""

    def __init__(self, code: int, detail: float = 0.0) -> None:
        super().__init__(code, detail)
        self.code, self.detail = code, detail

"""The numbers on the wire that have names: message types, states, faults, commands, error and event codes.

This module holds no layout and no behaviour.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Self


class OpenEnum(IntEnum):
    """Numbers of which a later version may have more: one without a name is kept, and called `word` and its number."""

    _word: str

    def __init_subclass__(cls, word: str, **others: object) -> None:
        super().__init_subclass__(**others)
        cls._word = word

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        if not isinstance(value, int):
            return None
        member = int.__new__(cls, value)
        member._name_ = f"{cls._word} {value}"
        member._value_ = value
        return member


class MessageType(OpenEnum, word="type"):
    """Byte 0 of a frame."""

    HELLO = 0x01
    TIME_SYNC = 0x02
    HEARTBEAT = 0x04
    ALIVE = 0x05
    BLOB_READ = 0x10
    PARAM_GET = 0x11
    PARAM_SET = 0x12
    PARAM_COMMIT = 0x13
    BLOB_WRITE = 0x14
    STATE_CMD = 0x20
    SETPOINT = 0x21
    STREAM_SET = 0x30
    STREAM_START = 0x31
    STREAM_STOP = 0x32
    STREAM_GET = 0x33
    CAPTURE_ARM = 0x38
    CAPTURE_STATUS = 0x39
    DATA = 0x40
    EDGES = 0x41
    EVENT = 0x42
    LOG = 0x43


class DriveState(OpenEnum, word="state"):
    """State of a device; the outputs are on in RUNNING only."""

    BOOT = 0
    IDLE = 1
    ARMED = 2
    RUNNING = 3
    FAULT = 4


class Fault(IntFlag):
    """Bits of a fault mask."""

    WATCHDOG = 1  # no ALIVE or SETPOINT in time
    OVERCURRENT = 2  # a phase current beyond its limit
    OVERSPEED = 4  # the shaft faster than allowed
    UNDERVOLTAGE = 8  # DC link too low
    OVERVOLTAGE = 16  # DC link too high
    HALL = 32  # illegal codes or sequences from the Hall sensors
    INTERNAL = 64  # the firmware's own
    OVERLOAD = 128  # more current for longer than the winding bears


def fault_names(faults: int) -> list[str]:
    """Names of the bits in a fault mask; those that this version does not know as one number in hex."""
    unknown = faults & ~sum(Fault)
    return [fault.name or "" for fault in Fault if fault & faults] + ([f"0x{unknown:x}"] if unknown else [])


class Command(IntEnum):
    """What STATE_CMD asks for."""

    ARM = 1
    START = 2
    STOP = 3
    FAULT_CLEAR = 4


class SetpointMode(OpenEnum, word="mode"):
    """What the values of a SETPOINT mean."""

    SPEED = 1  # value: mechanical rad/s
    CURRENT = 2  # value: i_q in A, value2: i_d in A
    TORQUE = 3  # value: N·m (a load machine)
    VOLTAGE = 4  # value: u_q in V, value2: u_d in V (chapter 20)


class StreamEvent(OpenEnum, word="event"):
    """What makes a stream take a record."""

    PWM = 0  # a sample of the chosen channels every `decimation` PWM periods
    SLOW = 1  # reserved for a task slower than the PWM
    EDGES = 2  # every Hall edge
    MEAN = 3  # the mean of the chosen channels over every `decimation` PWM periods


class Role(OpenEnum, word="role"):
    """What a node is on the bench."""

    DRIVE = 1
    LOAD = 2


class Feature(IntFlag):
    """Optional abilities of a device, in HELLO."""

    EDGES = 1  # timestamped Hall edges can be streamed
    COMMIT = 2  # parameters can be stored for the next boot
    SIMULATED = 4  # no hardware moves
    CAPTURE = 8  # samples are held in the device's memory and frozen by a trigger (chapter 19)
    COMMISSION = 16  # modes without a sensor, and test signals (chapter 20)
    MEANINGS = 32  # blob 3 tells what parameters and channels mean
    WAVEFORM = 64  # blob 4 takes the samples of a test signal (chapter 20)
    MEANS = 128  # the stream event MEAN


class CaptureTrigger(OpenEnum, word="trigger"):
    """What freezes a capture."""

    OFF = 0  # nothing: what is held is given up
    NOW = 1  # the request itself
    ABOVE = 2  # the channel is above `level`
    BELOW = 3  # the channel is below `level`
    RISES = 4  # the channel was not above `level` in the period before, and is now
    FALLS = 5  # the channel was not below `level` in the period before, and is now
    CHANGES = 6  # the channel has another raw value than in the period before
    FAULT = 7  # a fault adds a bit to `faults`
    STATE = 8  # the state changes
    ILLEGAL = 9  # a Hall edge has the bit illegal
    PULSE = 10  # a Hall edge takes back the edge before it, within `level` seconds


class CaptureState(OpenEnum, word="capture state"):
    """Where a capture is."""

    OFF = 0  # the device holds nothing and waits for nothing
    ARMED = 1  # samples are taken, the trigger is awaited
    TRIGGERED = 2  # the trigger has come, samples after it are still taken
    FROZEN = 3  # the capture is complete, and blob 1 is it


class TestSignal(OpenEnum, word="test signal"):
    """Values of the parameter `test`: what the test signal is added to."""

    __test__ = False  # pytest: this is no test
    OFF = 0
    U_D = 1  # the d voltage, after the loop
    U_Q = 2  # the q voltage, after the loop
    I_D = 3  # the reference of the d current
    I_Q = 4  # the reference of the q current
    SPEED = 5  # the reference of the speed, after the ramp


class ErrorCode(OpenEnum, word="error"):
    """Why a request was refused; `detail` is the number that goes with it."""

    UNKNOWN_TYPE = 1  # detail: the type
    BAD_LENGTH = 2  # detail: the payload's length
    BAD_VALUE = 3  # detail: the value
    OUT_OF_RANGE = 4  # detail: the limit
    WRONG_STATE = 5  # detail: the state
    BAD_TOKEN = 6  # detail: 0
    UNKNOWN_ID = 7  # detail: the id
    READ_ONLY = 8  # detail: the id
    DOES_NOT_FIT = 9  # detail: what would fit
    FAULTS_CHANGED = 10  # detail: the faults now
    FAULT_PERSISTS = 11  # detail: the faults whose cause is still there
    BUSY = 12  # detail: what is busy
    BAD_VERSION = 13  # detail: the major that the device speaks
    UNKNOWN_NODE = 14  # detail: the node
    NOT_SUPPORTED = 15  # detail: what was asked for
    STORE_FAILED = 16  # detail: the device's own


class EventCode(OpenEnum, word="event"):
    """What an EVENT reports."""

    STATE_CHANGED = 1  # arg: the new DriveState
    FAULT = 2  # arg: the bits that were added
    SETPOINT_REJECTED = 3  # arg: the ErrorCode
    ARM_LAPSED = 4  # arg: seconds that ARMED lasts
    PARAM_CHANGED = 5  # arg: the parameter's id
    CAPTURED = 6  # arg: the number of the capture that is now FROZEN

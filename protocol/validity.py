"""What a host cannot work with in what a device says of itself: decided here, and nowhere else.

Each function raises DeviceDefect, in one line that names the field and the number. What is only odd passes, and is
shown as it is. SPEC.md, chapter 4, has the same list. What cannot even be read is a `PayloadError` of its message.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from protocol.errors import DeviceDefect, VersionError
from protocol.framing import MAJOR
from protocol.messages import BlobReply, HelloReply, ParamReply, Payload
from protocol.signals import RawType

RECORD_BYTES = 32
MAX_RECORDS = 4096
MAX_DESCRIPTOR = MAX_RECORDS * RECORD_BYTES
MIN_RX_MAX = 128  # payload bytes that either side takes at least


def check_reply(message: Payload, node: int) -> None:
    """Check a reply of `node`, whatever its type. VersionError for a device of another major."""
    if isinstance(message, HelloReply):
        _check_hello(message, node)
    elif isinstance(message, BlobReply) and message.id == 0:
        check_descriptor_size(message.total, f"node {node}")


def _check_hello(hello: HelloReply, node: int) -> None:
    who = f"HELLO of node {node}"
    if hello.major != MAJOR:
        raise VersionError(f"{who}: the device speaks HBP {hello.major}.{hello.minor}, this host {MAJOR}: update one")
    if hello.node != node or not node:
        raise DeviceDefect(f"{who}: node is {hello.node}, must be the frame's and 1..255")
    if hello.rx_max < MIN_RX_MAX:
        raise DeviceDefect(f"{who}: rx_max is {hello.rx_max}, must be at least {MIN_RX_MAX}")
    if not hello.pwm_hz:
        raise DeviceDefect(f"{who}: pwm_hz is 0, must be at least 1")
    if not hello.tick_hz or hello.tick_hz % hello.pwm_hz:
        raise DeviceDefect(f"{who}: tick_hz is {hello.tick_hz}, must be a multiple of pwm_hz = {hello.pwm_hz}")
    if not hello.name:
        raise DeviceDefect(f"{who}: name is empty")


def check_descriptor_size(total: int, whose: str) -> None:
    """Check the length of a descriptor in bytes."""
    if total % RECORD_BYTES or total > MAX_DESCRIPTOR:
        raise DeviceDefect(
            f"the descriptor of {whose} has {total} bytes, must be at most {MAX_RECORDS} records of {RECORD_BYTES}"
        )


def check_channel(raw_type: int, scale: float, offset: float, name: str, whose: str) -> None:
    """Check what a channel's record says of its values; `name` may be empty."""
    if raw_type not in RawType._value2member_map_:
        raise DeviceDefect(f"the descriptor of {whose}: channel {name!r} has the unknown type {raw_type}")
    if not (math.isfinite(scale) and math.isfinite(offset) and scale):
        raise DeviceDefect(
            f"the descriptor of {whose}: channel {name!r} has scale {scale:g} and offset {offset:g}, "
            "must be finite and the scale not 0"
        )


def check_names(kind: str, records: Iterable[tuple[int, str]], whose: str) -> None:
    """Check ids and names of a `kind` (channel, parameter): none lacks a name, or has the id or name of another."""
    seen: set[int | str] = set()
    for number, name in records:
        if not name:
            raise DeviceDefect(f"the descriptor of {whose}: {kind} {number} has an empty name")
        for key in (number, name):
            if key in seen:
                raise DeviceDefect(f"the descriptor of {whose}: {kind} {key!r} comes twice")
            seen.add(key)


def check_parameter(name: str, reply: ParamReply, whose: str) -> None:
    """Check a parameter's value. Its range and default may be anything: they are only shown."""
    if not math.isfinite(reply.value):
        raise DeviceDefect(f"parameter {name!r} of {whose} is {reply.value:g}, must be a finite number")
    if name == "n_p" and not (reply.value >= 1 and reply.value == int(reply.value)):
        raise DeviceDefect(f"parameter 'n_p' of {whose} is {reply.value:g}, must be a whole number of pole pairs")

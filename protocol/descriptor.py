"""The descriptor: what a drive can telemeter and which parameters it has, as 32-byte records.

The device's own table goes out as blob 0, and its CRC-32 is the `schema_crc` of HELLO. A host builds
everything from the descriptor that it read and nothing from `protocol.signals`. Ranges and values of
parameters are not in it: they come with PARAM_GET. This module never does I/O.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self
from zlib import crc32

import numpy as np

from protocol.errors import LocalProtocolError
from protocol.payload import text_from_wire
from protocol.signals import Flag, Parameter, RawType, Signal, Unit
from protocol.validity import check_channel, check_descriptor_size, check_names

NAME_BYTES = 16

_RECORD = struct.Struct("<HBBHHff16s")


@dataclass(frozen=True, slots=True)
class Channel:
    """One record: physical value = raw * scale + offset in `unit`. Scale and offset are float32 values."""

    id: int
    name: str
    unit: Unit
    raw: RawType
    scale: float
    flags: Flag
    offset: float = 0.0


@dataclass(frozen=True)
class Descriptor:
    """The channels that a device can stream, in the order of its samples, and its parameters."""

    channels: tuple[Channel, ...]
    parameters: tuple[Channel, ...]

    @classmethod
    def of(cls, signals: Iterable[Signal], parameters: Iterable[Parameter]) -> Self:
        """Return the descriptor of a device with these tables."""
        return cls(
            tuple(Channel(s.id, s.name, s.unit, s.raw, _f32(s.scale), s.flags, _f32(s.offset)) for s in signals),
            tuple(Channel(p.id, p.name, p.unit, RawType.F32, 1.0, p.flags) for p in parameters),
        )

    def pack(self) -> bytes:
        """Return the blob; LocalProtocolError if a name has not 1 to 16 bytes or a number does not fit."""
        blob = bytearray()
        for record in (*self.channels, *self.parameters):
            name = record.name.encode()
            if not 1 <= len(name) <= NAME_BYTES:
                raise LocalProtocolError(f"name {record.name!r}: {len(name)} bytes, 1 to {NAME_BYTES} fit")
            try:
                blob += _RECORD.pack(
                    record.id, record.raw, record.unit, record.flags, 0, record.scale, record.offset, name
                )
            except (struct.error, OverflowError) as error:
                raise LocalProtocolError(f"record {record.name!r} does not fit: {error}") from None
        return bytes(blob)

    @classmethod
    def unpack(cls, blob: bytes, whose: str = "the device") -> Self:
        """Return the descriptor in a blob; `whose` names the device in errors.

        Records of neither kind, and flags and units that are unknown here, are no error. DeviceDefect if a host cannot
        work with the descriptor: see `protocol.validity`.
        """
        check_descriptor_size(len(blob), whose)
        channels: list[Channel] = []
        parameters: list[Channel] = []
        for number, raw_type, unit, bits, _, scale, offset, raw_name in _RECORD.iter_unpack(blob):
            name, flags = text_from_wire(raw_name), Flag(bits)
            if flags & Flag.CHANNEL:
                check_channel(raw_type, scale, offset, name, whose)
                channels.append(Channel(number, name, Unit(unit), RawType(raw_type), scale, flags, offset))
            if flags & Flag.PARAMETER:
                parameters.append(Channel(number, name, Unit(unit), RawType.F32, 1.0, flags))
        for kind, records in (("channel", channels), ("parameter", parameters)):
            check_names(kind, ((record.id, record.name) for record in records), whose)
        return cls(tuple(channels), tuple(parameters))

    @cached_property
    def crc(self) -> int:
        """CRC-32 of the blob: `schema_crc`."""
        return crc32(self.pack())

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """Packed structured dtype with a field per channel, in order: a full sample of this device."""
        return sample_dtype(self.channels)

    def channel(self, name: str) -> Channel:
        """Return the channel of that name; KeyError, naming what there is, if there is none."""
        return _by_name("channel", self.channels, name)

    def parameter(self, name: str) -> Channel:
        """Return the parameter of that name; KeyError, naming what there is, if there is none."""
        return _by_name("parameter", self.parameters, name)


def sample_dtype(channels: Sequence[Channel | Signal]) -> np.dtype[np.void]:
    """Return the packed structured dtype of a sample of these channels."""
    return np.dtype([(channel.name, channel.raw.dtype) for channel in channels])


def _by_name(kind: str, records: tuple[Channel, ...], name: str) -> Channel:
    for record in records:
        if record.name == name:
            return record
    raise KeyError(f"no {kind} {name!r}; there are: {', '.join(record.name for record in records)}")


def _f32(value: float) -> float:
    return float(np.float32(value))

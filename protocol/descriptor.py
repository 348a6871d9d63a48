"""The descriptor: what a drive can telemeter and which parameters it has, as 32-byte records.

The device's own table goes out as blob 0, and its CRC-32 is the `schema_crc` of HELLO. A host builds
everything from the descriptor that it read and nothing from `protocol.signals`. Ranges and values of
parameters are not in it: they come with PARAM_GET. This module never does I/O.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self
from zlib import crc32

import numpy as np

from protocol.errors import LocalProtocolError
from protocol.messages import PayloadError
from protocol.payload import text_from_wire
from protocol.signals import Flag, Parameter, RawType, Signal, Unit

RECORD_BYTES = 32
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
        """Return the blob; LocalProtocolError if a name is longer than 16 bytes or a number does not fit."""
        blob = bytearray()
        for record in (*self.channels, *self.parameters):
            name = record.name.encode()
            if len(name) > NAME_BYTES:
                raise LocalProtocolError(f"name {record.name!r}: {len(name)} bytes, at most {NAME_BYTES} fit")
            try:
                blob += _RECORD.pack(
                    record.id, record.raw, record.unit, record.flags, 0, record.scale, record.offset, name
                )
            except (struct.error, OverflowError) as error:
                raise LocalProtocolError(f"record {record.name!r} does not fit: {error}") from None
        return bytes(blob)

    @classmethod
    def unpack(cls, blob: bytes) -> Self:
        """Return the descriptor in a blob.

        A unit unknown here reads as a pure number. PayloadError if the blob is no whole number of records, a
        type is unknown, or an id or name comes twice among the channels or among the parameters.
        """
        if len(blob) % RECORD_BYTES:
            raise PayloadError(f"descriptor of {len(blob)} bytes: not in {RECORD_BYTES}-byte records")
        channels: list[Channel] = []
        parameters: list[Channel] = []
        for number, raw_type, unit, bits, _, scale, offset, raw_name in _RECORD.iter_unpack(blob):
            name = text_from_wire(raw_name)
            try:
                kind = RawType(raw_type)
            except ValueError:
                raise PayloadError(f"descriptor: {name!r} has the unknown type {raw_type}") from None
            if bits & Flag.CHANNEL and not (math.isfinite(offset) and math.isfinite(scale) and scale):
                raise PayloadError(f"descriptor: {name!r} has scale {scale:g} and offset {offset:g}")
            known = Unit(unit) if unit in Unit._value2member_map_ else Unit.NONE
            record = Channel(number, name, known, kind, scale, Flag(bits), offset)
            if record.flags & Flag.CHANNEL:
                channels.append(record)
            if record.flags & Flag.PARAMETER:
                parameters.append(record)
        for kind_name, records in (("channel", channels), ("parameter", parameters)):
            _require_unique(kind_name, records)
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


def _require_unique(kind: str, records: list[Channel]) -> None:
    seen: set[int | str] = set()
    for record in records:
        for key in (record.id, record.name):
            if key in seen:
                raise PayloadError(f"descriptor: {kind} {key!r} comes twice")
            seen.add(key)


def _f32(value: float) -> float:
    return float(np.float32(value))

"""What all payloads share: a dataclass whose fields stand in the order of a struct, with `pack` and `unpack`.

This module knows no message.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, ClassVar, Self, dataclass_transform, get_type_hints

from protocol.codes import MessageType
from protocol.errors import LocalProtocolError, RemoteProtocolError
from protocol.text import printable


class PayloadError(RemoteProtocolError, ValueError):
    """A payload that cannot be read: wrong length, or a value that the message does not have."""

    def __init__(self, message: str, bad_length: bool = False, value: float = 0.0) -> None:
        super().__init__(message)
        self.bad_length = bad_length
        self.value = value


@dataclass_transform(frozen_default=True)
class Payload:
    """A payload: each subclass is a frozen dataclass whose fields stand in the order of its `layout`.

    That is little-endian, as `struct` has it. What is made of a number or of text on the wire is the field's
    annotation; of `Annotated` the function in it.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]
    FIXED_BYTES: ClassVar[int] = 0
    """Bytes of the layout, before a part of any length."""
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("")
    _GROWS: ClassVar[bool] = True  # a longer payload is legal: a later minor may append

    def __init_subclass__(cls, layout: str = "") -> None:
        dataclass(frozen=True)(cls)
        cls._LAYOUT = struct.Struct(f"<{layout}")
        cls.FIXED_BYTES = cls._LAYOUT.size

    def pack(self) -> bytes:
        """Return the payload; LocalProtocolError if a number does not fit its field. Text is cut to what fits."""
        return self._pack_fixed([getattr(self, field.name) for field in fields(self)])

    def _pack_fixed(self, values: list[Any]) -> bytes:
        wire = [text_to_wire(value) if isinstance(value, str) else value for value in values]
        try:
            return self._LAYOUT.pack(*wire)
        except (struct.error, OverflowError) as error:
            raise LocalProtocolError(f"{self} cannot be sent: {error}") from None

    @classmethod
    def unpack(cls, payload: bytes) -> Self:
        """Return the message; PayloadError if the payload cannot be read as one."""
        if not cls._GROWS and len(payload) != cls._LAYOUT.size:
            raise cls._length_error(payload)
        return cls(**cls._unpack_fixed(payload))

    @classmethod
    def _unpack_fixed(cls, payload: bytes) -> dict[str, Any]:
        if len(payload) < cls._LAYOUT.size:
            raise cls._length_error(payload)
        values: dict[str, Any] = {}
        for (name, convert), value in zip(cls._converters(), cls._LAYOUT.unpack_from(payload), strict=False):
            try:
                values[name] = convert(value)
            except ValueError as error:
                raise PayloadError(f"{cls.__name__}.{name}: {error}", value=value) from None
        return values

    @classmethod
    @cache
    def _converters(cls) -> list[tuple[str, Any]]:
        """Each field's name, and what makes its value of what the wire has; of a tuple that is the length."""
        hints = get_type_hints(cls, include_extras=True)
        others = {str: text_from_wire, tuple[int, ...]: int}
        kinds = {field.name: hints[field.name] for field in fields(cls)}
        return [(name, getattr(kind, "__metadata__", [others.get(kind, kind)])[0]) for name, kind in kinds.items()]

    @classmethod
    def _length_error(cls, payload: bytes) -> PayloadError:
        text = f"{cls.__name__} of {len(payload)} bytes, expected {cls._LAYOUT.size}"
        return PayloadError(text, bad_length=True)


class Message(Payload):
    """A payload that belongs to one `type` of frame."""

    TYPE: ClassVar[MessageType]

    def __init_subclass__(cls, type: MessageType | None = None, layout: str = "") -> None:
        super().__init_subclass__(layout)
        if type is not None:
            cls.TYPE = type


class Request(Message):
    """A message from the host. Its length is exact: a device must not ignore what it does not know."""

    _GROWS: ClassVar[bool] = False


def text_to_wire(text: str) -> bytes:
    """Return UTF-8 bytes."""
    return text.encode("utf-8", "replace")


def whole_from_wire(value: float) -> int | None:
    """Return the whole number from 0 to 2^32 - 1 that an f32 stands for, None if it is none."""
    return int(value) if 0 <= value < 1 << 32 and value == int(value) else None


def text_from_wire(raw: bytes) -> str:
    """Return the text before the padding, printable; what is no UTF-8 is replaced."""
    return printable(raw.split(b"\0", 1)[0].decode("utf-8", "replace"))

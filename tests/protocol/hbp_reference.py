"""An independent, slow implementation of the wire: written from SPEC.md, sharing nothing with `protocol`.

Whole frames of the vectors are compared with it, and the fast implementation is.
"""

from __future__ import annotations

import struct

KINDS = {"u8": 1, "u16": 2, "u32": 4, "u64": 8}


def crc32(data: bytes) -> int:
    """CRC-32/ISO-HDLC, bit by bit from its polynomial."""
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xEDB88320 if register & 1 else 0)
    return register ^ 0xFFFFFFFF


def cobs_encode(data: bytes) -> bytes:
    """COBS as Cheshire and Baker describe it."""
    out, block = bytearray(), bytearray()
    for position, byte in enumerate(data):
        if byte:
            block.append(byte)
        if not byte or len(block) == 254:
            out.append(len(block) + 1)
            out += block
            full = byte != 0
            block.clear()
            if full and position == len(data) - 1:
                return bytes(out)
    return bytes(out) + bytes([len(block) + 1]) + bytes(block)


def cobs_decode(data: bytes) -> bytes | None:
    out, position = bytearray(), 0
    while position < len(data):
        code = data[position]
        block = data[position + 1 : position + code]
        if code == 0 or len(block) != code - 1 or 0 in block:
            return None
        out += block
        position += code
        if code != 0xFF and position < len(data):
            out.append(0)
    return bytes(out)


def fields(*values: tuple[str, object]) -> bytes:
    """Return fields one after the other: ("u16", 5), ("f32", 1.5), ("text16", "a"), ("pad", 2)."""
    out = b""
    for kind, value in values:
        if kind == "f32":
            out += struct.pack("<f", value)
        elif kind in ("text16", "text24"):
            out += str(value).encode().ljust(int(kind[4:]), b"\0")
        elif kind == "pad":
            out += b"\0" * int(str(value))
        else:
            assert isinstance(value, int)
            out += value.to_bytes(KINDS[kind], "little")
    return out


def body(type_: int, flags: int, tid: int, node: int, payload: bytes, length: int | None = None) -> bytes:
    """Return header + payload."""
    length = len(payload) if length is None else length
    return fields(("u8", type_), ("u8", flags), ("u16", tid), ("u16", length), ("u8", node), ("u8", 0)) + payload


def wire(body_: bytes, crc: int | None = None) -> bytes:
    """Return the bytes on the link of header + payload."""
    crc = crc32(body_) if crc is None else crc
    return b"\0" + cobs_encode(body_ + crc.to_bytes(4, "little")) + b"\0"


def receive(data: bytes) -> list[bytes]:
    """Return header + payload of every intact frame in `data`, of which the first byte run is dropped."""
    out = []
    for chunk in data.split(b"\0")[1:-1]:
        decoded = cobs_decode(chunk)
        if not chunk or decoded is None or len(decoded) < 12 or len(decoded) > 1036:
            continue
        head, crc = decoded[:-4], int.from_bytes(decoded[-4:], "little")
        if crc == crc32(head) and int.from_bytes(head[4:6], "little") == len(head) - 8:
            out.append(head)
    return out

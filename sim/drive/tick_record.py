"""Raw telemetry of control periods, laid out as `protocol.signals` says, ready for the wire.

Values round half to even and saturate at the ends of their type; angles wrap. Nothing here computes a value.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from protocol.signals import ANGLE, MILLI
from protocol.streams import EDGE_ILLEGAL
from sim.hints import seldom
from sim.native import Pointer, native
from sim.numba_cache import kernel

Three = tuple[float, float, float]
TWO_PI = 2.0 * math.pi
PER_RAD = 1.0 / ANGLE
PER_UNIT = 1.0 / MILLI
TURNS, CLIPPED, UNSIGNED, BYTE, FLAG, FLOAT = range(6)
"""How a column becomes raw: an angle, a signed or unsigned word that saturates, a byte, a bit of a byte, a float32."""


class Column(NamedTuple):
    """Where a column of 8-byte numbers lies in a block of sections of n records each, and what becomes of it."""

    section: int  # words of a record of all sections before
    field: int  # words of its record before it
    stride: int  # words of its record
    kind: int
    per_unit: float  # counts; of a FLAG the bit
    at: int  # bytes before it in a raw sample


@kernel
def angle(value: float) -> int:
    """An angle (rad, wrapped or not) as counts that cover a turn in 16 bits; the scale is no exact part of a turn."""
    if not -math.pi <= value < math.pi:
        value -= TWO_PI * math.floor((value + math.pi) / TWO_PI)
    return int(np.rint(value * PER_RAD))


@kernel
def clipped(value: float) -> int:
    """A count, held within 16 bits with a sign."""
    return int(min(max(np.rint(value), -32768.0), 32767.0))


@kernel
def _in_i16(count: float) -> float:
    return min(max(count, -32768.0), 32767.0)


@kernel
def quantised(value: float, scale: float, per_unit: float) -> float:
    """A value as telemetry carries it: a whole number of `scale`, 1 / `per_unit`, a power of two, within an i16."""
    return _in_i16(float(np.rint(value * per_unit))) * scale


@kernel
def quantised_three(values: Three, scale: float, per_unit: float) -> Three:
    """The same of three values."""
    a, b, c = (
        float(np.rint(values[0] * per_unit)),
        float(np.rint(values[1] * per_unit)),
        float(np.rint(values[2] * per_unit)),
    )
    if seldom(max(abs(a), abs(b), abs(c)) > 32767.0):
        a, b, c = _in_i16(a), _in_i16(b), _in_i16(c)
    return a * scale, b * scale, c * scale


@kernel
def quantised_u16(value: float) -> float:
    """The DC link voltage (V) likewise: a whole number of `MILLI` within a u16."""
    return float(min(max(np.rint(value * PER_UNIT), 0.0), 65535.0)) * MILLI


@kernel
def edge_codes(old: int, new: int) -> int:
    """The field `codes` of an EDGE_RECORD for an edge between two Hall codes."""
    changed = old ^ new
    illegal = new == 0 or new == 7 or changed & (changed - 1) != 0
    return old | new << 3 | (EDGE_ILLEGAL if illegal else 0)


@kernel
def _put(raw: Pointer[np.uint8], at: int, count: int) -> None:
    raw[at] = np.uint8(count & 0xFF)
    raw[at + 1] = np.uint8((count >> 8) & 0xFF)


@native
def pack(
    columns: Pointer[Column],
    m: int,
    floats: Pointer[float],
    words: Pointer[int],
    n: int,
    raw: Pointer[np.uint8],
    size: int,
) -> None:
    """Make raw samples of `size` bytes of the columns of a block, `floats` and `words` both; n samples."""
    for c in range(m):
        column = columns[c]
        here = column.section * n + column.field
        for k in range(n):
            there = k * size + column.at
            if column.kind == TURNS:
                _put(raw, there, angle(floats[here]))
            elif column.kind == CLIPPED:
                _put(raw, there, clipped(floats[here] * column.per_unit))
            elif column.kind == UNSIGNED:
                _put(raw, there, int(floats[here] * column.per_unit))
            elif column.kind == BYTE:
                raw[there] = np.uint8(words[here] & 0xFF)
            elif column.kind == FLOAT:
                bits = int(np.float32(floats[here]).view(np.uint32))
                _put(raw, there, bits)
                _put(raw, there + 2, bits >> 16)
            elif words[here] == 1:
                raw[there] = np.uint8(int(raw[there]) | int(column.per_unit))
            here += column.stride

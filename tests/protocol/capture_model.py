"""Captures and means as SPEC.md says them, period by period, slow and obvious: what devices are compared with.

It shares nothing with `protocol.device`: times are whole ticks, values exact fractions.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from hbp_reference import crc32

CODES = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i", "f32": "f"}
OFF, NOW, ABOVE, BELOW, RISES, FALLS, CHANGES, FAULT, STATE, ILLEGAL, PULSE = range(11)


@dataclass(frozen=True)
class Kind:
    """A channel: its type, what a count of it is worth, and whether it has a unit and wraps."""

    type: str
    scale: float = 1.0
    offset: float = 0.0
    unit: bool = True
    wraps: bool = False


@dataclass(frozen=True)
class Edge:
    """A Hall edge: when, the codes before and after, whether the device calls it illegal, the encoder's count."""

    tick: int
    old: int
    new: int
    illegal: bool
    encoder: int

    def packed(self) -> bytes:
        codes = self.old | self.new << 3 | self.illegal << 6
        return struct.pack("<IBBH", self.tick & 0xFFFFFFFF, codes, 0, self.encoder)


@dataclass(frozen=True)
class Asked:
    """CAPTURE_ARM; channels by their position."""

    trigger: int
    decimation: int
    before: int
    after: int
    level: float
    channel: int
    edges: int
    channels: tuple[int, ...]


@dataclass(frozen=True)
class Course:
    """What happens to a device from the period `begin` on, which is the first after arming."""

    kinds: Sequence[Kind]
    begin: int
    rows: Sequence[Sequence[float]]  # raw values of the periods from `begin` on
    edges: Sequence[Edge]  # since arming, in order
    edges_before: int  # since boot, before arming
    tick0: int  # of period 0
    period: int  # ticks
    tick_hz: int
    fault: int | None = None  # period at whose tick a fault comes, after its sample has been judged
    state: int | None = None  # period at whose tick the state changes, likewise

    def tick(self, index: int) -> int:
        return self.tick0 + index * self.period


def physical(value: float, kind: Kind) -> Fraction | None:
    """None for what is no number."""
    if math.isnan(value):
        return None
    scale, offset = (struct.unpack("<f", struct.pack("<f", x))[0] for x in (kind.scale, kind.offset))
    return Fraction(value) * Fraction(scale) + Fraction(offset)


def _found(asked: Asked, course: Course) -> list[tuple[int, int, int, int]]:
    """All that could be the trigger: tick, rank among what is at that tick, period, kind."""
    level = Fraction(asked.level)
    found = []
    for k, row in enumerate(course.rows):
        index = course.begin + k
        if asked.trigger == NOW and k == 0:
            found.append((course.tick(index), 0, index, NOW))
        if not ABOVE <= asked.trigger <= CHANGES:
            continue
        kind = course.kinds[asked.channel]
        now = physical(row[asked.channel], kind)
        above, below = now is not None and now > level, now is not None and now < level
        if asked.trigger == ABOVE:
            met = above
        elif asked.trigger == BELOW:
            met = below
        elif k == 0:
            met = False
        elif asked.trigger == CHANGES:
            raw, last = (struct.pack("<" + CODES[kind.type], each[asked.channel]) for each in (row, course.rows[k - 1]))
            met = raw != last
        else:
            last_one = physical(course.rows[k - 1][asked.channel], kind)
            if asked.trigger == RISES:
                met = above and not (last_one is not None and last_one > level)
            else:
                met = below and not (last_one is not None and last_one < level)
        if met:
            found.append((course.tick(index), 0, index, asked.trigger))
    for k, edge in enumerate(course.edges):
        met = asked.trigger == ILLEGAL and edge.illegal
        if asked.trigger == PULSE and k:
            last_edge = course.edges[k - 1]
            soon = Fraction(edge.tick - last_edge.tick, course.tick_hz) <= level
            met = edge.new == last_edge.old and soon
        if met:
            index = -((course.tick0 - edge.tick) // course.period)
            found.append((edge.tick, 0, index, asked.trigger))
    if asked.trigger == STATE and course.state is not None:
        found.append((course.tick(course.state), 1, course.state, STATE))
    if course.fault is not None:
        found.append((course.tick(course.fault), 2, course.fault, FAULT))
    return found


def captured(asked: Asked, course: Course) -> tuple[bytes, dict[str, int]] | None:
    """Blob 1 and what the reply says of it; None where the capture is not complete."""
    found = _found(asked, course)
    if not found:
        return None
    _, _, at, trigger = min(found)
    last = course.begin + len(course.rows) - 1
    records = [index for index in range(course.begin, last + 1) if index % asked.decimation == 0]
    after = [index for index in records if index >= at][: asked.after]
    if len(after) < asked.after:
        return None
    before = [index for index in records if index < after[0]]
    before = before[len(before) - min(asked.before, len(before)) :]
    blob = b""
    for index in before + after:
        for channel in asked.channels:
            blob += struct.pack("<" + CODES[course.kinds[channel].type], course.rows[index - course.begin][channel])
    first_tick, last_tick = course.tick((before + after)[0]), course.tick(after[-1])
    between = [k for k, edge in enumerate(course.edges) if first_tick <= edge.tick <= last_tick]
    kept = between[len(between) - min(asked.edges, len(between)) :]
    blob += b"".join(course.edges[k].packed() for k in kept)
    return blob, {
        "trigger": trigger,
        "first": len(before),
        "records": len(before) + len(after),
        "edges": len(kept),
        "edges_lost": len(between) - len(kept),
        "first_edge": course.edges_before + kept[0] if kept else 0,
        "size": len(blob),
        "crc": crc32(blob),
        "tick": course.tick(after[0]),
        "index": after[0],
    }


def turn_of(kind: Kind) -> Fraction:
    """What a turn of a channel that wraps is in raw values: all of a whole type, or 2 pi."""
    if kind.type == "f32":
        return Fraction(math.tau) / abs(Fraction(kind.scale))
    return Fraction(1 << 8 * struct.calcsize(CODES[kind.type]))


def mean(values: Sequence[float], kind: Kind) -> Fraction:
    """The mean of some raw values of a channel by 11.51, exactly."""
    if not kind.unit:
        return Fraction(values[-1])
    if not kind.wraps:
        return sum(map(Fraction, values), Fraction(0)) / len(values)
    turn = turn_of(kind)
    lowest = Fraction(0) if kind.type[0] == "u" else -turn / 2
    first = Fraction(values[0])
    away = [(Fraction(value) - first + turn / 2) % turn - turn / 2 for value in values]
    return (first + sum(away, Fraction(0)) / len(values) - lowest) % turn + lowest

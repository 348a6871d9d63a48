"""The text of slcan: frames to lines, and bytes cut anywhere back to frames. Both ends of an adapter use it.

The lines are those of LAWICEL's CAN232 (t, T, r, R) with the CAN FD ones of CANable 2.0 (d, D without and b, B with
bit-rate switch). Many lines of one letter and length are handled by one numpy operation each. This module opens no
port, reads no clock and answers nothing: what an answer means is for its caller.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.canmap.frame import (
    BRS,
    CAN_RECORD,
    EXTENDED,
    EXTENDED_MASK,
    FD_LENGTHS,
    FDF,
    MAX_DATA,
    RECORD_BYTES,
    REMOTE,
    STANDARD_MASK,
)

MAX_LINE = 300
"""Most bytes of a line; the longest frame has 142."""

MAX_REPLIES = 65536
"""Most lines that are no frames which a parser keeps for its caller: as many as one read of a link can hold."""

END = b"\r"
BELL = b"\a"

STAMP_PERIOD = 60_000
"""Time stamps count milliseconds from 0 to this less one."""

_RATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000, 83_300)
BITRATES = {rate: b"S%d" % n for n, rate in enumerate(_RATES)}
"""The command that sets a bit rate, by that rate in bit/s."""

DATA_BITRATES = {2_000_000: b"Y2", 5_000_000: b"Y5", 8_000_000: b"Y8"}
"""The same for CAN FD's data phase."""

TIMING_CLOCK = 8_000_000
"""Hz: clock of which the registers that `s` sets count a bit time."""

_CR, _BELL = END[0], BELL[0]
_STAMP_DIGITS = 4
_BAD = 0xFF  # no hex digit
_REPLY = re.compile(rb"(?:[zZ]|[CFLMNOSVWXYZmsv][ -~]*)?")  # an answer of an adapter or a command of a host


class _Form(NamedTuple):
    """One letter's frames."""

    letter: int
    id_bits: int  # EXTENDED and REMOTE bits of a record's `id`
    flags: int
    id_digits: int
    id_mask: int
    lengths: tuple[int, ...]  # by DLC


_IDS = ((0, 3, STANDARD_MASK), (EXTENDED, 8, EXTENDED_MASK))  # bit, digits and mask: of small and of capital letters
_FORMS = tuple(
    _Form(ord(letter), id_bits | extended, flags, digits, mask, FD_LENGTHS if flags & FDF else FD_LENGTHS[:9])
    for letters, id_bits, flags in (("tT", 0, 0), ("rR", REMOTE, 0), ("dD", 0, FDF), ("bB", 0, FDF | BRS))
    for letter, (extended, digits, mask) in zip(letters, _IDS, strict=True)
)
_BY_LETTER: Mapping[int, _Form] = {form.letter: form for form in _FORMS}
_BY_BITS: Mapping[int, _Form] = {form.id_bits >> 29 << 8 | form.flags: form for form in _FORMS}

_IS_FRAME = np.zeros(256, bool)
_IS_FRAME[list(_BY_LETTER)] = True

_HEX = np.frombuffer(b"".join(b"%02X" % n for n in range(256)), np.uint16)  # two characters each

_NIBBLE = np.full(256, _BAD, np.uint8)
for _digit, _value in zip(b"0123456789ABCDEFabcdef", (*range(16), *range(10, 16)), strict=True):
    _NIBBLE[_digit] = _value

_ID_WEIGHTS = (16 ** np.arange(7, -1, -1)).astype(np.uint32)


_LENGTHS = {form.letter: np.array(form.lengths + (-1,) * (256 - len(form.lengths)), np.int16) for form in _FORMS}
"""Data bytes by DLC digit, -1 where there is no such DLC."""


def encode(records: NDArray[np.void], *, stamped: bool = False) -> bytes:
    """Return the lines of these CAN_RECORDs, in their order.

    `stamped` adds each record's time in ms, modulo a minute, as an adapter does after Z1. ESI has no place in slcan.

    Raises:
        ValueError: slcan has no line for one of them: an error frame, a length that its format does not have, an
            identifier too large.
    """
    if not len(records):
        return b""
    keys = (records["id"] >> 29).astype(np.int64) << 16
    keys |= (records["flags"] & (FDF | BRS)).astype(np.int64) << 8 | records["length"]
    kinds = set(keys.tolist())
    if len(kinds) == 1:
        return _lines(records, kinds.pop(), stamped).tobytes()
    sizes = np.empty(len(records), np.int64)
    groups = []
    for kind in kinds:
        members = np.flatnonzero(keys == kind)
        lines = _lines(records[members], kind, stamped)
        sizes[members] = lines.shape[1]
        groups.append((members, lines))
    starts = np.cumsum(sizes) - sizes
    text = np.empty(int(sizes.sum()), np.uint8)
    for members, lines in groups:
        _windows(text, lines.shape[1])[starts[members]] = lines.view(f"V{lines.shape[1]}")[:, 0]
    return text.tobytes()


def _lines(records: NDArray[np.void], kind: int, stamped: bool) -> NDArray[np.uint8]:
    """Return one line in each row, for frames of one format and length."""
    form, length = _BY_BITS.get(kind >> 8), kind & 0xFF
    numbers = records["id"] & EXTENDED_MASK
    if form is None or length not in form.lengths or int(numbers.max()) > form.id_mask:
        worst = records[numbers.argmax()]
        raise ValueError(
            f"slcan has no line for a frame with id 0x{worst['id']:08X}, flags {worst['flags']}, length {length}"
        )
    head = 2 + form.id_digits
    tail = head + (0 if form.id_bits & REMOTE else 2 * length)
    lines = np.empty((len(records), tail + (_STAMP_DIGITS if stamped else 0) + 1), np.uint8)
    lines[:, 0] = form.letter
    lines[:, 1 : head - 1] = _hex(numbers.astype(">u4"))[:, 8 - form.id_digits :]
    lines[:, head - 1] = b"0123456789ABCDEF"[form.lengths.index(length)]
    if tail > head:
        lines[:, head:tail] = _hex(records["data"][:, :length])
    if stamped:
        lines[:, tail:-1] = _hex((records["time"] * 1000 % STAMP_PERIOD).astype(">u2"))
    lines[:, -1] = _CR
    return lines


def _hex(values: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Return the hex digits of each row's bytes."""
    rows = len(values)
    return _HEX[np.ascontiguousarray(values).view(np.uint8).reshape(rows, -1)].view(np.uint8)


def _windows(buffer: bytes | NDArray[np.uint8], size: int) -> NDArray[np.void]:
    """Return the piece of `size` bytes at each position of the buffer, without copying."""
    return np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer, strides=(1,))


class Reply(NamedTuple):
    """A line that is no frame: an answer of an adapter, or a command of a host."""

    text: bytes
    """Without its end; a bell is b"\\a"."""
    frames: int
    """How many frames of the same `feed` came before it."""


class SlcanParser:
    """Bytes of slcan to frames."""

    def __init__(self) -> None:
        self.replies: list[Reply] = []
        """Lines that are no frames, for the caller to take and clear."""
        self.replies_dropped = 0
        """Such lines for which there was no room."""
        self.strange = b""
        """The first line that could not be read."""
        self._malformed = 0
        self._rest = b""
        self._after_cr = False

    @property
    def malformed(self) -> int:
        """Lines dropped because they are neither a frame nor a reply, or longer than `MAX_LINE`."""
        return self._malformed + (len(self._rest) > MAX_LINE)

    def feed(self, data: bytes, now: float) -> NDArray[np.void]:
        """Take bytes, cut anywhere; return the frames that they complete as CAN_RECORDs with the time `now`."""
        data = self._rest + self._lines(data)
        buffer = np.frombuffer(data, np.uint8)
        ends = np.flatnonzero((buffer == _CR) | (buffer == _BELL))
        used = int(ends[-1]) + 1 if len(ends) else 0
        self._rest = data[used : used + MAX_LINE + 1]  # one byte too many is enough to know that it is too long
        if not used:
            return np.empty(0, CAN_RECORD)
        starts = np.empty_like(ends)
        starts[0], starts[1:] = 0, ends[:-1] + 1
        lengths = ends - starts
        letters = buffer[starts]
        is_frame = _IS_FRAME[letters] & (buffer[ends] == _CR)
        keys = np.where(is_frame, lengths << 8 | letters, 0)
        records = np.empty(len(ends), CAN_RECORD)
        good = np.zeros(len(ends), bool)
        for key in set(keys.tolist()) - {0}:
            members = np.flatnonzero(keys == key)
            length = key >> 8
            text = _windows(data, length)[starts[members]].view(np.uint8).reshape(len(members), length)
            frames, passed = _parse(_BY_LETTER[key & 0xFF], text, now)
            records.view(f"V{RECORD_BYTES}")[members] = frames.view(f"V{RECORD_BYTES}")
            good[members] = passed
        before = np.cumsum(good)
        count = int(before[-1])
        others = np.flatnonzero(~is_frame).tolist()
        self._malformed += len(ends) - len(others) - count
        for line in np.flatnonzero(is_frame & ~good).tolist()[:1]:
            self.strange = self.strange or data[starts[line] : ends[line]]
        for line in others:
            self._put_aside(data[starts[line] : ends[line]], data[ends[line]] == _BELL, int(before[line]))
        return records if count == len(records) else records[good]

    def _lines(self, data: bytes) -> bytes:
        """The data with lines that end in a carriage return, however they end: many sketches send a line feed, too."""
        if not data:
            return data
        second = self._after_cr and data.startswith(b"\n")
        self._after_cr = data.endswith(END)
        data = data[second:]
        return data.replace(END + b"\n", END).replace(b"\n", END) if b"\n" in data else data

    def _put_aside(self, text: bytes, bell: bool, frames: int) -> None:
        replies = [BELL] if bell else [text]
        if (bell and text) or len(text) > MAX_LINE or not _REPLY.fullmatch(text):
            self._malformed += 1
            self.strange = self.strange or text
            replies = replies[: int(bell)]
        for reply in replies:
            if len(self.replies) < MAX_REPLIES:
                self.replies.append(Reply(reply, frames))
            else:
                self.replies_dropped += 1


def _parse(form: _Form, text: NDArray[np.uint8], now: float) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
    """Read the lines in the rows of `text`, all of one letter; return a record for each, and which of them hold."""
    rows, width = text.shape
    records = np.zeros(rows, CAN_RECORD)
    body = 1 + form.id_digits  # digits before the data
    if width <= body or (width - 1 - body) % 2 or width - 1 - body > 2 * MAX_DATA + _STAMP_DIGITS:
        return records, np.zeros(rows, bool)
    digits = _NIBBLE[text[:, 1:]]
    numbers = digits[:, : form.id_digits].astype(np.uint32) @ _ID_WEIGHTS[-form.id_digits :]
    sizes = _LENGTHS[form.letter][digits[:, form.id_digits]]
    there = (width - 1 - body) // 2  # bytes after the DLC: data and perhaps a time stamp
    expected = np.zeros_like(sizes) if form.id_bits & REMOTE else sizes
    stamped = expected + _STAMP_DIGITS // 2 == there
    good = (digits.max(axis=1) != _BAD) & (numbers <= form.id_mask) & (sizes >= 0) & ((expected == there) | stamped)
    records["id"] = numbers | np.uint32(form.id_bits)
    records["length"] = np.where(good, sizes, 0)
    records["flags"] = form.flags
    records["time"] = now
    data = digits[:, body::2] << 4 | digits[:, body + 1 :: 2]
    if stamped.any():
        data[stamped, -_STAMP_DIGITS // 2 :] = 0
    records["data"][:, :there] = data[:, :MAX_DATA]
    return records, good

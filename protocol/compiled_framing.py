"""COBS and CRC-32 of frames on a byte link as compiled kernels (`protocol.machine_code`): no C compiler is needed.

COBS: Cheshire and Baker, IEEE/ACM Transactions on Networking 7(2), 1999. Importing this module takes some 0.1 s, the
first time on a machine a second: `protocol.framing` does it before anything waits for an answer.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.machine_code import Store, hashed, kernel

RUN = 254  # most bytes that a code byte stands for without a zero after them
CRC_BYTES = 4
CRC_BLOCK = 16  # bytes that go into the CRC at a time; 32 are no quicker
RESULTS = INTACT, BAD_COBS, BAD_CRC, BAD_LENGTH, TOO_LONG = 0, 1, 2, 3, 4
"""What a chunk can be."""
_NO_ZERO = b"\xff" * 8
RECORDS, MOST_RECORDS = 24, 0xFFFF
"""Bytes of the two headers before a stream frame's records, and how many of these one can say that it holds."""
EDGES = 0x41
"""Type of a frame of edges; one of samples is one less."""
ROW = 5
"""Numbers of a stream: its type, node, number and cfg_id in one, the last three of `Followed`, and the index that comes
next, -1 at first. What is before that its decoder will not take, and nothing is joined to it."""

Bytes = Any
"""In a kernel: where bytes begin; a pointer to other numbers likewise."""
_ONES, _HIGH = np.uint64(0x0101010101010101), np.uint64(0x8080808080808080)
_ZERO, _ONE, _RUN = np.uint64(0), np.uint64(1), np.uint64(RUN)
_ALL = np.uint32(0xFFFFFFFF)
_RESIDUE = np.uint32(0xDEBB20E3)  # CRC register after any message followed by its own CRC-32, little-endian


def _crc_tables() -> NDArray[np.uint32]:
    """Of CRC-32 (reflected polynomial 0xEDB88320), for the bytes of a block in their order: shape (CRC_BLOCK, 256)."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, table >> 1 ^ np.uint32(0xEDB88320), table >> 1).astype(np.uint32)
    tables = [table]
    for _ in range(CRC_BLOCK - 1):
        tables.append(table[tables[-1] & 0xFF] ^ tables[-1] >> 8)
    return np.array(tables[::-1], np.uint32)


_TABLES = _crc_tables()


@kernel
def _crc(data: Bytes, begin: Any, end: Any, crc: Any) -> Any:
    """The CRC register after these bytes: a block of them at a time ("slicing", Kounavis and Berry, ISCC 2005)."""
    k, last, block = np.uint64(begin), np.uint64(end), np.uint64(CRC_BLOCK)
    while k + block <= last:
        register = np.uint32(0)
        for j in range(np.uint64(CRC_BYTES)):
            register ^= _TABLES[j, data[k + j] ^ crc >> 8 * j & 0xFF]
        for j in range(np.uint64(CRC_BYTES), block):
            register ^= _TABLES[j, data[k + j]]
        crc = np.uint32(register)
        k += block
    while k < last:
        crc = np.uint32(_TABLES[block - _ONE, (crc ^ data[k]) & 0xFF] ^ crc >> 8)
        k += _ONE
    return crc


@kernel
def _put(data: Bytes, begin: Any, end: Any, out: Bytes, code: Any, n: Any) -> tuple[Any, Any]:
    """Add bytes to `out`, whose last code byte belongs at `code` and whose next byte at `n`; return both.

    Indices have no sign, so that nothing looks whether one counts from the end.
    """
    while begin < end:
        if n - code > _RUN:  # full, and more comes
            out[code] = n - code
            code = n
            n += _ONE
        stop = min(end, begin + _RUN + _ONE - (n - code))
        for k in range(begin, stop):
            byte = data[k]
            out[n] = byte
            out[code] = n - code  # no branch: it is written once more where the run goes on
            code = n if byte == 0 else code  # its place is that of the next code byte
            n += _ONE
        begin = stop
    return code, n


@kernel
def _encode(
    heads: Bytes,
    size: Any,
    data: Bytes,
    begin: Any,
    end: Any,
    step: Any,
    summed: Any,
    frames: Any,
    out: Bytes,
    ends: Bytes,
    tail: Bytes,
) -> None:
    n, head = _ZERO, _ZERO
    for frame in range(frames):
        stop = min(end, begin + step)
        out[n] = 0
        code, n = _put(heads, head, head + size, out, n + _ONE, n + _ONE + _ONE)
        code, n = _put(data, begin, stop, out, code, n)
        if summed:
            crc = _crc(heads, np.int64(head), np.int64(head + size), _ALL)
            crc = _crc(data, np.int64(begin), np.int64(stop), crc) ^ _ALL
            for k in range(CRC_BYTES):
                tail[k] = crc >> 8 * k & 0xFF
            code, n = _put(tail, _ZERO, np.uint64(CRC_BYTES), out, code, n)
        out[code] = n - code
        out[n] = 0
        n += _ONE
        ends[frame] = n
        head += size
        begin = stop


@kernel
def _uncovered(data: Bytes, begin: int, end: int) -> int:
    """Decode a chunk where it lies: what it held is from the byte behind `begin` on. Return its end, 0 if damaged."""
    removed, full, k = 0, True, begin
    while k < end:
        stop = k + int(data[k])
        if stop > end:
            return 0
        if k > begin and full:
            removed += 1
        else:
            data[k - removed] = 0
        if removed:
            by = np.uint64(removed)
            for each in range(np.uint64(k + 1), np.uint64(stop)):  # as in `_put`
                data[each - by] = data[each]
        full = stop - k > RUN
        k = stop
    return end - removed


@kernel
def _number(data: Bytes, at: int, size: int) -> int:
    value = 0
    for k in range(size):
        value |= int(data[at + k]) << 8 * k
    return value


@kernel
def _stream_of(data: Bytes, begin: int, end: int, streams: Bytes, known: int) -> int:
    """The row of `streams` that an intact frame is of; -1 if of none, not as long as it says, or older than others."""
    if end - begin >= RECORDS:
        key = _number(data, begin, 1) | _number(data, begin + 6, 1) << 8 | _number(data, begin + 8, 1) << 16
        key |= _number(data, begin + 12, 2) << 24
        for row in range(known):
            if streams[ROW * row] == key:
                n, ahead = _number(data, begin + 10, 2), _number(data, begin + 16, 4) - streams[ROW * row + 4]
                new = streams[ROW * row + 4] < 0 or ahead & 0xFFFFFFFF < 1 << 31
                return row if new and n and n * streams[ROW * row + 1] == end - begin - RECORDS else -1
    return -1


@kernel
def _decode(
    data: Bytes,
    words: Bytes,
    length: int,
    longest: int,
    payload: int,
    overhead: int,
    streams: Bytes,
    known: int,
    found: Bytes,
    count: Bytes,
) -> None:
    n, begin = 0, 0
    run, row, more, samples, next_seq, next_tick = 0, -1, 0, 0, 0, 0
    for result in range(len(RESULTS) + 2):
        count[result] = 0
    for w in range(length):
        if not (words[w] - _ONES) & ~words[w] & _HIGH:  # none of its bytes is zero
            continue
        for end in range(8 * w, 8 * w + 8):
            if data[end]:
                continue
            if end > begin:
                first, last = begin + 1, 0
                if end - begin <= longest:
                    last = _uncovered(data, begin, end)
                held = last - first - overhead
                if end - begin > longest or held > payload:  # zeros take no room in COBS
                    result = TOO_LONG
                elif not last:
                    result = BAD_COBS
                elif held >= 0 and _crc(data, first, last, _ALL) != _RESIDUE:
                    result = BAD_CRC
                elif held < 0 or _number(data, first + 4, 2) != held:
                    result = BAD_LENGTH
                else:
                    result = INTACT
                count[result] += 1
                if result != INTACT:
                    count[len(RESULTS)] += end - begin
                else:
                    last -= CRC_BYTES
                    before, row = row, _stream_of(data, first, last, streams, known)
                    follows, new, seq, index, tick = False, 0, 0, 0, 0
                    if row >= 0:
                        new, seq = _number(data, first + 10, 2), _number(data, first + 14, 2)
                        index, tick = _number(data, first + 16, 4), _number(data, first + 20, 4)
                        follows = row == before and seq == next_seq and index == streams[ROW * row + 4]
                        follows = follows and not data[first + 9] and data[first + 1] == data[run + 1]
                        follows = follows and samples + new <= MOST_RECORDS
                        follows = follows and (streams[ROW * row + 3] < 0 or tick == next_tick)
                        next_seq = seq + 1 & 0xFFFF
                        streams[ROW * row + 4] = index + new * streams[ROW * row + 2] & 0xFFFFFFFF
                        next_tick = tick + new * streams[ROW * row + 3] & 0xFFFFFFFF
                    if follows:
                        more += 1
                        at = found[2 * n - 1]
                        by = np.uint64(first + RECORDS - at)
                        for each in range(np.uint64(first + RECORDS), np.uint64(last)):
                            data[each - by] = data[each]
                        found[2 * n - 1] = at + last - first - RECORDS
                        samples += new
                        data[run + 10], data[run + 11] = samples & 0xFF, samples >> 8
                        data[run + 2], data[run + 3] = more & 0xFF, more >> 8
                    else:
                        run, samples, more = first, new, 0
                        found[2 * n], found[2 * n + 1] = first, last
                        n += 1
                        if known and data[run] | 1 == EDGES:  # a device's own tid there says nothing
                            data[run + 2] = data[run + 3] = 0
            begin = end + 1
    count[len(RESULTS) + 1] = n


def encode(
    heads: bytes, n: int, data: bytes, begin: int, end: int, step: int, summed: bool = True
) -> tuple[bytes, list[int]]:
    """Return n frames, one behind the other, and where each ends.

    A frame is `00 | COBS(head, data, CRC-32 of both unless not summed) | 00`, with the next of n heads of equal length
    and the next `step` bytes of `data[begin:end]`.
    """
    size = len(heads) + end - begin + n * CRC_BYTES
    out, ends = np.empty(size + size // RUN + 4 * n, np.uint8), np.empty(n + 1, np.int64)
    at = _address(ends)
    _encode_compiled(
        heads, len(heads) // n, data, begin, end, step, summed, n, _address(out), at, at + n * ends.itemsize
    )
    lengths = ends[:n].tolist()
    return out[: lengths[-1]].tobytes(), lengths


class Followed(NamedTuple):
    """What the frames of a stream have in common, and how one that follows another goes on."""

    type: int
    node: int
    stream: int
    cfg_id: int
    record_bytes: int
    index_step: int
    """From record to record."""
    ticks: int
    """Likewise; -1 where a frame's tick says nothing of the next one's."""


class Decoder:
    """Decodes chunks of a link, in memory that it keeps from one call to the next.

    Args:
        longest: the longest chunk that may be a frame, bytes.
        payload: the longest payload of a frame, bytes.
        overhead: bytes of header and CRC; bytes 4 and 5 of the header say how long the payload is.
    """

    def __init__(self, longest: int, payload: int, overhead: int) -> None:
        self._limits = longest, payload, overhead
        self._counts = memoryview(bytearray(8 * (len(RESULTS) + 2))).cast("q")
        self._counts_at = _address(np.frombuffer(self._counts, np.int64))
        self._make_room(1 << 13)
        self._streams = np.empty((0, ROW), np.int64)
        self._known = _address(self._streams), 0

    def join(self, new: Followed) -> None:
        """From now on frames of this stream that follow each other at once become one, as `decode` says."""
        what = new.type | new.node << 8 | new.stream << 16
        rows = [row for row in self._streams.tolist() if row[0] & 0xFFFFFF != what]
        self._streams = np.array([*rows, [what | new.cfg_id << 24, *new[4:], -1]], np.int64)
        self._known = _address(self._streams), len(self._streams)

    def _make_room(self, size: int) -> None:
        """For so many bytes. A chunk has two at least, with its zero, and a frame's place is two numbers of four."""
        work, found = np.empty(size + 8, np.uint8), np.empty(size, np.int32)
        self._size, self._work, self._found = size, work.data, found.data
        self._work_at, self._found_at = _address(work), _address(found)

    def decode(self, data: bytes) -> tuple[bytes, list[int], list[int]]:
        """Decode all chunks that a zero ends, with zeros between them; what is behind the last zero is left alone.

        Frames that are joined are one of as many records, whose tid says how many more it is made of.

        Returns:
            The decoded bytes; for each intact frame where its header and payload begin in them, and where they end;
            how many chunks had each of `RESULTS`, and how many bytes the damaged ones had.
        """
        n = len(data)
        if n > self._size:
            self._make_room(2 * n)
        self._work[:n] = data
        self._work[n : n + 8] = _NO_ZERO
        at = self._work_at
        _decode_compiled(at, at, (n + 7) // 8, *self._limits, *self._known, self._found_at, self._counts_at)
        *counts, frames = self._counts.tolist()
        return self._work[:n].tobytes(), self._found[: 2 * frames].tolist(), counts


def _address(array: NDArray[Any]) -> int:
    at: int = array.ctypes.data
    return at


_FUNCTIONS: dict[str, Callable[..., None]] = {"encode": _encode, "decode": _decode}
_SOURCES = (Path(__file__), Path(__file__).with_name("ir_by_numba.py"))
_STORE = Store(Path(__file__).with_name("kernels"), hashed(_SOURCES, Path(__file__).parent))


def _ir(name: str) -> str:
    """The IR of a function, by numba."""
    from numba import types

    from protocol.ir_by_numba import ir_by_numba

    of: Any = types
    bytes_, words, places, counts = (of.CPointer(kind) for kind in (of.uint8, of.uint64, of.int32, of.int64))
    kinds = {
        "encode": [bytes_, of.uint64, bytes_, *[of.uint64] * 4, of.int64, bytes_, counts, bytes_],
        "decode": [bytes_, words, *[of.int64] * 4, counts, of.int64, places, counts],
    }
    return ir_by_numba(_FUNCTIONS[name], kinds[name])


def ship() -> None:
    """Write the IR that comes with the sources: `python -m sim.compile --ship`."""
    from protocol.ir_by_numba import VERSIONS

    _STORE.ship({name: _ir(name) for name in _FUNCTIONS}, VERSIONS)


def _loaded(name: str, *arguments: Any) -> Callable[..., int]:
    function: Callable[..., int] = ctypes.PYFUNCTYPE(ctypes.c_int32, *arguments)(
        _STORE.address(name, partial(_ir, name))
    )
    return function


_AT, _NUMBER, _GIVEN = ctypes.c_size_t, ctypes.c_int64, ctypes.c_char_p
_encode_compiled = _loaded("encode", _GIVEN, _NUMBER, _GIVEN, *[_NUMBER] * 5, _AT, _AT, _AT)
_decode_compiled = _loaded("decode", _AT, _AT, *[_NUMBER] * 4, _AT, _NUMBER, _AT, _AT)

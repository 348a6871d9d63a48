"""What a UART adds to a byte pipe that has none: a finite rate, and rubbish when the two ends' rates differ.

A pty takes any rate and passes bytes at once; with this in between, a wrong `baud=` and a line that is too
slow show up in the simulated drive as they do in a real one.
"""

from __future__ import annotations

from functools import lru_cache

BITS_PER_CHARACTER = 10  # start, 8 data, stop
RATE_TOLERANCE = 0.03  # receivers centre their samples on the bits: half a bit in ten may be lost, less margins
_BURST = 0.02  # s of line time that may be sent at once after a pause


class Pacer:
    """How many bytes a line of `baud` has had the time to send; times in seconds of any one clock."""

    def __init__(self, baud: int) -> None:
        self._per_second = baud / BITS_PER_CHARACTER
        self._credit = 0.0
        self._last: float | None = None

    def allowance(self, now: float) -> int:
        """Bytes that may be sent at `now`."""
        if self._last is not None:
            # at least one byte can always come together, however slow the line
            most = max(self._per_second * _BURST, 1.0)
            self._credit = min(self._credit + (now - self._last) * self._per_second, most)
        self._last = now
        return int(self._credit)

    def spend(self, n: int) -> None:
        """Note that `n` bytes went out."""
        self._credit -= n


def same_rate(sent: int, received: int) -> bool:
    """Whether a receiver at one rate reads a sender at the other."""
    return abs(sent - received) <= RATE_TOLERANCE * sent


def misread(data: bytes, sent: int, received: int) -> bytes:
    """What a receiver at `received` baud makes of `data` sent at `sent` baud.

    Each character is taken with an idle line after it. A character whose stop bit reads low is dropped, as by
    a driver that ignores framing errors.
    """
    if same_rate(sent, received):
        return data
    if sent <= 0 or received <= 0:  # a rate of 0 means hung up
        return b""
    table = _misread_table(sent, received)
    return b"".join([table[byte] for byte in data])


@lru_cache(maxsize=8)
def _misread_table(sent: int, received: int) -> tuple[bytes, ...]:
    return tuple(_misread_one(byte, sent / received) for byte in range(256))


def _misread_one(byte: int, step: float) -> bytes:
    """Sample one character at intervals of `step` of its bits, from each falling edge on."""
    levels = [0, *((byte >> n) & 1 for n in range(8)), 1]

    def level(bit: float) -> int:
        return levels[int(bit)] if bit < len(levels) else 1

    read = bytearray()
    position = 0.0
    while True:
        while position < len(levels) and level(position):
            position = int(position) + 1.0
        if position >= len(levels):
            return bytes(read)
        samples = [level(position + (n + 0.5) * step) for n in range(10)]
        if samples[0] == 0 and samples[9] == 1:
            read.append(sum(bit << n for n, bit in enumerate(samples[1:9])))
        position += 9.5 * step
        while position < len(levels) and not level(position):  # wait for the line to rise
            position = int(position) + 1.0

"""An emulated slcan adapter: a pty for the host on one side, CAN_RECORDs of a simulated bus on the other.

It answers as LAWICEL's CAN232 does, with CANable 2.0's commands for CAN FD. It never blocks, echoes no frame that the
host sent, and does not arbitrate: the bus does. Commands that it could only pretend to obey (acceptance filters,
polling) are refused.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from protocol.canmap.frame import (
    BRS,
    CAN_RECORD,
    ERROR,
    ERROR_BUS,
    ERROR_CONTROLLER,
    ERROR_OVERFLOW,
    ERROR_PROTOCOL,
    EXTENDED,
    FDF,
    RECORD_BYTES,
    BusRates,
)
from protocol.canmap.slcan import BELL, BITRATES, DATA_BITRATES, END, TIMING_CLOCK, SlcanParser, encode
from protocol.links.target import CanTarget
from sim.ports.byte_ports import PtyPort

MAX_ANSWERS = 16_384
"""Bytes of answers that wait for a host that does not read."""

_BITRATES = {command: bitrate for bitrate, command in BITRATES.items()}
_DATA_BITRATES = {command: bitrate for bitrate, command in DATA_BITRATES.items()}
_RATE_TOLERANCE = 0.005  # controllers resynchronise at edges; half a per cent is what the worst frame still bears
_EVERYTHING = b"FFFFFFFF"  # acceptance mask that lets every frame pass

_FIXED_ANSWERS = {b"": END, b"V": b"V1013\r", b"v": b"v1013\r", b"N": b"NSIM1\r"}

# Bits of the answer to F.
_WARNING, _OVERRUN, _PASSIVE, _BUS_ERROR = 0x04, 0x08, 0x20, 0x80
# data[1] of Linux's error frames with ERROR_CONTROLLER
_LINUX_WARNING, _LINUX_PASSIVE = 0x0C, 0x30


class SlcanPort:
    """An slcan adapter on a bus, as a `sim.ports.byte_ports.Port` whose bytes are CAN_RECORDs.

    `read` gives the frames that the host asked to transmit; `write` takes frames of the bus. A bit rate that the host
    set other than the bus's loses all frames both ways, a data bit rate those that switch to it.

    Args:
        link: path of a symbolic link to make to the pty; None: the pty's own name.
        rates: of the bus; also the adapter's until the host sets others.
        extended: 29-bit identifiers, for the target string.

    Raises:
        LinkError: `link` cannot be made.
    """

    def __init__(self, link: Path | None, rates: BusRates, extended: bool = False) -> None:
        self._pty = PtyPort(link)
        self._rates = rates
        self._extended = extended
        self.mismatched = 0
        """Frames lost because the host set a bit rate that is not that of the bus."""
        self.refused = 0
        """Lines of the host that were answered with a bell."""
        self.answers_dropped = 0
        """Answers for which the host left no room."""
        self._reset()

    def _reset(self) -> None:
        """Take the state that an adapter has when it gets power."""
        self._parser = SlcanParser()
        self._malformed = 0
        self._open = self._listen_only = self._stamped = False
        self._bitrate: float = self._rates.bitrate
        self._data_bitrate: float | None = self._rates.data_bitrate
        self._status = 0
        self._output = b""  # the rest of a line cut by a full pty, then answers

    @property
    def target(self) -> str:
        """See `Port.target`."""
        path = self._pty.target.removeprefix("serial:")
        options = [("bitrate", str(self._rates.bitrate))]
        if self._rates.fd:
            options += [("fd", "1"), ("data_bitrate", str(self._rates.data_bitrate))]
        return str(CanTarget("slcan", path, tuple(options), extended=self._extended))

    def account(self) -> str:
        """See `Port.account`."""
        lost = f"; {self.mismatched} frames lost at other bit rates" if self.mismatched else ""
        refused = f"; {self.refused} lines refused" if self.refused else ""
        return lost + refused + (f"; {self.answers_dropped} answers dropped" if self.answers_dropped else "")

    def read_fds(self) -> list[int]:
        """See `Port.read_fds`."""
        return self._pty.read_fds()

    def write_fds(self) -> list[int]:
        """See `Port.write_fds`."""
        return self._pty.write_fds()

    def read(self) -> bytes:
        """Obey the host's lines that have come; return the frames among them that go to the bus."""
        sent: list[NDArray[np.void]] = []
        records = self._parser.feed(self._pty.read(), 0.0)
        done = 0
        for reply in self._parser.replies:
            sent.append(self._transmit(records[done : reply.frames]))
            done = reply.frames
            self._answer(self._obey(reply.text))
        sent.append(self._transmit(records[done:]))
        self._parser.replies.clear()
        for _ in range(self._parser.malformed - self._malformed):
            self._answer(BELL)
        self._malformed = self._parser.malformed
        self._flush()
        return b"".join([each.tobytes() for each in sent])

    def write(self, data: bytes) -> int:
        """Take whole records of the bus for the host; return how many bytes of them, 0 while the pty is full.

        A frame that the host cannot see (closed channel, other bit rate) is taken and lost. An error frame has no line
        in slcan: it sets the bits that the command F reads.
        """
        records = np.frombuffer(data, CAN_RECORD)
        if not self._open:
            return len(data)
        self._flush()
        if self._output:
            return 0
        errors = records["id"] & ERROR != 0
        seen = self._understood(records) & ~errors
        text = encode(records[seen], stamped=self._stamped)
        written = self._pty.write(text)
        if written and text[written - 1 : written] != END:
            self._output = text[written : text.index(END, written) + 1]
        lines = text.count(END, 0, written) + bool(self._output)
        shown = np.flatnonzero(seen)
        taken = len(records) if lines == len(shown) else int(shown[lines])
        self.mismatched += int(np.count_nonzero(~seen[:taken] & ~errors[:taken]))
        for error in records[:taken][errors[:taken]]:
            self._note(error)
        return taken * RECORD_BYTES

    def unplug(self) -> None:
        """See `Port.unplug`."""
        self._pty.unplug()
        self._reset()

    def plug(self) -> None:
        """See `Port.plug`."""
        self._pty.plug()

    def _understood(self, records: NDArray[np.void]) -> NDArray[np.bool_]:
        """Return which of these frames pass between the host's bit rates and the bus's."""
        if not _same(self._bitrate, self._rates.bitrate):
            return np.zeros(len(records), bool)
        if _same(self._data_bitrate, self._rates.data_bitrate):
            return np.ones(len(records), bool)
        one_rate: NDArray[np.bool_] = records["flags"] & BRS == 0
        return one_rate

    def _transmit(self, records: NDArray[np.void]) -> NDArray[np.void]:
        """Answer each of the host's frames and return those that reach the bus."""
        allowed = np.full(len(records), self._open and not self._listen_only)
        if not self._rates.fd:
            allowed &= records["flags"] & FDF == 0
        for extended, accepted in zip((records["id"] & EXTENDED != 0).tolist(), allowed.tolist(), strict=True):
            self._answer((b"Z\r" if extended else b"z\r") if accepted else BELL)
        understood = self._understood(records)
        self.mismatched += int(np.count_nonzero(allowed & ~understood))
        return records[allowed & understood]

    def _obey(self, line: bytes) -> bytes:
        """Return the answer to a line that is no frame."""
        if line == b"C":
            self._open = False
            return END
        if line in _FIXED_ANSWERS:
            return _FIXED_ANSWERS[line]
        if self._open:
            return self._tell_status() if line == b"F" else BELL
        return END if self._set_up(line) else BELL

    def _set_up(self, line: bytes) -> bool:
        """Obey a command that only a closed channel takes; return whether it is one."""
        letter, argument = line[:1], line[1:]
        if line in (b"O", b"L"):
            self._open, self._listen_only = True, line == b"L"
        elif line in _BITRATES:
            self._bitrate = _BITRATES[line]
        elif letter == b"s" and _is_hex(argument, 4):
            self._bitrate = _register_bitrate(int(argument[:2], 16), int(argument[2:], 16))
        elif line in _DATA_BITRATES:
            self._data_bitrate = _DATA_BITRATES[line]
        elif line in (b"Z0", b"Z1"):
            self._stamped = line == b"Z1"
        else:  # filters that let everything pass, and frames sent to the host unasked: as it is here anyway
            return (
                line in (b"W0", b"W1", b"X1")
                or (letter == b"M" and _is_hex(argument, 8))
                or (letter == b"m" and argument.upper() == _EVERYTHING)
            )
        return True

    def _tell_status(self) -> bytes:
        status, self._status = self._status, 0
        return b"F%02X" % status + END

    def _note(self, error: np.void) -> None:
        kind, change = int(error["id"]), int(error["data"][1])
        if kind & ERROR_CONTROLLER:
            self._status |= _OVERRUN if change & ERROR_OVERFLOW else 0
            self._status |= _WARNING if change & _LINUX_WARNING else 0
            self._status |= _PASSIVE if change & _LINUX_PASSIVE else 0
        if kind & (ERROR_PROTOCOL | ERROR_BUS):
            self._status |= _BUS_ERROR

    def _answer(self, answer: bytes) -> None:
        self.refused += answer == BELL
        if len(self._output) + len(answer) <= MAX_ANSWERS:
            self._output += answer
        else:
            self.answers_dropped += 1

    def _flush(self) -> None:
        if self._output:
            self._output = self._output[self._pty.write(self._output) :]


def _same(one: float | None, other: float | None) -> bool:
    if one is None or other is None:  # a classic bus has no data bit rate that could differ
        return True
    return abs(one - other) <= _RATE_TOLERANCE * other


def _register_bitrate(btr0: int, btr1: int) -> float:
    """Return the bit rate that an SJA1000's timing registers set."""
    quanta = 1 + (btr1 & 15) + 1 + (btr1 >> 4 & 7) + 1
    return TIMING_CLOCK / ((btr0 & 63) + 1) / quanta


def _is_hex(text: bytes, digits: int) -> bool:
    return len(text) == digits and all(byte in b"0123456789abcdefABCDEF" for byte in text)

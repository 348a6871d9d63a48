"""A socketcand server by which the simulated CAN bus can be joined.

It is a port (`sim.ports.byte_ports.Port`) whose bytes are rows of `CAN_RECORD`: `read` gives the frames that a host
sent, `write` takes those that the host is to see. It knows no HBP and never blocks.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from protocol.canmap.frame import (
    ERROR,
    EXTENDED,
    EXTENDED_MASK,
    FDF,
    RECORD,
    RECORD_BYTES,
    REMOTE,
    STANDARD_MASK,
    BusRates,
)
from protocol.errors import LinkError
from protocol.links.target import CanTarget
from sim.ports.byte_ports import TcpPort

CHANNEL = "can0"
QUIET = 0.1
"""Seconds after the handshake in which a client is not sent frames, unless it sends first: python-can takes a frame
that arrives together with the last `< ok >` for a failed handshake."""

_MAX_OUTPUT = 262144  # bytes of text that wait for a slow client; more frames are not taken
_MAX_MESSAGE = 200  # bytes; python-can gives up a longer one too
_SEND = re.compile(rb"< send ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8}) ([0-8])((?: [0-9A-Fa-f]{1,2}){0,8}) *>")


@dataclass(slots=True)
class _Session:
    """What a client has sent and not finished, is still to be sent, and how far it has come."""

    input: bytearray = field(default_factory=bytearray)
    output: bytearray = field(default_factory=bytearray)
    opened: bool = False
    raw_since: float | None = None
    spoke: bool = False


class SocketcandPort(TcpPort):
    """A socketcand server (https://github.com/linux-can/socketcand) in raw mode, for one client at a time.

    A second client is closed at once. Frames that come while nobody listens are taken and gone, as on a bus.

    Args:
        host: address to listen on, IPv4.
        port: its port; 0 takes a free one.
        rates: of the bus, for the target string.
        extended: 29-bit identifiers, likewise.
        clock: seconds, for `QUIET`.

    Raises:
        LinkError: the address cannot be listened on, or a CAN FD bus: python-can's socketcand has no such frames.
    """

    def __init__(
        self,
        host: str,
        port: int,
        rates: BusRates,
        extended: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if rates.fd:
            raise LinkError(f"socketcand has no CAN FD frames, and the bus is {rates}: take a classic bus or slcan")
        self.malformed = 0
        """Messages of clients that could not be read."""
        self.dropped = 0
        """Remote and CAN FD frames, which python-can's socketcand has no form for, and answers that nobody reads."""
        self._rates = rates
        self._extended = extended
        self._clock = clock
        self._session = _Session()
        super().__init__(host, port)

    @property
    def target(self) -> str:
        """See `Port.target`."""
        host, port = self._address
        options = (("host", host), ("port", str(port)), *_rate_options(self._rates))
        return str(CanTarget("socketcand", CHANNEL, options, extended=self._extended))

    def read(self) -> bytes:
        """See `Port.read`."""
        data = super().read()
        self._flush()
        buffer = self._session.input
        buffer += data
        rows = bytearray()
        while (end := buffer.find(b">")) >= 0:
            message = bytes(buffer[: end + 1])
            del buffer[: end + 1]
            rows += self._obey(message[max(0, message.find(b"<")) :])
        if len(buffer) > _MAX_MESSAGE:
            buffer.clear()
            self.malformed += 1
        return bytes(rows)

    def write(self, data: bytes) -> int:
        """See `Port.write`; whole records."""
        taken = len(data)
        if self._listens:
            taken = 0
            for number, length, flags, _, when, payload in RECORD.iter_unpack(data):
                if len(self._session.output) >= _MAX_OUTPUT:
                    break
                taken += RECORD_BYTES
                if number & REMOTE or flags & FDF:
                    self.dropped += 1
                elif number & ERROR:
                    self._session.output += b"< error %03X %.6f >" % (number & EXTENDED_MASK, when)
                else:
                    name = b"%08X" % (number & EXTENDED_MASK) if number & EXTENDED else b"%03X" % number
                    # without data too there are two blanks before the >: python-can looks for them
                    text = payload[:length].hex().upper().encode()
                    self._session.output += b"< frame %s %.6f %s >" % (name, when, text)
        self._flush()
        return taken

    @property
    def _listens(self) -> bool:
        session = self._session
        return session.raw_since is not None and (session.spoke or self._clock() - session.raw_since >= QUIET)

    def _obey(self, message: bytes) -> bytes:
        """Do what a message asks for; give the frame that it sends."""
        session = self._session
        if session.raw_since is not None and message.startswith(b"< send "):
            session.spoke = True
            frame = _read_frame(message)
            if not frame:
                self.malformed += 1  # without an answer, as socketcand does: python-can would take it for a lost bus
            return frame
        if message == b"< echo >":
            self._reply(message)
        elif session.raw_since is None and message == b"< open %s >" % CHANNEL.encode():
            session.opened = True
            self._reply(b"< ok >")
        elif session.raw_since is None and message.startswith(b"< open "):
            self._reply(b"< error could not open bus >")
        elif session.opened and session.raw_since is None and message == b"< rawmode >":
            session.raw_since = self._clock()
            self._reply(b"< ok >")
        else:
            self.malformed += 1
            self._reply(b"< error unknown command >")
        return b""

    def _reply(self, text: bytes) -> None:
        if len(self._session.output) < _MAX_OUTPUT:
            self._session.output += text
        else:
            self.dropped += 1
        self._flush()

    def _flush(self) -> None:
        if self._session.output:
            del self._session.output[: super().write(bytes(self._session.output))]

    def _accept(self) -> None:
        before = self._client
        super()._accept()
        if self._client is not before:
            self._reply(b"< hi >")

    def _drop_client(self) -> None:
        super()._drop_client()
        self._session = _Session()


def _rate_options(rates: BusRates) -> tuple[tuple[str, str], ...]:
    fd = () if rates.data_bitrate is None else (("fd", "1"), ("data_bitrate", str(rates.data_bitrate)))
    return (("bitrate", str(rates.bitrate)), *fd)


def _read_frame(message: bytes) -> bytes:
    """Return the record of a `< send … >`; b"" if it is none."""
    sent = _SEND.fullmatch(message)
    if sent is None:
        return b""
    number, extended = int(sent[1], 16), len(sent[1]) == 8
    data = bytes(int(byte, 16) for byte in sent[3].split())
    if len(data) != int(sent[2]) or number > (EXTENDED_MASK if extended else STANDARD_MASK):
        return b""
    return RECORD.pack(number | (EXTENDED if extended else 0), len(data), 0, 0, 0.0, data)

"""What a link is, and the part that every link over a file descriptor shares.

A link moves bytes and nothing else: it knows no messages, retries nothing and never waits longer than it was
told to. A failure is a named error (`protocol.errors`), never silence.
"""

from __future__ import annotations

import os
import select
import time
from abc import ABC, abstractmethod
from typing import Protocol

from protocol.errors import LinkClosed, LinkError
from protocol.wire import ByteWire, HostWire

MAX_READ = 65536
"""Most bytes that one `read` returns."""

SLICE, AGAIN, BRIM = 0.01, 0.001, 12285
"""Seconds after which a settling read empties the kernel's buffer, and after which it does where that had held so many
bytes: a pty was full then, and its writer has more."""

FULL, REFILL = 4095, 0.0005
"""Bytes that Linux keeps ready of a tty's: a read of fewer took all; seconds in which it makes more of them ready."""

WRITE_TIMEOUT = 0.5
"""Seconds that `write` may take; a link that takes nothing for so long has failed."""


class Link(Protocol):
    """A byte link to a device, with the clock that its time-outs are counted on."""

    @property
    def name(self) -> str:
        """The link as errors show it, for example `/dev/ttyACM0`."""

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        """Bytes that have arrived, at most `MAX_READ`; b"" when none came within `timeout` seconds.

        `settle` is the time in seconds to go on collecting after the first byte, about: a reader of a stream that
        trickles in wakes once every `settle` seconds instead of at every packet.

        Raises:
            LinkClosed: the link is gone. Bytes that came before are returned first.
        """

    def write(self, data: bytes) -> None:
        """Hand all of `data` to the link, within `WRITE_TIMEOUT`.

        Raises:
            LinkClosed: the link is gone.
            LinkError: the link took only a part of it in time.
        """

    def close(self) -> None:
        """Let go of the link. Closing a closed link does nothing."""

    def reopen(self) -> None:
        """Close, then open the same target again, once: after an unplug the caller tries until it is back.

        Raises:
            LinkNotFound: it is not there (yet).
            LinkBusy: another program holds it.
        """

    def clock(self) -> float:
        """Seconds of a monotonic clock: real time, or virtual time on a link to a simulation."""

    def wire(self) -> HostWire:
        """A new host's end of the language that this kind of link speaks."""


class DescriptorLink(ABC):
    """Read and write of a link over a non-blocking file descriptor: select, then take what is there.

    A link that is none on every system brings its own `_come`, `_ready`, `_take`, `_give` and `_room`.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        """The link as errors show it."""
        self._heard = False  # whether anything came since it was opened
        self._due = 0.0  # s of the monotonic clock, when the kernel's buffer should be emptied
        self._held = bytearray()  # received, and not returned yet: an exception of a signal may end a read

    def clock(self) -> float:
        """Seconds of the machine's monotonic clock."""
        return time.monotonic()

    def wire(self) -> HostWire:
        """See `Link.wire`."""
        return ByteWire()

    def reopen(self) -> None:
        """See `Link.reopen`."""
        self.close()
        self._held.clear()
        self._heard = False
        self._open()

    @abstractmethod
    def _open(self) -> None:
        """Open the target."""

    @abstractmethod
    def _fileno(self) -> int:
        """The open file descriptor, or -1 when closed."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the link."""

    @abstractmethod
    def _gone(self, cause: OSError | None) -> LinkClosed:
        """The error that says how this kind of link is lost; `cause` is None at an end of file."""

    def _closed(self) -> bool:
        return self._fileno() < 0

    def _ready(self, timeout: float) -> bool:
        """Whether bytes can be read within `timeout` s. OSError if the link is gone, or True, and the read tells."""
        return readable(self._fileno(), timeout)

    def _come(self, timeout: float) -> bool:
        """The same, for a read that settles."""
        return self._ready(timeout)

    def _take(self, most: int) -> bytes:
        """Up to so many bytes that have come; b"" at the end of the link. BlockingIOError for none, else OSError."""
        return os.read(self._fileno(), most)

    def _give(self, data: memoryview) -> int:
        """How many bytes of it were taken. BlockingIOError for none, else OSError."""
        return os.write(self._fileno(), data)

    def _room(self, timeout: float) -> bool:
        """Whether the link takes more within `timeout` s."""
        return writable(self._fileno(), timeout)

    def _require_open(self) -> None:
        if self._closed():
            raise LinkClosed(f"{self.name} is closed")

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        """See `Link.read`."""
        self._require_open()
        try:
            if not self._held and not (self._come if settle > 0.0 else self._ready)(max(0.0, timeout)):
                return b""
        except OSError as error:
            raise self._gone(error) from None
        until = max(time.monotonic(), self._due) + settle if settle > 0.0 else 0.0
        while True:
            if (pause := min(until, self._due) - time.monotonic()) > 0.0:
                time.sleep(pause)
            start, before = time.monotonic(), len(self._held)
            more = self._drain(REFILL if settle > 0.0 else 0.0)
            self._due = start + (SLICE if len(self._held) < before + BRIM else AGAIN)
            if not more or time.monotonic() >= until:
                got, self._held = self._held, bytearray()
                return bytes(got)

    def _drain(self, refill: float) -> bool:
        """Hold what has arrived, up to `MAX_READ` in all; False if no more can be taken now.

        Linux hands a pty's bytes over by another thread: after each read of `FULL` `refill` s are waited for more.
        """
        wait = 0.0
        while (free := MAX_READ - len(self._held)) > 0:
            try:
                if not self._come(wait):
                    return True
                part = self._take(free)
            except BlockingIOError:
                return True
            except OSError as error:
                if self._held:  # the caller gets the tail now and the error at the next read
                    return False
                raise self._gone(error) from None
            if not part:
                if self._held:
                    return False
                raise self._gone(None)
            self._heard = True
            self._held += part
            if len(part) < FULL:
                return True
            wait = refill
        return False

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._require_open()
        rest = memoryview(data)
        deadline = time.monotonic() + WRITE_TIMEOUT
        while rest:
            try:
                rest = rest[self._give(rest) :]
            except BlockingIOError:
                left = deadline - time.monotonic()
                if left <= 0.0 or not self._room(left):
                    sent = len(data) - len(rest)
                    raise LinkError(
                        f"{self.name} took {sent} of {len(data)} bytes in {WRITE_TIMEOUT:g} s: "
                        "nothing at the other end reads"
                    ) from None
            except OSError as error:
                raise self._gone(error) from None


def readable(fd: int, timeout: float) -> bool:
    """Whether a descriptor can be read within `timeout` s."""
    return bool(select.select([fd], [], [], timeout)[0])


def writable(fd: int, timeout: float) -> bool:
    """Whether a descriptor can be written within `timeout` s."""
    return bool(select.select([], [fd], [], timeout)[1])

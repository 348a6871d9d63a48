"""Link over a serial port: a UART adapter, a microcontroller's USB port, or a pty.

pyserial opens and locks the port; `protocol.links.serial_port` reads and writes.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import sys
import time

import serial
from serial.tools import list_ports

from protocol.errors import LinkBusy, LinkClosed, LinkError, LinkNotFound, TargetError
from protocol.links.base import DescriptorLink
from protocol.links.read_ahead import ReadAhead
from protocol.links.rivals import rivals
from protocol.links.serial_port import DescriptorPort, PolledPort
from protocol.links.target import SerialTarget
from protocol.wire import ByteWire, HostWire

_GONE = {errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO}
_RATE_TOLERANCE = 0.03
BOOT = 7.0  # s after opening a port in which a board that was reset by that is waited for
MUCH = 50_000  # bytes/s from which on a port is read ahead: a pty holds 12 KiB, 0.2 s of that
LOOK = 0.005  # s between two looks at a port for which nothing has come
OPENED: type[DescriptorPort | PolledPort] = PolledPort if sys.platform == "win32" else DescriptorPort
"""What reads and writes a port on this system."""
_TOLD = re.compile(r"Error\((\d+), .*, None, (\d+)\)")  # errno and Windows' own number, in pyserial's words there
_WRONG_PARAMETER = 87  # Windows' number of it


class SerialLink(DescriptorLink):
    """A serial port, 8N1, no flow control, locked against other programs that lock.

    Raises:
        LinkNotFound: no such port; the message lists those that are there.
        LinkBusy: another program holds it.
        TargetError: the port cannot run at that rate.
        LinkError: it is no serial port, or may not be opened by this user.
    """

    def __init__(self, target: SerialTarget) -> None:
        super().__init__(target.port)
        self.target = target
        self._port: serial.Serial | None = None
        self._ahead: ReadAhead | None = None
        self._much = False  # whether much is expected of it
        self._opened: DescriptorPort | PolledPort | None = None
        self._open()

    def _open(self) -> None:
        port, baud = self.target.port, self.target.baud
        try:
            opened = serial.Serial(port, baud, exclusive=True)
        except serial.SerialException as error:
            raise self._cannot_open(error) from None
        except (ValueError, OverflowError):
            raise self._bad_rate() from None
        except OSError as error:
            raise self._cannot_open(error) from None
        try:
            self._opened = OPENED(opened)
            actual = self._opened.rate()
        except OSError as error:
            opened.close()
            raise LinkNotFound(f"{port} disappeared while being opened: {error}") from None
        if actual is not None and abs(actual - baud) > _RATE_TOLERANCE * baud:
            opened.close()
            raise self._bad_rate(actual)
        self._port = opened
        if self._much:
            self._read_ahead()

    def _bad_rate(self, actual: int | None = None) -> TargetError:
        port, baud = self.target.port, self.target.baud
        instead = f" (its driver would run at {actual})" if actual else ""
        return TargetError(f"{port} cannot run at {baud} baud{instead}: choose another rate")

    def _cannot_open(self, error: OSError) -> LinkError | TargetError:
        port, number = self.target.port, error.errno
        if told := _TOLD.search(str(error)):
            if int(told[2]) == _WRONG_PARAMETER:
                return self._bad_rate()
            number = errno.EBUSY if int(told[1]) == errno.EACCES else int(told[1])  # Windows refuses a second opening
        if number in (errno.EAGAIN, errno.EBUSY):
            named = f" ({', '.join(others)})" if (others := rivals(port)) else ""
            return LinkBusy(f"{port} is held by another program{named}: close it and try again")
        if number in (errno.EACCES, errno.EPERM):
            return LinkError(f"no permission for {port}: add your user to its group (often dialout)")
        if number in _GONE:
            ports = [info.device for info in list_ports.comports()]
            there = f"ports here: {', '.join(ports)}" if ports else "this machine has no serial port"
            return LinkNotFound(f"no port {port}; {there}")
        if number == errno.EISDIR or "Could not configure port" in str(error):
            return LinkError(f"{port} is not a serial port")
        return LinkError(f"cannot open {port}: {error}")

    def oddities(self) -> list[str]:
        """Why nothing may come, if that is known: another program has the port open, too."""
        names = " and ".join(rivals(self.target.port, 0 if self._ahead is None else self._ahead.pid))
        return [f"{names} has {self.target.port} open, too, and may take what comes: close it"] if names else []

    def wire(self) -> HostWire:
        """See `Link.wire`."""
        return ByteWire(self.target.baud, BOOT, self.target.open_delay)

    def expect(self, rate: float) -> None:
        """So many bytes/s will come. Of much a busy host would lose some: then the port is read ahead from now on."""
        if rate > MUCH and not self._much:
            self._much = True
            self._read_ahead()

    def _read_ahead(self) -> None:
        self._require_open()
        if isinstance(self._opened, DescriptorPort) and sys.executable:
            with contextlib.suppress(OSError):  # else it is read from here
                self._ahead = ReadAhead(self._fileno())

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        """See `Link.read`."""
        if self._ahead is not None and not self._held and self._ahead.ready():
            got = self._ahead.read(timeout, settle)
            if got is not None:
                return got
            self._read_here()  # the port is gone, which it tells itself, or that process is
            timeout = 0.0
        return super().read(timeout, settle)

    def _read_here(self) -> None:
        if self._ahead is not None:
            self._ahead.close()
            self._ahead = None

    def close(self) -> None:
        """See `Link.close`."""
        self._read_here()
        if self._port is not None:
            self._port.close()
            self._port = self._opened = None

    def _closed(self) -> bool:
        return self._port is None

    def _fileno(self) -> int:
        return -1 if self._port is None else int(self._port.fileno())

    def _ready(self, timeout: float) -> bool:
        """See `DescriptorLink._ready`."""
        return super()._ready(timeout) if isinstance(self._opened, DescriptorPort) else self._come(timeout)

    def _come(self, timeout: float) -> bool:
        """See `DescriptorLink._come`. On an empty port `select` and `read` stand still until Linux's worker had a core.

        On a busy machine that was 0.3 s, too long for a drive's watchdog: it is only asked how many bytes there are.
        """
        end = 0.0
        there = self._there
        while not there.waiting():
            if (now := time.monotonic()) >= (end := end or now + timeout):
                return False
            time.sleep(min(end - now, LOOK))
        return True

    @property
    def _there(self) -> DescriptorPort | PolledPort:
        if self._opened is None:  # another thread has closed it
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        return self._opened

    def _take(self, most: int) -> bytes:
        return self._there.take(most)

    def _give(self, data: memoryview) -> int:
        return self._there.give(data)

    def _room(self, timeout: float) -> bool:
        return self._there.room(timeout)

    def _gone(self, cause: OSError | None) -> LinkClosed:
        self.close()
        why = "" if cause is None else f" ({cause.strerror or cause})"
        return LinkClosed(f"{self.name} is gone{why}: unplugged, or the device was reset")

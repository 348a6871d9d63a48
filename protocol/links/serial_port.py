"""An open serial port as the operating system gives it: by its descriptor, or, on Windows, by pyserial's own calls."""

from __future__ import annotations

import os
import struct
import sys

import serial

from protocol.links.base import WRITE_TIMEOUT, writable

if sys.platform != "win32":
    import fcntl
    import termios

_TCGETS2 = 0x802C542A
_TERMIOS2 = struct.Struct("=4I20x2I")  # c_iflag..c_lflag, c_line and c_cc, c_ispeed, c_ospeed
_RECEIVED = 1 << 20  # bytes that Windows' driver is asked to keep: pyserial asks for 4096, 14 ms at 3 Mbaud
_PART = 4096  # bytes of one write


class DescriptorPort:
    """By the descriptor: pyserial's read throws away the bytes that it holds when the port vanishes.

    OSError where the port is gone.
    """

    def __init__(self, port: serial.Serial) -> None:
        self._fd = int(port.fileno())
        self.set_up()

    def set_up(self) -> None:
        """VMIN = 1: an empty read then means that the port is gone, never that there is nothing to read."""
        if sys.platform != "win32":
            try:
                attributes = termios.tcgetattr(self._fd)
                attributes[6][termios.VMIN] = 1
                attributes[6][termios.VTIME] = 0
                termios.tcsetattr(self._fd, termios.TCSANOW, attributes)
            except termios.error as error:
                raise OSError(*error.args) from None

    def waiting(self) -> bool:
        """Whether there are bytes to read."""
        if sys.platform != "win32":
            return any(fcntl.ioctl(self._fd, termios.FIONREAD, bytes(4)))
        raise NotImplementedError

    def take(self, most: int) -> bytes:
        """Up to so many bytes; b"" at the end of the port, BlockingIOError where there are none."""
        return os.read(self._fd, most)

    def give(self, data: memoryview) -> int:
        """Send some of it; returns how many bytes that was. BlockingIOError where there is no room."""
        return os.write(self._fd, data)

    def room(self, timeout: float) -> bool:
        """Whether there is room within `timeout` s."""
        return writable(self._fd, timeout)

    def rate(self) -> int | None:
        """See `line_rate`."""
        return line_rate(self._fd)


class PolledPort:
    """By pyserial's own calls, where a port has no descriptor to wait for. As `DescriptorPort`."""

    def __init__(self, port: serial.Serial) -> None:
        self._port = port
        port.timeout, port.write_timeout = 0.0, WRITE_TIMEOUT
        if hasattr(port, "set_buffer_size"):
            port.set_buffer_size(_RECEIVED)

    def set_up(self) -> None:
        """See `DescriptorPort.set_up`: nothing that pyserial would set back."""

    def waiting(self) -> bool:
        """See `DescriptorPort.waiting`."""
        return bool(self._port.in_waiting)

    def take(self, most: int) -> bytes:
        """See `DescriptorPort.take`."""
        if not (n := min(most, self._port.in_waiting)):
            raise BlockingIOError
        return bytes(self._port.read(n))

    def give(self, data: memoryview) -> int:
        """See `DescriptorPort.give`; waits for room itself."""
        try:
            return int(self._port.write(bytes(data[:_PART])) or 0)
        except serial.SerialTimeoutException:
            raise BlockingIOError from None

    def room(self, timeout: float) -> bool:
        """See `DescriptorPort.room`: `give` has waited."""
        return False

    def rate(self) -> int | None:
        """See `line_rate`: Windows refuses a rate that the driver lacks."""
        return None


def line_rate(fd: int) -> int | None:
    """The rate in baud at which a terminal's driver says it sends; None where this system does not tell."""
    rate: int | None
    if sys.platform == "linux":
        state = bytearray(_TERMIOS2.size)
        try:
            fcntl.ioctl(fd, _TCGETS2, state)
        except OSError:
            return None
        rate = int(_TERMIOS2.unpack(state)[5])
    else:
        rate = None
    return rate

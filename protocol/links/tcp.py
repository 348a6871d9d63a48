"""Link over TCP: to a simulated drive, or to a serial port that another machine shares."""

from __future__ import annotations

import contextlib
import errno
import os
import socket

from protocol.errors import LinkClosed, LinkNotFound
from protocol.links.base import DescriptorLink
from protocol.links.target import TcpTarget

CONNECT_TIMEOUT = 3.0
"""Seconds that `open` and `reopen` wait for the connection."""


class TcpLink(DescriptorLink):
    """A TCP connection, without Nagle's delay.

    Raises:
        LinkNotFound: no such host, nothing listens there, or no answer within `CONNECT_TIMEOUT`.
    """

    def __init__(self, target: TcpTarget) -> None:
        super().__init__(str(target))
        self.target = target
        self._socket: socket.socket | None = None
        self._open()

    def _open(self) -> None:
        host, port = self.target.host, self.target.port
        try:
            connection = socket.create_connection((host, port), CONNECT_TIMEOUT)
        except socket.gaierror as error:
            raise LinkNotFound(f"{self.name}: no host '{host}': {error.strerror}") from None
        except UnicodeError:  # an empty or overlong part between the dots
            raise LinkNotFound(f"{self.name}: '{host}' is not a host name") from None
        except TimeoutError:
            raise LinkNotFound(f"{self.name}: no answer within {CONNECT_TIMEOUT:g} s") from None
        except ConnectionRefusedError:
            raise LinkNotFound(
                f"{self.name}: nothing listens on port {port} of {host}: is the drive running?"
            ) from None
        except OSError as error:
            raise LinkNotFound(f"{self.name}: {error.strerror or error}") from None
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(False)
        self._socket = connection

    def close(self) -> None:
        """See `Link.close`."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None

    def _fileno(self) -> int:
        return -1 if self._socket is None else self._socket.fileno()

    def _take(self, most: int) -> bytes:
        """See `DescriptorLink._take`: Windows reads a socket by no other call."""
        return self._opened.recv(most)

    def _give(self, data: memoryview) -> int:
        """See `DescriptorLink._give`."""
        return self._opened.send(data)

    @property
    def _opened(self) -> socket.socket:
        if self._socket is None:  # another thread has closed it
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        return self._socket

    def _gone(self, cause: OSError | None) -> LinkClosed:
        self.close()
        if not self._heard:
            return LinkClosed(
                f"{self.name} closed the connection without a word: "
                "is another program connected? (a drive takes one client at a time)"
            )
        if cause is None:
            return LinkClosed(f"{self.name} was closed by the other end")
        return LinkClosed(f"{self.name} was lost: {cause.strerror or cause}")

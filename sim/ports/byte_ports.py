"""Where the simulated drive can be plugged in: a pty, which looks like a serial port, or a TCP port.

A port never blocks: it gives what has arrived and takes what fits. It knows no frames. A full pty may say once that it
is writable; after a second write it says so only when it has room.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
import socket
import sys
from pathlib import Path
from typing import Protocol

from protocol.errors import LinkError
from protocol.links.serial_port import line_rate
from protocol.links.target import SerialTarget, TcpTarget
from sim.ports.uart import misread, same_rate

_CHUNK = 65536
_SEND_BUFFER = 262144  # bytes that the kernel may hold for a slow TCP client
HAS_PTY = sys.platform != "win32"
NO_PTY = "this system has no pseudo terminals: serve on TCP, bench sim --tcp 127.0.0.1:7000"
_PTY = re.compile(r"/dev/(pts/|ttys)\d+")
_TURNED_AWAY = 8  # clients that are given time to read that there is another


class Port(Protocol):
    """A place for one host at a time."""

    @property
    def target(self) -> str:
        """The target string by which a host reaches it."""

    def read_fds(self) -> list[int]:
        """Descriptors whose readiness means that `read` has something to do."""

    def write_fds(self) -> list[int]:
        """Descriptors whose readiness means that `write` takes something again."""

    def read(self) -> bytes:
        """What has arrived; b"" when nothing has."""

    def write(self, data: bytes) -> int:
        """How many bytes of `data` were taken; all of them when nobody is there to miss them."""

    def unplug(self) -> None:
        """Vanish, as when the cable is pulled; at the end too."""

    def account(self) -> str:
        """What there is to say at the end."""

    def plug(self) -> None:
        """Come back after `unplug`."""


class PtyPort:
    """A pty, under its own name or a symbolic link that survives `unplug` and `plug`.

    The server keeps the slave side open too, so a host that comes and goes is like a cable with nobody
    listening: the port stays, and what the line does not take is dropped by the device.

    Args:
        link: path of a symbolic link to make; a link to a pty, as an earlier run leaves it, is replaced, anything else
            refused.
        baud: rate of the simulated UART; a host that sets another reads and writes rubbish. None: like a
            microcontroller's USB port, which ignores the rate.

    Raises:
        LinkError: `link` cannot be made, or the system has no ptys.
    """

    def __init__(self, link: Path | None = None, baud: int | None = None) -> None:
        self._link = link
        self._baud = baud
        self._master = self._slave = -1
        self._name = ""
        self.plug()

    @property
    def target(self) -> str:
        """See `Port.target`."""
        path = str(self._link) if self._link is not None else self._name
        return str(SerialTarget(path, self._baud) if self._baud is not None else SerialTarget(path))

    def plug(self) -> None:
        """See `Port.plug`."""
        if self._master >= 0:
            return
        self._master, self._slave, self._name = _new_pty()
        if self._link is not None:
            try:
                if self._link.is_symlink() and _PTY.fullmatch(os.readlink(self._link)):
                    self._link.unlink()
                self._link.symlink_to(self._name)
            except OSError as error:
                self.unplug()
                why = str(error.strerror)
                if self._link.is_symlink():
                    why = "another link exists there, not to a pty; remove it or choose another path"
                raise LinkError(f"cannot make the link {self._link}: {why}") from None

    def unplug(self) -> None:
        """See `Port.unplug`."""
        if self._master < 0:
            return
        os.close(self._slave)
        os.close(self._master)
        self._master = self._slave = -1
        if self._link is not None:
            with contextlib.suppress(OSError):
                if os.readlink(self._link) == self._name:
                    self._link.unlink()

    def account(self) -> str:
        """See `Port.account`."""
        return ""

    def read_fds(self) -> list[int]:
        """See `Port.read_fds`."""
        return [self._master] if self._master >= 0 else []

    write_fds = read_fds

    def read(self) -> bytes:
        """See `Port.read`."""
        data = b""
        if self._master >= 0:
            with contextlib.suppress(OSError):
                data = os.read(self._master, _CHUNK)
        rate = self._host_rate()
        return data if rate is None else misread(data, rate, self._baud or rate)

    def write(self, data: bytes) -> int:
        """See `Port.write`."""
        if self._master < 0:
            return len(data)
        rate = self._host_rate()
        try:
            if rate is None:
                return os.write(self._master, data)
            # rubbish is longer or shorter than what it was: it is taken whole, whatever fits of it
            os.write(self._master, misread(data, self._baud or rate, rate))
        except OSError:
            return 0 if rate is None else len(data)
        return len(data)

    def _host_rate(self) -> int | None:
        """The host's rate where it differs from ours."""
        if self._baud is None or self._master < 0:
            return None
        rate = line_rate(self._master)
        return None if rate is None or same_rate(self._baud, rate) else rate


def _new_pty() -> tuple[int, int, str]:
    """Descriptors of both ends, the first one not blocking, and the name of the other."""
    if sys.platform == "win32":
        raise LinkError(NO_PTY)
    else:  # noqa: RET506
        import tty

        try:
            master, slave = os.openpty()
        except OSError as error:
            raise LinkError(f"no pty available: {error.strerror}") from None
        tty.setraw(slave)
        os.set_blocking(master, False)
        return master, slave, os.ttyname(slave)


class TcpPort:
    """A listening TCP port that serves one client at a time.

    A second client is accepted and gets an end of file at once, instead of waiting.

    Raises:
        LinkError: the address cannot be listened on.
    """

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._turned_away: list[socket.socket] = []
        self.refused = 0
        """Clients sent away because another was there."""
        self.plug()

    @property
    def target(self) -> str:
        """See `Port.target`."""
        return str(TcpTarget(*self._address))

    @property
    def exposed(self) -> bool:
        """Whether other machines reach it."""
        if self._listener is None:
            return False
        return not ipaddress.ip_address(self._listener.getsockname()[0].partition("%")[0]).is_loopback

    def plug(self) -> None:
        """See `Port.plug`."""
        if self._listener is not None:
            return
        host, port = self._address
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            listener = socket.create_server((host, port), family=family, backlog=4)
        except OSError as error:
            raise LinkError(f"cannot listen on {TcpTarget(host, port)}: {error.strerror or error}") from None
        listener.setblocking(False)
        self._listener = listener
        self._address = (host, listener.getsockname()[1])

    def unplug(self) -> None:
        """See `Port.unplug`."""
        self._drop_client()
        while self._turned_away:
            self._turned_away.pop().close()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def account(self) -> str:
        """See `Port.account`."""
        return f"; {self.refused} clients refused" if self.refused else ""

    def read_fds(self) -> list[int]:
        """See `Port.read_fds`."""
        return [s.fileno() for s in (self._listener, self._client) if s is not None]

    def write_fds(self) -> list[int]:
        """See `Port.write_fds`."""
        return [] if self._client is None else [self._client.fileno()]

    def read(self) -> bytes:
        """See `Port.read`."""
        data = b""
        if self._client is not None:
            try:
                data = self._client.recv(_CHUNK)
                if not data:
                    self._drop_client()
            except BlockingIOError:
                pass
            except OSError:
                self._drop_client()
        self._turned_away = [client for client in self._turned_away if _drained(client)]
        self._accept()  # last: a client that has gone makes room for the next
        return data

    def write(self, data: bytes) -> int:
        """See `Port.write`."""
        if self._client is None:
            return len(data)
        try:
            return self._client.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self._drop_client()
            return len(data)

    def _accept(self) -> None:
        while self._listener is not None:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            if self._client is not None:
                self.refused += 1
                self._turn_away(client)
                continue
            client.setblocking(False)
            try:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
                client.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            except OSError:  # gone again already
                client.close()
                continue
            self._client = client

    def _turn_away(self, client: socket.socket) -> None:
        """Give it an end of file. It is closed when it has closed: before that, what it says would be a reset."""
        client.setblocking(False)
        with contextlib.suppress(OSError):
            client.shutdown(socket.SHUT_WR)
            self._turned_away.append(client)
            if len(self._turned_away) > _TURNED_AWAY:
                self._turned_away.pop(0).close()

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None


def _drained(client: socket.socket) -> bool:
    """Throw away what a client has said; False, and it is closed, once it has nothing more to say."""
    try:
        while client.recv(_CHUNK):
            pass
    except BlockingIOError:
        return True
    except OSError:
        pass
    client.close()
    return False

"""The CAN link through python-can's socketcand, with a server by hand at the other end."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
from can_ends import opened, read
from can_rows import parts, records

from protocol.canmap.frame import ERROR, EXTENDED, BusRates
from protocol.errors import LinkClosed, LinkNotFound, TargetError
from protocol.links import can_open, open_link

BUS = "can:socketcand/can0"
FRAMES = [(0x123, b"\1\2\3", 0), (0x12345678 | EXTENDED, b"\0\x0f\xf0", 0), (0x7FF, bytes(range(8)), 0)]


class Server:
    """A socketcand server with the bus can0, as far as its protocol says: it greets, opens, and then passes text on."""

    def __init__(self, greeting: bytes = b"< hi >") -> None:
        self.heard = b""
        """What the last client has said since the handshake."""
        self._greeting = greeting
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.target = f"{BUS}?host=127.0.0.1&port={self.port}"
        self._clients: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                client = self._listener.accept()[0]
            except OSError:
                return
            self._clients.append(client)
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with suppress(OSError):  # it was stopped meanwhile
            client.sendall(self._greeting)
            for wanted in (b"< open can0 >", b"< rawmode >"):
                said = client.recv(200)
                if not said:
                    return
                client.sendall(b"< ok >" if said == wanted else b"< error could not open bus >")
            self.heard = b""
            while said := client.recv(4096):
                self.heard += said

    def says(self, text: bytes) -> None:
        """Send text to the last client."""
        self._clients[-1].sendall(text)

    def stop(self) -> None:
        for each in (self._listener, *self._clients):
            with suppress(OSError):  # the other end may have gone
                each.shutdown(socket.SHUT_RDWR)
            each.close()


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.stop()


def test_frames_go_both_ways(server: Server) -> None:
    with opened(server.target) as link:
        link.write(records(*FRAMES))
        wanted = b"< send 123 3 1 2 3 >< send 12345678 3 0 F F0 >< send 7FF 8 0 1 2 3 4 5 6 7 >"
        deadline = time.monotonic() + 5.0
        while len(server.heard) < len(wanted) and time.monotonic() < deadline:
            time.sleep(0.001)
        assert server.heard.upper() == wanted.upper()
        server.says(b"< frame 123 1.5 010203 >< frame 12345678 1.5 000FF0 >< frame 7FF 2.0 0001020304050607 >")
        server.says(b"< error 040 12.5 >< error 020 12.6 >")
        got = parts(read(link, 5))
        assert (got[:3], [number & ERROR for number, _, _ in got[3:]]) == (FRAMES, [ERROR, ERROR])
        assert (link.health.error_frames["bus-off"], link.health.error_frames["no ack"]) == (1, 1)
        assert (link.name, link.rates) == (BUS, BusRates())


def test_a_server_that_dies_closes_the_link(server: Server) -> None:
    with opened(server.target) as link:
        server.says(b"< frame 001 0.0 01 >")
        assert parts(read(link, 1)) == [(1, b"\1", 0)]
        server.stop()
        with pytest.raises(LinkClosed, match=f"{BUS} was"):
            read(link, 1, timeout=5.0)
        names = {thread.name for thread in threading.enumerate()}
        assert f"reads {BUS}" not in names  # python-can would spin
        with pytest.raises(LinkNotFound, match="nothing listens"):
            link.reopen()


def test_targets_that_no_server_has(server: Server) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        free = listener.getsockname()[1]
    here = "host=127.0.0.1"
    for target, kind, match in (
        (f"{BUS}?{here}&port={free}", LinkNotFound, f"{BUS}: nothing listens on port {free} of 127.0.0.1"),
        (f"{BUS}?{here}", TargetError, rf"names no server: write {BUS}\?host="),
        (f"can:socketcand?{here}&port=29536", TargetError, rf"can:socketcand names no bus .* write {BUS}\?host="),
        (f"{BUS}?{here}&port=29536&fd=1", TargetError, f"{BUS}: python-can's socketcand has no CAN FD frames: leave"),
        (server.target.replace("can0", "can9"), LinkNotFound, "^can:socketcand/can9: the server has no bus can9$"),
    ):
        with pytest.raises(kind, match=match):
            open_link(target)


@pytest.mark.parametrize(
    ("greeting", "match"), [(b"", "no answer from port .* within 0.3 s"), (b"220 smtp ready\r\n", "is not socketcand")]
)
def test_servers_that_are_no_socketcand(monkeypatch: pytest.MonkeyPatch, greeting: bytes, match: str) -> None:
    monkeypatch.setattr(can_open, "OPEN_TIMEOUT", 0.3)
    server = Server(greeting)
    with pytest.raises(LinkNotFound, match=match):
        open_link(server.target)
    server.stop()

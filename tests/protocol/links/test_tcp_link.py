"""The TCP link over loopback."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from protocol.errors import LinkClosed, LinkNotFound
from protocol.links import TcpTarget, open_link
from protocol.links.tcp import TcpLink


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5.0)
        yield server


def connect(server: socket.socket) -> tuple[TcpLink, socket.socket]:
    link = TcpLink(TcpTarget("127.0.0.1", server.getsockname()[1]))
    peer, _ = server.accept()
    peer.settimeout(5.0)
    return link, peer


def test_it_sends_without_delay(server: socket.socket) -> None:
    link, peer = connect(server)
    assert link._socket is not None
    assert link._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    link.close()
    peer.close()


@pytest.mark.parametrize(
    ("last", "reset", "words"),
    [
        (b"tail", False, r"tcp:127.0.0.1:\d+ was closed by the other end"),
        (b"tail", True, "was lost"),
        (b"", False, "closed the connection without a word: is another program connected"),
        (b"", True, "closed the connection without a word: is another program connected"),
    ],
)
def test_a_peer_goes(server: socket.socket, last: bytes, reset: bool, words: str) -> None:
    link, peer = connect(server)
    peer.sendall(last)
    if reset:  # which takes with it what was not read
        assert link.read(5.0 if last else 0.0) == last
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    peer.close()
    if not reset and last:
        assert link.read(5.0) == last
    with pytest.raises(LinkClosed, match=words):
        link.read(5.0)


def test_nobody_listens() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(LinkNotFound, match=f"nothing listens on port {port} of 127.0.0.1"):
        open_link(f"tcp:127.0.0.1:{port}")


@pytest.mark.parametrize(
    ("error", "words"), [(TimeoutError(), "no answer within 3 s"), (socket.gaierror(-2, "Name"), "no host 'nowhere'")]
)
def test_nobody_can_be_reached(monkeypatch: pytest.MonkeyPatch, error: OSError, words: str) -> None:
    def fail(*_: object) -> socket.socket:
        raise error

    monkeypatch.setattr(socket, "create_connection", fail)
    with pytest.raises(LinkNotFound, match=words):
        open_link("tcp:nowhere:7000")

"""The socketcand port of the simulated bus, with python-can and our own link at the other end, and by hand."""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from can_ends import opened, read
from can_rows import parts, records

from protocol.canmap.frame import BRS, ERROR, EXTENDED, FDF, RECORD_BYTES, REMOTE, BusRates
from protocol.errors import LinkBusy, LinkClosed, LinkNotFound, TargetError
from protocol.links import can_open, open_link
from protocol.links.can import CanLink
from sim.ports.socketcand_port import QUIET, SocketcandPort

RATES = BusRates()


CLASSIC = [
    (0x123, b"\1\2\3", 0),
    (0x000, b"", 0),
    (0x7FF, bytes(range(0xF8, 0x100)), 0),
    (0x12345678 | EXTENDED, b"\0\x0f\xf0", 0),
    (0x00000007 | EXTENDED, b"", 0),
]


class StoppedPort(SocketcandPort):
    """A socketcand port with a clock that stands still."""

    def __init__(self) -> None:
        self.now = 0.0
        super().__init__("127.0.0.1", 0, RATES, clock=lambda: self.now)


class Server:
    """A socketcand port stepped by a thread."""

    def __init__(self) -> None:
        self.port = StoppedPort()
        self.got = bytearray()
        self._lock = threading.Lock()
        self._stop = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop:
            select.select(self.port.read_fds(), [], [], 0.002)
            with self._lock:
                self.got += self.port.read()

    def write(self, data: bytes) -> int:
        with self._lock:
            return self.port.write(data)

    def wait(self, n: int) -> list[tuple[int, bytes, int]]:
        deadline = time.monotonic() + 5.0
        while len(self.got) < n * RECORD_BYTES and time.monotonic() < deadline:
            time.sleep(0.001)
        return parts(bytes(self.got))

    def stop(self) -> None:
        self._stop = True
        self._thread.join()
        self.port.unplug()


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.stop()


def test_our_link_and_the_server_understand_each_other(server: Server) -> None:
    target = server.port.target
    assert target == f"can:socketcand/can0?host=127.0.0.1&port={server.port._address[1]}&bitrate=1000000"
    errors = [(ERROR | 0x40, bytes(8), 0), (ERROR | 0x20, bytes(8), 0)]
    with opened(target) as link:
        link.write(records(*CLASSIC))
        assert server.wait(len(CLASSIC)) == CLASSIC
        server.write(records(*CLASSIC, *errors, when=12.5))
        assert parts(read(link, len(CLASSIC) + 2))[:-2] == CLASSIC
        assert (link.health.error_frames["bus-off"], link.health.error_frames["no ack"]) == (1, 1)
        assert (link.name, link.rates, server.port.malformed) == ("can:socketcand/can0", RATES, 0)


def read_empty(link: CanLink) -> None:
    for _ in range(100):
        link.read(0.1)


# By hand


class Client:
    """A plain socket to a port that is stepped by the same thread."""

    def __init__(self, port: StoppedPort) -> None:
        self.port = port
        self.socket = socket.create_connection(port._address, 5.0)
        self.got = b""

    def say(self, text: bytes) -> None:
        self.socket.sendall(text)
        assert select.select(self.port.read_fds(), [], [], 5.0)[0]
        self.got += self.port.read()

    def hear(self) -> bytes:
        return self.socket.recv(65536)

    def shake_hands(self) -> None:
        self.say(b"")
        assert self.hear() == b"< hi >"
        self.say(b"< open can0 >")
        assert self.hear() == b"< ok >"
        self.say(b"< rawmode >")
        assert self.hear() == b"< ok >"


@pytest.fixture
def port() -> Iterator[StoppedPort]:
    made = StoppedPort()
    yield made
    made.unplug()


@pytest.fixture
def client(port: StoppedPort) -> Client:
    """One that has shaken hands."""
    made = Client(port)
    made.shake_hands()
    return made


def test_handshake_and_commands(port: StoppedPort) -> None:
    client = Client(port)
    client.say(b"")
    assert client.hear() == b"< hi >"
    for text, answer in (
        (b"< rawmode >", b"< error unknown command >"),
        (b"< send 123 0 >", b"< error unknown command >"),
        (b"< open can7 >", b"< error could not open bus >"),
        (b"< open can0 >", b"< ok >"),
        (b"< send 123 0 >", b"< error unknown command >"),
        (b"< echo >", b"< echo >"),
        (b"< rawmode >", b"< ok >"),
        (b"< echo >", b"< echo >"),
        (b"< bcmmode >", b"< error unknown command >"),
        (b"noise< echo >", b"< echo >"),
    ):
        client.say(text)
        assert client.hear() == answer, text
    assert (port.malformed, client.got) == (4, b"")


def test_the_text_of_frames(client: Client) -> None:
    client.say(b"< send 7FF 8 0 1 a ff 10 0 0 0 >< send 00000123 1 7 >< send 001 0  >")
    data = bytes([0, 1, 10, 255, 16, 0, 0, 0])
    assert parts(client.got) == [(0x7FF, data, 0), (0x123 | EXTENDED, b"\7", 0), (1, b"", 0)]
    client.port.write(records((0x12, b"\xab\xc0", 0), (0x12 | EXTENDED, b"", 0), (ERROR | 0x8, bytes(8), 0), when=3.25))
    assert client.hear() == b"< frame 012 3.250000 ABC0 >< frame 00000012 3.250000  >< error 008 3.250000 >"


def test_commands_cut_anywhere(client: Client) -> None:
    for byte in b"< send 123 2 1 2 >< send 124 1 3 >":
        client.say(bytes([byte]))
    assert parts(client.got) == [(0x123, b"\1\2", 0), (0x124, b"\3", 0)]


@pytest.mark.parametrize(
    "text",
    [
        b"< send 123 9 1 2 3 4 5 6 7 8 9 >",
        b"< send 123 2 1 >",
        b"< send 123 1 1 2 >",
        b"< send 123 1 100 >",
        b"< send 123 1 -1 >",
        b"< send 800 0 >",
        b"< send 20000000 0 >",
        b"< send 1234 0 >",
        b"< send 0x1 0 >",
        b"< send 123 >",
        b"< send 123 8  >",  # python-can's form of a remote frame
        b"x" * 300,
    ],
)
def test_what_cannot_be_read_is_counted_and_no_frame(client: Client, text: bytes) -> None:
    client.say(text)
    client.say(b"< send 321 1 5 >< echo >")
    assert parts(client.got) == [(0x321, b"\5", 0)]
    assert client.port.malformed == 1
    assert client.hear() == b"< echo >"  # and no answer to the other


def test_no_frame_follows_the_handshake_too_closely(port: StoppedPort) -> None:
    frame = records((0x1, b"", 0))
    client = Client(port)
    assert port.write(frame) == len(frame)  # nobody there
    client.shake_hands()
    port.now = QUIET - 0.01
    assert port.write(frame) == len(frame)
    client.say(b"< echo >")
    assert client.hear() == b"< echo >"
    port.now = QUIET
    port.write(frame)
    assert client.hear() == b"< frame 001 0.000000  >"
    client.socket.close()
    second = Client(port)
    second.shake_hands()
    second.say(b"< send 123 0 >")  # who speaks has read the last answer
    port.write(frame)
    assert second.hear() == b"< frame 001 0.000000  >"


def test_a_client_that_reads_nothing_is_bounded(port: StoppedPort, client: Client) -> None:
    port.now = QUIET
    taken = 0
    while True:
        burst = records(*((k % 0x800, k.to_bytes(8, "little"), 0) for k in range(taken, taken + 1000)))
        some = port.write(burst)
        if some == 0:
            break
        assert some % RECORD_BYTES == 0
        taken += some // RECORD_BYTES
        assert taken < 1_000_000, "and still no end"
    assert len(port._session.output) < 300_000
    text = b""
    while text.count(b">") < taken:  # once it reads, it gets all that were taken, whole
        text += client.hear()
        port.read()
    datas = [bytes.fromhex(each.split()[-1].decode()) for each in text.split(b">")[:-1]]
    assert datas == [k.to_bytes(8, "little") for k in range(taken)]


def test_frames_without_a_form_are_counted(port: StoppedPort, client: Client) -> None:
    client.say(b"< send 001 0 >")
    data = records((1, b"", FDF | BRS), (2 | REMOTE, b"", 0), (3, b"", 0))
    assert port.write(data) == len(data)
    assert client.hear() == b"< frame 003 0.000000  >"
    assert port.dropped == 2


def test_extended_identifiers_are_in_the_target() -> None:
    port = SocketcandPort("127.0.0.1", 0, BusRates(500_000), extended=True)
    assert port.target.endswith("&bitrate=500000&ext=1")
    port.unplug()


# The ends of a connection


def test_a_second_client_is_sent_away(server: Server) -> None:
    with opened(server.port.target), pytest.raises(LinkBusy, match="is another program connected"):
        open_link(server.port.target)
    assert server.port.refused == 1
    with opened(server.port.target) as second:
        second.write(records((5, b"", 0)))
        assert server.wait(1) == [(5, b"", 0)]


def test_a_server_that_dies_closes_the_link(server: Server) -> None:
    with opened(server.port.target) as link:
        server.port.now += 2 * QUIET
        server.write(records((1, b"tail", 0)))
        server.stop()
        started = time.monotonic()
        assert parts(read(link, 1)) == [(1, b"tail", 0)]
        with pytest.raises(LinkClosed, match="can:socketcand/can0 was"):
            read_empty(link)
        assert time.monotonic() - started < 5.0
        with pytest.raises(LinkClosed):
            link.write(records((1, b"", 0)))
        names = {thread.name for thread in threading.enumerate()}
        assert "reads can:socketcand/can0" not in names  # python-can would spin
        with pytest.raises(LinkNotFound, match="nothing listens"):
            link.reopen()


def test_unplug_plug_and_reopen(server: Server) -> None:
    with opened(server.port.target) as link:
        with server._lock:
            server.port.unplug()
            assert server.port.read_fds() == []
            assert server.port.write(records((1, b"", 0))) == RECORD_BYTES
        with pytest.raises(LinkClosed):
            read_empty(link)
        with server._lock:
            server.port.plug()
        link.reopen()
        link.write(records((6, b"", 0)))
        assert server.wait(1) == [(6, b"", 0)]


def test_targets_that_no_server_has(server: Server) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        number = listener.getsockname()[1]
    bus, here = "can:socketcand/can0", "host=127.0.0.1"
    for target, kind, match in (
        (f"{bus}?{here}&port={number}", LinkNotFound, f"{bus}: nothing listens on port {number} of 127.0.0.1"),
        (f"{bus}?{here}", TargetError, rf"names no server: write {bus}\?host="),
        (f"can:socketcand?{here}&port=29536", TargetError, rf"can:socketcand names no bus .* write {bus}\?host="),
        (f"{bus}?{here}&port=29536&fd=1", TargetError, f"{bus}: python-can's socketcand has no CAN FD frames: leave"),
        (server.port.target.replace("can0", "can9"), LinkNotFound, "^can:socketcand/can9: the server has no bus can9$"),
    ):
        with pytest.raises(kind, match=match):
            open_link(target)


@pytest.mark.parametrize(
    ("greeting", "match"),
    [
        (b"", "no answer from port .* within 0.3 s"),
        (b"220 smtp ready\r\n", "is not socketcand"),
        (b"< hi >", "no handshake within 0.3 s"),  # and never an answer
    ],
)
def test_servers_that_are_no_socketcand(monkeypatch: pytest.MonkeyPatch, greeting: bytes, match: str) -> None:
    monkeypatch.setattr(can_open, "OPEN_TIMEOUT", 0.3)
    listener = socket.create_server(("127.0.0.1", 0))
    clients: list[socket.socket] = []

    def serve() -> None:
        while True:
            try:
                clients.append(listener.accept()[0])
            except OSError:
                return
            clients[-1].sendall(greeting)

    serving = threading.Thread(target=serve)
    serving.start()
    with pytest.raises(LinkNotFound, match=match):
        open_link(f"can:socketcand/can0?host=127.0.0.1&port={listener.getsockname()[1]}")
    listener.shutdown(socket.SHUT_RDWR)
    serving.join()
    for each in (listener, *clients):
        each.close()

"""The ports of the simulated drive, with the project's own links at the other end."""

from __future__ import annotations

import os
import select
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.errors import LinkClosed, LinkError, LinkNotFound
from protocol.links import open_link
from sim.ports.byte_ports import Port, PtyPort, TcpPort


def wait(port: Port) -> None:
    assert select.select(port.read_fds(), [], [], 5.0)[0], "nothing came within 5 s"


@pytest.fixture(params=["pty", "link", "baud", "tcp"])
def port(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Port]:
    made: dict[str, Port] = {
        "pty": PtyPort(),
        "link": PtyPort(tmp_path / "ttySIM"),
        "baud": PtyPort(baud=921_600),
        "tcp": TcpPort("127.0.0.1", 0),
    }
    yield made[request.param]
    for each in made.values():
        each.unplug()


def test_a_host_comes_by_the_target_string_goes_and_comes_back(port: Port) -> None:
    for n in range(3):
        link = open_link(port.target)
        port.read()  # lets a TCP client in
        sent = bytes(range(n, 256))
        link.write(sent)
        wait(port)
        assert port.read() == sent
        assert port.write(sent) == len(sent)
        assert link.read(5.0) == sent
        link.close()
        if isinstance(port, TcpPort):
            wait(port)
        assert port.read() == b""


def test_nothing_blocks_when_nobody_reads(port: Port) -> None:
    link = open_link(port.target)
    port.read()
    total = 0
    for _ in range(20_000):
        taken = port.write(bytes(4096))
        total += taken
        if taken == 0:
            break
    assert taken == 0, f"{total} bytes taken and still no end"
    link.close()


def test_unplug_and_plug(port: Port) -> None:
    link = open_link(port.target)
    port.read()
    port.unplug()
    assert port.read() == b""
    assert port.write(b"into the void") == 13
    assert port.read_fds() == []
    with pytest.raises(LinkClosed):
        link.read(5.0)
    own_name = not isinstance(port, PtyPort) or "ttySIM" in port.target
    if own_name:  # the number of a pty may be that of another process by now
        with pytest.raises(LinkNotFound):
            link.reopen()
    port.plug()
    if own_name:
        link.reopen()
    else:
        link = open_link(port.target)
    port.read()
    port.write(b"back")
    assert link.read(5.0) == b"back"
    link.close()


def test_link_replaces_a_link_that_an_earlier_run_left_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "ttySIM"
    path.symlink_to("/dev/pts/987654")
    port = PtyPort(path)
    assert os.readlink(path).startswith("/dev/")
    port.unplug()
    assert not path.is_symlink()
    path.write_text("precious")
    with pytest.raises(LinkError, match="cannot make the link"):
        PtyPort(path)
    assert path.read_text() == "precious"
    path.unlink()
    path.symlink_to("/dev/ttyACM0")
    with pytest.raises(LinkError, match=r"cannot make the link .*: another link exists there, not to a pty; remove it"):
        PtyPort(path)
    assert os.readlink(path) == "/dev/ttyACM0"


def test_link_of_another_drive_is_left_alone(tmp_path: Path) -> None:
    first = PtyPort(tmp_path / "ttySIM")
    second = PtyPort(tmp_path / "ttySIM")
    first.unplug()
    assert (tmp_path / "ttySIM").is_symlink()
    second.unplug()
    assert not (tmp_path / "ttySIM").is_symlink()


def test_wrong_rate_is_rubbish_both_ways() -> None:
    port = PtyPort(baud=921_600)
    link = open_link(port.target.replace("921600", "115200"))
    text = b"HELLO, drive"
    port.write(text)
    assert link.read(5.0) not in (b"", text)
    link.write(text)
    wait(port)
    assert port.read() not in (b"", text)
    link.close()
    port.unplug()


@pytest.fixture
def tcp() -> Iterator[TcpPort]:
    port = TcpPort("127.0.0.1", 0)
    yield port
    port.unplug()


def test_second_tcp_client_is_closed_and_the_next_takes_over(tcp: TcpPort) -> None:
    first = open_link(tcp.target)
    tcp.read()
    second = open_link(tcp.target)
    second.write(b"HELLO")  # unread by the time that the port turns it away
    wait(tcp)
    tcp.read()
    with pytest.raises(LinkClosed, match="closed the connection without a word: is another program connected"):
        second.read(5.0)
    tcp.write(b"still here")
    assert first.read(5.0) == b"still here"
    assert tcp.refused == 1
    first.close()
    wait(tcp)
    tcp.read()
    second.reopen()
    wait(tcp)
    tcp.read()
    tcp.write(b"your turn")
    assert second.read(5.0) == b"your turn"
    second.close()


def test_clients_that_are_turned_away_do_not_pile_up(tcp: TcpPort) -> None:
    first = open_link(tcp.target)
    tcp.read()
    before = len(os.listdir("/proc/self/fd"))
    others = []
    for n in range(30):
        others.append(open_link(tcp.target))
        wait(tcp)
        tcp.read()
        assert tcp.refused == n + 1
    assert len(os.listdir("/proc/self/fd")) - before <= 30 + 8
    tcp.write(b"still here")
    assert first.read(5.0) == b"still here"
    for link in (first, *others):
        link.close()


@pytest.mark.parametrize(
    ("host", "exposed"), [("127.0.0.1", False), ("localhost", False), ("::1", False), ("0.0.0.0", True), ("::", True)]
)
def test_only_a_loopback_address_is_for_this_machine_alone(host: str, exposed: bool) -> None:
    try:
        port = TcpPort(host, 0)
    except LinkError:
        pytest.skip(f"no address {host} here")
    assert port.exposed == exposed
    port.unplug()

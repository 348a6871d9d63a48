"""The CAN link over python-can's own buses: virtual, a plug-in that fails to order, and drivers that are not here.

The other end is python-can itself; socketcand is in `test_socketcand.py`.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import can
import can.interfaces
import numpy as np
import pytest
from can_ends import opened, read
from can_rows import CLASSIC_MESSAGES, FD_MESSAGES, records, records_of, standard, untimed

from protocol.canmap.frame import CAN_RECORD, ERROR, EXTENDED, BusRates
from protocol.errors import HbpError, LinkBusy, LinkClosed, LinkError, LinkNotFound, TargetError
from protocol.framing import Frame
from protocol.links import CanTarget, open_link, parse_target
from protocol.links import can as can_link
from protocol.links.can import CanLink
from protocol.links.can_open import bus_arguments
from protocol.messages import Hello

pytestmark = pytest.mark.slow

CHANNELS = (f"test-{n}" for n in itertools.count())


class Ends(NamedTuple):
    link: CanLink
    bus: can.BusABC  # python-can's, at the other end


@contextlib.contextmanager
def connected(query: str) -> Iterator[Ends]:
    channel = next(CHANNELS)
    with (
        can.Bus(interface="virtual", channel=channel, ignore_config=True) as bus,
        opened(f"can:virtual/{channel}{query}") as link,
    ):
        yield Ends(link, bus)


@pytest.fixture
def ends() -> Iterator[Ends]:
    with connected("") as made:
        yield made


def test_messages_pass_both_ways_in_order(ends: Ends) -> None:
    messages = CLASSIC_MESSAGES + FD_MESSAGES
    ends.link.write(records_of(messages))
    for msg in messages:
        assert ends.bus.recv(5.0).equals(msg, timestamp_delta=None, check_channel=False)
    before = time.monotonic()
    for msg in messages:
        ends.bus.send(msg)
    rows = read(ends.link, len(messages))
    assert before <= rows["time"].min() <= rows["time"].max() <= time.monotonic()
    assert untimed(rows.tobytes()) == records_of(messages)
    assert (ends.link.health.sent, ends.link.health.received) == (len(messages), len(messages))


# class 2 (to a device), node, number of the host; behind "HB" where identifiers are long
@pytest.mark.parametrize(
    ("query", "number", "extended"),
    [
        ("", 0x210, False),
        ("?host_number=15", 0x21F, False),
        ("?node=3&host_number=5", 0x235, False),
        ("?node=3&host_number=5&ext=1", 0x02421235, True),
    ],
)
def test_a_hello_goes_out_with_the_numbers_of_node_and_host(query: str, number: int, extended: bool) -> None:
    with connected(query) as ends:
        ends.link.write(ends.link.wire().encode(Frame(Hello.TYPE, 1, 1, 0, Hello(7).pack())))
        assert ends.link.health.sent > 0
        for _ in range(ends.link.health.sent):
            got = ends.bus.recv(5.0)
            assert (got.arbitration_id, got.is_extended_id) == (number, extended)


# include/uapi/linux/can/error.h: class in the identifier, controller's state in data[1]
ERROR_FRAMES = {
    "protocol": [(0x008, 0), (0x080, 0), (0x088, 0)],
    "no ack": [(0x020, 0)],
    "controller warning": [(0x004, 0x04), (0x004, 0x08)],
    "controller passive": [(0x004, 0x10), (0x204, 0x20)],
    "overflow": [(0x004, 0x01), (0x004, 0x02)],
    "bus-off": [(0x040, 0), (0x044, 0x20)],
    "restarted": [(0x100, 0)],
    "other": [(0x001, 0), (0x002, 0), (0x004, 0x40)],
}


@pytest.mark.parametrize(
    ("number", "detail", "kind"), [(*frame, kind) for kind, frames in ERROR_FRAMES.items() for frame in frames]
)
def test_error_frames_are_records_counted_by_kind(ends: Ends, number: int, detail: int, kind: str) -> None:
    data = bytes([0, detail, 0, 0, 0, 0, 0, 0])
    ends.bus.send(standard(number, data, is_error_frame=True))
    (row,) = read(ends.link, 1)
    assert (row["id"], row["length"], bytes(row["data"][:8])) == (ERROR | number, 8, data)
    health = ends.link.health
    assert {name: count for name, count in health.error_frames.items() if count} == {kind: 1}
    assert health.received == 0
    assert health.bus_off == (kind == "bus-off")


@pytest.mark.parametrize("settle", [0.0, 0.001])
def test_a_burst_is_read_whole_and_in_order(ends: Ends, settle: float) -> None:
    n = 20_000

    def send() -> None:
        for k in range(n):
            ends.bus.send(standard(k % 0x700, k.to_bytes(4, "little")))

    sender = threading.Thread(target=send)
    sender.start()
    rows = read(ends.link, n, 30.0, settle)
    sender.join()
    assert np.array_equal(rows["data"][:, :4].copy().view("<u4")[:, 0], np.arange(n))
    assert np.all(np.diff(rows["time"]) >= 0.0)
    assert (ends.link.health.received, ends.link.health.dropped) == (n, 0)


def test_read_waits_no_longer_than_told(ends: Ends) -> None:
    started = time.monotonic()
    for _ in range(50):
        assert ends.link.read(0.0) == b""
        assert ends.link.read(-1.0) == b""
    assert time.monotonic() - started < 2.0
    started = time.monotonic()
    assert ends.link.read(0.05) == b""
    assert 0.05 <= time.monotonic() - started < 2.0


def test_a_settled_read_collects(ends: Ends) -> None:
    for k in range(3):
        threading.Timer(0.02 * k, ends.bus.send, [standard(k)]).start()
    assert len(ends.link.read(5.0, settle=0.5)) == 3 * CAN_RECORD.itemsize


def test_one_read_gives_whole_records_up_to_its_limit(ends: Ends) -> None:
    for k in range(1000):
        ends.bus.send(standard(k))
    while ends.link.health.received < 1000:
        time.sleep(0.001)
    sizes = [len(ends.link.read(0.0)) // CAN_RECORD.itemsize for _ in range(3)]
    assert sizes == [65536 // 80, 1000 - 65536 // 80, 0]


def test_what_the_buffer_cannot_hold_is_counted(monkeypatch: pytest.MonkeyPatch, ends: Ends) -> None:
    monkeypatch.setattr(can_link, "MAX_BUFFER", 100 * CAN_RECORD.itemsize)
    for k in range(250):
        ends.bus.send(standard(k))
    health = ends.link.health
    deadline = time.monotonic() + 5.0
    while health.dropped < 150 and time.monotonic() < deadline:
        time.sleep(0.001)
    assert (health.received, health.dropped) == (250, 150)
    assert read(ends.link, 100)["id"].tolist() == list(range(100))
    ends.bus.send(standard(0x555))
    assert read(ends.link, 1)["id"].tolist() == [0x555]


def test_close_ends_a_read_and_the_thread(ends: Ends) -> None:
    caught: list[HbpError] = []

    def wait() -> None:
        try:
            ends.link.read(30.0)
        except HbpError as error:
            caught.append(error)

    waiting = threading.Thread(target=wait)
    waiting.start()
    name = f"reads {ends.link.name}"
    assert name in {thread.name for thread in threading.enumerate()}
    started = time.monotonic()
    ends.link.close()
    ends.link.close()
    waiting.join(5.0)
    assert time.monotonic() - started < 1.0
    assert isinstance(caught[0], LinkClosed)
    assert name not in {thread.name for thread in threading.enumerate()}
    for use in (lambda: ends.link.read(0.0), lambda: ends.link.write(records((1, b"", 0)))):
        with pytest.raises(LinkClosed, match=r"can:virtual/\S+ is closed"):
            use()


# A driver of our own, by python-can's plug-in mechanism: it does what no bus on this machine can be made to do


class Wayward(can.BusABC):
    """A bus with a keyword of its own, that gives, raises or swallows what the test ordered."""

    plan: ClassVar[list[Any]]
    shut: ClassVar[list[Wayward]]
    on_open: ClassVar[Exception | None]
    sends: ClassVar[Iterator[Exception | None]]  # what becomes of each send
    state_now: ClassVar[can.BusState]

    def __init__(self, channel: str, bitrate: int, keyword: int = 0) -> None:
        super().__init__(channel)
        if self.on_open is not None:
            raise self.on_open

    @property
    def state(self) -> can.BusState:
        return self.state_now

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.plan:
            step = self.plan.pop(0)
            if isinstance(step, BaseException):
                raise step
            return step() if callable(step) else step, False
        time.sleep(min(timeout or 0.0, 0.005))
        return None, False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if error := next(self.sends):
            raise error

    def shutdown(self) -> None:
        super().shutdown()
        self.shut.append(self)


@pytest.fixture
def wayward(monkeypatch: pytest.MonkeyPatch) -> type[Wayward]:
    Wayward.plan, Wayward.shut, Wayward.on_open = [], [], None
    Wayward.sends, Wayward.state_now = itertools.repeat(None), can.BusState.ACTIVE
    monkeypatch.setitem(can.interfaces.BACKENDS, "wayward", (__name__, "Wayward"))
    monkeypatch.setattr("can.util.VALID_INTERFACES", can.interfaces.VALID_INTERFACES | {"wayward"})
    return Wayward


@pytest.fixture
def link(wayward: type[Wayward]) -> Iterator[CanLink]:
    with opened("can:wayward/7?keyword=1") as made:
        yield made


def os_failure(number: int) -> can.CanOperationError:
    """What python-can's socketcan raises."""
    error = can.CanOperationError(f"Failed: {errno.errorcode[number]}", number)
    error.__cause__ = OSError(number, "the system's text")
    return error


def test_frames_before_a_loss_are_delivered_first(wayward: type[Wayward], link: CanLink) -> None:
    # python-can's socketcand puts a whole traceback into its error
    wayward.plan += [standard(1), standard(2), can.CanOperationError("pulled out\nTraceback: File …")]
    assert read(link, 2)["id"].tolist() == [1, 2]
    for _ in range(2):
        with pytest.raises(LinkClosed, match=r"^can:wayward/7 was lost: pulled out$"):
            link.read(5.0)
    with pytest.raises(LinkClosed, match="pulled out"):
        link.write(records((1, b"", 0)))
    link.reopen()
    wayward.plan.append(standard(3))
    assert read(link, 1)["id"].tolist() == [3]
    assert link.health.received == 3


def test_frames_that_can_cannot_have_are_counted(wayward: type[Wayward], link: CanLink) -> None:
    wayward.plan += [
        standard(0x800),
        can.Message(arbitration_id=1, data=bytes(9)),
        can.Message(arbitration_id=1, data=bytes(65), is_fd=True),
        standard(5),
    ]
    assert read(link, 1)["id"].tolist() == [5]
    assert (link.health.malformed, link.health.received) == (3, 1)


def test_error_frames_of_drivers_without_linux_bits_are_other(wayward: type[Wayward], link: CanLink) -> None:
    wayward.plan.append(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))  # no bus-off here
    assert read(link, 1)["id"].tolist() == [ERROR]
    assert link.health.error_frames["other"] == 1
    assert not link.health.bus_off


def test_a_state_of_bus_off_is_reported_once_and_the_link_stays(wayward: type[Wayward], link: CanLink) -> None:
    wayward.state_now = can.BusState.ERROR
    assert read(link, 1)["id"].tolist() == [ERROR | 0x40]
    assert link.health.bus_off
    assert link.read(0.25) == b""
    wayward.state_now = can.BusState.ACTIVE
    assert read(link, 1)["id"].tolist() == [ERROR | 0x100]
    assert not link.health.bus_off
    assert (link.health.error_frames["bus-off"], link.health.error_frames["restarted"]) == (1, 1)


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), LinkNotFound("no"), OSError(errno.ENETDOWN, "down")])
def test_what_ends_an_opening_leaves_no_bus_open(wayward: type[Wayward], stop: BaseException) -> None:
    wayward.plan.append(stop)
    with pytest.raises((KeyboardInterrupt, LinkNotFound)):
        CanLink(CanTarget("wayward", "7"))
    assert len(wayward.shut) == 1


STALL = 0.3  # s, more than an idle bus is ever left alone


def fresh_again(link: CanLink, send: Callable[[], None]) -> bool:
    """Whether a frame soon has the time at which it was read; a machine that is busy may stall the link again."""
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        sent = time.monotonic()
        send()
        if read(link, 1)["time"][0] >= sent:
            return True
    return False


def test_after_a_stall_records_are_no_younger_than_the_last_look(
    wayward: type[Wayward], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(can_link, "MISTRUST", 1.0)
    began: list[float] = []

    def stall() -> can.Message:
        began.append(time.monotonic())
        time.sleep(STALL)
        return standard(1)

    before = time.monotonic()
    with opened("can:wayward/7") as link:
        wayward.plan += [stall, standard(2), standard(0x20, bytes(8), is_error_frame=True)]
        rows = read(link, 3)
        assert before <= rows["time"].max() <= began[0]
        wayward.plan.append(standard(4))
        assert read(link, 1)["time"][0] <= began[0]
        assert fresh_again(link, lambda: wayward.plan.append(standard(5)))
        assert time.monotonic() >= began[0] + STALL + 1.0


def test_a_short_pause_is_no_stall(wayward: type[Wayward], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can_link, "STALL", 30.0)
    paused: list[float] = []

    def pause() -> can.Message:
        time.sleep(0.05)
        paused.append(time.monotonic())
        return standard(1)

    with opened("can:wayward/7") as link:
        wayward.plan.append(pause)
        assert read(link, 1)["time"][0] >= paused[0]


def test_a_full_transmit_buffer_is_tried_again(wayward: type[Wayward], link: CanLink) -> None:
    wayward.sends = itertools.chain([os_failure(errno.ENOBUFS)] * 5, itertools.repeat(None))
    link.write(records((1, b"", 0), (2, b"", 0)))
    assert link.health.sent == 2


def test_a_transmit_buffer_that_stays_full_fails_the_write(
    wayward: type[Wayward], link: CanLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(can_link, "WRITE_TIMEOUT", 0.03)
    wayward.sends = itertools.chain([None], itertools.repeat(can.CanOperationError("Transmit buffer full")))
    with pytest.raises(LinkError, match=r"can:wayward/7 took 1 of 3 frames: .* for 0.03 s: is another node") as caught:
        link.write(records((1, b"", 0), (2, b"", 0), (3, b"", 0)))
    assert not isinstance(caught.value, LinkClosed)
    assert link.health.sent == 1


def test_a_refused_frame_is_an_error_and_a_dead_socket_a_loss(wayward: type[Wayward], link: CanLink) -> None:
    wayward.sends = iter([can.CanOperationError("no FD here"), BrokenPipeError(errno.EPIPE, "Broken pipe")])
    with pytest.raises(LinkError, match="took 0 of 1 frames: no FD here"):
        link.write(records((1, b"", 0)))
    assert link.read(0.0) == b""
    for use in (lambda: link.write(records((1, b"", 0))), lambda: link.read(0.0)):
        with pytest.raises(LinkClosed, match="Broken pipe"):
            use()


@pytest.mark.parametrize(
    ("error", "kind", "parts"),
    [
        (OSError(errno.ENODEV, "No such device"), LinkNotFound, ["No such device", "`ip link` lists"]),
        (OSError(errno.EAFNOSUPPORT, "Address family not supported"), LinkNotFound, ["modprobe can_raw"]),
        (OSError("pcanbasic library not found."), LinkNotFound, ["library not found: is the adapter plugged in"]),
        (NameError("name 'canGetNumberOfChannels' is not defined"), LinkNotFound, ["its library is missing"]),
        (ImportError("Please install x"), LinkNotFound, ["Please install x", "driver installed?"]),
        (can.CanInterfaceNotImplementedError("Windows only"), LinkNotFound, ["Windows only"]),
        (can.CanInitializationError(""), LinkNotFound, ["CanInitializationError"]),
        (can.CanInitializationError("hardware is already in use by a net"), LinkBusy, ["held by another program"]),
        (OSError(errno.EBUSY, "Device or resource busy"), LinkBusy, ["close it and try again"]),
        (PermissionError(errno.EACCES, "Permission denied"), LinkError, ["no permission", "dialout"]),
        (ValueError("bitrate 7 is not possible"), TargetError, ["refuses these options: bitrate 7"]),
        (can.CanInitializationError("first\nsecond"), LinkNotFound, ["first"]),
    ],
)
def test_what_a_driver_raises_is_one_line(
    wayward: type[Wayward], error: Exception, kind: type[HbpError], parts: list[str]
) -> None:
    wayward.on_open = error
    with pytest.raises(HbpError) as caught:
        open_link("can:wayward/7")
    assert type(caught.value) is kind
    text = str(caught.value)
    assert "\n" not in text
    assert [part for part in ("can:wayward/7", *parts) if part not in text] == []


def test_an_interface_that_is_down_is_not_found(wayward: type[Wayward]) -> None:
    wayward.plan.append(os_failure(errno.ENETDOWN))  # SocketCAN opens it, and says so at the first read
    with pytest.raises(LinkNotFound, match=r"can:wayward/can0 .*: bring it up with `ip link set can0 up`"):
        open_link("can:wayward/can0")


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """No configuration of python-can's, and an empty home."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


# An adapter that speaks slcan: the pty's other end


@pytest.fixture
def adapter() -> Iterator[tuple[int, str]]:
    master, slave = pty.openpty()
    tty.setraw(slave)
    name = os.ttyname(slave)
    os.close(slave)
    yield master, name
    with contextlib.suppress(OSError):
        os.close(master)


def test_slcan_is_opened_with_our_own_bus(adapter: tuple[int, str]) -> None:
    master, name = adapter
    link = open_link(f"can:slcan/{name}?bitrate=500000")
    assert (link.name, link.rates) == (f"can:slcan/{name}", BusRates(500_000))
    assert b"S6\r" in os.read(master, 100)
    os.write(master, b"t1232AABB\rtXYZ\r\aT000000070\r")
    assert read(link, 2)["id"].tolist() == [0x123, 0x7 | EXTENDED]
    assert (link.health.received, link.health.malformed, link.health.refused) == (2, 1, 1)
    link.write(records((0x321, b"\x0f", 0), (0x8 | EXTENDED, b"", 0)))
    assert os.read(master, 100) == b"t32110F\rT000000080\r"
    assert link.health.sent == 2
    with pytest.raises(LinkBusy, match=f"can:slcan/{name}: .*held by another program"):
        open_link(f"can:slcan/{name}")
    os.write(master, b"t0010\r")
    assert read(link, 1)["id"].tolist() == [1]
    os.close(master)
    with pytest.raises(LinkClosed, match=f"can:slcan/{name} was lost: {name} is gone"):
        link.read(5.0)
    with pytest.raises(LinkNotFound, match=f"can:slcan/{name}: "):
        link.reopen()


def test_text_that_is_no_slcan_is_no_loss(adapter: tuple[int, str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can_link, "_BUSY_WINDOW", 0.15)
    master, name = adapter
    with opened(f"can:slcan/{name}") as link:
        os.set_blocking(master, False)
        deadline = time.monotonic() + 2.2 * can_link._BUSY_WINDOW  # more than twice what tells a dead connection
        while time.monotonic() < deadline:
            with contextlib.suppress(BlockingIOError):
                os.write(master, b"no\rframe\r" * 200)
            assert link.read(0.0) == b""
        os.set_blocking(master, True)
        os.write(master, b"\rt0010\r")
        assert read(link, 1)["id"].tolist() == [1]
        assert link.health.malformed > 300


# What is not here, and python-can's configuration

SOCKETCAND = "can:socketcand/can0?host=127.0.0.1"


@pytest.mark.parametrize(
    ("target", "match"),
    [
        ("can:wayward/7?keywrod=1", r"can:wayward/7: .*wayward refuses these options: .*'keywrod'"),
        ("can:socketcn/can0", r"can:socketcn/can0: .*no interface 'socketcn': did you mean socketcan\?"),
        ("can:zzz/can0", r"known: .*pcan, .*virtual"),
        ("can:virtual/x?port=first", "does not accept this configuration: Port config must be a number"),
        ("can:", "no CAN interface is named.*set CAN_INTERFACE"),
        ("can:slcan//dev/ttyNONE?bitrat=500000", r"interface slcan has no key 'bitrat': did you mean bitrate\?"),
        ("can:slcan//dev/ttyNONE?rtsct=1", r"interface slcan has no key 'rtsct': did you mean rtscts\?"),
        ("can:slcan//dev/ttyNONE?brp=1", "interface slcan has no key 'brp': known: .*bitrate"),
        (f"{SOCKETCAND}&port=9&bitrat=500000", r"interface socketcand has no key 'bitrat': did you mean bitrate\?"),
        (f"{SOCKETCAND}&prot=9", r"interface socketcand has no key 'prot': did you mean port\?"),
        ("can:virtual/x?hostnumber=3", r"interface virtual has no key 'hostnumber': did you mean host_number\?"),
        ("can:virtual/x?nod=3", r"interface virtual has no key 'nod': did you mean node\?"),
        ("can:virtual/x?zzz=3", "interface virtual has no key 'zzz': known: bitrate, .*rx_queue_size"),
    ],
)
def test_targets_that_mean_nothing_here(wayward: type[Wayward], bare: Path, target: str, match: str) -> None:
    with pytest.raises(TargetError, match=match):
        open_link(target)


@pytest.mark.parametrize(
    "target",
    [
        *(f"can:{interface}//dev/ttyNONE" for interface in ("robotell", "seeedstudio", "slcan")),
        pytest.param("can:socketcan/nocan0", marks=pytest.mark.skipif(not hasattr(socket, "PF_CAN"), reason="Linux's")),
    ],
)
def test_missing_ports(target: str) -> None:
    with pytest.raises(LinkNotFound, match=f"{target}.*"):
        open_link(target)


@pytest.mark.parametrize("interface", ["pcan", "kvaser", "ixxat", "gs_usb", "neovi", "cantact", "systec"])
def test_missing_drivers(interface: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(LinkNotFound, match=rf"^can:{interface}/[^\n]*driver installed\?\Z"):
        open_link(f"can:{interface}/0?bitrate=500000" if interface != "pcan" else "can:pcan/PCAN_USBBUS1")
    assert capfd.readouterr() == ("", "")  # python-can's own reports


def test_configuration_by_file_context_and_environment(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (bare / "can.conf").write_text(
        "[default]\ninterface = virtual\nchannel = by-file\nbitrate = 500000\n\n"
        "[bench]\nchannel = by-context\nfd = True\ndata_bitrate = 2000000\n"
    )

    def check(target: str, name: str, rates: BusRates, node: int = 1) -> None:
        with opened(target) as link:
            assert (link.name, link.rates, link.node) == (f"can:virtual/{name}", rates, node)

    check("can:", "by-file", BusRates(500_000))
    check("can:?context=bench&node=3", "by-context", BusRates(500_000, 2_000_000), 3)
    check("can:virtual/by-target?bitrate=125000", "by-target", BusRates(125_000))  # the target comes first
    (bare / "can.conf").unlink()
    for key, value in (("INTERFACE", "virtual"), ("CHANNEL", "by-environment"), ("BITRATE", "250000")):
        monkeypatch.setenv(f"CAN_{key}", value)
    check("can:", "by-environment", BusRates(250_000))


def test_a_configuration_that_cannot_be_read(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused = "does not accept this configuration: "
    (bare / "can.conf").write_text("no section\n")
    with pytest.raises(TargetError, match=f"{refused}File contains no section headers"):
        open_link("can:")
    (bare / "can.conf").unlink()
    monkeypatch.setenv("CAN_BITRATE", "fast")
    for target in ("can:virtual/x", "can:slcan//dev/ttyNONE", "can:pcan/PCAN_USBBUS1?fd=1"):
        with pytest.raises(TargetError, match=f"{refused}.*'fast'"):
            open_link(target)
    monkeypatch.setenv("CAN_CONFIG", "{")
    with pytest.raises(TargetError, match=refused):
        open_link("can:")


def test_keys_of_a_configuration_count_where_it_names_the_interface(bare: Path) -> None:
    (bare / "can.conf").write_text("[default]\ninterface = slcan\nchannel = /dev/ttyNONE\nbitrat = 500000\n")
    with pytest.raises(TargetError, match=r"the interface slcan has no key 'bitrat': did you mean bitrate\?"):
        open_link("can:")
    assert bus_arguments(CanTarget("virtual", "x")).keys() == {"interface", "channel"}


def test_a_context_that_is_nowhere(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (bare / "can.conf").write_text("[default]\ninterface = virtual\nchannel = x\n\n[bench]\nchannel = y\n")
    with pytest.raises(TargetError, match=r"no context 'nosuch': no section \[nosuch\] in can.conf, and no variable"):
        open_link("can:?context=nosuch")
    assert bus_arguments(CanTarget(context="bench"))["channel"] == "y"
    monkeypatch.setenv("CAN_CHANNEL_nosuch", "z")
    assert bus_arguments(CanTarget(context="nosuch"))["channel"] == "z"


@pytest.mark.parametrize(
    ("word", "on"),
    [("yes", True), ("On", True), ("true", True), ("1", True), ("no", False), ("off", False), ("False", False)],
)
def test_switches_of_a_configuration(bare: Path, word: str, on: bool) -> None:
    switches = ("fd", "listen_only", "rtscts")
    (bare / "can.conf").write_text(
        "[default]\ndata_bitrate = 2000000\n" + "".join(f"{key} = {word}\n" for key in switches)
    )
    arguments = bus_arguments(CanTarget("slcan", "/dev/ttyACM0"))
    assert [arguments[key] for key in switches] == [on] * 3
    assert arguments.get("data_bitrate") == (2_000_000 if on else None)
    assert bus_arguments(CanTarget("slcan", "/dev/ttyACM0", (("listen_only", "1"),)))["listen_only"] is True


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("fd = maybe", "fd must be yes or no, got 'maybe'"),
        ("listen_only = 2", "listen_only must be yes or no, got '2'"),
        ("bitrate = 1M", "bitrate must be a whole number of bit/s, got '1M'"),
        ("bitrate = 0", "bitrate must be a whole number of bit/s, got '0'"),
        ("data_bitrate = fast", "data_bitrate must be a whole number of bit/s, got 'fast'"),
        ("timing = 1", "timing cannot be text, got '1': give f_clock, brp, tseg1, tseg2, sjw, nof_samples"),
    ],
)
def test_values_of_a_configuration_that_mean_nothing(bare: Path, line: str, said: str) -> None:
    (bare / "can.conf").write_text(f"[default]\n{line}\n")
    with pytest.raises(TargetError) as caught:
        open_link("can:slcan//dev/ttyNONE")
    assert str(caught.value) == f"can:slcan//dev/ttyNONE: python-can does not accept this configuration: {said}"


CLASSIC_TIMING = "f_clock=8000000&brp=1&tseg1=5&tseg2=2&sjw=1&nof_samples=1"


@pytest.mark.parametrize(
    ("target", "told"),
    [
        ("can:pcan/PCAN_USBBUS1", {"bitrate": 1_000_000}),
        ("can:pcan/PCAN_USBBUS1?bitrate=250000", {"bitrate": 250_000}),
        ("can:gs_usb/0", {"bitrate": 1_000_000}),
        ("can:slcan//dev/ttyACM0", {"bitrate": 1_000_000}),
        ("can:slcan//dev/ttyACM0?fd=1", {"bitrate": 1_000_000, "data_bitrate": 5_000_000}),
        ("can:ixxat/0?fd=1&bitrate=500000", {"bitrate": 500_000, "data_bitrate": 5_000_000}),
        ("can:vector/0?fd=1&data_bitrate=2000000", {"bitrate": 1_000_000, "data_bitrate": 2_000_000}),
        # python-can's pcan reads none of `bitrate`, `data_bitrate` on an FD bus: it needs every segment
        ("can:pcan/PCAN_USBBUS1?fd=1", {"timing": (1_000_000, 5_000_000)}),
        ("can:kvaser/0?fd=1", {"timing": (1_000_000, 5_000_000)}),
        (f"can:pcan/PCAN_USBBUS1?{CLASSIC_TIMING}", {"timing": (1_000_000,)}),
        (f"can:slcan//dev/ttyACM0?{CLASSIC_TIMING}", {"timing": (1_000_000,)}),
        ("can:socketcan/can0", {}),
        ("can:socketcan/can0?fd=1", {}),
        ("can:socketcand/can0?host=10.0.0.5&port=29536", {}),
        ("can:udp_multicast/239.74.163.2?fd=1", {}),
        ("can:virtual/x?fd=1", {}),
        ("can:virtual/x?bitrate=125000", {"bitrate": 125_000}),
    ],
)
def test_python_can_is_told_the_rates_that_are_its_to_set(bare: Path, target: str, told: dict[str, object]) -> None:
    arguments = bus_arguments(parse_target(target))
    if timing := arguments.get("timing"):
        arguments["timing"] = tuple(
            getattr(timing, rate) for rate in ("bitrate", "nom_bitrate", "data_bitrate") if hasattr(timing, rate)
        )
    assert {key: arguments[key] for key in ("bitrate", "data_bitrate", "timing") if key in arguments} == told

"""The commands on a CAN bus: python-can's virtual one, in this process, with the simulated bench on it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from unittest.mock import patch

import can
import can.interfaces
import pytest
from against import said as bench
from virtual_bus import on_virtual_bus
from virtual_run import RecordingScreen, WatchedLink

from bench.device.bus import BusMeter, bus_rows
from bench.device.client import Client
from bench.device.scan import scan
from bench.errors import BenchError, DoesNotFit
from bench.live import run as live
from bench.live.summary import Summary
from protocol.canmap.frame import BusRates
from protocol.errors import LinkClosed, NoReply, RemoteProtocolError
from protocol.links import open_link
from protocol.messages import Role
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import CanNetwork

pytestmark = pytest.mark.slow


class NamedLink(WatchedLink):
    name = "can:virtual/cli"


@contextmanager
def reached(rates: BusRates, extended: bool = False) -> Iterator[None]:
    """Whatever target is opened is a simulated bench on such a bus, in virtual time."""
    link = NamedLink(SimulatedDevice(load_params(), 1, network=CanNetwork(rates, extended)))

    def opened(target: object) -> NamedLink:
        link.reopen()
        return link

    with ExitStack() as stack:
        for place in ("protocol.links", "bench.live.run", "bench.device.description"):
            stack.enter_context(patch(f"{place}.open_link", opened))
        yield


@pytest.fixture
def classic() -> Iterator[str]:
    with reached(BusRates()):
        yield "can:virtual/cli"


@pytest.fixture
def fd() -> Iterator[str]:
    with reached(BusRates(1_000_000, 8_000_000), extended=True):
        yield "can:virtual/cli?fd=1&ext=1"


@pytest.fixture(scope="module")
def real() -> Iterator[str]:
    with on_virtual_bus("cli") as target:
        yield target


def run(target: str, **options: object) -> tuple[Summary, list[str]]:
    screen = RecordingScreen()
    given = {"target": target, "viewer": "none", "duration": 1.0, "yes": True} | options
    ended = live.run(live.LiveOptions(**given), screen, None, lambda summary: None)  # type: ignore[arg-type]
    return ended.summary, screen.notes


def test_devices_lists_the_nodes_of_a_bus(capsys: pytest.CaptureFixture[str], real: str) -> None:
    nodes = json.loads(bench(capsys, "devices", real, "--json")[0])
    assert [(n["node"], n["role"], n["state"], n["name"], n["serial"]) for n in nodes] == [
        (1, "drive", "IDLE", "simulated drive", "SIM-0001"),
        (2, "load", "IDLE", "load machine", "SIM-0002"),
    ]
    assert "load machine" in bench(capsys, "devices", real)[0]


def test_a_scan_asks_every_node_at_once_and_hosts_do_not_disturb_each_other(real: str) -> None:
    with closing(open_link(real)) as first, closing(open_link(real + "&host_number=3")) as second:
        assert [reply.role for reply in scan(first)] == [Role.DRIVE, Role.LOAD]
        assert [reply.node for reply in scan(second)] == [1, 2]


def test_info_shows_the_bus_and_each_rate_that_is_offered_is_taken(capsys, classic: str) -> None:
    info = json.loads(bench(capsys, "info", classic, "--json")[0])
    assert [node["identity"]["node"] for node in info["nodes"]] == [1, 2]
    bus, fits = info["bus"], info["bus"]["fits"]
    # two heartbeats of 8 frames, ten times a second: 16 x 10 x about 115 us
    assert 0.01 < bus["load"] < 0.03
    assert (bus["rates"], fits[0]["channels"], fits[-1]["rate_hz"]) == ("1 Mbit/s", 26, 16_000)
    out, _ = bench(capsys, "info", classic)
    assert "watched for a second" in out
    assert "streams of node 1 that fit" in out
    names = [c["name"] for c in info["nodes"][0]["channels"]]
    for fit in {fit["channels"]: fit for fit in (fits[0], fits[len(fits) // 2], fits[-1])}.values():
        given = ("--channels", ",".join(names[: fit["channels"]]), "--rate", f"{fit['rate_hz']:g}")  # as it is printed
        out, _ = bench(capsys, "live", classic, "--viewer", "none", *given, "--duration", "0.2", "--json", "-")
        assert json.loads(out)["bus"]["load_predicted"] == pytest.approx(fit["load"], rel=1e-5)


def test_live_says_what_would_fit(capsys: pytest.CaptureFixture[str], classic: str) -> None:
    _, err = bench(capsys, "live", classic, "--viewer", "none", code=2)
    assert "26 channels at 16000 Hz would load can:virtual/cli (1 Mbit/s) to 1894%" in err
    assert "26 channels at 666.667 Hz (92%)" in err
    assert "--fit" in err
    _, err = bench(capsys, "live", classic, "--viewer", "none", "--channels", "i_a,i_b", "--rate", "16000", code=2)
    assert "2 channels at 16000 Hz would load" in err
    with pytest.raises(DoesNotFit) as caught:
        run(classic)
    assert caught.value.decimation == 24
    with pytest.raises(BenchError, match=r"would load .*--host-observers needs every PWM period: --channels hall,"):
        run(classic, fit=True, host_observers=True)


def test_fit_takes_the_highest_rate(classic: str) -> None:
    summary, notes = run(classic, fit=True)
    assert "--fit: 26 channels at 666.667 Hz" in notes
    assert summary.samples == pytest.approx(666, rel=0.2)
    assert 0.3 < summary.bus["load"] < summary.bus["load_predicted"] < 0.95
    assert not any((summary.lost.samples_by_index, summary.lost.edges_by_index, summary.lost.frames_by_sequence))


def test_the_load_machine_is_a_node_of_its_own(fd: str, tmp_path: Path) -> None:
    summary, notes = run(fd, fit=True, speed_rpm=300.0, load_a=1.0, save=tmp_path / "a.run", duration=0.6)
    assert "--fit: 26 channels at 5333.33 Hz" in notes
    assert summary.result == "ok as far as was seen; unverified: whether 300 r/min are held (too short a time)"
    assert (summary.recording["samples"], summary.faults) == (summary.samples, [])


def test_a_bus_that_is_too_slow_for_the_edges_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    with reached(BusRates(100_000)):
        _, err = bench(capsys, "live", "can:virtual/cli", "--fit", "--viewer", "none", code=2)
        assert "error: can:virtual/cli (0.1 Mbit/s) is too slow: the Hall edges alone" in err
        assert "no stream of node 1 fits" in bench(capsys, "info", "can:virtual/cli")[0]


@pytest.mark.campaign("links")
def test_what_does_not_answer_on_a_bus_is_told(capsys: pytest.CaptureFixture[str], real: str) -> None:
    """Each waits 3 s: a node, a bus, and FD frames for a host that was told of a classic bus."""
    with pytest.raises(NoReply, match="no HBP device answered on can:virtual/cli within 3 s"):
        run(real + "&node=7")
    for command in ("info", "devices"):
        _, err = bench(capsys, command, "can:virtual/empty", code=2)
        assert "no HBP device answered on can:virtual/empty" in err
        assert "check power, cable, termination" in err
    with (
        on_virtual_bus("cli-fd", BusRates(1_000_000, 8_000_000), extended=True),
        pytest.raises((RemoteProtocolError, NoReply), match=r"add fd=1|no HBP device answered"),
    ):
        run("can:virtual/cli-fd?ext=1")


def test_a_bus_that_pythons_configuration_names_is_shown_by_its_name(real: str, monkeypatch) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    monkeypatch.setenv("CAN_CHANNEL", "cli")
    summary, notes = run("can:", fit=True, duration=0.3)
    assert summary.target == "can:virtual/cli"
    assert any("on can:virtual/cli: boot" in note for note in notes)


class FullBus(can.BusABC):
    """An adapter that takes nothing: nobody acknowledges."""

    channel_info = "full"

    def __init__(self, channel: str, **kwargs: object) -> None:
        super().__init__(channel, **kwargs)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("Transmit buffer full")

    def _recv_internal(self, timeout: float | None) -> tuple[None, bool]:
        time.sleep(timeout or 0.0)
        return None, False


def test_a_bus_that_opens_but_takes_nothing_is_one_outage_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(can.interfaces.BACKENDS, "full", (__name__, "FullBus"))
    monkeypatch.setattr("can.util.VALID_INTERFACES", can.interfaces.VALID_INTERFACES | {"full"})
    link = open_link("can:full/x")
    client = Client(link, reconnect=1.2)
    client.session.connect(1, client.now())
    with pytest.raises(LinkClosed, match=r"did not return within 1\.2 s"):
        client.run_for(20.0)
    assert client.health.outages == 1
    link.close()


def test_an_adapter_that_is_off_the_bus_is_shown() -> None:
    with on_virtual_bus("off") as target:
        link = open_link(target)
        client = Client(link)
        client.connect()
        meter = BusMeter(client)
        with can.Bus("off", interface="virtual") as other:  # Linux's bit for bus-off
            other.send(can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8)))
            client.wait(lambda: link.health.bus_off, 5.0)  # type: ignore[attr-defined]
        report = meter.report()
        assert report["errors"] == {"bus-off": 1}
        assert ["errors on the bus", "1 bus-off; the adapter is off the bus"] in bus_rows(report)
        link.close()

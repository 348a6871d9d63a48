"""The commands on a CAN bus: python-can's virtual one, in this process, with the simulated bench on it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import can
import can.interfaces
import pytest
from virtual_bus import on_virtual_bus
from virtual_run import RecordingScreen

from bench.cli import main
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

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def classic() -> Iterator[str]:
    with on_virtual_bus("cli") as target:
        yield target


@pytest.fixture(scope="module")
def fd() -> Iterator[str]:
    with on_virtual_bus("cli-fd", BusRates(1_000_000, 8_000_000), extended=True) as target:
        yield target


def bench(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> tuple[str, str]:
    got = 0
    try:
        main(list(arguments))
    except SystemExit as ended:
        got = int(ended.code or 0)
    read = capsys.readouterr()
    assert got == code, read
    return read.out, read.err


def run(target: str, **options: object) -> tuple[Summary, list[str]]:
    screen = RecordingScreen()
    given = {"target": target, "viewer": "none", "duration": 1.0, "yes": True} | options
    ended = live.run(live.LiveOptions(**given), screen, None, lambda summary: None)  # type: ignore[arg-type]
    return ended.summary, screen.notes


def test_devices_lists_the_nodes_of_a_bus(capsys: pytest.CaptureFixture[str], fd: str) -> None:
    nodes = json.loads(bench(capsys, "devices", fd, "--json")[0])
    assert [(n["node"], n["role"], n["state"], n["name"]) for n in nodes] == [
        (1, "drive", "IDLE", "simulated drive"),
        (2, "load", "IDLE", "load machine"),
    ]
    assert [n["serial"] for n in nodes] == ["SIM-0001", "SIM-0002"]
    out, _ = bench(capsys, "devices", fd)
    assert "load machine" in out
    _, err = bench(capsys, "devices", "can:virtual/empty", code=2)
    assert "no HBP device answered on can:virtual/empty: check power, cable, termination" in err


def test_a_scan_asks_every_node_at_once_and_hosts_do_not_disturb_each_other(classic: str) -> None:
    first, second = open_link(classic), open_link(classic + "&host_number=3")
    try:
        assert [reply.role for reply in scan(first)] == [Role.DRIVE, Role.LOAD]
        assert [reply.node for reply in scan(second)] == [1, 2]
    finally:
        first.close()
        second.close()


def test_info_shows_the_bus(capsys: pytest.CaptureFixture[str], classic: str) -> None:
    info = json.loads(bench(capsys, "info", classic, "--json")[0])
    assert [node["identity"]["node"] for node in info["nodes"]] == [1, 2]
    bus = info["bus"]
    assert bus["rates"] == "1 Mbit/s"
    # two heartbeats of 8 frames, ten times a second: 16 x 10 x about 115 us
    assert 0.01 < bus["load"] < 0.03
    assert bus["fits"][0]["channels"] == 26
    assert bus["fits"][-1]["rate_hz"] == 16_000
    out, _ = bench(capsys, "info", classic)
    assert "watched for a second" in out
    assert "streams of node 1 that fit" in out


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


def test_each_rate_that_is_offered_is_taken(capsys: pytest.CaptureFixture[str], classic: str) -> None:
    info = json.loads(bench(capsys, "info", classic, "--json")[0])
    names = [c["name"] for c in info["nodes"][0]["channels"]]
    fits = info["bus"]["fits"]
    for fit in {fit["channels"]: fit for fit in (fits[0], fits[len(fits) // 2], fits[-1])}.values():
        channels = ",".join(names[: fit["channels"]])
        rate = f"{fit['rate_hz']:g}"  # as it is printed
        out, _ = bench(
            capsys, "live", classic, "--viewer", "none", "--channels", channels, "--rate", rate, "--duration", "0.2",
            "--json", "-",
        )  # fmt: skip
        summary = json.loads(out)
        assert summary["bus"]["load_predicted"] == pytest.approx(fit["load"], rel=1e-5)


def test_fit_takes_the_highest_rate(classic: str, fd: str) -> None:
    summary, notes = run(classic, fit=True)
    assert "--fit: 26 channels at 666.667 Hz" in notes
    assert summary.samples == pytest.approx(666, rel=0.2)
    assert summary.bus is not None
    assert 0.3 < summary.bus["load"] < summary.bus["load_predicted"] < 0.95
    assert not any((summary.lost.samples_by_index, summary.lost.edges_by_index, summary.lost.frames_by_sequence))
    _, notes = run(fd, fit=True)
    assert "--fit: 26 channels at 5333.33 Hz" in notes


def test_the_load_machine_is_a_node_of_its_own(fd: str, tmp_path: Path) -> None:
    summary, _ = run(fd, fit=True, speed_rpm=300.0, load_a=1.0, save=tmp_path / "a.run", duration=0.6)
    assert summary.result == "ok as far as was seen; unverified: whether 300 r/min are held (too short a time)"
    assert summary.recording["samples"] == summary.samples
    assert summary.faults == []


def test_a_node_that_is_not_there(capsys: pytest.CaptureFixture[str], classic: str) -> None:
    with pytest.raises(NoReply, match="no HBP device answered on can:virtual/cli within 3 s"):
        run(classic + "&node=7")
    _, err = bench(capsys, "info", "can:virtual/empty", code=2)
    assert "check power, cable, termination, the bit rates and the node" in err


def test_frames_of_the_other_format_are_named(fd: str) -> None:
    """A host that was told of a classic bus hears FD frames."""
    with pytest.raises((RemoteProtocolError, NoReply), match=r"add fd=1|no HBP device answered"):
        run("can:virtual/cli-fd?ext=1")


def test_host_observers_need_every_period(classic: str) -> None:
    with pytest.raises(BenchError, match=r"would load .*--host-observers needs every PWM period: --channels hall,"):
        run(classic, fit=True, host_observers=True)


def test_a_bus_that_is_too_slow_for_the_edges_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    with on_virtual_bus("slow", BusRates(100_000)) as target:
        _, err = bench(capsys, "live", target, "--fit", "--viewer", "none", code=2)
        assert "error: can:virtual/slow (0.1 Mbit/s) is too slow: the Hall edges alone" in err
        out, _ = bench(capsys, "info", target)
        assert "no stream of node 1 fits" in out


def test_a_bus_that_pythons_configuration_names_is_shown_by_its_name(
    classic: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    monkeypatch.setenv("CAN_CHANNEL", "cli")
    summary, notes = run("can:", fit=True)
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
        assert report is not None
        assert report["errors"] == {"bus-off": 1}
        assert ["errors on the bus", "1 bus-off; the adapter is off the bus"] in bus_rows(report)
        link.close()

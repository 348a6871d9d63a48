"""`bench capture` on real links, in real time: a trigger, a fault that nobody asked about, what is given up."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest
from against import said as bench
from capture_rebuilt import buffer_of
from virtual_bus import PATIENT, VirtualPort, in_real_time

import bench as api
from bench.device.client import Client
from bench.device.node import Node
from protocol.canmap.frame import BusRates
from protocol.links import open_link
from protocol.links.target import CanTarget
from protocol.messages import CaptureArm, CaptureReply, CaptureState, DriveState, Fault
from protocol.signals import STATUS_STATE_MASK
from sim.config.params import load_params
from sim.ports.byte_ports import PtyPort, TcpPort
from sim.ports.device import SimulatedDevice
from sim.ports.networks import ByteNetwork, CanNetwork
from sim.ports.slcan_port import SlcanPort

pytestmark = [pytest.mark.long("captures come in real time, in a process that simulates"), pytest.mark.real_time]

RATES = BusRates()
MEMORY = 65536  # bytes: some 80 ms before a fault, so that a slow machine carries them soon


def on_pty(stack: ExitStack) -> tuple[PtyPort, ByteNetwork | CanNetwork | None, str]:
    port = PtyPort()
    return port, None, port.target


def on_tcp(stack: ExitStack) -> tuple[TcpPort, ByteNetwork | CanNetwork | None, str]:
    port = TcpPort("127.0.0.1", 0)
    port.plug()
    return port, None, port.target


def on_slcan(stack: ExitStack) -> tuple[SlcanPort, ByteNetwork | CanNetwork | None, str]:
    port = SlcanPort(None, RATES)
    return port, CanNetwork(RATES), port.target


def on_bus(stack: ExitStack) -> tuple[VirtualPort, ByteNetwork | CanNetwork | None, str]:
    port = stack.enter_context(closing(VirtualPort("captures")))
    return port, CanNetwork(RATES), str(CanTarget("virtual", "captures", (("bitrate", "1000000"),)))


class Drive:
    """A simulated drive in real time, the target that reaches it, and what is done to it between two steps."""

    def __init__(self, device: SimulatedDevice, target: str) -> None:
        self.device, self.target = device, target
        self._waiting: list[Callable[[], object]] = []
        self._done = threading.Event()

    def between_steps(self) -> None:
        while self._waiting:
            self._waiting.pop()()
            self._done.set()

    def do(self, act: Callable[[], object]) -> None:
        self._done.clear()
        self._waiting.append(act)
        assert self._done.wait(5.0)


EACH = {"pty": on_pty, "tcp": on_tcp, "slcan": on_slcan, "virtual": on_bus}


@pytest.fixture(params=["pty"])
def drive(request: pytest.FixtureRequest) -> Iterator[Drive]:
    with ExitStack() as stack:
        port, network, target = EACH[request.param](stack)
        device = SimulatedDevice(load_params(None, PATIENT | {"memory.capture": MEMORY}), 3, network=network)
        device.advance(32)
        made = Drive(device, target)
        stack.enter_context(in_real_time(device, port, made.between_steps))
        yield made


@pytest.mark.parametrize("drive", EACH, indirect=True)
def test_now_and_at_a_fault_on_each_link(drive: Drive, tmp_path, capsys) -> None:
    buffers: list[bytes] = []
    arm = drive.device.drive.capture.arm

    def kept(request: CaptureArm, tx_max: int) -> CaptureReply:
        buffers.append(drive.device.drive.capture.blob or b"")
        return arm(request, tx_max)

    drive.device.drive.capture.arm = kept
    path = tmp_path / "now.run"
    out, _ = bench(capsys, "capture", drive.target, "--trigger", "now", "--for", "0.02", "-o", str(path), "--json=-")
    (told,) = json.loads(out)
    run = api.read(path)
    assert buffer_of(run.samples, run.edges if told["edges"] else None) == buffers[-1]
    assert (told["records"], told["before"], told["frozen_by"]) == (320, 0, "now")
    assert told["first_s"] == run.span[0]

    _, err = bench(capsys, "capture", drive.target, "--at-fault", "-o", str(tmp_path / "no.run"), code=2)
    assert "node 1 holds no capture: it is ARMED, for a fault" in err
    assert not (tmp_path / "no.run").exists()

    time.sleep(0.05)
    drive.do(lambda: drive.device.drive.fault(Fault.OVERVOLTAGE))
    fault = tmp_path / "fault.run"
    out, _ = bench(capsys, "capture", drive.target, "--at-fault", "-o", str(fault))
    assert "the drive tripped: OVERVOLTAGE" in out
    opened = api.open(fault)
    assert opened.info.identity["capture"]["faults"] == ["OVERVOLTAGE"]
    assert buffer_of(opened.read().samples, None) == buffers[-1][: len(buffer_of(opened.read().samples, None))]
    (mark,) = opened.run.marks
    before = (mark.first_tick - opened.run.span[0]) / opened.info.tick_hz
    assert before >= 0.05

    assert drive.device.drive.capture.state == CaptureState.ARMED


def test_what_nobody_has_fetched_is_told_and_given_up_only_when_asked(drive: Drive, tmp_path, capsys) -> None:
    drive.do(lambda: drive.device.drive.fault(Fault.HALL))
    time.sleep(0.3)  # what follows the fault is taken in real time
    path = str(tmp_path / "a.run")
    _, err = bench(capsys, "capture", drive.target, "--trigger", "now", "-o", path, code=2)
    assert "(fault: HALL at" in err
    assert "that nobody has fetched: fetch it with --at-fault, or give it up with --discard" in err
    assert drive.device.drive.capture.state == CaptureState.FROZEN
    out, _ = bench(capsys, "capture", drive.target, "--discard")
    assert out.startswith("given up: node 1 holds capture ")
    bench(capsys, "capture", drive.target, "--trigger", "now", "--for", "0.01", "-o", path)
    assert len(api.read(path)) == 160


def test_armed_now_and_fetched_later_by_another_command(drive: Drive, tmp_path, capsys) -> None:
    out, _ = bench(capsys, "capture", drive.target, "--trigger", "state", "--for", "0.02", "--arm")
    assert "is armed and waits for 'state'" in out
    link = open_link(drive.target)
    with closing(link):
        client = Client(link)
        node = Node(client, client.connect().node)
        client.run_for(0.1)
        node.arm()
        node.stop()
        client.run_for(0.1)
    out, _ = bench(capsys, "capture", drive.target, "--held", "-o", str(tmp_path / "b.run"))
    assert "frozen by a change of state" not in out
    run = api.read(tmp_path / "b.run", channels=["status"])
    assert len(run) == 320
    states = run["status"].astype(int) & STATUS_STATE_MASK
    assert states[0] == DriveState.IDLE
    assert states.max() > DriveState.IDLE


def test_parts_and_a_trigger_that_does_not_come(drive: Drive, tmp_path, capsys) -> None:
    path = tmp_path / "c.run"
    bench(capsys, "capture", drive.target, "--trigger", "now", "--for", "0.01", "--repeat", "2", "-o", str(path))
    first, second = (api.read(tmp_path / f"c-00{k}.run") for k in (1, 2))
    assert first.span[1] < second.span[0]
    _, err = bench(
        capsys,
        "capture",
        drive.target,
        "--trigger",
        "i_q > 4",
        "--for",
        "0.02",
        "--timeout",
        "0.3",
        "-o",
        str(path),
        code=2,
    )
    assert "no trigger 'i_q > 4' within 0.3 s; nothing is armed now" in err
    assert drive.device.drive.capture.trigger.name == "FAULT"

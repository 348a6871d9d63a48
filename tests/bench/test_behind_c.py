"""The simulated drive behind the device side in C: the same run as behind the one in Python, sample by sample."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest
from collect import Bench, Collector

from protocol.canmap.frame import BusRates
from protocol.device.compiled import CompiledLink
from protocol.device.session import DeviceLink
from protocol.framing import MAJOR, Deframer, Frame, encode_frame, parse_frame
from protocol.messages import (
    BlobReply,
    CaptureReply,
    CaptureState,
    CaptureStatus,
    CaptureTrigger,
    Command,
    EventCode,
    Fault,
    Request,
    StateCommand,
)
from sim.config.params import load_params
from sim.ports.device import SimulatedDevice
from sim.ports.networks import ByteNetwork, CanNetwork, Network
from sim.ports.virtual import VirtualLink
from tests.protocol.small_drive import whole_blob
from tests.tools import needs

NAMES = ("hall", "theta_enc", "theta_vt", "i_q")


def ran(network: Network | None) -> Collector:
    """Start, speed step, load step, a watchdog that is not fed, a new start; node 2 loads."""
    bench = Bench(VirtualLink(SimulatedDevice(load_params(), 5, network=network)))
    decimation = 1 if network is None or isinstance(network, ByteNetwork) else 8
    bench.stream(NAMES, decimation)
    bench.load.arm()
    bench.load.start()
    bench.turn(60.0)
    bench.client.run_for(0.5)
    bench.load.torque(0.05)
    bench.client.run_for(0.2)
    bench.drive.speed(-30.0)
    bench.client.run_for(0.5)
    bench.rest()
    return bench.collector


@pytest.fixture(scope="module")
def in_python() -> Collector:
    return ran(None)


@needs("C compiler")
def test_the_same_run_over_a_byte_link(in_python: Collector) -> None:
    in_c = ran(ByteNetwork(CompiledLink(1 << 21)))
    ours, theirs = in_c.all_samples(), in_python.all_samples()
    n = min(len(ours), len(theirs))
    assert abs(len(ours) - len(theirs)) < 0.01 * n  # when it stops, the link's pace decides
    assert n > 15_000
    assert (ours.index[:n] == theirs.index[:n]).all()
    assert (ours.tick[:n] == theirs.tick[:n]).all()
    # commands come in the same period only as long as the links deliver in the same steps
    assert (ours.raw[:8000] == theirs.raw[:8000]).all()
    edges, others = in_c.all_edges(), in_python.all_edges()
    assert (edges.tick[:100] == others.tick[:100]).all()
    assert (np.diff(edges.index) == 1).all()
    assert (in_c.lost, {event.code for _, event in in_c.events}) == ((0, 0), {EventCode.STATE_CHANGED})


def held_after_a_trip(link: DeviceLink | CompiledLink) -> tuple[CaptureReply, bytes]:
    """What the drive has held unasked, half a second after it was armed and then left alone: the watchdog trips."""
    device = SimulatedDevice(load_params(), 5, network=ByteNetwork(link))
    device.advance(6000)
    boot = device.drive.identity.boot_id

    def ask(message: Request) -> bytes:
        device.data_to_send()
        device.receive(encode_frame(Frame(message.TYPE, MAJOR, device.periods % 65535 + 1, 1, message.pack())))
        device.advance(1)
        frames = map(parse_frame, Deframer().feed(b"\0" + device.data_to_send()))
        return next(frame.payload for frame in frames if frame.is_reply)

    ask(StateCommand(Command.ARM, boot))
    device.advance(8000)
    return CaptureReply.unpack(ask(CaptureStatus())), whole_blob(lambda request: BlobReply.unpack(ask(request)))


@needs("C compiler")
def test_the_same_is_held_after_a_trip() -> None:
    (ours, in_c), (theirs, in_python) = held_after_a_trip(CompiledLink(1 << 21)), held_after_a_trip(DeviceLink())
    assert ours == theirs
    assert in_c == in_python
    assert (ours.state, ours.trigger, ours.faults) == (CaptureState.FROZEN, CaptureTrigger.FAULT, Fault.WATCHDOG)
    assert (len(in_c), crc32(in_c)) == (ours.size, ours.crc)
    assert (ours.first + 1) * ours.decimation / 16_000 >= 0.05


@needs("C compiler")
@pytest.mark.parametrize("rates", [BusRates(1_000_000), BusRates(1_000_000, 5_000_000)], ids=["classic", "FD"])
def test_the_same_run_over_can(rates: BusRates) -> None:
    in_c, in_python = ran(CanNetwork(rates, compiled=True)), ran(CanNetwork(rates))
    ours, theirs = in_c.all_samples(), in_python.all_samples()
    n = min(len(ours), len(theirs))
    assert n > 1000
    assert (ours.index[:n] == theirs.index[:n]).all()
    assert (ours.raw[: n // 3] == theirs.raw[: n // 3]).all()
    assert in_c.lost == (0, 0)


def test_without_a_compiler_it_says_so(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bench", "sim", "--device", "c"]
    environment = {"PATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "error: --device c: no C compiler: install gcc or clang, or set CC to one\n"

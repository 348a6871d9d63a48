"""A capture of a second over classic CAN: its bits, an unplugged cable, and the drive's buffer byte for byte."""

from __future__ import annotations

import math

import numpy as np
import pytest
from capture_rebuilt import buffer_of
from unplugged import UnpluggedLink

import bench
from bench.capture.memory import CaptureMemory
from bench.capture.store import about, store
from bench.capture.trigger import Trigger
from bench.capture.wanted import Wanted
from bench.device.client import Client
from bench.device.node import Node
from bench.errors import NodeError
from bench.record.info import RunInfo
from protocol.canmap.frame import CAN_RECORD, BusRates
from protocol.messages import CaptureState
from sim.config.params import load_params
from sim.ports.can_bits import count_bits
from sim.ports.device import SimulatedDevice
from sim.ports.networks import CanNetwork

CHANNELS = (
    "hall", "status", "theta_enc", "omega_enc", "i_a", "i_b", "i_c", "i_d", "i_q", "u_dc", "theta_vt", "omega_vt",
    "theta_avg", "omega_avg",
)  # fmt: skip
BUDGET = 1.15  # of what frames of 7 data bytes need
RATES = BusRates(1_000_000)


def bits_needed(data: bytes) -> int:
    """Of frames with 7 of these bytes and one more each, as a drive's replies have them, and nothing else."""
    n = math.ceil(len(data) / 7)
    frames = np.zeros(n, CAN_RECORD)
    frames["id"], frames["length"] = 3 << 8 | 1 << 4, 8
    frames["data"][:, :7] = np.frombuffer(data.ljust(7 * n, b"\0"), np.uint8).reshape(n, 7)
    frames["data"][:, 7] = 0x20
    return int(count_bits(frames).sum())


def frozen(length: float, network: CanNetwork, **link: object) -> tuple[CaptureMemory, UnpluggedLink, Client]:
    """A drive that has captured, beside the link by which it is read."""
    device = SimulatedDevice(load_params(None, {}), 5, network=network)
    unplugged = UnpluggedLink(device, **({"at": 1 << 40, "seconds": 0.0, "silent": False} | link))  # type: ignore[arg-type]
    client = Client(unplugged, reconnect=30.0)
    node = Node(client, client.connect().node)
    memory = CaptureMemory(node)
    memory.arm(Wanted(Trigger.parse("now"), length, 0.0, CHANNELS))
    client.run_for(length + 0.2)
    assert memory.status().state == CaptureState.FROZEN
    return memory, unplugged, client


@pytest.mark.long("carries 450 kB in frames of 8 bytes")
@pytest.mark.parametrize("silent", [False, True], ids=["the port goes", "nothing comes"])
def test_a_second_of_14_channels_survives_an_unplugged_cable_within_the_budget_of_bits(tmp_path, silent) -> None:
    network = CanNetwork(RATES)
    memory, link, client = frozen(1.0, network, seconds=3.0, silent=silent)
    status = memory.frozen()
    buffer = link.device.drive.capture.blob
    frames = len(buffer) / 7
    link.pull(round(frames / 2) * CAN_RECORD.itemsize)
    began = network.bus.busy_seconds
    captured = memory.read(status)
    bits = (network.bus.busy_seconds - began) * RATES.bitrate

    assert link.outages == 1
    assert captured.data == buffer
    assert len(captured.samples) == 16_000
    assert bits <= BUDGET * bits_needed(buffer)
    path = tmp_path / "shot.run"
    store(captured, path, RunInfo(captured.stream.tick_hz, captured.stream.pwm_hz, ()), about(captured))
    run = bench.read(path)
    assert run.names == CHANNELS or set(run.names) == set(CHANNELS)
    assert buffer_of(run.samples, run.edges) == buffer
    assert client.health.outages == (0 if silent else 1)


def test_a_link_that_does_not_come_back_tells_how_much_is_left_and_the_drive_still_holds_it() -> None:
    memory, link, _ = frozen(0.05, CanNetwork(RATES), seconds=60.0, silent=True)
    status, size = memory.frozen(), len(link.device.drive.capture.blob)
    link.pull(round(size / 14) * CAN_RECORD.itemsize)
    memory.patience = 1.0
    with pytest.raises(NodeError, match=rf"of {size} bytes \(\d+ %\) are left; the drive still holds it: --at-fault"):
        memory.read(status)
    assert link.device.drive.capture.state == CaptureState.FROZEN


def test_another_capture_or_another_boot_is_not_read_on() -> None:
    memory, link, _ = frozen(0.05, CanNetwork(RATES), seconds=1.0, silent=True)
    status = memory.frozen()
    link.pull(20 * CAN_RECORD.itemsize)
    poll = link.read

    def given_up(timeout: float, settle: float = 0.0) -> bytes:
        if link.out and link.device.drive.capture.number == status.number:
            link.device.drive.capture._begin(None)
        return poll(timeout, settle)

    link.read = given_up  # type: ignore[method-assign]
    with pytest.raises(NodeError, match=f"no longer holds capture {status.number}: another host has given it up"):
        memory.read(status)


def test_what_is_read_beside_streams_costs_them_nothing() -> None:
    """19.28: beside a stream that takes half of the bus nothing of it is lost, and the capture comes all the same."""
    memory, link, client = frozen(0.1, CanNetwork(RATES))
    node, buffer = memory.node, link.device.drive.capture.blob
    node.set_samples(node.channels(["i_q", "theta_enc", "omega_enc"]), 4)
    node.start_streams()
    client.run_for(0.5)
    assert 0.3 < node.load < 0.9
    before, began = client.losses(node.number).samples, client.now()
    captured = memory.read(memory.frozen())
    took = client.now() - began
    client.run_for(0.3)
    after = client.losses(node.number).samples
    assert captured.data == buffer
    assert after.lost_by_index == before.lost_by_index == 0
    assert after.samples - before.samples == pytest.approx(4000 * (took + 0.3), rel=0.05)
    alone = bits_needed(buffer) / RATES.bitrate
    assert took >= alone / (1.0 - node.load)

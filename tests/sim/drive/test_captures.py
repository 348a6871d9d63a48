"""The simulated drive's captures: what is held at a fault is what was streamed, at the fault's own period."""

from __future__ import annotations

import numpy as np
import pytest
from small_host import SmallHost

from protocol.descriptor import sample_dtype
from protocol.messages import (
    BlobRead,
    BlobReply,
    CaptureArm,
    CaptureReply,
    CaptureState,
    CaptureStatus,
    CaptureTrigger,
    DriveState,
    EventCode,
    Fault,
    Feature,
    SetpointMode,
)
from protocol.signals import STATUS_STATE_MASK
from protocol.streams import EDGE_RECORD
from sim.config.params import BenchParams, load_params
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink
from tests.protocol.small_drive import whole_blob


def host_of(step: float = 0.002, params: BenchParams | None = None) -> SmallHost:
    return SmallHost(VirtualLink(SimulatedDevice(params or load_params(), seed=4), step=step))


def ask(host: SmallHost, message: CaptureArm | CaptureStatus) -> CaptureReply:
    reply = host.request(message)
    assert isinstance(reply, CaptureReply)
    return reply


def read(host: SmallHost, told: CaptureReply) -> tuple[np.ndarray, np.ndarray]:
    """Records and edges of what is held."""
    data = whole_blob(host.request)
    by_id = {channel.id: channel for channel in host.nodes[1].descriptor.channels}
    records = told.records * told.sample_bytes
    dtype = sample_dtype([by_id[number] for number in told.channels])
    return np.frombuffer(data[:records], dtype), np.frombuffer(data[records:], EDGE_RECORD)


@pytest.mark.parametrize("step", [0.002, 0.05])
def test_at_a_fault_the_periods_before_it_are_held_unasked(step: float) -> None:
    """They are those that were streamed, whatever the portions in which the drive runs; the edges too."""
    host = host_of(step)
    assert host.connect().features & Feature.CAPTURE
    armed = ask(host, CaptureStatus())
    assert (armed.state, armed.trigger, armed.decimation) == (CaptureState.ARMED, CaptureTrigger.FAULT, 1)
    by_id = {channel.id: channel.name for channel in host.nodes[1].descriptor.channels}
    names = [by_id[number] for number in armed.channels]
    assert {"i_a", "i_b", "i_c", "i_d", "i_q", "u_dc", "status", "theta_enc", "theta_vt"} <= set(names)
    host.stream(names)
    host.start()
    host.setpoint(SetpointMode.SPEED, 80.0)
    host.run(0.4)
    host.set("i_trip", 0.05)
    host.run(0.3)
    told = ask(host, CaptureStatus())
    assert (told.state, told.faults) == (CaptureState.FROZEN, Fault.OVERCURRENT)
    assert (told.first, told.records) == (armed.before, armed.before + armed.after)
    records, edges = read(host, told)
    streamed = host.samples()
    states = streamed.raw["status"] & STATUS_STATE_MASK
    tripped = int(streamed.index[np.argmax(states == DriveState.FAULT)])
    assert told.index == tripped  # the first period in which the firmware has switched off
    assert told.tick == streamed.tick[streamed.index == tripped][0]
    begin = int(np.searchsorted(streamed.index, tripped - told.first))
    for name in names:
        assert np.array_equal(records[name], streamed.raw[name][begin : begin + told.records]), name
    during = (host.edges().tick >= streamed.tick[begin]) & (
        host.edges().tick <= streamed.tick[begin + told.records - 1]
    )
    assert edges["tick"].tolist() == (host.edges().tick[during] & 0xFFFFFFFF).tolist()
    assert len(edges) > 20
    codes = {item.event.code: item.event for item in host.kept.events}
    assert codes[EventCode.FAULT].tick == told.tick
    assert codes[EventCode.CAPTURED].arg == told.number


def test_channels_that_nobody_streams_are_captured() -> None:
    """An observer runs for a capture alone; a trigger's channel need not be held."""
    host = host_of()
    host.connect()
    channel = host.nodes[1].descriptor.channel
    held, watched = channel("theta_lut"), channel("i_q")
    armed = ask(
        host,
        CaptureArm(CaptureTrigger.ABOVE, 0, 2, 500, 1000, 0.1, watched.id, 100, (held.id, channel("theta_true").id)),
    )
    assert armed.state == CaptureState.ARMED
    host.start()
    host.setpoint(SetpointMode.SPEED, 60.0)
    host.run(0.5)
    told = ask(host, CaptureStatus())
    assert told.state == CaptureState.FROZEN
    records, _ = read(host, told)
    away = (records["theta_lut"] - records["theta_true"])[-300:]  # int16: wraps as the angle does
    assert np.abs(away.astype(int)).max() < 32768 / 180 * 40
    assert np.ptp(records["theta_true"].astype(int)) > 30_000


def test_a_drive_without_memory_has_no_captures_and_all_tell_what_names_mean() -> None:
    host = host_of(params=load_params(None, {"memory.capture": 0}))
    assert not host.connect().features & Feature.CAPTURE
    for number, node in host.nodes.items():
        assert node.identity.features & Feature.MEANINGS
        reply = host.request(BlobRead(3, 1000, 0), number)
        assert isinstance(reply, BlobReply)
        name, _, meaning = reply.data.decode().partition("\n")[0].partition(" ")
        assert node.descriptor.channel(name).id == 1
        assert len(meaning) > 10

"""Level 4, second part: captures of edges, and voltages that are given. Chapters 19 and 20 of SPEC."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator

from bench.conform.captured import Captured, captured, require_capture, status
from bench.conform.checks import Group
from bench.conform.commissioned import put, require, restored, run_at_zero_volts, value_of
from bench.conform.data import signed
from bench.conform.device import EDGE_BYTES, Configured, Device, ids, width
from bench.conform.levels import MOTION
from bench.conform.means import means_beside
from bench.conform.motion import RUN_UP, Edge, Watch, edges_of, spin
from bench.conform.setpoints import is_taken, rejected
from bench.conform.verdicts import Failed, Unknown
from protocol.codes import CaptureTrigger, ErrorCode, Feature, SetpointMode
from protocol.messages import CaptureArm

motion = Group("motion", MOTION)
capture = Group("capture", MOTION)
commission = Group("commission", MOTION)

SECONDS = 0.5  # that a capture lasts
RECORDS = 250
ROOMS = (400, 3)  # edges for which there is room: for all, and for few
VOLTS, OF_LIMIT = 0.05, 0.1  # V, largest voltage that is tried, and share of i_max that it may drive where that is told
MOST_OF_IT = 0.8  # share of the largest voltage


@motion("means", "11.51")
def means(device: Device) -> str:
    """A record of MEAN holds the mean of angles that pass the end of their range, too."""
    device.require(Feature.MEANS)

    def turn(told: Configured) -> None:
        spin(device)
        device.probe.listen(RUN_UP)

    with device.probe.watched(Watch(device, None, None, None).look):
        return means_beside(device, turn)


@capture("edges", "19.24 19.26 19.29")
def edges(device: Device) -> Iterator[str]:
    """A capture holds the edges between its first and its last record, the newest where not all have room."""
    require_capture(device)
    device.require(Feature.EDGES)
    channel = min(device.channels, key=width)
    for room in ROOMS:
        told = device.configure_edges(0)
        device.start_streams(1)
        records = min(RECORDS, (status(device).room - room * EDGE_BYTES) // width(channel))
        if records < 2:
            raise Unknown(f"there is no room for {room} edges")
        decimation = min(max(1, math.ceil(SECONDS * device.pwm_hz / records)), 0xFFFF)
        with device.probe.watched(Watch(device, None, None, told.reply.slot).look):
            spin(device)
            device.probe.listen(RUN_UP)
            request = CaptureArm(CaptureTrigger.NOW, 0, decimation, 0, records, edges=room, channels=ids([channel]))
            found = captured(device, request)
        device.probe.stop()
        device.fresh()
        device.stop_streams()
        yield _same_edges(device, found, edges_of(device, told.reply.slot), room)
        device.rest()
        device.probe.forget()


def _same_edges(device: Device, found: Captured, streamed: list[Edge], room: int) -> str:
    reply = found.reply
    period = reply.decimation * device.ticks_per_period
    first, last = reply.tick - reply.first * period, reply.tick + (reply.after - 1) * period
    meant = [edge for edge in streamed if signed(edge.tick - first) >= 0 >= signed(edge.tick - last)]
    words = f"{len(meant)} edges were streamed between its records, it has room for {room} and holds {reply.edges}"
    if not meant:
        raise Unknown("no edges: the motor did not turn")
    if reply.edges != min(len(meant), room) or bool(reply.edges_lost) != (len(meant) > reply.edges):
        raise Failed(f"{words}, edges_lost is {reply.edges_lost}")
    for edge, raw in zip(meant[-reply.edges :], found.edges, strict=True):
        tick, codes, flags, encoder = struct.unpack("<IBBH", raw)
        seen = (edge.tick, edge.codes, edge.encoder) + ((edge.flags,) if not device.probe.line.bus else ())
        if seen != (tick, codes, encoder, flags)[: len(seen)]:
            raise Failed(f"{words}: {raw.hex()} in the capture, tick, codes, encoder {seen} in the stream")
    size = 256 if device.probe.line.bus else 1 << 32
    if (reply.first_edge - meant[-reply.edges].index) % size:
        raise Failed(f"{words}: first_edge is {reply.first_edge}, in the stream it is edge {meant[-reply.edges].index}")
    return f"{words}: as streamed"


@commission("nothing-jumps", "20.11 20.10")
def nothing_jumps(device: Device) -> Iterator[str]:
    """With u_test_max lowered to next to nothing, a voltage beyond it, or further away than it, is rejected."""
    device.require(Feature.COMMISSION)
    record = require(device, "u_test_max")
    resistance, largest = device.named("R_s_hat"), device.named("i_max")
    volts = VOLTS
    if resistance and largest:
        volts = OF_LIMIT * device.parameter(resistance).value * device.parameter(largest).value
    limit = min(volts, device.parameter(record).value)
    if limit <= 0:
        raise Unknown("u_test_max is 0")
    with restored(device, "u_test_max"):
        put(device, "u_test_max", limit)
        limit = value_of(device, "u_test_max")
        run_at_zero_volts(device)
        volts = MOST_OF_IT * limit
        if not is_taken(device, SetpointMode.VOLTAGE, 1, 0.0, volts):
            raise Failed(f"VOLTAGE 0, {volts:.3g} V from 0 was rejected, u_test_max is {limit:.3g} V")
        for n, (u_q, u_d) in enumerate(((0.0, -volts), (volts, -0.5 * volts), (volts, volts)), 2):
            what = f"VOLTAGE {u_q:.3g}, {u_d:.3g} V from 0, {volts:.3g} V"
            yield rejected(device, what, (SetpointMode.VOLTAGE, n, u_q, u_d), ErrorCode.OUT_OF_RANGE, limit)
        if not is_taken(device, SetpointMode.VOLTAGE, 9):
            raise Failed(f"VOLTAGE 0 from 0, {volts:.3g} V was rejected, u_test_max is {limit:.3g} V")
        yield "VOLTAGE 0: accepted"

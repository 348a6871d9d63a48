"""Level 4: motion, at the low speed announced. Chapters 5, 7, 8, 11 and 12 of SPEC."""

from __future__ import annotations

import math
import struct
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.conform.checks import Carrier, Group
from bench.conform.data import EDGES_FIRST, edges_ahead
from bench.conform.device import PATIENCE, Device, ids, require_granted
from bench.conform.levels import MOTION
from bench.conform.probe import accepted, read, state_name
from bench.conform.setpoints import code_name, send
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from bench.device.safety import is_off, says
from bench.rig.runaway import Runaway
from bench.signal.units import RPM, pole_pairs
from bench.signal.waveforms.sectors import edge_passages, steps_between
from protocol.codes import DriveState, ErrorCode, EventCode, Fault, Role, SetpointMode
from protocol.descriptor import Channel
from protocol.messages import Heartbeat, StateReply
from protocol.signals import Flag, Unit

check = Group("motion", MOTION)

TURNS = 1.5  # s for which it turns
RUN_UP = 0.3  # s of them after which the direction is looked at
LATENCY_MS = 10
RATE = 200.0  # Hz of the reference channel
COMMON = 1.05  # a setpoint beyond a limit, over that


@dataclass(frozen=True)
class Turn:
    """What came while it turned: edges as (index, tick, codes), the encoder's travel in rad, and heartbeats."""

    edges: list[tuple[int, int, int]]
    travel: float
    beats: list[Heartbeat]
    ahead: str
    """Evidence that edges are ahead of samples; empty where that was not so, and `late` says why."""
    late: str
    stopped: Heartbeat
    answered: DriveState


def spin(device: Device) -> None:
    """Begin to turn at the speed that was announced. Raises Unknown, NotApplicable."""
    if device.hello.role != Role.DRIVE:
        raise NotApplicable(f"the device is {device.hello.role.name}, not a drive")
    device.run()
    beat = send(device, SetpointMode.SPEED, 0x5EED, device.speed_rpm * RPM)
    if beat.setpoint_counter != 0x5EED or beat.state != DriveState.RUNNING:
        raise Unknown(f"SPEED {device.speed_rpm:g} r/min was not accepted; the state is {state_name(beat.state)}")


def turned(device: Device) -> Turn:
    """It turns once, for all checks that look at that."""
    return device.once("turn", lambda: _turn(device))


def reference(device: Device) -> Channel | None:
    """The angle of the encoder, by flags and unit."""
    wanted = Flag.REFERENCE | Flag.WRAPS
    return next((c for c in device.descriptor.channels if c.flags & wanted == wanted and c.unit == Unit.RAD), None)


def _turn(device: Device) -> Turn:
    channel = reference(device)
    slot = None
    if device.offers_edges:
        slot = device.configure_edges(0).reply.slot
    mask = 1 if device.offers_edges else 0
    told = None
    if device.descriptor.channels:
        told = device.configure(1, ids([channel or device.descriptor.channels[0]]), RATE, LATENCY_MS)
        mask |= 2
    device.start_streams(mask)
    watch = _Watch(device, channel if told else None, told.reply.slot if told else 0, slot)
    with device.probe.watched(watch.look):
        spin(device)
        device.probe.listen(TURNS)
    device.probe.feed_every = None
    answer = device.probe.stop()
    accepted(answer, "STOP while turning")
    stopped = device.fresh()
    device.probe.listen(0.15)  # for a heartbeat that counts what came
    beats = [beat for _, beat in device.probe.beats]
    device.stop_streams()
    ahead = late = ""
    if device.offers_edges and told is not None and not device.probe.line.bus:
        try:
            ahead = edges_ahead(device, told, "the motor did not turn")
        except Failed as failure:
            late = str(failure)
        except Unknown:
            ahead = ""
    travel = _travel(device, channel, told.reply.slot if told else 0)
    return Turn(_edges(device, slot), travel, beats, ahead, late, stopped, read(answer.frame, StateReply).state)


class _Watch:
    """Looks whether the motor runs away while it turns; its drive tells its pole pairs, or nothing is looked at."""

    def __init__(self, device: Device, channel: Channel | None, slot: int, edge_slot: int | None) -> None:
        self._device, self._channel, self._slots = device, channel, (slot, edge_slot)
        names = ("n_p", "omega_m_max")
        told = {name: device.parameter(record).value for name in names if (record := device.named(name))}
        self._runaway = Runaway(pole_pairs(told), lambda: told.get("omega_m_max", 0.0))
        self._runaway.ask(device.speed_rpm * RPM)
        self._seen = (0, 0)  # how many messages, and frames of streams on a bus, were looked at
        self._edge: tuple[int, int] | None = None  # tick and codes of the last one
        self._angles = np.zeros(0)

    def look(self) -> None:
        """Look at what has come since. Raises Failed, with the motor stopped, where it runs away."""
        device, now = self._device, self._device.probe.now()
        since, self._seen = self._seen, (len(device.probe.heard), len(device.probe.stream_frames))
        if since == self._seen:
            return
        slot, edge_slot = self._slots
        edges = [(tick, codes) for _, tick, codes in _edges(device, edge_slot, since)]
        if edges and self._edge is not None and (ticks := (edges[-1][0] - self._edge[0]) & 0xFFFFFFFF) < 1 << 31:
            codes = np.array([codes for _, codes in edges])
            self._runaway.by_edges(now, max(ticks, 1) / device.hz, steps_between(codes & 7, codes >> 3 & 7))
        self._edge = edges[-1] if edges else self._edge
        if self._channel is not None:
            angles = np.concatenate([self._angles[-1:], _angles(device, self._channel, slot, since)])
            if len(angles) > 1:
                self._runaway.by_encoder(now, (len(angles) - 1) / RATE, _turned_by(angles))
            self._angles = angles
        self._runaway.judge(now)
        if words := self._runaway.verdict:
            device.probe.stop()
            raise Failed(f"the drive {words}; STOP was sent")


def _edges(device: Device, slot: int | None, since: tuple[int, int] = (0, 0)) -> list[tuple[int, int, int]]:
    """`since`: how many messages, and frames of streams on a bus, are left out."""
    found: list[tuple[int, int, int]] = []
    for block in device.blocks(since=since[0]):
        if block.edges:
            rows = struct.iter_unpack("<IBBH", block.data)
            found += [(block.index + k, tick, codes) for k, (tick, codes, _, _) in enumerate(rows)]
    for frame in device.probe.stream_frames[since[1] :]:
        if frame.edges and frame.slot == slot:
            tick, codes, index = struct.unpack_from("<IBB", frame.data)
            found.append((index, tick, codes))
    return found


def _travel(device: Device, channel: Channel | None, slot: int) -> float:
    """How far the encoder turned, in electrical rad with its sign; NaN where there is none."""
    values = np.zeros(0) if channel is None else _angles(device, channel, slot)
    return math.nan if len(values) < 2 else _turned_by(values)


def _angles(device: Device, channel: Channel, slot: int, since: tuple[int, int] = (0, 0)) -> NDArray[np.float64]:
    """What the encoder's `channel` showed, (n,) rad; `since` as in `_edges`."""
    raw: list[bytes] = [block.data for block in device.blocks(1, since[0]) if not block.edges]
    size = np.dtype(channel.raw.dtype).itemsize
    for frame in device.probe.stream_frames[since[1] :]:
        if not frame.edges and frame.slot == slot:
            counter = 4 if device.bus.rates.fd else 2
            raw.append(frame.data[counter : counter + (len(frame.data) - counter) // size * size])
    return np.frombuffer(b"".join(raw), channel.raw.dtype) * channel.scale + channel.offset


def _turned_by(angles: NDArray[np.float64]) -> float:
    steps = (np.diff(angles) + math.pi) % (2 * math.pi) - math.pi
    return float(steps.sum())


@check("stop", 7, "STOP is never refused", critical=True)
def stop(device: Device) -> str:
    """STOP while turning leads to IDLE, outputs off."""
    turn = turned(device)
    if turn.answered != DriveState.IDLE or turn.stopped.state != DriveState.IDLE or not is_off(turn.stopped):
        raise Failed(f"the reply has {state_name(turn.answered)}; after it {says(turn.stopped)}")
    return f"at {device.speed_rpm:g} r/min: IDLE in the reply, IDLE and outputs off in a later heartbeat"


@check("direction", 12, "Positive rotation passes through the sectors in ascending order")
def direction(device: Device) -> str:
    """A positive speed turns the motor forward, by its edges and by its encoder."""
    turn = turned(device)
    codes = np.array([codes for _, _, codes in turn.edges], np.int64)
    _, way = edge_passages(codes & 7, codes >> 3 & 7)
    up, down = np.count_nonzero(way > 0), np.count_nonzero(way < 0)
    words = f"{up} edges forward, {down} in reverse" if turn.edges else "no edges"
    if not math.isnan(turn.travel):
        words += f", {math.degrees(turn.travel):.0f} electrical degrees by the encoder"
    elif not up + down:
        raise Unknown("neither edges nor an encoder show the direction")
    if not up + down and not abs(turn.travel) > math.pi / 3:
        raise Unknown(f"{words}: no motion seen")
    if down > up or turn.travel < -math.pi / 3:
        raise Failed(f"{words} at {device.speed_rpm:g} r/min")
    return f"{words} at {device.speed_rpm:g} r/min"


@check("edges-counted", 5, "Hall edges since boot")
def edges_counted(device: Device) -> str:
    """`edges` in the heartbeat rises by the number of edges received between two heartbeats."""
    device.require_edges()
    turn = turned(device)
    beats = [beat for beat in turn.beats if turn.edges and _before(turn.edges[0][1], beat.tick)]
    if len(beats) < 2:
        raise Unknown(f"{len(turn.edges)} edges received, and {len(beats)} heartbeats after the first")
    first, last = beats[0], beats[-1]
    came = sum(_before(first.tick, tick) and not _before(last.tick, tick) for _, tick, _ in turn.edges)
    counted = (last.edges - first.edges) & 0xFFFFFFFF
    words = f"{came} edges received between two heartbeats, `edges` rose by {counted}"
    if came != counted:
        raise Failed(words)
    return words


def _before(tick: int, other: int) -> bool:
    """Whether `tick` was before `other`, by their low 32 bits."""
    return 0 < (other - tick) & 0xFFFFFFFF < 1 << 31


@check("edges-before-samples", 11, EDGES_FIRST, carrier=Carrier.BYTES)
def edges_before_samples(device: Device) -> str:
    """Every edge comes before any sample taken at or after it."""
    device.require_edges()
    turn = turned(device)
    if turn.late:
        raise Failed(turn.late)
    if not turn.ahead:
        raise Unknown("no edges received alongside samples")
    return turn.ahead


@check("watchdog", 7, "When it expires: outputs off, FAULT with the bit WATCHDOG")
def watchdog(device: Device) -> str:
    """While turning, an unfed watchdog trips: FAULT, outputs off."""
    spin(device)
    device.probe.listen(RUN_UP)
    device.probe.feed_every = None
    began = device.probe.now()
    with suppress(Unknown):  # what it says then is looked at
        device.wait_state(DriveState.FAULT, 2 * device.watchdog + PATIENCE)
    seconds = device.probe.now() - began
    beat = device.fresh()
    words = f"unfed for {seconds:.2f} s at {device.speed_rpm:g} r/min: {says(beat)}"
    if beat.state != DriveState.FAULT or beat.outputs_on or not beat.faults & Fault.WATCHDOG:
        raise Failed(words)
    return words


@check("never-clipped", 8, "Values are never clipped")
def never_clipped(device: Device) -> str:
    """With the limit lowered to --speed, a higher speed is rejected with that limit."""
    record = device.named("omega_m_max")
    if record is None or record.flags & Flag.READ_ONLY:
        raise Unknown("the speed limit cannot be lowered (no parameter omega_m_max): not tried")
    before = device.parameter(record).value
    try:
        limit = float(np.float32(device.speed_rpm * RPM))
        require_granted(device.set(record, limit), f"omega_m_max = {limit:g}")
        device.run()
        return _beyond(device, limit)
    finally:
        try:
            device.rest()
        finally:
            device.put_back(record, before)


def _beyond(device: Device, limit: float) -> str:
    was = device.fresh()
    now = send(device, SetpointMode.SPEED, 0x0BAD, COMMON * limit)
    words = f"SPEED {COMMON * limit:.5g} rad/s, the limit is {limit:.5g}"
    if now.setpoint_counter == 0x0BAD:
        raise Failed(f"{words}: accepted")
    events = device.events(EventCode.SETPOINT_REJECTED)
    if not events and now.setpoints_rejected == was.setpoints_rejected:
        raise Unknown(f"{words}: not accepted, but no rejection seen")
    if events and (events[-1].arg, events[-1].detail) != (ErrorCode.OUT_OF_RANGE, limit):
        raise Failed(f"{words}: {code_name(events[-1])}, detail {events[-1].detail:.9g}")
    return f"{words}: rejected with OUT_OF_RANGE, detail {limit:.9g}" if events else f"{words}: rejected"

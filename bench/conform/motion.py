"""Level 4: motion, at the low speed announced. Chapters 5, 7, 8, 11 and 12 of SPEC."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bench.conform.checks import Carrier, Group
from bench.conform.data import edges_ahead, late, signed
from bench.conform.device import (
    EDGE_BYTES,
    SLOW_LINK,
    WELL_LOADED,
    Block,
    Configured,
    Device,
    ids,
    require_granted,
)
from bench.conform.levels import MOTION
from bench.conform.probe import accepted, read, state_name
from bench.conform.setpoints import NO_MODE, code_name, is_taken, send
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from bench.device.safety import is_off, says
from bench.rig.runaway import Runaway
from bench.signal.units import RPM, pole_pairs
from bench.signal.waveforms.sectors import edge_passages, steps_between
from protocol.codes import Command, DriveState, ErrorCode, EventCode, Fault, Feature, Role, SetpointMode
from protocol.descriptor import Channel
from protocol.messages import Heartbeat, StateReply
from protocol.signals import Flag, Unit
from protocol.streams import OVERRUN

check = Group("motion", MOTION)

TURNS = 1.5  # s for which it turns
RUN_UP = 0.3  # s of them after which the direction is looked at
LATENCY_MS = 10
RATE = 200.0  # Hz of the reference channel
COARSE = 50  # ticks of a PWM period, above which edges are not all at the same place in one
ALONE, ALONE_MS = 0.8, 60  # s for which it turns with a stream of edges alone, and that stream's max_latency_ms
STRETCH = 0.25  # s in which motion is measured
TWITCH = math.radians(60)  # that a shaft without a setpoint may turn
COASTS = 24  # STRETCHes that a shaft may need to come to rest
USUAL_POLE_PAIRS = 10.0  # where no parameter tells them
PER_TURN = 2.5  # samples of an electrical turn that show its direction
LITTLE = 2.0**-10  # A: no motor turns by it
COMMON = 1.05  # a setpoint beyond a limit, over that


@dataclass(frozen=True)
class Edge:
    """A record of EDGES, with the index that its frame gives it, and when it came; `flags` is 0 on CAN."""

    index: int
    tick: int
    codes: int
    flags: int
    encoder: int
    at: float

    @property
    def before(self) -> int:
        """The Hall code before it."""
        return self.codes & 7

    @property
    def after(self) -> int:
        """The Hall code after it."""
        return self.codes >> 3 & 7


@dataclass(frozen=True)
class Turn:
    """What came while it turned: edges, the encoder's travel in rad, heartbeats, and blocks of edges on a byte link."""

    edges: list[Edge]
    blocks: list[Block]
    travel: float
    beats: list[Heartbeat]
    told: Configured | None
    """Of the stream of edges."""
    ahead: str
    """Evidence that edges are ahead of samples; empty where that was not so, and `late` says why."""
    late: str
    stopped: Heartbeat
    answered: DriveState
    ended: int
    """Tick when all had come."""
    dropped: str
    """What the device dropped meanwhile, in words."""


def spin(device: Device) -> None:
    """Begin to turn at the speed that was announced. Raises Unknown, NotApplicable."""
    if device.hello.role != Role.DRIVE:
        raise NotApplicable(f"the device is {device.hello.role.name}, not a drive")
    device.run()
    taken = is_taken(device, SetpointMode.SPEED, 0x5EED, device.speed_rpm * RPM)
    if not taken or (state := device.fresh().state) != DriveState.RUNNING:
        words = "was not accepted" if not taken else f"led to {state_name(state)}"
        raise Unknown(f"SPEED {device.speed_rpm:g} r/min {words}")


def turned(device: Device) -> Turn:
    """It turns once, for all checks that look at that."""
    return device.once("turn", lambda: _turn(device))


def reference(device: Device) -> Channel | None:
    """The angle of the encoder, by flags and unit."""
    wanted = Flag.REFERENCE | Flag.WRAPS
    return next((c for c in device.descriptor.channels if c.flags & wanted == wanted and c.unit == Unit.RAD), None)


def _turn(device: Device) -> Turn:
    channel = reference(device)
    slot, edges = None, None
    if device.offers(Feature.EDGES):
        edges = device.configure_edges(0)
        slot = edges.reply.slot
    mask = 1 if device.offers(Feature.EDGES) else 0
    told = None
    if device.descriptor.channels:
        followed = [channel or device.descriptor.channels[0]]
        told = device.configure(1, ids(followed), RATE, LATENCY_MS, WELL_LOADED)
        mask |= 2
    device.start_streams(mask)
    watch = Watch(device, channel, told, slot)
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
    if device.offers(Feature.EDGES) and told is not None and not device.probe.line.bus:
        try:
            ahead = edges_ahead(device, told, "the motor did not turn")
        except Failed as failure:
            late = str(failure)
        except Unknown:
            ahead = ""
    travel = _travel(device, channel, told.reply.slot) if told and _often_enough(device, told) else math.nan
    blocks = [block for block in device.blocks(0) if block.edges]
    state = read(answer.frame, StateReply).state
    ended = device.probe.tick()[1]
    dropped = device.dropped()
    return Turn(edges_of(device, slot), blocks, travel, beats, edges, ahead, late, stopped, state, ended, dropped)


def _often_enough(device: Device, told: Configured) -> bool:
    """Whether an angle that is sampled like this shows which way it turns at the speed that was announced."""
    record = device.named("n_p")
    pairs = USUAL_POLE_PAIRS if record is None else device.parameter(record).value
    return device.pwm_hz / told.asked.decimation > PER_TURN * device.speed_rpm / 60 * pairs


class Watch:
    """Looks whether the motor runs away while it turns; its drive tells its pole pairs, or nothing is looked at."""

    def __init__(self, device: Device, channel: Channel | None, told: Configured | None, edge_slot: int | None) -> None:
        self._device, self._slots = device, (told.reply.slot if told else 0, edge_slot)
        self._channel = channel if told and _often_enough(device, told) else None
        self._rate = device.pwm_hz / told.asked.decimation if told else math.nan
        names = ("n_p", "omega_m_max")
        values = {name: device.parameter(record).value for name in names if (record := device.named(name))}
        self._runaway = Runaway(pole_pairs(values), lambda: values.get("omega_m_max", 0.0))
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
        edges = [(edge.tick, edge.codes) for edge in edges_of(device, edge_slot, since)]
        if edges and self._edge is not None and (ticks := (edges[-1][0] - self._edge[0]) & 0xFFFFFFFF) < 1 << 31:
            codes = np.array([codes for _, codes in edges])
            self._runaway.by_edges(now, max(ticks, 1) / device.hz, steps_between(codes & 7, codes >> 3 & 7))
        self._edge = edges[-1] if edges else self._edge
        if self._channel is not None:
            angles = np.concatenate([self._angles[-1:], _angles(device, self._channel, slot, since)])
            if len(angles) > 1:
                self._runaway.by_encoder(now, (len(angles) - 1) / self._rate, _turned_by(angles))
            self._angles = angles
        self._runaway.judge(now)
        if words := self._runaway.verdict:
            device.probe.stop()
            raise Failed(f"the drive {words}; STOP was sent")


def edges_of(device: Device, slot: int | None, since: tuple[int, int] = (0, 0)) -> list[Edge]:
    """`since`: how many messages, and frames of streams on a bus, are left out."""
    found: list[Edge] = []
    for block in device.blocks(since=since[0]):
        if block.edges:
            rows = struct.iter_unpack("<IBBH", block.data)
            found += [
                Edge(block.index + k, tick, codes, flags, encoder, block.at)
                for k, (tick, codes, flags, encoder) in enumerate(rows)
            ]
    for frame in device.probe.stream_frames[since[1] :]:
        if frame.edges and frame.slot == slot:
            if len(frame.data) < EDGE_BYTES:
                raise Failed(f"a frame of edges has {len(frame.data)} bytes")
            tick, codes, index, encoder = struct.unpack_from("<IBBH", frame.data)
            found.append(Edge(index, tick, codes, 0, encoder, frame.at))
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


@check("stop", "7.9", critical=True)
def stop(device: Device) -> str:
    """STOP while turning leads to IDLE, outputs off."""
    turn = turned(device)
    if turn.answered != DriveState.IDLE or turn.stopped.state != DriveState.IDLE or not is_off(turn.stopped):
        raise Failed(f"the reply has {state_name(turn.answered)}; after it {says(turn.stopped)}")
    return f"at {device.speed_rpm:g} r/min: IDLE in the reply, IDLE and outputs off in a later heartbeat"


@check("direction", "12.2")
def direction(device: Device) -> str:
    """A positive speed turns the motor forward, by its edges and by its encoder."""
    turn = turned(device)
    codes = np.array([edge.codes for edge in turn.edges], np.int64)
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


@check("edges-counted", "10.4 5.14")
def edges_counted(device: Device) -> str:
    """`edges` in the heartbeat rises by the number of edges received between two heartbeats."""
    _some(device, 0)
    turn = turned(device)
    beats = [beat for beat in turn.beats if turn.edges and _before(turn.edges[0].tick, beat.tick)]
    if len(beats) < 2:
        raise Unknown(f"{len(turn.edges)} edges received, and {len(beats)} heartbeats after the first")
    first, last = beats[0], beats[-1]
    came = sum(_before(first.tick, edge.tick) and not _before(last.tick, edge.tick) for edge in turn.edges)
    counted = (last.edges - first.edges) & 0xFFFFFFFF
    words = f"{came} edges received between two heartbeats, `edges` rose by {counted}"
    if came != counted:
        raise Failed(words)
    return words


def _before(tick: int, other: int) -> bool:
    """Whether `tick` was before `other`, by their low 32 bits."""
    return 0 < (other - tick) & 0xFFFFFFFF < 1 << 31


@check("edges-before-samples", "11.43", carrier=Carrier.BYTES)
def edges_before_samples(device: Device) -> str:
    """Every edge comes before any sample taken at or after it."""
    _some(device, 0)
    turn = turned(device)
    if turn.late:
        raise Failed(turn.late)
    if not turn.ahead:
        raise Unknown("no edges received alongside samples")
    return turn.ahead


def _some(device: Device, least: int = 2) -> list[Edge]:
    """Edges of the turn. Raises NotApplicable, Unknown."""
    device.require(Feature.EDGES)
    turn = turned(device)
    if turn.dropped or len(turn.edges) < least:
        raise Unknown(turn.dropped or f"only {len(turn.edges)} edges received")
    return turn.edges


@check("edge-codes", "11.38 11.39 11.41 12.4")
def edge_codes(device: Device) -> str:
    """The code before an edge is that after the one before it, and "illegal" marks those that it must, and no other."""
    edges = _some(device)
    for one, edge in pairwise(edges):
        if one.after != edge.before and (edge.index - one.index) % 256 == 1:
            raise Failed(f"edge {edge.index} is from {edge.before} to {edge.after}, the one before to {one.after}")
    for edge in edges:
        if edge.before == edge.after or edge.codes & 0x80:
            raise Failed(f"edge {edge.index} has codes 0x{edge.codes:02x}, from {edge.before} to {edge.after}")
        illegal = edge.after in (0, 7) or (edge.before ^ edge.after).bit_count() > 1
        if bool(edge.codes & 0x40) != illegal:
            words = "marked" if edge.codes & 0x40 else "not marked"
            raise Failed(f"edge {edge.index} from {edge.before} to {edge.after} is {words} as illegal")
    illegals = sum(bool(edge.codes & 0x40) for edge in edges)
    return f"{len(edges)} edges, each from the code to which the one before led; {illegals} illegal"


@check("edge-flags", "11.41", carrier=Carrier.BYTES)
def edge_flags(device: Device) -> str:
    """The flags of an edge are 0."""
    edges = _some(device, 1)
    if wrong := [edge.flags for edge in edges if edge.flags]:
        raise Failed(f"{len(wrong)} of {len(edges)} edges have flags 0x{wrong[0]:02x}")
    return f"{len(edges)} edges with flags 0"


@check("edge-ticks", "11.37")
def edge_ticks(device: Device) -> str:
    """Edges follow one another in time, none is of the future, and they are not all on samples."""
    edges, ended = _some(device, 12), turned(device).ended
    for one, edge in pairwise(edges):
        if signed(edge.tick - one.tick) < 0:
            raise Failed(f"edge {edge.index} has tick {edge.tick}, the one before it {one.tick}")
    if signed(edges[-1].tick - ended) > 0:
        raise Failed(f"the last edge has tick {edges[-1].tick}, a TIME_SYNC after it {ended}")
    period = device.ticks_per_period
    if period > COARSE and len({edge.tick % period for edge in edges}) == 1:
        raise Failed(f"the ticks of {len(edges)} edges are all {edges[0].tick % period} in a PWM period of {period}")
    return f"{len(edges)} edges, each later than the one before it"


@check("edge-head", "11.37 11.34 11.15 11.42", carrier=Carrier.BYTES)
def edge_head(device: Device) -> str:
    """Frames of edges have the index and tick of their first record, whole records, and consecutive seq from 0."""
    _some(device, 1)
    turn = turned(device)
    assert turn.told is not None
    due, seq = None, 0
    for block in turn.blocks:
        first = struct.unpack_from("<I", block.data)[0]
        reasons = {
            f"tick {block.tick}, its first record {first}": block.tick != first,
            f"n {block.n}, but {len(block.data)} bytes of records": block.n * 8 != len(block.data),
            f"{block.n} records, block is {turn.told.reply.block}": block.n > turn.told.reply.block,
            f"cfg_id {block.cfg_id}, not {turn.told.reply.cfg_id}": block.cfg_id != turn.told.reply.cfg_id,
            f"seq {block.seq}, not {seq}": block.seq != seq and not block.flags & OVERRUN,
            f"index {block.index}, not {due}": due is not None and block.index != due and not block.flags,
            f"flags 0x{block.flags:x}, though nothing is missing": bool(block.flags) and block.index == due,
        }
        for words, wrong in reasons.items():
            if wrong:
                raise Failed(f"a frame of edges has {words}")
        due, seq = (block.index + block.n) & 0xFFFFFFFF, (block.seq + 1) & 0xFFFF
    return f"{len(turn.blocks)} frames of edges, with seq from 0 and index from {turn.blocks[0].index}"


@check("edge-index", "11.36")
def edge_index(device: Device) -> str:
    """The index of an edge is the number of edges before it, by a heartbeat between the two."""
    return _same_counts(device, _some(device), turned(device).beats)


def _same_counts(device: Device, edges: list[Edge], beats: list[Heartbeat]) -> str:
    """Evidence that each heartbeat has the index of the edge that follows. Raises Failed, Unknown."""
    size = 256 if device.probe.line.bus else 1 << 32
    looked = 0
    for beat in beats:
        later = [edge for edge in edges if signed(edge.tick - beat.tick) > 0]
        if not later:
            continue
        looked += 1
        if (later[0].index - beat.edges) % size:
            raise Failed(f"after a heartbeat with {beat.edges} edges comes edge {later[0].index} (of {size})")
    if not looked:
        raise Unknown("no edge received after a heartbeat")
    return f"{looked} heartbeats have the index of the edge that follows"


@check("edge-encoder", "11.40")
def edge_encoder(device: Device) -> str:
    """The encoder's counts at edges advance by as much in each electrical turn; without an encoder they are 0."""
    edges, channel = _some(device, 14), reference(device)
    counts = [edge.encoder for edge in edges]
    if channel is None:
        if any(counts):
            raise Failed(f"no channel is an encoder's (REFERENCE), but edges have counts {counts[:6]}")
        return "no encoder: all counts are 0"
    turns = sorted(
        ((six.encoder - one.encoder + 0x8000) & 0xFFFF) - 0x8000
        for at, (one, six) in enumerate(zip(edges[:-6], edges[6:], strict=True))
        if all((edge.before, edge.after) in FORWARD for edge in edges[at : at + 7])
    )
    if not turns:
        raise Unknown("the motor did not turn steadily forward")
    usual = turns[len(turns) // 2]
    near = 2 + 0.1 * abs(usual)
    wraps = [n for n in turns if abs(n - usual) > near]  # of a counter that begins anew with each turn of the shaft
    words = f"{len(turns)} electrical turns, most of about {usual} counts, {len(wraps)} otherwise"
    if len(set(counts)) == 1 or (wraps and max(wraps) - min(wraps) > near) or 2 * len(wraps) > len(turns):
        raise Failed(f"{words}: {turns[0]} to {turns[-1]}")
    return words


FORWARD = set(pairwise((1, 3, 2, 6, 4, 5, 1)))


@check("edges-alone", "11.11 11.16 11.36")
def edges_alone(device: Device) -> str:
    """A stream of edges alone has all edges, none later than max_latency_ms."""
    device.require(Feature.EDGES)
    told = device.configure_edges(0, latency_ms=ALONE_MS)
    device.start_streams(1)
    with device.probe.watched(Watch(device, None, None, told.reply.slot).look):
        spin(device)
        device.probe.listen(ALONE)
    device.probe.stop()
    device.fresh()
    device.probe.listen(0.15 + 1e-3 * ALONE_MS)
    beats = [beat for _, beat in device.probe.beats]
    counted = (beats[-1].edges - beats[0].edges) & 0xFFFFFFFF
    device.stop_streams()
    edges = edges_of(device, told.reply.slot)
    came = [edge for edge in edges if signed(edge.tick - beats[0].tick) > 0 >= signed(edge.tick - beats[-1].tick)]
    words = f"{len(came)} edges came, `edges` rose by {counted}"
    if len(came) != counted:
        raise Failed(words)
    if not counted:
        raise Unknown("no edges: the motor did not turn")
    words += f"; {_same_counts(device, edges, beats)}"
    return f"{words}; {late(device, [(edge.at, edge.tick) for edge in came], ALONE_MS, 'edges')}"


@check("undisturbed", "8.11 8.14 7.6 4.15")
def undisturbed(device: Device) -> str:
    """HELLO, START, refused requests and rejected setpoints leave the speed as it is."""
    probe = device.probe
    motion = _Motion(device)
    with probe.watched(Watch(device, motion.channel, motion.told, None).look):
        spin(device)
        probe.listen(RUN_UP)
        before = motion.turned()
        for mode, value, value2 in ((NO_MODE, 0.0, 0.0), (1, math.nan, 0.0), (1, 0.0, math.nan)):
            send(device, mode, 0x0BAD, value, value2)
        probe.hello()
        probe.command(Command.START)
        probe.command(Command.ARM, device.hello.boot_id ^ 1)
        probe.command(0)
        probe.listen(RUN_UP)
        after = motion.turned()
    if abs(before) < math.pi / 3:
        raise Unknown("no motion seen")
    words = f"{math.degrees(before):.0f}, then {math.degrees(after):.0f} electrical degrees in {STRETCH:g} s"
    if not 0.5 < after / before < 2.0:
        raise Failed(f"{words}, after HELLO, START, refused requests and rejected setpoints")
    return words


@check("starts-at-rest", "7.3 8.14 8.11")
def starts_at_rest(device: Device) -> str:
    """A setpoint does not outlast STOP or a fault, and one before START is forgotten: RUNNING begins at rest."""
    probe, speed = device.probe, device.speed_rpm * RPM
    motion = _Motion(device)
    words = []
    for what, turns, trips in (("STOP", True, False), ("a fault", True, True), ("setpoints before it", False, False)):
        with probe.watched(Watch(device, motion.channel, motion.told, None).look):
            if turns:
                spin(device)
                probe.listen(RUN_UP)
            if trips:
                device.trip()
        device.rest()
        if not motion.stands():
            raise Unknown("the shaft does not come to rest")
        for state in (DriveState.IDLE, DriveState.ARMED):
            device.enter(state)
            if not turns:
                send(device, SetpointMode.SPEED, 1, speed)
        require_granted(probe.command(Command.START), "START")
        travel = abs(motion.turned()) + abs(motion.turned())
        device.rest()
        words.append(f"{math.degrees(travel):.0f} electrical degrees after {what}")
        if travel > TWITCH:
            raise Failed(f"{words[-1]} and a new START, without a setpoint, in {2 * STRETCH:g} s")
    return ", ".join(words)


class _Motion:
    """How far the shaft turns, by its encoder or by the edges that heartbeats count; Unknown where it has neither."""

    def __init__(self, device: Device) -> None:
        self._device, self.channel = device, reference(device)
        self.told: Configured | None = None
        if self.channel is not None:
            self.told = device.configure(1, ids([self.channel]), RATE, LATENCY_MS, WELL_LOADED)
            if not _often_enough(device, self.told):
                raise Unknown("the link is too slow for samples that show how the motor turns")
            device.start_streams(2)
        elif not device.offers(Feature.EDGES):
            raise Unknown("the device has neither encoder nor edges by which its motion shows")

    def turned(self) -> float:
        """Electrical rad by which it turns from now on in STRETCH s."""
        device, probe = self._device, self._device.probe
        if self.channel is None:
            before = device.fresh().edges
            probe.listen(STRETCH)
            return ((device.fresh().edges - before) & 0xFFFFFFFF) * math.pi / 3
        since, begin = (len(probe.heard), len(probe.stream_frames)), probe.tick()[1]
        probe.listen(STRETCH)
        if not probe.line.bus:  # where a slow UART still has those of before under way
            since = (self._fresh(since[0], begin, begin + round(STRETCH * device.hz)), since[1])
        angles = _angles(device, self.channel, self.told.reply.slot if self.told else 0, since)
        if len(angles) < 2:
            raise Unknown(f"{len(angles)} samples of {self.channel.name} received within {STRETCH:g} s")
        return _turned_by(angles)

    def _fresh(self, since: int, begin: int, end: int) -> int:
        """The place of the first samples from tick `begin` on, once those of `end` have come."""
        device = self._device
        device.probe.until(lambda: any(signed(b.tick - end) >= 0 for b in device.blocks(1, since)), SLOW_LINK)
        places = (block.place for block in device.blocks(1, since) if signed(block.tick - begin) >= 0)
        return next(places, len(device.probe.heard))

    def stands(self) -> bool:
        """Whether the shaft comes to rest in some seconds."""
        return any(abs(self.turned()) < TWITCH / 10 for _ in range(COASTS))


@check("watchdog", "7.28")
def watchdog(device: Device) -> str:
    """While turning, an unfed watchdog trips: FAULT, outputs off."""
    spin(device)
    device.probe.listen(RUN_UP)
    began = device.probe.now()
    with suppress(Unknown):  # what it says then is looked at
        device.trip()
    seconds = device.probe.now() - began
    beat = device.fresh()
    words = f"unfed for {seconds:.2f} s at {device.speed_rpm:g} r/min: {says(beat)}"
    if beat.state != DriveState.FAULT or beat.outputs_on or not beat.faults & Fault.WATCHDOG:
        raise Failed(words)
    return words


@check("never-clipped", "8.1 8.6 8.9")
def never_clipped(device: Device) -> str:
    """With the limit lowered to --speed, a higher speed is rejected with that limit, in either direction."""
    record = device.named("omega_m_max")
    if record is None or record.flags & Flag.READ_ONLY:
        raise Unknown("the speed limit cannot be lowered (no parameter omega_m_max): not tried")
    limit = float(np.float32(device.speed_rpm * RPM))
    with _running_with(device, record, limit):
        words = f"{_beyond(device, limit)}; {_beyond(device, -limit)}"
        if not is_taken(device, SetpointMode.SPEED, 0x0C0D, limit):
            raise Failed(f"{words}; the limit itself, {limit:.6g} rad/s, is not accepted")
        return f"{words}; the limit itself: accepted"


@contextmanager
def _running_with(device: Device, record: Channel, limit: float) -> Iterator[None]:
    """RUNNING with a parameter set to this, which is put back at rest."""
    before = device.parameter(record).value
    try:
        require_granted(device.set(record, limit), f"{record.name} = {limit:g}")
        device.run()
        yield
    finally:
        try:
            device.rest()
        finally:
            device.put_back(record, before)


def _beyond(device: Device, limit: float) -> str:
    was, since = device.fresh(), len(device.events(EventCode.SETPOINT_REJECTED))
    now = send(device, SetpointMode.SPEED, 0x0BAD, COMMON * limit)
    words = f"SPEED {COMMON * limit:.5g} rad/s, the limit is {limit:.5g}"
    if now.setpoint_counter == 0x0BAD:
        raise Failed(f"{words}: accepted")
    events = device.events(EventCode.SETPOINT_REJECTED)[since:]
    if not events and now.setpoints_rejected == was.setpoints_rejected:
        raise Unknown(f"{words}: not accepted, but no rejection seen")
    if events and (events[-1].arg, events[-1].detail) != (ErrorCode.OUT_OF_RANGE, abs(limit)):
        raise Failed(f"{words}: {code_name(events[-1])}, detail {events[-1].detail:.9g}")
    return f"{words}: rejected with OUT_OF_RANGE, detail {abs(limit):.9g}" if events else f"{words}: rejected"


@check("current-limit", "8.9 8.8 8.6")
def current_limit(device: Device) -> str:
    """With `i_max` lowered to next to nothing, a current beyond it is rejected, by magnitude; the limit is accepted."""
    record = device.named("i_max")
    if record is None or record.flags & Flag.READ_ONLY:
        raise NotApplicable("the device has no parameter i_max that can be set")
    told = device.parameter(record)
    limit = max(told.lo, LITTLE)
    if not limit <= told.hi:
        raise Unknown(f"i_max goes up to {told.hi:g} A")
    words = []
    with _running_with(device, record, limit):
        if not is_taken(device, SetpointMode.CURRENT, 1):
            raise Unknown("CURRENT 0 was not accepted")
        for n, (i_q, i_d) in enumerate(((COMMON, 0.0), (-COMMON, 0.0), (0.0, COMMON), (0.8, 0.8)), 0x0100):
            since = len(device.events(EventCode.SETPOINT_REJECTED))
            what = f"CURRENT {i_q * limit:.3g}, {i_d * limit:.3g} A"
            if is_taken(device, SetpointMode.CURRENT, n, i_q * limit, i_d * limit):
                raise Failed(f"{what}: accepted, i_max is {limit:g}")
            events = device.events(EventCode.SETPOINT_REJECTED)[since:]
            if events and (events[0].arg, events[0].detail) != (ErrorCode.OUT_OF_RANGE, limit):
                raise Failed(f"{what}: {code_name(events[0])}, detail {events[0].detail:.9g}, i_max is {limit:g}")
            words.append(what)
        if not is_taken(device, SetpointMode.CURRENT, 2, limit):
            raise Failed(f"CURRENT {limit:g} A, which is i_max, is not accepted")
        return f"{', '.join(words)}: rejected with {limit:g}; {limit:g} A: accepted"

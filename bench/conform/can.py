"""Level 5: CAN and CAN FD, chapter 16 of SPEC. Only on a bus; what needs an armed drive needs level 3."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

from bench.conform.checks import Carrier, Group
from bench.conform.data import MORE_THAN_A_BYTE, bus_samples
from bench.conform.device import Device, ids, width
from bench.conform.levels import CAN, MOTION, STATES, STREAMS
from bench.conform.lines import BusLine, changed, cut, remote
from bench.conform.motion import turned
from bench.conform.probe import GRACE, HELLO, accepted, name_of, read, refusal
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from protocol.canmap.frame import BRS, FDF
from protocol.canmap.ids import BROADCAST, STATUS_SLOTS, CanClass, CanId
from protocol.canmap.layout import MAX_GROUPS, edge_load, sample_layout
from protocol.codes import DriveState, ErrorCode, Feature, MessageType
from protocol.descriptor import Channel
from protocol.framing import Frame
from protocol.messages import BlobRead, BlobReply, StreamGet, StreamInfo, StreamReply
from protocol.streams import MAX_DECIMATION
from protocol.text import counted

bus = Group("can", CAN, Carrier.BUS)

REQUEST = BlobRead(0, 8, 0).pack()
OTHER_HOST = 11
SINGLE = 0xC0  # bits of the tail of a transfer in one frame
OTHER_ID = 9  # a transfer id
SLOW = 10.0  # Hz
LONG = 70  # bytes: more than a frame of CAN FD takes
MOST_LOAD = 0.95
LOAD_ERROR = 0.01
WATCHED = 0.8  # s
RATE = 100.0  # Hz


def _request(device: Device) -> tuple[Frame, list[bytes]]:
    """A request of at least two frames: STREAM_SET of many unknown channels on FD, BLOB_READ else."""
    if device.bus.rates.fd:
        n = LONG // 2
        frame = device.probe.frame(
            MessageType.STREAM_SET, struct.pack(f"<BBHHH{n}H", 0, 0, 1, 20, n, *range(0x7000, 0x7000 + n))
        )
    else:
        frame = device.probe.frame(MessageType.BLOB_READ, REQUEST)
    return frame, cut(device.bus.encode(frame))


def _silent(device: Device, records: Sequence[bytes], what: str) -> str:
    return device.probe.silence(b"".join(records), what)


@bus("transfer", "16.13", needs=0)
def transfer(device: Device) -> str:
    """A request in several frames is reassembled."""
    frame, records = _request(device)
    answer = device.probe.ask_frame(frame, wire=b"".join(records))
    return f"{len(records)} frames: {answer}"


@bus("crc", "16.16", needs=0)
def crc(device: Device) -> str:
    """A transfer with a wrong CRC is not answered."""
    _, records = _request(device)
    return _silent(device, [changed(records[0], 3, 1), *records[1:]], "a transfer with a changed bit")


@bus("length", "16.16", needs=0)
def length(device: Device) -> str:
    """A single-frame transfer with a wrong len is not answered."""
    (record,) = cut(device.bus.encode(device.probe.frame(MessageType.TIME_SYNC)))
    return _silent(device, [changed(record, 4, 0x40)], "a single-frame transfer with a wrong len")


@bus("toggle", "16.16", needs=0)
def toggle(device: Device) -> str:
    """A transfer with a wrong toggle is not answered."""
    _, records = _request(device)
    return _silent(device, [records[0], changed(records[1], -1, 0x20), *records[2:]], "a transfer with a wrong toggle")


@bus("transfer-id", "16.16", needs=0)
def transfer_id(device: Device) -> str:
    """A transfer whose transfer id changes is not answered."""
    _, records = _request(device)
    return _silent(device, [records[0], changed(records[1], -1, 0x07), *records[2:]], "a transfer with two ids")


@bus("first-frame-missing", "16.17", needs=0)
def first_frame_missing(device: Device) -> str:
    """A transfer without its first frame is ignored, and not counted."""
    _, records = _request(device)
    before = device.fresh().rx_bad
    words = _silent(device, records[1:], "a transfer without its first frame")
    if (n := device.fresh().rx_bad - before) > 0:
        raise Failed(f"rx_bad rose by {n} for a transfer without its first frame")
    return f"{words}; rx_bad unchanged"


@bus("first-frame-again", "16.16", needs=0)
def first_frame_again(device: Device) -> str:
    """An incomplete transfer is abandoned for the next one, which is answered."""
    _, records = _request(device)
    frame, again = _request(device)
    answer = device.probe.ask_frame(frame, wire=records[0] + b"".join(again))
    return f"after the first frame of another transfer: {answer}"


@bus("damage-is-counted", "16.17", needs=0)
def damage_is_counted(device: Device) -> str:
    """rx_bad counts each damaged or abandoned transfer once, whatever is wrong with it."""
    (single,) = cut(device.bus.encode(device.probe.frame(MessageType.TIME_SYNC)))
    kinds: dict[str, Callable[[list[bytes]], list[bytes]]] = {
        "a changed bit": lambda records: [changed(records[0], 3, 1), *records[1:]],
        "a wrong toggle": lambda records: [records[0], changed(records[1], -1, 0x20), *records[2:]],
        "another transfer id": lambda records: [records[0], changed(records[1], -1, 0x07), *records[2:]],
        "no last frame": lambda records: records[:1],
        "a wrong len": lambda records: [changed(single, 4, 0x40)],
    }
    for words, damaged in kinds.items():
        before = device.fresh().rx_bad
        _silent(device, damaged(_request(device)[1]), f"a transfer with {words}")
        if (counted := (device.fresh().rx_bad - before) & 0xFFFFFFFF) != 1:
            raise Failed(f"rx_bad counted {counted} for a transfer with {words}")
    return f"rx_bad counted one for each of {', '.join(kinds)}"


@bus("repeated-frame", "16.15", needs=0)
def repeated_frame(device: Device) -> str:
    """A frame received twice in a row is taken once."""
    probe = device.probe
    frame = probe.frame(MessageType.TIME_SYNC)
    since = len(probe.heard)
    probe.ask_frame(frame, tries=1, wire=2 * device.bus.encode(frame))
    probe.ask(MessageType.TIME_SYNC)
    probe.listen(GRACE)
    if (n := len(probe.answers(frame, since))) != 1:
        raise Failed(f"a TIME_SYNC whose frame was sent twice in a row was answered {n} times")
    return "a TIME_SYNC whose frame was sent twice in a row was answered once"


@bus("ids-count", "16.12", needs=0)
def ids_count(device: Device) -> str:
    """The transfer ids of replies are consecutive, and so are those of heartbeats."""
    found = [device.probe.ask(MessageType.TIME_SYNC, tries=1).heard.transfer for _ in range(6)]
    for _ in range(4):
        device.probe.beat()
    heard = [each for each in device.probe.heard if each.frame.type == MessageType.HEARTBEAT]
    beats = [each.transfer for each in heard if each.frame.node == device.probe.node]
    for what, row in (("replies", found), ("heartbeats", beats)):
        if any((after - before) % 32 != 1 for before, after in pairwise(row)):
            raise Failed(f"{what} have transfer ids {row}")
    return f"six replies have transfer ids {', '.join(map(str, found))}; heartbeats {', '.join(map(str, beats))}"


@bus("frames-sent", "16.1 16.14 16.27", needs=0)
def frames_sent(device: Device) -> str:
    """Frames are of the kind of the bus, and bytes that fill an FD frame up are 0."""
    line = device.bus
    line.records.clear()
    device.probe.ask(MessageType.BLOB_READ, REQUEST)
    device.probe.ask(MessageType.TIME_SYNC)
    device.probe.beat()
    own = [(flags, part) for flags, parts, part in line.records if part and parts.node == device.probe.node]
    for flags, part in own:
        if bool(flags & FDF) != line.rates.fd or (line.rates.fd and not flags & BRS):
            kind = f"FD, bit-rate switch {bool(flags & BRS)}" if flags & FDF else "classic"
            raise Failed(f"a frame is {kind}, the bus is {line.rates}")
        used = 6 + int.from_bytes(part[4:6], "little")
        if part[-1] & SINGLE == SINGLE and any(part[used:-1]):
            raise Failed(f"a frame is filled up with {part[used:-1].hex()}")
    return f"{len(own)} frames of the kind of the bus"


@bus("classic-accepted", "16.1", needs=0)
def classic_accepted(device: Device) -> str:
    """On an FD bus, a classic frame is taken."""
    line, probe = device.bus, device.probe
    if not line.rates.fd:
        raise NotApplicable("the bus is classic")
    frame = probe.frame(MessageType.TIME_SYNC)
    flags, tid = frame.flags, frame.tid
    part = struct.pack("<BBHH", frame.type, flags, tid, 0) + bytes([SINGLE | 0x20 | OTHER_ID])
    answer = probe.ask_frame(frame, wire=line.record(line.address(frame), part, fd=False))
    return accepted(answer, "a TIME_SYNC in a classic frame")


@bus("status-slots", "16.10", needs=0)
def status_slots(device: Device) -> str:
    """What a device sends unasked is on the identifier of its type; refusals of ALIVE go to host 0."""
    probe, line = device.probe, device.bus
    probe.beat()
    for each in probe.heard:
        if not each.frame.is_reply and each.slot != STATUS_SLOTS.get(each.frame.type):
            raise Failed(f"{name_of(each.frame.type)} came in slot {each.slot}")
    alive = probe.frame(MessageType.ALIVE, bytes(4), tid=5)
    slot = probe.ask_frame(alive, wire=line.encode(alive)).heard.slot
    if slot:
        raise Failed(f"the refusal of an ALIVE with a tid was sent to host {slot}, not to host 0")
    return f"{len(probe.heard)} messages on the identifiers of their types; a refusal of ALIVE went to host 0"


@bus("kept-transfer-id", "16.18", needs=0)
def kept_transfer_id(device: Device) -> str:
    """A kept reply is sent again with its original transfer id."""
    probe = device.probe
    frame = probe.frame(MessageType.BLOB_READ, REQUEST)
    first = probe.ask_frame(frame)
    again = probe.ask_again(frame)
    if first.heard.transfer != again.heard.transfer:
        raise Failed(f"a kept reply had transfer id {again.heard.transfer}, not {first.heard.transfer}")
    return f"BLOB_READ repeated: transfer id {again.heard.transfer} again"


@bus("node-0-hello", "16.7", needs=0)
def node_0_hello(device: Device) -> str:
    """A HELLO to node 0 is answered with the device's own node."""
    probe = device.probe
    frame = probe.frame(MessageType.HELLO, HELLO.pack(probe.tid(), 1, 1, 1024))
    since = len(probe.heard)
    probe.write(device.bus.broadcast(frame))
    probe.listen(0.25)
    nodes = sorted({each.frame.node for each in probe.answers(frame, since)})
    if probe.node not in nodes:
        raise Failed(f"a HELLO to node 0 was answered by nodes {nodes}, not by {probe.node}")
    return f"answered by nodes {', '.join(map(str, nodes))}"


@bus("node-0-others", "16.7", needs=0)
def node_0_others(device: Device) -> str:
    """Only HELLO is answered at node 0."""
    wire = device.bus.broadcast(device.probe.frame(MessageType.TIME_SYNC))
    return device.probe.silence(wire, "a TIME_SYNC to node 0")


@bus("other-node", "16.3", needs=0)
def other_node(device: Device) -> str:
    """A message to another node is not answered."""
    probe = device.probe
    node = probe.node % 15 + 1
    frame = probe.frame(MessageType.TIME_SYNC)._replace(node=node)
    since = len(probe.heard)
    probe.send(frame)
    probe.ask(MessageType.TIME_SYNC)
    probe.listen(GRACE)
    if any(each.frame.node == probe.node for each in probe.answers(frame, since)):
        raise Failed(f"node {probe.node} answered a TIME_SYNC to node {node}")
    return f"a TIME_SYNC to node {node} was not answered by node {probe.node}"


@bus("identifier-of-type", "16.11", needs=0)
def identifier_of_type(device: Device) -> Iterator[str]:
    """A request on the identifier of ALIVE, or of class 7, is not answered."""
    node = device.probe.node
    for name, can_id in (
        ("the identifier of ALIVE", CanId(CanClass.STATUS, node, STATUS_SLOTS[MessageType.ALIVE])),
        ("class 7", CanId(CanClass.FREE, node, 0)),
    ):
        wire = device.bus.transfer(can_id, device.probe.frame(MessageType.TIME_SYNC))
        yield device.probe.silence(wire, f"a TIME_SYNC on {name}")


@bus("other-form", "16.4", needs=0)
def other_form(device: Device) -> str:
    """Identifiers of the other form, and remote frames, are ignored."""
    line, probe = device.bus, device.probe
    other = BusLine(line.rates, line.node, not line.extended, line.host)
    words = probe.silence(other.encode(probe.frame(MessageType.TIME_SYNC)), "a TIME_SYNC in the other form")
    if line.rates.fd:
        return words
    wire = remote(cut(line.encode(probe.frame(MessageType.TIME_SYNC)))[0])
    return f"{words}; {probe.silence(wire, 'a remote frame')}"


@bus("host-numbers", "16.9 16.10", needs=0)
def host_numbers(device: Device) -> str:
    """Another host is answered on its own identifier, and does not affect this host's kept replies."""
    probe, line = device.probe, device.bus
    host = OTHER_HOST if line.host != OTHER_HOST else OTHER_HOST + 1
    kept = probe.frame(MessageType.BLOB_READ, REQUEST)
    first = probe.ask_frame(kept)
    line.records.clear()
    hello = probe.frame(MessageType.HELLO, HELLO.pack(probe.tid(), 1, 1, 1024))
    accepted(probe.ask_frame(hello, wire=line.transfer(CanId(CanClass.TO_DEVICE, probe.node, host), hello)), "HELLO")
    slots = {parts.slot for _, parts, _ in line.records if parts.kind == CanClass.TO_HOST and parts.node == probe.node}
    if slots != {host}:
        raise Failed(f"host {host} was answered on slots {sorted(slots)}")
    small = probe.frame(MessageType.HELLO, HELLO.pack(probe.tid(), 1, 1, 128))
    accepted(probe.ask_frame(small, wire=line.transfer(CanId(CanClass.TO_DEVICE, probe.node, host), small)), "HELLO")
    wide = probe.get(BlobRead(0, 0xFFFF, 0), BlobReply)
    if len(wide.data) < min(wide.total, device.hello.tx_max - 12):
        raise Failed(f"the rx_max 128 of host {host} limits what host {line.host} gets: {len(wide.data)} bytes")
    probe.ask_frame(kept)  # one of the last four again
    again = probe.ask_again(kept)
    if first.heard.transfer != again.heard.transfer:
        raise Failed(f"the HELLO of host {host} cleared the kept replies of host {line.host}")
    return f"host {host} was answered on slot {host}; host {line.host}'s kept replies are unaffected"


# -- STOP -------------------------------------------------------------------------------------------------------------


@bus("stop-frame", "16.5", needs=STATES, critical=True)
def stop_frame(device: Device) -> str:
    """A frame of class 0 to the device's node, or to node 0, takes ARMED and RUNNING to IDLE, whatever else it has."""
    words = []
    for state in (DriveState.ARMED, DriveState.RUNNING):
        for node in (device.probe.node, BROADCAST):
            device.enter(state)
            device.probe.feed_every = None
            since = len(device.probe.heard)
            slot = 7 if state == DriveState.RUNNING else 0
            data = bytes(range(8)) if node else b""
            device.probe.write(device.bus.record(CanId(CanClass.STOP, node, slot), data))
            device.probe.listen(GRACE)
            if any(each.frame.is_reply for each in device.probe.heard[since:]):
                raise Failed(f"a frame of class 0 to node {node} was answered")
            beat = device.fresh()
            if beat.state != DriveState.IDLE or beat.outputs_on:
                raise Failed(f"a frame of class 0 to node {node} in {state.name}: {beat.state.name}")
            words.append(f"{state.name}, node {node}")
    return f"in {'; '.join(words)}: IDLE, outputs off"


@bus("stop-of-others", "16.5", needs=STATES)
def stop_of_others(device: Device) -> str:
    """A frame of class 0 to another node stops nothing; in FAULT one to the device changes nothing."""
    device.run()
    device.probe.write(device.bus.stop(device.probe.node % 15 + 1))
    if (now := device.fresh()).state != DriveState.RUNNING:
        raise Failed(f"a frame of class 0 to node {device.probe.node % 15 + 1} led to {now.state.name}")
    device.trip()
    device.probe.write(device.bus.stop(device.probe.node))
    if (now := device.fresh()).state != DriveState.FAULT or not now.faults:
        raise Failed(f"a frame of class 0 in FAULT: {now.state.name}, faults 0x{int(now.faults):x}")
    return "one to another node: still RUNNING; one in FAULT: still FAULT"


# -- streams ----------------------------------------------------------------------------------------------------------


def _layout(device: Device, chosen: Sequence[Channel], block: int) -> tuple[int, list[int]]:
    """Groups of a sample, and the data bytes of a frame of each."""
    layout = sample_layout([width(channel) for channel in chosen], device.bus.rates.fd, block)
    return len(layout.groups), [layout.length(group) for group in range(len(layout.groups))]


@bus("slots", "16.20", needs=STREAMS)
def slots(device: Device) -> str:
    """A new configuration gets the slots after those of the previous one, and none that are in use."""
    narrow = min(device.channels, key=width)
    device.configure(1, [narrow.id], RATE / 4)
    kept = device.probe.get(StreamGet(1), StreamInfo).slot
    taken = [device.configure(0, [narrow.id], RATE).reply.slot for _ in range(34)]
    if kept in taken:
        raise Failed(f"a configuration got slot {kept}, which stream 1 has")
    if any((after - before) % 32 not in (1, 2) for before, after in pairwise(taken)) or max(taken) > 31:
        raise Failed(f"34 configurations have slots {taken}: not a circle of 32")
    device.stop_streams()
    if device.offers(Feature.EDGES):
        edges = [device.configure_edges(0).reply.slot for _ in range(18)]
        if any((after - before) % 16 not in (1, 2) for before, after in pairwise(edges)) or max(edges) > 15:
            raise Failed(f"18 configurations of edges have slots {edges}: not a circle of 16")
    found = [device.configure(0, [narrow.id], RATE).reply.slot for _ in range(5)]
    if any(not 0 <= slot < 32 for slot in found):
        raise Failed(f"slots {found}: not all in 0 to 31")
    for before, after in pairwise(found):
        if (after - before) % 32 not in (1, 2):
            raise Failed(f"five configurations of one group have slots {found}")
        if before == after:
            raise Failed(f"two configurations in a row have slot {after}")
    return f"five configurations of one group have slots {', '.join(map(str, found))}"


@bus("groups", "16.24 16.26", needs=STREAMS)
def groups(device: Device) -> str:
    """Each group of channels has its own slot and frame length, and all groups of a sample the same counter."""
    chosen = _some_groups(device)
    told = device.stream(chosen, RATE)
    n, lengths = _layout(device, chosen, told.reply.block)
    device.probe.listen(WATCHED)
    frames = [frame for frame in device.probe.stream_frames if not frame.edges]
    if not frames:
        raise Unknown("no stream frame received")
    for frame in frames:
        group = (frame.slot - told.reply.slot) % 32
        if group >= n:
            raise Failed(f"a frame in slot {frame.slot}: the {n} groups have slots from {told.reply.slot} on")
        if len(frame.data) != lengths[group]:
            raise Failed(f"a frame of group {group} has {len(frame.data)} bytes, not {lengths[group]}")
    size, first, others = layout_counter(device), b"", 0
    for frame in frames:
        if frame.slot == told.reply.slot:
            first = frame.data[:size]
        elif first and frame.data[:size] != first:
            others += 1
    if others > len(frames) / 4:
        raise Failed(f"{others} of {len(frames)} frames have another counter than the first group of their sample")
    samples = bus_samples(device, told, chosen)
    per_sample = len(frames) / n * told.reply.block
    if len(samples) < per_sample - 2 * told.reply.block:
        raise Failed(f"{len(frames)} frames of {n} groups make only {len(samples)} whole samples by their counters")
    words = f"{counted(len(chosen), 'channel')} in {counted(n, 'group')}"
    return f"{words}: {len(frames)} frames of {lengths} bytes, {len(samples)} samples"


def layout_counter(device: Device) -> int:
    """Bytes of the counter of samples."""
    return 4 if device.bus.rates.fd else 2


def _some_groups(device: Device) -> tuple[Channel, ...]:
    """Channels that make two or three groups, if there are so many."""
    for n in range(1, len(device.channels) + 1):
        count, _ = _layout(device, device.channels[:n], 1)
        if count > 2:
            return device.channels[: n - 1]
    return device.channels


@bus("counters", "16.25", needs=STREAMS)
def counters(device: Device) -> Iterator[str]:
    """Counters continue from frame to frame, also at a decimation of more than a byte; lost ones are in tx_dropped."""
    for rate in (RATE, min(device.pwm_hz / MORE_THAN_A_BYTE, RATE / 2)):
        yield _counters(device, rate)
        device.stop_streams()
        device.probe.stream_frames.clear()


def _counters(device: Device, rate: float) -> str:
    before = device.fresh().tx_dropped
    told = device.stream([min(device.channels, key=width)], rate)
    device.probe.listen(max(WATCHED, 4.2 / rate))
    dropped = (device.fresh().tx_dropped - before) & 0xFFFFFFFF
    fd = device.bus.rates.fd
    size, step = (4, told.asked.decimation) if fd else (2, 1)
    found = [int.from_bytes(f.data[:size], "little") for f in device.probe.stream_frames if not f.edges]
    if len(found) < 3:
        raise Unknown(f"only {len(found)} frames received")
    wanted, wrap = step * told.reply.block, 1 << 8 * size
    lost = [((after - one) % wrap) / wanted - 1 for one, after in pairwise(found)]
    row = f"counters {found[0]} to {found[-1]} by {wanted}"
    words = f"{len(found)} frames, {told.reply.block} samples each: {row}, tx_dropped {dropped}"
    if any(n != int(n) for n in lost) or sum(lost) > dropped:
        raise Failed(f"{words}: in steps of {sorted({(b - a) % wrap for a, b in pairwise(found)})}")
    tick0, period = told.reply.tick0, device.ticks_per_period
    newest = (device.fresh().tick - tick0) // period // (1 if fd else told.asked.decimation)
    behind = ((newest - found[-1] + wrap // 2) % wrap - wrap // 2) * (1 if fd else told.asked.decimation)
    if abs(behind) >= max(device.pwm_hz / 2, 2 * told.asked.decimation):
        raise Failed(f"{words}; by the last heartbeat the newest is {newest % wrap}: {behind} periods off")
    early = device.fresh().tick // device.ticks_per_period < 1 << 32  # the counter is the whole index
    if fd and early and any(n % told.asked.decimation for n in found):
        raise Failed(f"{words}: not divisible by {told.asked.decimation}")
    return words


@bus("stop-sends-nothing", "16.22", needs=STREAMS)
def stop_sends_nothing(device: Device) -> str:
    """STREAM_STOP does not send an incomplete frame."""
    narrow = min(device.channels, key=width)
    told = device.stream([narrow], SLOW, latency_ms=10_000)
    if told.reply.block < 2:
        raise Unknown(f"a frame holds {told.reply.block} sample")
    seconds = 0.5 * told.reply.block * told.asked.decimation / device.pwm_hz
    device.probe.listen(seconds)
    device.stop_streams()
    device.probe.listen(0.1)
    came = len(device.probe.stream_frames)
    if came:
        raise Failed(f"{seconds:.2f} s after STREAM_START, with half a frame, {came} frames were sent at STREAM_STOP")
    return f"STREAM_STOP {seconds:.2f} s after STREAM_START, with half a frame: nothing was sent"


@bus("too-many-groups", "16.23", needs=STREAMS)
def too_many_groups(device: Device) -> str:
    """A sample of more than 16 groups is refused with the bytes that 16 of them hold."""
    chosen = device.channels[: (device.hello.rx_max - 8) // 2]
    layout = sample_layout([width(channel) for channel in chosen], device.bus.rates.fd, 1)
    if len(layout.groups) <= MAX_GROUPS:
        raise NotApplicable(f"all channels together make {counted(len(layout.groups), 'group')}")
    room = layout.groups[MAX_GROUPS - 1][1]
    answer = device.stream_set(0, ids(chosen), MAX_DECIMATION)
    return refusal(answer, ErrorCode.DOES_NOT_FIT, room, f"{len(layout.groups)} groups")


@bus("load", "16.23", needs=STREAMS)
def load(device: Device) -> Iterator[str]:
    """The load of a stream follows SPEC's formula; edges count as 1000 frames per second."""
    line = device.bus
    for n in (1, 3):
        chosen = device.channels[:n]
        told = device.configure(0, ids(chosen), RATE)
        layout = sample_layout([width(c) for c in chosen], line.rates.fd, told.reply.block)
        due = layout.load(line.rates, device.pwm_hz / told.asked.decimation, line.extended)
        yield _same_load(
            told.reply, due, f"{counted(len(chosen), 'channel')} at {device.pwm_hz / told.asked.decimation:g} Hz"
        )
    device.stop_streams()
    if device.offers(Feature.EDGES):
        yield _same_load(device.configure_edges(0).reply, edge_load(line.rates, line.extended), "edges")


def _same_load(reply: StreamReply, due: float, what: str) -> str:
    if abs(reply.load - due) > LOAD_ERROR * due:
        raise Failed(f"{what}: the load is {reply.load:.4%}, not {due:.4%} as by the formula")
    return f"{what}: {reply.load:.3%}"


@bus("overload", "11.28 16.23", needs=STREAMS)
def overload(device: Device) -> str:
    """A bus load beyond 95 % is refused with the smallest decimation that fits; that decimation is accepted."""
    line = device.bus
    chosen = device.channels
    while _layout(device, chosen, 1)[0] > MAX_GROUPS:
        chosen = chosen[:-1]
    widths = [width(c) for c in chosen]

    def at(decimation: int) -> float:
        in_time = max(1, 20 * device.pwm_hz // (1000 * decimation))
        return sample_layout(widths, line.rates.fd, in_time).load(line.rates, device.pwm_hz / decimation, line.extended)

    if at(1) <= MOST_LOAD:
        raise NotApplicable(f"{counted(len(chosen), 'channel')} at {device.pwm_hz} Hz load the bus to {at(1):.0%}")
    fits = next(n for n in range(2, 65536) if at(n) <= MOST_LOAD)
    words = refusal(
        device.stream_set(0, ids(chosen), 1),
        ErrorCode.DOES_NOT_FIT,
        fits,
        f"{counted(len(chosen), 'channel')}, {at(1):.0%}",
    )
    again = device.stream_set(0, ids(chosen), fits)
    accepted(again, f"decimation {fits}")
    return f"{words}; decimation {fits}: load {read(again.frame, StreamReply).load:.1%}"


@bus("edges", "16.28", needs=MOTION)
def edges(device: Device) -> str:
    """Each edge has its own frame, numbered consecutively."""
    device.require(Feature.EDGES)
    numbers = [edge.index for edge in turned(device).edges]
    if len(numbers) < 2:
        raise Unknown(f"only {len(numbers)} edges received")
    if any((after - before) % 256 != 1 for before, after in pairwise(numbers)):
        raise Failed(f"{len(numbers)} edges have numbers {numbers[:12]}")
    return f"{len(numbers)} edges, numbers {numbers[0]} to {numbers[-1]} without a gap"

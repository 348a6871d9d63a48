"""Level 5: CAN and CAN FD, chapter 16 of SPEC. Only on a bus; what needs an armed drive needs level 3."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from itertools import pairwise

from bench.conform.checks import Carrier, Group
from bench.conform.data import bus_samples
from bench.conform.device import Device, ids, width
from bench.conform.levels import CAN, MOTION, STATES, STREAMS
from bench.conform.lines import BusLine, changed, cut, remote
from bench.conform.motion import turned
from bench.conform.probe import GRACE, HELLO, accepted, read, refusal
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from protocol.canmap.ids import BROADCAST, STATUS_SLOTS, CanClass, CanId
from protocol.canmap.layout import MAX_GROUPS, edge_load, sample_layout
from protocol.codes import DriveState, ErrorCode, MessageType
from protocol.descriptor import Channel
from protocol.framing import Frame
from protocol.messages import BlobRead, StreamReply
from protocol.text import counted

bus = Group("can", CAN, Carrier.BUS)

REQUEST = BlobRead(0, 8, 0).pack()
OTHER_HOST = 11
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


@bus("transfer", 16, "It is split into frames of at most 7 (FD: 63) bytes", needs=0)
def transfer(device: Device) -> str:
    """A request in several frames is reassembled."""
    frame, records = _request(device)
    answer = device.probe.ask_frame(frame, wire=b"".join(records))
    return f"{len(records)} frames: {answer}"


@bus("crc", 16, "if the length or CRC is wrong", needs=0)
def crc(device: Device) -> str:
    """A transfer with a wrong CRC is not answered."""
    _, records = _request(device)
    return _silent(device, [changed(records[0], 3, 1), *records[1:]], "a transfer with a changed bit")


@bus("length", 16, "if the length or CRC is wrong", needs=0)
def length(device: Device) -> str:
    """A single-frame transfer with a wrong len is not answered."""
    (record,) = cut(device.bus.encode(device.probe.frame(MessageType.TIME_SYNC)))
    return _silent(device, [changed(record, 4, 0x40)], "a single-frame transfer with a wrong len")


@bus("toggle", 16, "if the toggle or transfer id is not the expected one", needs=0)
def toggle(device: Device) -> str:
    """A transfer with a wrong toggle is not answered."""
    _, records = _request(device)
    return _silent(device, [records[0], changed(records[1], -1, 0x20), *records[2:]], "a transfer with a wrong toggle")


@bus("transfer-id", 16, "if the toggle or transfer id is not the expected one", needs=0)
def transfer_id(device: Device) -> str:
    """A transfer whose transfer id changes is not answered."""
    _, records = _request(device)
    return _silent(device, [records[0], changed(records[1], -1, 0x07), *records[2:]], "a transfer with two ids")


@bus("first-frame-missing", 16, "ignores frames until the next first one", needs=0)
def first_frame_missing(device: Device) -> str:
    """A transfer without its first frame is ignored, and not counted."""
    _, records = _request(device)
    before = device.fresh().rx_bad
    words = _silent(device, records[1:], "a transfer without its first frame")
    if (n := device.fresh().rx_bad - before) > 0:
        raise Failed(f"rx_bad rose by {n} for a transfer without its first frame")
    return f"{words}; rx_bad unchanged"


@bus("first-frame-again", 16, "if a first frame arrives before the last one", needs=0)
def first_frame_again(device: Device) -> str:
    """An incomplete transfer is abandoned for the next one, which is answered."""
    _, records = _request(device)
    frame, again = _request(device)
    answer = device.probe.ask_frame(frame, wire=records[0] + b"".join(again))
    return f"after the first frame of another transfer: {answer}"


@bus("damage-is-counted", 16, "a damaged transfer is not answered, and `rx_bad` counts it", needs=0)
def damage_is_counted(device: Device) -> str:
    """rx_bad counts abandoned transfers."""
    before = device.fresh().rx_bad
    for _ in range(3):
        _, records = _request(device)
        _silent(device, [changed(records[0], 3, 1), *records[1:]], "a transfer with a changed bit")
    if (counted := device.fresh().rx_bad - before) != 3:
        raise Failed(f"rx_bad counted {counted} of 3 damaged transfers")
    return "rx_bad counted 3 of 3"


@bus("repeated-frame", 16, "It ignores a frame that is identical to the previous one on its identifier", needs=0)
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


@bus("ids-count", 16, "The transfer id counts the transfers on each identifier", needs=0)
def ids_count(device: Device) -> str:
    """The transfer ids of replies are consecutive."""
    found = [device.probe.ask(MessageType.TIME_SYNC, tries=1).heard.transfer for _ in range(6)]
    if any((after - before) % 32 != 1 for before, after in pairwise(found)):
        raise Failed(f"six replies have transfer ids {found}")
    return f"six replies have transfer ids {', '.join(map(str, found))}"


@bus("kept-transfer-id", 16, "A kept reply is sent again with its original transfer id", needs=0)
def kept_transfer_id(device: Device) -> str:
    """A kept reply is sent again with its original transfer id."""
    probe = device.probe
    frame = probe.frame(MessageType.BLOB_READ, REQUEST)
    first = probe.ask_frame(frame)
    again = probe.ask_again(frame)
    if first.heard.transfer != again.heard.transfer:
        raise Failed(f"a kept reply had transfer id {again.heard.transfer}, not {first.heard.transfer}")
    return f"BLOB_READ repeated: transfer id {again.heard.transfer} again"


@bus("node-0-hello", 16, "every device answers with its own node", needs=0)
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


@bus("node-0-others", 16, "and nothing else sent there is answered", needs=0)
def node_0_others(device: Device) -> str:
    """Only HELLO is answered at node 0."""
    wire = device.bus.broadcast(device.probe.frame(MessageType.TIME_SYNC))
    return device.probe.silence(wire, "a TIME_SYNC to node 0")


@bus("other-node", 16, "A message to an absent node is not answered", needs=0)
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


@bus(
    "identifier-of-type", 16, "A message on an identifier that does not match its type is ignored and counted", needs=0
)
def identifier_of_type(device: Device) -> Iterator[str]:
    """A request on the identifier of ALIVE, or of class 7, is not answered."""
    node = device.probe.node
    for name, can_id in (
        ("the identifier of ALIVE", CanId(CanClass.STATUS, node, STATUS_SLOTS[MessageType.ALIVE])),
        ("class 7", CanId(CanClass.FREE, node, 0)),
    ):
        wire = device.bus.transfer(can_id, device.probe.frame(MessageType.TIME_SYNC))
        yield device.probe.silence(wire, f"a TIME_SYNC on {name}")


@bus("other-form", 16, "All HBP on a bus has the same form. Remote frames are not used and are ignored", needs=0)
def other_form(device: Device) -> str:
    """Identifiers of the other form, and remote frames, are ignored."""
    line, probe = device.bus, device.probe
    other = BusLine(line.rates, line.node, not line.extended, line.host)
    words = probe.silence(other.encode(probe.frame(MessageType.TIME_SYNC)), "a TIME_SYNC in the other form")
    if line.rates.fd:
        return words
    wire = remote(cut(line.encode(probe.frame(MessageType.TIME_SYNC)))[0])
    return f"{words}; {probe.silence(wire, 'a remote frame')}"


@bus("host-numbers", 16, "A device keeps for each of them what it keeps for a host on a byte link", needs=0)
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
    again = probe.ask_again(kept)
    if first.heard.transfer != again.heard.transfer:
        raise Failed(f"the HELLO of host {host} cleared the kept replies of host {line.host}")
    return f"host {host} was answered on slot {host}; host {line.host}'s kept replies are unaffected"


# -- STOP -------------------------------------------------------------------------------------------------------------


@bus("stop-frame", 16, "acts as STATE_CMD STOP at once, whatever its slot and data", needs=STATES, critical=True)
def stop_frame(device: Device) -> str:
    """A frame of class 0 to the device's node, or to node 0, takes ARMED and RUNNING to IDLE."""
    words = []
    for state in (DriveState.ARMED, DriveState.RUNNING):
        for node in (device.probe.node, BROADCAST):
            device.enter(state)
            device.probe.feed_every = None
            device.probe.write(device.bus.stop(node))
            beat = device.fresh()
            if beat.state != DriveState.IDLE or beat.outputs_on:
                raise Failed(f"a frame of class 0 to node {node} in {state.name}: {beat.state.name}")
            words.append(f"{state.name}, node {node}")
    return f"in {'; '.join(words)}: IDLE, outputs off"


# -- streams ----------------------------------------------------------------------------------------------------------


def _layout(device: Device, chosen: Sequence[Channel], block: int) -> tuple[int, list[int]]:
    """Groups of a sample, and the data bytes of a frame of each."""
    layout = sample_layout([width(channel) for channel in chosen], device.bus.rates.fd, block)
    return len(layout.groups), [layout.length(group) for group in range(len(layout.groups))]


@bus("slots", 16, "A device assigns a new configuration the slots after those of the previous one", needs=STREAMS)
def slots(device: Device) -> str:
    """A new configuration gets the slots after those of the previous one."""
    narrow = min(device.channels, key=width)
    found = [device.configure(0, [narrow.id], RATE).reply.slot for _ in range(5)]
    if any(not 0 <= slot < 32 for slot in found):
        raise Failed(f"slots {found}: not all in 0 to 31")
    for before, after in pairwise(found):
        if (after - before) % 32 not in (1, 2):
            raise Failed(f"five configurations of one group have slots {found}")
        if before == after:
            raise Failed(f"two configurations in a row have slot {after}")
    return f"five configurations of one group have slots {', '.join(map(str, found))}"


@bus("groups", 16, "Channels are divided into groups in the order in which STREAM_SET names them", needs=STREAMS)
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
    samples = bus_samples(device, told, chosen)
    per_sample = len(frames) / n * told.reply.block
    if len(samples) < per_sample - 2 * told.reply.block:
        raise Failed(f"{len(frames)} frames of {n} groups make only {len(samples)} whole samples by their counters")
    words = f"{counted(len(chosen), 'channel')} in {counted(n, 'group')}"
    return f"{words}: {len(frames)} frames of {lengths} bytes, {len(samples)} samples"


def _some_groups(device: Device) -> tuple[Channel, ...]:
    """Channels that make two or three groups, if there are so many."""
    for n in range(1, len(device.channels) + 1):
        count, _ = _layout(device, device.channels[:n], 1)
        if count > 2:
            return device.channels[: n - 1]
    return device.channels


@bus("counters", 16, "Losses are counted from the counters", needs=STREAMS)
def counters(device: Device) -> str:
    """Counters continue from frame to frame; missing frames are counted in tx_dropped."""
    chosen = [min(device.channels, key=width)]
    before = device.fresh().tx_dropped
    told = device.stream(chosen, RATE)
    device.probe.listen(WATCHED)
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
    early = device.fresh().tick // device.ticks_per_period < 1 << 32  # the counter is the whole index
    if fd and early and any(n % told.asked.decimation for n in found):
        raise Failed(f"{words}: not divisible by {told.asked.decimation}")
    return words


@bus("load", 16, "is the largest share of the bus that this device's streams may take", needs=STREAMS)
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
    if device.offers_edges:
        yield _same_load(device.configure_edges(0).reply, edge_load(line.rates, line.extended), "edges")


def _same_load(reply: StreamReply, due: float, what: str) -> str:
    if abs(reply.load - due) > LOAD_ERROR * due:
        raise Failed(f"{what}: the load is {reply.load:.4%}, not {due:.4%} as by the formula")
    return f"{what}: {reply.load:.3%}"


@bus("overload", 16, "or with more than 16 groups, a stream is refused (DOES_NOT_FIT", needs=STREAMS)
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


@bus(
    "edges", 16, "is the record of chapter 11 with the low 8 bits of the edge's index in place of `flags`", needs=MOTION
)
def edges(device: Device) -> str:
    """Each edge has its own frame, numbered consecutively."""
    device.require_edges()
    numbers = [edge.index for edge in turned(device).edges]
    if len(numbers) < 2:
        raise Unknown(f"only {len(numbers)} edges received")
    if any((after - before) % 256 != 1 for before, after in pairwise(numbers)):
        raise Failed(f"{len(numbers)} edges have numbers {numbers[:12]}")
    return f"{len(numbers)} edges, numbers {numbers[0]} to {numbers[-1]} without a gap"

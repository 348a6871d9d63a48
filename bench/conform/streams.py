"""Level 2, first part: stream requests and their replies. Chapters 5 and 11 of SPEC."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from itertools import pairwise

from bench.conform.checks import Carrier, Group
from bench.conform.device import Configured, Device, ids, require_granted, width
from bench.conform.levels import STREAMS
from bench.conform.lines import BusLine
from bench.conform.probe import accepted, read, refusal
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from protocol.canmap.layout import sample_layout
from protocol.codes import ErrorCode, Feature, MessageType, StreamEvent
from protocol.messages import StreamGet, StreamInfo, StreamReply
from protocol.signals import Flag
from protocol.streams import MAX_DECIMATION, STREAM_HEADER
from protocol.text import counted

check = Group("stream", STREAMS)

ABSENT = 0xFFF0
SLOW_HZ = 100.0
CONFIGURATIONS = 6


def absent(device: Device) -> int:
    """An id that no channel has."""
    taken = set(ids(device.descriptor.channels))
    return next(n for n in range(ABSENT, 0, -1) if n not in taken)


@check("set-refusals", "11.18 11.13 11.19 11.20 11.21 11.22 11.23 11.24 11.25 11.51")
def set_refusals(device: Device) -> Iterator[str]:
    """Each error in STREAM_SET is refused with its code and detail."""
    first, other = device.channels[0].id, absent(device)
    rows: list[tuple[str, tuple[int, Sequence[int], int, int, int], ErrorCode, float]] = [
        ("stream 4", (4, [first], 1, 20, 0), ErrorCode.OUT_OF_RANGE, 3),
        ("event 1 (SLOW)", (0, [first], 1, 20, 1), ErrorCode.NOT_SUPPORTED, 1),
        ("event 9", (0, [first], 1, 20, 9), ErrorCode.NOT_SUPPORTED, 9),
        ("decimation 0", (0, [first], 0, 20, 0), ErrorCode.BAD_VALUE, 0),
        ("no channels", (0, [], 1, 20, 0), ErrorCode.BAD_VALUE, 0),
        (f"channel {other}", (0, [first, other], 1, 20, 0), ErrorCode.UNKNOWN_ID, other),
        (f"channel {first} twice", (0, [first, first], 1, 20, 0), ErrorCode.BAD_VALUE, first),
    ]
    if device.offers(Feature.EDGES):
        rows.append(("edges with two channels", (0, [first, first], 1, 20, 2), ErrorCode.BAD_VALUE, 2))
    else:
        rows.append(("edges", (0, [], 1, 20, 2), ErrorCode.NOT_SUPPORTED, 2))
    if device.offers(Feature.MEANS):
        rows += [
            ("means with decimation 0", (0, [first], 0, 20, 3), ErrorCode.BAD_VALUE, 0),
            ("means of no channels", (0, [], 1, 20, 3), ErrorCode.BAD_VALUE, 0),
            (f"means of channel {other}", (0, [first, other], 1, 20, 3), ErrorCode.UNKNOWN_ID, other),
            (f"means of channel {first} twice", (0, [first, first], 1, 20, 3), ErrorCode.BAD_VALUE, first),
        ]
    else:
        rows.append(("means", (0, [first], 1, 20, 3), ErrorCode.NOT_SUPPORTED, 3))
    return (refusal(device.stream_set(*asked), code, detail, words) for words, asked, code, detail in rows)


@check("set-order", "11.18")
def set_order(device: Device) -> Iterator[str]:
    """Of two errors in STREAM_SET, the one that is checked first is reported."""
    first, other = device.channels[0].id, absent(device)
    rows: list[tuple[str, tuple[int, Sequence[int], int, int, int], ErrorCode]] = [
        ("stream 4 and event 9", (4, [first], 1, 20, 9), ErrorCode.OUT_OF_RANGE),
        ("event 1 and decimation 0", (0, [first], 0, 20, 1), ErrorCode.NOT_SUPPORTED),
        ("an unknown channel, then a repeated one", (0, [other, first, first], 1, 20, 0), ErrorCode.UNKNOWN_ID),
        ("a repeated channel, then an unknown one", (0, [first, first, other], 1, 20, 0), ErrorCode.BAD_VALUE),
        ("stream 4 and decimation 0", (4, [first], 0, 20, 0), ErrorCode.OUT_OF_RANGE),
        ("decimation 0 and an unknown channel", (0, [other], 0, 20, 0), ErrorCode.BAD_VALUE),
    ]
    yield from (refusal(device.stream_set(*asked), code, None, words) for words, asked, code in rows)
    device.stream(device.channels[:1], SLOW_HZ)
    running = device.stream_set(0, [other], 1, 20, 0)
    yield refusal(running, ErrorCode.UNKNOWN_ID, other, "a running stream and an unknown channel")
    never = device.stream_set(0, [first], 0, 20, 0)
    yield refusal(never, ErrorCode.BAD_VALUE, 0, "a running stream and decimation 0")
    unknown = device.stream_set(0, [first], 1, 20, 9)
    yield refusal(unknown, ErrorCode.NOT_SUPPORTED, 9, "a running stream and event 9")
    if device.offers(Feature.EDGES):
        edges = device.stream_set(0, [first], 1, 20, StreamEvent.EDGES)
        yield refusal(edges, ErrorCode.BAD_VALUE, 1, "a running stream and edges with a channel")


@check("busy", "11.26")
def busy(device: Device) -> str:
    """A running stream cannot be reconfigured."""
    first = device.channels[0].id
    device.stream(device.channels[:1], SLOW_HZ)
    before = device.probe.get(StreamGet(0), StreamInfo)
    words = refusal(device.stream_set(0, [first], 7), ErrorCode.BUSY, 0, "STREAM_SET of a running stream")
    now = device.probe.get(StreamGet(0), StreamInfo)
    if now != before:
        raise Failed(f"{words}, but STREAM_GET gives cfg_id {now.cfg_id}, decimation {now.decimation}")
    return words


@check("too-long", "11.27", carrier=Carrier.BYTES)
def too_long(device: Device) -> str:
    """A sample too long for a frame is refused with the bytes that fit."""
    tx_max = device.probe.hello(rx_max=128).tx_max
    room = tx_max - STREAM_HEADER.size
    most = (device.hello.rx_max - 8) // 2
    chosen = device.channels[:most]
    if sum(map(width, chosen)) <= room:
        raise NotApplicable(f"all channels together have {sum(map(width, chosen))} bytes, {room} fit")
    return refusal(device.stream_set(0, ids(chosen)), ErrorCode.DOES_NOT_FIT, room, counted(len(chosen), "channel"))


@check("cfg-id", "5.37")
def cfg_id(device: Device) -> str:
    """Each configuration has its own cfg_id."""
    first = device.channels[0].id
    found = [device.configure(n % 2, [first], SLOW_HZ).reply.cfg_id for n in range(CONFIGURATIONS)]
    if 0 in found or len(set(found)) < len(found):
        raise Failed(f"{CONFIGURATIONS} configurations have cfg_ids {found}")
    return f"{CONFIGURATIONS} configurations have cfg_ids {', '.join(map(str, found))}"


@check("reply-fields", "11.14 5.38")
def reply_fields(device: Device) -> Iterator[str]:
    """The reply to STREAM_SET has the correct sample_bytes and block, whatever max_latency_ms is."""
    for n, latency in ((1, 200), (3, 200), (len(device.channels), 200), (1, 0), (1, 35), (1, 0xFFFF)):
        chosen = device.fitting(device.channels[:n])
        told = device.configure(0, ids(chosen), SLOW_HZ, latency_ms=latency)
        size = sum(map(width, chosen))
        if told.reply.stream != 0 or told.reply.sample_bytes != size:
            raise Failed(
                f"{counted(len(chosen), 'channel')}: stream {told.reply.stream}, "
                f"{told.reply.sample_bytes} bytes, not {size}"
            )
        yield f"{counted(len(chosen), 'channel')}: {size} bytes, {_block(device, told)}"


def _block(device: Device, told: Configured) -> str:
    reply, asked = told.reply, told.asked
    in_time = max(1, asked.max_latency_ms * device.pwm_hz // (1000 * asked.decimation))
    if isinstance(line := device.probe.line, BusLine):
        by_id = {channel.id: width(channel) for channel in device.channels}
        fits = sample_layout([by_id[number] for number in asked.channels], line.rates.fd, 0xFFFF).samples
    else:
        fits = (device.hello.tx_max - STREAM_HEADER.size) // reply.sample_bytes
    if not 1 <= reply.block <= min(fits, in_time):
        raise Failed(f"block is {reply.block}: {fits} fit in a frame, {in_time} are taken in {asked.max_latency_ms} ms")
    return f"block {reply.block} ({fits} fit, {in_time} in time)"


@check("get", "5.40 11.1")
def get(device: Device) -> str:
    """STREAM_GET returns the last configuration, and whether the stream is running."""
    chosen = ids(device.channels[:2])
    device.configure(0, chosen[:1], SLOW_HZ / 2)
    anew = device.stream_set(0, chosen, MAX_DECIMATION)
    if anew.error is not None and anew.error.code == ErrorCode.BUSY:
        raise Failed(f"STREAM_SET of a stream that is configured, and not running: {anew}")
    told = device.configure(0, chosen, SLOW_HZ, latency_ms=30)
    for running in (False, True):
        if running:
            device.start_streams(1)
        info = device.probe.get(StreamGet(0), StreamInfo)
        reply, asked = told.reply, told.asked
        wanted = StreamInfo(
            stream=0, running=running, event=asked.event, slot=reply.slot, decimation=asked.decimation,
            max_latency_ms=asked.max_latency_ms, cfg_id=reply.cfg_id, sample_bytes=reply.sample_bytes,
            block=reply.block, tick0=reply.tick0, channels=asked.channels,
        )  # fmt: skip
        if info != wanted:
            raise Failed(f"STREAM_GET gives {info}, STREAM_SET gave {wanted}")
    words = f"cfg_id {told.reply.cfg_id}, decimation {told.asked.decimation}, channels {chosen}, running 0, then 1"
    if not device.offers(Feature.EDGES):
        return words
    reply = device.configure_edges(3, decimation=7, latency_ms=90).reply
    info = device.probe.get(StreamGet(3), StreamInfo)
    edges = StreamInfo(
        stream=3, running=False, event=StreamEvent.EDGES, slot=reply.slot, decimation=7, max_latency_ms=90,
        cfg_id=reply.cfg_id, sample_bytes=8, block=reply.block, tick0=reply.tick0, channels=(),
    )  # fmt: skip
    if info != edges:
        raise Failed(f"STREAM_GET of edges gives {info}, STREAM_SET gave {edges}")
    return f"{words}; of edges as they were set"


@check("get-refusals", "5.41")
def get_refusals(device: Device) -> tuple[str, ...]:
    """STREAM_GET is refused for a free stream and for one above 3."""
    probe = device.probe
    return (
        probe.refused(ErrorCode.OUT_OF_RANGE, 3, MessageType.STREAM_GET, StreamGet(4).pack()),
        probe.refused(ErrorCode.UNKNOWN_ID, 2, MessageType.STREAM_GET, StreamGet(2).pack()),
    )


@check("start-free", "11.4")
def start_free(device: Device) -> list[str]:
    """STREAM_START of a free stream is refused with its number, and starts none."""
    probe = device.probe
    device.configure(0, [device.channels[0].id], SLOW_HZ)
    words = []
    for mask, lowest in ((0b100101, 2), (0x11, 4), (1 << 31 | 1, 31)):
        answer = probe.ask(MessageType.STREAM_START, struct.pack("<I", mask))
        words.append(refusal(answer, ErrorCode.UNKNOWN_ID, lowest, f"STREAM_START 0x{mask:x}"))
    if probe.get(StreamGet(0), StreamInfo).running:
        raise Failed(f"{words[0]}, but stream 0 is running")
    return words


@check("mask-0", "11.6")
def mask_0(device: Device) -> str:
    """A mask of 0 is answered and does nothing."""
    probe = device.probe
    device.configure(0, [device.channels[0].id], SLOW_HZ)
    none = struct.pack("<I", 0)
    started = accepted(probe.ask(MessageType.STREAM_START, none), "STREAM_START 0")
    running = probe.get(StreamGet(0), StreamInfo).running
    stopped = accepted(probe.ask(MessageType.STREAM_STOP, none), "STREAM_STOP 0")
    there = probe.ask(MessageType.STREAM_GET, StreamGet(0).pack()).error is None
    if running or not there:
        raise Failed(f"running after START 0: {running}; configured after STOP 0: {there}")
    return f"{started}; {stopped}; stream 0 stays configured and is not running"


@check("stop-frees", "11.5")
def stop_frees(device: Device) -> str:
    """STREAM_STOP frees a stream, running or not, and ignores streams that are not configured."""
    probe = device.probe
    words = ""
    for running in (False, True):
        told = device.configure(0, ids(device.channels[:1]), SLOW_HZ)
        if running:
            device.start_streams(1)
        words = accepted(probe.ask(MessageType.STREAM_STOP, struct.pack("<I", 0xFFFFFFF3)), "STREAM_STOP FFFFFFF3")
        answer = probe.ask(MessageType.STREAM_GET, StreamGet(0).pack())
        state = "running" if running else "configured"
        words += "; " + refusal(answer, ErrorCode.UNKNOWN_ID, 0, f"STREAM_GET of {told.asked.stream}, {state} before")
    return words


@check("numbers", "11.19 11.2")
def numbers(device: Device) -> Iterator[str]:
    """Each of the streams 0 to 3 can be configured, alone, and its frames have its number."""
    for number in range(4):
        answer = device.stream_set(number, ids(device.channels[:1]), MAX_DECIMATION)
        if answer.error is not None and answer.error.code == ErrorCode.OUT_OF_RANGE:
            raise Failed(f"stream {number}: {answer}")
        told = device.configure(number, ids(device.channels[:1]), SLOW_HZ)
        info = device.probe.get(StreamGet(number), StreamInfo)
        if (told.reply.stream, info.stream, info.cfg_id) != (number, number, told.reply.cfg_id):
            raise Failed(
                f"stream {number}: STREAM_SET has stream {told.reply.stream}, STREAM_GET stream {info.stream}, "
                f"cfg_id {info.cfg_id}, not {told.reply.cfg_id}"
            )
        if number == 3 and not device.probe.line.bus:
            device.start_streams(1 << number)
            device.probe.listen(0.1)
            if wrong := {block.stream for block in device.blocks()} - {number}:
                raise Failed(f"stream {number} sends frames of stream {', '.join(map(str, wrong))}")
        device.stop_streams()
        yield f"stream {number}: cfg_id {told.reply.cfg_id}"


@check("mask-selects", "11.2 11.5")
def mask_selects(device: Device) -> str:
    """STREAM_START and STREAM_STOP act on the streams of the mask and on no other."""
    probe, first = device.probe, ids(device.channels[:1])
    device.configure(0, first, SLOW_HZ)
    if device.offers(Feature.EDGES):
        device.configure_edges(2)
    else:
        device.configure(2, first, SLOW_HZ)

    def seen() -> list[bool | None]:
        found: list[bool | None] = []
        for number in (0, 2):
            answer = probe.ask(MessageType.STREAM_GET, StreamGet(number).pack())
            found.append(None if answer.error is not None else bool(read(answer.frame, StreamInfo).running))
        return found

    for kind, mask, due in (
        (MessageType.STREAM_START, 0b100, [False, True]), (MessageType.STREAM_START, 0b001, [True, True]),
        (MessageType.STREAM_STOP, 0b100, [True, None]), (MessageType.STREAM_STOP, 0b001, [None, None]),
    ):  # fmt: skip
        accepted(probe.ask(kind, struct.pack("<I", mask)), kind.name)
        if (now := seen()) != due:
            words = {None: "free", False: "configured", True: "running"}
            raise Failed(
                f"after {kind.name} {mask:#x} stream 0 is {words[now[0]]}, stream 2 {words[now[1]]}; "
                f"they must be {words[due[0]]} and {words[due[1]]}"
            )
    return "two streams were started and stopped one by one"


@check("hello-leaves-streams", "4.15")
def hello_leaves_streams(device: Device) -> str:
    """A HELLO with another nonce leaves streams as they are: one that runs goes on, with its seq."""
    probe = device.probe
    dropped = device.fresh().tx_dropped
    device.stream(device.channels[:1], SLOW_HZ)
    device.configure(1, ids(device.channels[:1]), SLOW_HZ)
    probe.listen(0.1)
    before = [probe.get(StreamGet(number), StreamInfo) for number in (0, 1)]
    probe.hello()
    for told in before:
        answer = probe.ask(MessageType.STREAM_GET, StreamGet(told.stream).pack())
        if answer.error is not None or read(answer.frame, StreamInfo) != told:
            raise Failed(f"after a HELLO, STREAM_GET of stream {told.stream}: {answer}; before it was {told}")
    since, frames = len(probe.heard), len(probe.stream_frames)
    probe.listen(0.2)
    blocks = device.blocks(0)
    device.require_undropped(dropped)
    if not any(block.place >= since for block in blocks) and len(probe.stream_frames) == frames:
        raise Failed("no frame of the running stream came after a HELLO")
    if any(after.seq != (one.seq + 1) & 0xFFFF for one, after in pairwise(blocks)):
        raise Failed(f"seq does not continue over a HELLO: {[block.seq for block in blocks]}")
    return "after a HELLO with another nonce one stream is running, one configured, as before"


@check("memory", "11.30")
def memory(device: Device) -> str:
    """There is memory for a stream of all channels that fit in a frame, and for one of edges besides."""
    chosen = device.fitting(device.channels)
    answer = device.stream_set(0, ids(chosen), MAX_DECIMATION, 200)
    words = accepted(answer, f"{counted(len(chosen), 'channel')} that fit in a frame")
    if not device.offers(Feature.EDGES):
        return words
    edges = device.stream_set(1, (), 1, 20, StreamEvent.EDGES)
    if edges.error is not None and edges.error.code == ErrorCode.DOES_NOT_FIT and edges.error.detail == 0:
        load = read(answer.frame, StreamReply).load
        if not load:
            raise Failed(f"{words}; edges besides: {edges}")
        return f"{words}, load {load:.1%}; the link does not carry edges besides"
    return f"{words}; {accepted(edges, 'edges besides')}"


@check("on-request", "9.11")
def on_request(device: Device) -> str:
    """A channel with the flag ON_REQUEST is streamed where STREAM_SET names it."""
    chosen = next((channel for channel in device.channels if channel.flags & Flag.ON_REQUEST), None)
    if chosen is None:
        raise NotApplicable("no channel has the flag ON_REQUEST")
    return accepted(device.stream_set(0, [chosen.id], MAX_DECIMATION), chosen.name)


@check("decimation-ends", "11.10")
def decimation_ends(device: Device) -> str:
    """Decimation 65535 is accepted and returned, and so is 1, where the link carries that."""
    narrow = min(device.channels, key=width)
    words = []
    for decimation in (MAX_DECIMATION, 1):
        answer = device.stream_set(0, [narrow.id], decimation)
        if decimation == 1 and answer.error is not None and answer.error.code == ErrorCode.DOES_NOT_FIT:
            words.append("1: the link is too slow")
            continue
        words.append(accepted(answer, f"decimation {decimation}"))
        told = device.probe.get(StreamGet(0), StreamInfo).decimation
        if told != decimation:
            raise Failed(f"STREAM_GET gives decimation {told}, {decimation} was set")
    return "; ".join(words)


@check("load-sums", "11.31")
def load_sums(device: Device) -> str:
    """The load of a second stream includes that of the first."""
    first = ids(device.channels[:1])

    def load(stream: int) -> float:
        answer = require_granted(device.stream_set(stream, first, MAX_DECIMATION, 0xFFFF), "STREAM_SET")
        return read(answer.frame, StreamReply).load

    one, both = load(0), load(1)
    device.stop_streams(1)
    alone = load(1)
    words = f"load {one:.4%} of one stream, {both:.4%} of two, {alone:.4%} of the second alone"
    if not one and not both and not alone:
        return "load 0: not known to the device"
    if not 0 < one < 1 or abs(both - one - alone) > 0.02 * both:
        raise Failed(words)
    return words


@check("start-again", "11.3")
def start_again(device: Device) -> str:
    """STREAM_START of a running stream changes nothing."""
    if device.probe.line.bus:
        raise NotApplicable("frames on CAN have no seq")
    device.stream(device.channels[:1], SLOW_HZ)
    before = device.streamed(0, 0.2)[-1]
    device.start_streams(1)
    after = device.streamed(0, 0.2)
    seqs = [block.seq for block in after if block.place > before.place]
    if not seqs:
        raise Unknown("no frame received after the second STREAM_START")
    if seqs[0] != (before.seq + 1) & 0xFFFF:
        raise Failed(f"seq was {before.seq}, then {seqs[0]} after the second STREAM_START")
    return f"seq {before.seq}, then {seqs[0]} after the second STREAM_START"


@check("edges-set", "11.12 11.11")
def edges_set(device: Device) -> Iterator[str]:
    """A stream of edges accepts any decimation."""
    device.require(Feature.EDGES)
    for decimation in (0, 7):
        answer = device.stream_set(1, (), decimation, 20, StreamEvent.EDGES)
        if answer.error is not None and answer.error.code == ErrorCode.DOES_NOT_FIT:
            raise Unknown(f"edges: {answer}")
        accepted(answer, f"edges with decimation {decimation}")
        reply = read(answer.frame, StreamReply)
        if reply.sample_bytes != 8 or not reply.cfg_id:
            raise Failed(f"edges: sample_bytes {reply.sample_bytes}, cfg_id {reply.cfg_id}")
        yield f"decimation {decimation}: cfg_id {reply.cfg_id}, 8 bytes"

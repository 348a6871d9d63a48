"""Level 2, second part: streamed data. Chapters 5, 10 and 11 of SPEC."""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bench.conform.checks import Carrier, Group
from bench.conform.device import ALL, Block, Configured, Device, ids, require_granted, width
from bench.conform.levels import MOTION, STREAMS
from bench.conform.probe import MOST_QUEUED, read, steps
from bench.conform.verdicts import Failed, NotApplicable, Unknown
from protocol.canmap.layout import sample_layout
from protocol.codes import Feature, MessageType
from protocol.descriptor import Channel
from protocol.framing import MAX_PAYLOAD
from protocol.messages import TimeSyncReply
from protocol.signals import Flag
from protocol.streams import DISCONTINUITY, OVERRUN, STREAM_HEADER
from protocol.text import counted

check = Group("stream", STREAMS, Carrier.BYTES)
either = Group("stream", STREAMS)

RATE = 400.0  # Hz of samples that are looked at one by one
WATCHED = 0.4  # s
MORE_THAN_A_BYTE = 257  # a decimation
SYNCED = 0.005  # s between two TIME_SYNCs
SLOW, LATENCY_MS = 50.0, 50  # Hz, and ms
SEEN = 0.04  # s that a frame may need beyond its latency, and this host to see it
ROUNDED = 1e-5  # rad
AHEAD, BEHIND = 0.002, 0.005  # s that a device may need from a sample to its frame, and from a frame to the link
MASK = 0xFFFFFFFF
HALL_ROWS = (
    (0, 1, 2, 3, 4, 5, 6, 7), (0, 2, 1, 3, 4, 6, 5, 7), (0, 1, 4, 5, 2, 3, 6, 7), (0, 4, 2, 6, 1, 5, 3, 7),
    (0, 4, 1, 5, 2, 6, 3, 7), (0, 2, 4, 6, 1, 3, 5, 7),
)  # fmt: skip
"""Codes of the input words 0 to 7, by `hall_swap_hat`."""
UNREAD = (0.6, 2.0, 4.0)  # s for which the link is not read, one after the other, until frames are dropped
SETTLE = 0.5  # s after that in which what waited is read
SLOWED = 8  # times at most that a rate is lowered until a stream takes no more than its share of the link
HALF = 0.4  # of the link, that each of two streams may take
LOADED = 0.6  # of the link, that one may take which is to lose nothing while it is read, beside heartbeats
SLOWEST = 64  # decimation beyond which a link is too slow to be loaded


@check("cfg-id-in-frames", "11.32")
def cfg_id_in_frames(device: Device) -> str:
    """Frames carry the cfg_id of the present configuration."""
    told = device.stream(device.channels[:1], RATE)
    device.streamed(0, WATCHED / 2)
    device.stop_streams()
    since = len(device.probe.heard)
    again = device.stream(device.channels[:1], RATE)
    blocks = [block for block in device.streamed(0, WATCHED / 2) if block.place >= since]
    if not blocks:
        raise Unknown("no frame received of the second configuration")
    wrong = {block.cfg_id for block in blocks} - {again.reply.cfg_id}
    if wrong:
        raise Failed(
            f"frames carry cfg_id {sorted(wrong)}; STREAM_SET gave {told.reply.cfg_id}, then {again.reply.cfg_id}"
        )
    return f"{len(blocks)} frames with cfg_id {again.reply.cfg_id}, none with {told.reply.cfg_id}"


@check("frame-fields", "11.34 11.15")
def frame_fields(device: Device) -> str:
    """Frames hold whole records, at most a block of them, and seq starts at 0, at each start."""
    chosen = device.channels[:3]
    device.stream(device.channels[:1], RATE)
    device.streamed(0, WATCHED / 2)
    device.stop_streams()
    device.probe.forget()
    told = device.stream(chosen, RATE)
    blocks = device.streamed(0, WATCHED)
    size = sum(map(width, chosen))
    for block in blocks:
        if not 0 < block.n <= told.reply.block or len(block.data) != block.n * size:
            raise Failed(
                f"a frame has {len(block.data)} bytes, n {block.n}; a record is {size} bytes, block {told.reply.block}"
            )
    if blocks[0].seq != 0 and not blocks[0].flags & OVERRUN:
        raise Failed(f"the first frame has seq {blocks[0].seq}, not 0")
    most = max(block.n for block in blocks)
    seqs = f"seq from {blocks[0].seq} to {blocks[-1].seq}"
    return f"{len(blocks)} frames of up to {most} records ({size} bytes each), {seqs}"


def periods(device: Device, told: Configured) -> int:
    """PWM periods since boot, by a heartbeat."""
    return (device.fresh().tick - told.reply.tick0) // device.ticks_per_period


def unwrapped(index: int, now: int) -> int:
    """The number with these low 32 bits that is nearest to `now`."""
    return now + signed(index - now)


@check("index-divisible", "11.10")
def index_divisible(device: Device) -> Iterator[str]:
    """The index of every sample is divisible by the decimation, also where that needs more than a byte."""
    most = device.pwm_hz / MORE_THAN_A_BYTE
    for rate in (min(RATE, device.pwm_hz / 2), min(RATE / 7, device.pwm_hz / 3), min(most, RATE)):
        told = device.stream(device.channels[:1], rate)
        blocks = device.streamed(0, max(WATCHED, 2.2 / rate))
        decimation = told.asked.decimation
        now = periods(device, told)
        wrong = [index for block in blocks if (index := unwrapped(block.index, now)) % decimation]
        if wrong:
            raise Failed(f"index {wrong[0]} is not divisible by {decimation}")
        yield f"{len(blocks)} frames from index {blocks[0].index}, divisible by {decimation}"
        device.stop_streams()
        device.probe.forget()


@check("tick-of-index", "10.3 11.35 5.39")
def tick_of_index(device: Device) -> str:
    """The tick of a sample is tick0 plus its index times the ticks of a PWM period."""
    told = device.stream(device.channels[:1], RATE)
    blocks = device.streamed(0, 2 * WATCHED)
    ticks, tick0, now = device.ticks_per_period, told.reply.tick0, periods(device, told)
    for block in blocks:
        index = unwrapped(block.index, now)
        off = signed(block.tick - tick0 - index * ticks)
        if off:
            raise Failed(f"index {block.index} has tick {block.tick}: {off} off from tick0 {tick0} + index * {ticks}")
    newest = now - unwrapped(blocks[-1].index, now)
    rule = f"tick = tick0 {tick0} + index * {ticks}"
    return f"{len(blocks)} frames to index {blocks[-1].index}: {rule}, {newest} periods before the heartbeat"


@check("tick-is-now", "11.17")
def tick_is_now(device: Device) -> str:
    """The newest samples lie between the TIME_SYNCs before and after them."""
    told = device.stream(device.channels[:1], RATE)
    step = told.asked.decimation * device.ticks_per_period
    asked: list[tuple[int, int]] = []  # the place of its answer, and its tick
    for _ in range(round(2 * WATCHED / SYNCED)):
        answer = device.probe.ask(MessageType.TIME_SYNC)
        place = next(n for n, each in enumerate(device.probe.heard) if each is answer.heard)
        asked.append((place, read(answer.frame, TimeSyncReply).tx_tick))
        device.probe.listen(SYNCED)
    if any(after < before for (_, before), (_, after) in pairwise(asked)):
        raise Unknown("the tick of TIME_SYNC goes back")
    ahead, behind = [], []
    for block in device.streamed(0, SYNCED):
        newest = block.tick + (block.n - 1) * step
        before = [tick for place, tick in asked if place <= block.place]
        after = [tick for place, tick in asked if place > block.place]
        behind += [signed(before[-1] - newest)] if before else []
        ahead += [signed(newest - after[0])] if after else []
    if not ahead or not behind:
        raise Unknown("no frame received between two TIME_SYNCs")
    period, early, late = device.ticks_per_period, max(ahead), min(behind)
    if early > period + AHEAD * device.hz:
        raise Failed(
            f"the tick of a sample is {1e3 * early / device.hz:.1f} ms later than that of a TIME_SYNC after it"
        )
    if late > period + (BEHIND + 2 * device.probe.takes(MAX_PAYLOAD)) * device.hz:
        raise Failed(
            f"the newest sample of every frame is at least {1e3 * late / device.hz:.1f} ms older than a TIME_SYNC "
            "before it"
        )
    return f"the newest sample of {len(behind)} frames lies between the TIME_SYNCs before and after it"


def signed(ticks: int) -> int:
    """A difference of ticks of 32 bits."""
    return ((ticks + (1 << 31)) & MASK) - (1 << 31)


@check("no-gaps", "11.34 11.35 11.42 11.46 11.48")
def no_gaps(device: Device) -> str:
    """Without losses, seq and index continue from frame to frame, and no frame has a flag."""
    told, dropped, damaged = device.stream(device.channels[:1], RATE), _dropped(device), device.probe.line.damaged
    blocks = device.streamed(0, 2 * WATCHED)
    lossless = _dropped(device) == dropped and device.probe.line.damaged == damaged
    if lossless and blocks[0].flags & OVERRUN:
        raise Failed("the first frame of a stream has OVERRUN, but nothing was dropped")
    for before, after in pairwise(blocks):
        if lossless and (after.flags & (OVERRUN | DISCONTINUITY) or after.seq != (before.seq + 1) & 0xFFFF):
            raise Failed(f"seq {before.seq}, then {after.seq} with flags 0x{after.flags:x}, but nothing was dropped")
        if after.seq != (before.seq + 1) & 0xFFFF or after.flags & DISCONTINUITY:
            continue
        if (due := (before.index + before.n * told.asked.decimation) & MASK) != after.index:
            raise Failed(f"seq {after.seq} begins at index {after.index}, expected {due}, without DISCONTINUITY")
    if len(blocks) < 2:
        raise Unknown("only one frame received")
    return f"{len(blocks)} frames, {sum(block.n for block in blocks)} samples without a gap"


@check("in-time", "11.16")
def in_time(device: Device) -> str:
    """A frame is sent before its oldest sample is older than max_latency_ms."""
    told = device.stream(device.channels[:1], SLOW, LATENCY_MS)
    device.probe.forget()
    blocks = device.streamed(0, 2 * WATCHED)
    return late(device, [(block.at, block.tick) for block in blocks], told.asked.max_latency_ms, "frames")


def late(device: Device, came: list[tuple[float, int]], latency_ms: int, what: str) -> str:
    """Evidence that what `came` with a tick is no older than that, for most of them. Raises Failed."""
    probe = device.probe
    tick, now = probe.tick()[1], probe.now()
    ages = sorted(signed(tick - then) / device.hz - (now - at) for at, then in came)
    age = ages[len(ages) // 2]
    words = f"{len(came)} {what}, most of them up to {1e3 * age:.0f} ms old, max_latency_ms is {latency_ms}"
    if age > 1e-3 * latency_ms + SEEN + 2 * probe.takes(MAX_PAYLOAD):
        raise Failed(words)
    return words


@check("only-running", "11.7")
def only_running(device: Device) -> str:
    """Frames come from running streams only: none before STREAM_START, none after STREAM_STOP."""
    device.configure(0, ids(device.channels[:1]), RATE)
    device.probe.listen(WATCHED / 2)
    if early := len(device.blocks()):
        raise Failed(f"{early} frames came before STREAM_START")
    device.start_streams(1)
    came = len(device.streamed(0, WATCHED / 2))
    device.stop_streams()
    device.probe.forget()
    device.probe.listen(WATCHED / 2)
    if after := len(device.blocks()):
        raise Failed(f"{after} frames came after STREAM_STOP and a pause")
    return f"none before STREAM_START, {came} until STREAM_STOP, none after it"


@check("rx-max-of-set", "4.18")
def rx_max_of_set(device: Device) -> str:
    """Frames are no longer than the rx_max of the HELLO before STREAM_SET, whatever a later HELLO says."""
    device.probe.hello(rx_max=128)
    narrow = min(device.channels, key=width)
    told = device.configure(0, [narrow.id], device.pwm_hz, latency_ms=1000)
    device.probe.hello()
    device.start_streams(1)
    blocks = device.streamed(0, WATCHED)
    most = max(STREAM_HEADER.size + len(block.data) for block in blocks)
    if most > 128 or told.reply.block * width(narrow) > 128 - STREAM_HEADER.size:
        raise Failed(f"a host that accepts 128 bytes gets frames of {most} bytes; block {told.reply.block}")
    return f"{len(blocks)} frames of up to {most} bytes, block {told.reply.block}"


@either("status", "13.4")
def status(device: Device) -> str:
    """The channel `status` holds the state of the heartbeats."""
    channel = device.channel_named("status")
    if channel is None:
        raise NotApplicable("the device has no channel `status`")
    told = device.stream((channel,), RATE)
    device.probe.listen(WATCHED / 2)
    found = {raw[0] & 7 for raw in instants(device, told, (channel,)).values()}
    state = device.fresh().state
    if not found:
        raise Unknown("no sample received")
    if found != {state}:
        raise Failed(f"the samples have state {', '.join(map(str, sorted(found)))}, heartbeats {int(state)}")
    return f"the samples have state {int(state)}, and so have heartbeats"


@either("wraps", "9.5")
def wraps(device: Device) -> str:
    """Angles with the flag WRAPS lie in [-pi, pi)."""
    chosen = [channel for channel in device.channels if channel.flags & Flag.WRAPS][: 3 if device.probe.line.bus else 8]
    if not chosen:
        raise NotApplicable("no channel has the flag WRAPS")
    told, _ = _within(device, chosen, RATE, LOADED)
    device.start_streams(1)
    device.probe.listen(WATCHED)
    samples = instants(device, told, tuple(chosen))
    if not samples:
        raise Unknown("no sample received")
    for at, sample in samples.items():
        for channel, raw in zip(chosen, split_sample(sample, tuple(chosen)), strict=True):
            value = float(np.frombuffer(raw, channel.raw.dtype)[0]) * channel.scale + channel.offset
            if not -math.pi - ROUNDED <= value < math.pi + ROUNDED:
                raise Failed(f"{channel.name} at {at} is {value:.6g} rad")
    return f"{len(samples)} samples of {counted(len(chosen), 'channel')}"


# -- what is in the samples -------------------------------------------------------------------------------------------


def instants(device: Device, told: Configured, chosen: tuple[Channel, ...]) -> dict[int, bytes]:
    """The samples of a stream that came whole, by index, or by counter on CAN."""
    if device.probe.line.bus:
        return bus_samples(device, told, chosen)
    size, decimation = sum(map(width, chosen)), told.asked.decimation
    if any(len(block.data) != block.n * size for block in device.blocks(told.asked.stream)):
        raise Unknown("frames do not have as many records as they say: see stream.frame-fields")
    return {
        block.index + k * decimation: block.data[k * size : (k + 1) * size]
        for block in device.blocks(told.asked.stream)
        for k in range(block.n)
    }


def bus_samples(device: Device, told: Configured, chosen: tuple[Channel, ...]) -> dict[int, bytes]:
    """The samples of a stream on CAN of which all groups came, by number (classic) or index (FD)."""
    fd = device.bus.rates.fd
    layout = sample_layout([width(channel) for channel in chosen], fd, told.reply.block)
    parts: dict[int, dict[int, bytes]] = {}
    size = layout.groups[-1][1]
    for frame in device.probe.stream_frames:
        group = (frame.slot - told.reply.slot) % 32
        if frame.edges or group >= len(layout.groups) or len(frame.data) < layout.used(group):
            continue
        counter = int.from_bytes(frame.data[: layout.counter], "little")
        step = told.asked.decimation if fd else 1
        body = frame.data[layout.counter : layout.used(group)]
        if len(layout.groups) > 1:
            parts.setdefault(counter, {})[group] = body
            continue
        for k in range(layout.samples):
            parts.setdefault(counter + k * step, {})[0] = body[k * size : (k + 1) * size]
    whole = {counter: found for counter, found in parts.items() if len(found) == len(layout.groups)}
    return {counter: b"".join(found[n] for n in sorted(found)) for counter, found in whole.items()}


def by_index(device: Device, told: Configured, chosen: tuple[Channel, ...]) -> dict[int, bytes]:
    """The samples of a stream that came whole, by the low 32 bits of their index."""
    samples, now = instants(device, told, chosen), periods(device, told)
    if not device.probe.line.bus or device.bus.rates.fd:
        return samples
    decimation = told.asked.decimation
    number = now // decimation
    return {(number + _signed16(key - number)) * decimation & MASK: sample for key, sample in samples.items()}


def _signed16(number: int) -> int:
    """A difference of counters of classic CAN."""
    return ((number + (1 << 15)) & 0xFFFF) - (1 << 15)


@either("same-instants", "11.10")
def same_instants(device: Device) -> str:
    """Two streams with the same decimation are sampled at the same instants."""
    forth, _, there, backwards = _both_ways(device)
    first, last = max(min(there), min(backwards)), min(max(there), max(backwards))
    here = {n for n in there if first <= n <= last}
    other = {n for n in backwards if first <= n <= last}
    if here ^ other and any(len(set(steps(sorted(each)))) > 1 for each in (there, backwards)):
        raise Unknown(f"{len(here ^ other)} instants are missing from one of two streams, and the streams have gaps")
    if here ^ other:
        raise Failed(
            f"instants in only one stream, both with decimation {forth.asked.decimation}: {sorted(here ^ other)[:5]}"
        )
    return f"{len(here)} instants from {first} to {last} in both streams"


@either("channel-order", "11.9")
def channel_order(device: Device) -> str:
    """Channels are in the order in which STREAM_SET names them, also in the opposite order."""
    chosen = few(device)
    if len(chosen) < 2:
        raise NotApplicable("the device has only one channel")
    _, _, there, backwards = _both_ways(device)
    common = sorted(set(there) & set(backwards))
    if not common:
        raise Unknown("the two streams have no sample in common")
    differ = False
    for n in common:
        values, reversed_ = split_sample(there[n], chosen), split_sample(backwards[n], chosen[::-1])
        differ = differ or values != reversed_
        for channel, one, other in zip(chosen, values, reversed_[::-1], strict=True):
            if one != other:
                raise Failed(f"{channel.name} at {n} is {one.hex()} in one order, {other.hex()} in the opposite order")
    if not differ:
        raise Unknown("all channels had the same values, so their order is not visible")
    return f"{len(common)} samples of {counted(len(chosen), 'channel')} in both orders: the same values"


def few(device: Device) -> tuple[Channel, ...]:
    """Channels that a slow link carries too; on CAN some of one width, which could be taken for one another."""
    if not device.probe.line.bus:
        return device.channels[:8]
    usual = Counter(map(width, device.channels)).most_common(1)[0][0]
    return tuple(channel for channel in device.channels if width(channel) == usual)[:3]


def split_sample(sample: bytes, chosen: tuple[Channel, ...]) -> list[bytes]:
    """The raw values in a sample of these channels, one by one."""
    found, at = [], 0
    for channel in chosen:
        found.append(sample[at : at + width(channel)])
        at += width(channel)
    return found


Both = tuple[Configured, Configured, dict[int, bytes], dict[int, bytes]]


def _both_ways(device: Device) -> Both:
    """The same channels in both orders, streamed once: how both are configured, and their samples."""
    return device.once("both", lambda: _streamed_both_ways(device))


def _within(device: Device, chosen: Sequence[Channel], rate: float, share: float) -> tuple[Configured, float]:
    """Stream 0 at `rate`, or at a lower one at which it takes no more than `share` of the link; and that rate."""
    told = device.configure(0, ids(chosen), rate, share=ALL)
    for _ in range(SLOWED):
        if told.reply.load <= share:
            break
        rate = device.pwm_hz / told.asked.decimation * share / told.reply.load
        told = device.configure(0, ids(chosen), rate, share=ALL)
    return told, rate


def _streamed_both_ways(device: Device) -> Both:
    chosen = few(device)
    rate = min(RATE, device.pwm_hz / 4)
    forth, rate = _within(device, chosen, rate, HALF)
    back = device.configure(1, ids(chosen[::-1]), rate, share=ALL)
    if forth.asked.decimation != back.asked.decimation:
        raise Unknown(f"the second stream fits only with decimation {back.asked.decimation}")
    device.start_streams(3)
    device.probe.listen(2 * WATCHED)
    there, backwards = instants(device, forth, chosen), instants(device, back, chosen[::-1])
    if not there or not backwards:
        raise Unknown(f"{len(there)} and {len(backwards)} samples received of two streams")
    return forth, back, there, backwards


@either("hall-inputs", "12.7 12.4 12.5")
def hall_inputs(device: Device) -> str:
    """With inputs taken as inverted or exchanged, the code is as by SPEC's table, and no edge is counted."""
    record, channel = device.named("hall_invert_hat"), device.channel_named("hall")
    if record is None or channel is None:
        raise NotApplicable("the device lacks the parameter hall_invert_hat, or the channel hall")
    exchanged = device.named("hall_swap_hat")
    own = int(device.parameter(record).value)
    swap = 0 if exchanged is None else int(device.parameter(exchanged).value)
    first = _codes(device, channel)
    edges = device.fresh().edges
    told = []
    try:
        others = [(s, own ^ 2) for s in range(6) if exchanged and s != swap]
        for s, invert in ((swap, own ^ 7), (swap, own ^ 1), *others):
            require_granted(device.set(record, invert), f"hall_invert_hat = {invert}")
            if exchanged:
                require_granted(device.set(exchanged, s), f"hall_swap_hat = {s}")
            told.append((s, invert, _codes(device, channel)))
        more = (device.fresh().edges - edges) & MASK
    finally:
        device.put_back(record, own)
        if exchanged:
            device.put_back(exchanged, swap)
    last = _codes(device, channel)
    if len(first) != 1 or first != last:
        raise Unknown(f"Hall codes {first} before, {last} after: the shaft must stand")
    pins = next(pins for pins in range(8) if HALL_ROWS[swap][pins ^ own] == first[0])
    for s, invert, codes in told:
        if codes != [due := HALL_ROWS[s][pins ^ invert]]:
            words = f"hall_swap_hat {s}, hall_invert_hat {invert} (was {swap}, {own})"
            raise Failed(f"Hall codes {codes} with {words}; before {first[0]}, due {due}")
    if more:
        raise Failed(f"{counted(more, 'edge')} counted for another hall_invert_hat or hall_swap_hat")
    return f"Hall code {first[0]}; {len(told)} other ways to read the inputs: codes as by the table, no edge counted"


def _codes(device: Device, channel: Channel) -> list[int]:
    """The Hall codes that are streamed now."""
    device.probe.forget()
    told = device.stream((channel,), RATE)
    device.probe.listen(WATCHED / 2)
    found = {raw[0] & 7 for raw in instants(device, told, (channel,)).values()}
    device.stop_streams()
    if not found:
        raise Unknown(f"no sample of {channel.name} received within {WATCHED / 2:g} s")
    return sorted(found)


@check("stop-sends", "11.5")
def stop_sends(device: Device) -> str:
    """STREAM_STOP sends an incomplete block."""
    narrow, dropped = min(device.channels, key=width), _dropped(device)
    told = device.configure(0, [narrow.id], RATE, latency_ms=3000)
    if told.reply.block < max(0.4 * device.pwm_hz / told.asked.decimation, 4):
        raise Unknown(f"a block holds {told.reply.block} samples: it would be full before STREAM_STOP")
    device.start_streams(1)
    device.probe.listen(max(0.2, 2.5 * told.asked.decimation / device.pwm_hz))
    early = len(device.blocks(0))
    device.stop_streams()
    device.probe.until(lambda: bool(device.blocks(0)), WATCHED)
    blocks = device.blocks(0)
    if early:
        raise Unknown("a frame was sent before STREAM_STOP")
    device.require_undropped(dropped)
    if not blocks:
        rate = device.pwm_hz / told.asked.decimation
        raise Failed(f"two samples or more at {rate:g} Hz, then STREAM_STOP: nothing was sent")
    return f"{sum(block.n for block in blocks)} samples, of {told.reply.block} in a block, were sent at STREAM_STOP"


# -- loss -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Overload:
    """A stream that was not read for a while: its frames, and what the device counted meanwhile."""

    words: str
    decimation: int
    block: int
    frames: list[Block]
    dropped: tuple[int, int]
    """At least, and at most, until the last of the frames."""
    damaged: int

    @property
    def jumps(self) -> list[tuple[Block, Block, int]]:
        """Neighbours between which samples are missing, and how many blocks they make, rounded up."""
        found = []
        for before, after in pairwise(self.frames):
            lacking = (after.index - before.index) % (1 << 32) - before.n * self.decimation
            if lacking and not after.flags & DISCONTINUITY:
                found.append((before, after, -(-lacking // (self.decimation * self.block))))
        return found

    @property
    def lost_by_seq(self) -> int:
        """Frames that are missing by seq."""
        return sum((after.seq - before.seq - 1) & 0xFFFF for before, after in pairwise(self.frames))


def overload(device: Device) -> Overload:
    """As many channels as fit, as often as the link carries, and not read for a while. Raises Unknown."""
    if "overload" not in device.kept:
        try:
            device.kept["overload"] = _overload(device)
        except Unknown as nothing:
            device.kept["overload"] = nothing
    found = device.kept["overload"]
    if isinstance(found, Unknown):
        raise found
    assert isinstance(found, Overload)
    return found


def _overload(device: Device) -> Overload:
    told, rate = _heaviest(device)
    probe = device.probe
    damaged, before = probe.line.damaged, _dropped(device)
    probe.forget()
    device.start_streams(1)
    device.streamed(0, 0.2)
    for seconds in UNREAD:
        probe.pause(seconds)
        _settle(device)
        if _dropped(device) != before:
            break
    probe.listen(SETTLE)
    beat = device.fresh()
    frames = _up_to(device, beat.tick)
    counted, most = ((now - before) & MASK for now in (beat.tx_dropped, _dropped(device)))
    device.stop_streams()
    if not counted and not any((b.seq - a.seq - 1) & 0xFFFF for a, b in pairwise(frames)) and not _jumped(frames, told):
        raise Unknown(f"nothing was dropped in {UNREAD[-1]:g} s without reading the link, {rate}")
    words = f"{rate}, {len(frames)} frames"
    damaged = probe.line.damaged - damaged
    return Overload(words, told.asked.decimation, told.reply.block, frames, (counted, most), damaged)


def _up_to(device: Device, tick: int) -> list[Block]:
    """The frames of stream 0 up to the first that is not older than `tick`: a slow link has a long queue."""

    def there() -> bool:
        blocks = device.blocks(0)
        return bool(blocks) and signed(blocks[-1].tick - tick) >= 0

    device.probe.until(there, MOST_QUEUED)
    blocks = device.blocks(0)
    newer = [n for n, block in enumerate(blocks, 1) if signed(block.tick - tick) >= 0]
    return blocks[: newer[0]] if newer else blocks


def _jumped(frames: list[Block], told: Configured) -> bool:
    return any(b.index != (a.index + a.n * told.asked.decimation) & MASK for a, b in pairwise(frames))


def _heaviest(device: Device) -> tuple[Configured, str]:
    """All channels that fit in a frame, at the highest rate at which nothing is dropped while the link is read."""
    chosen = device.fitting(device.channels)
    rate = float(device.pwm_hz)
    while True:
        told, rate = _within(device, chosen, rate, LOADED)
        before = _dropped(device)
        device.start_streams(1)
        device.streamed(0, 0.3)
        _settle(device)
        dropped = _dropped(device) != before
        device.stop_streams()
        if not dropped:
            told = device.configure(0, ids(chosen), rate, share=ALL)
            actual = device.pwm_hz / told.asked.decimation
            return told, f"{counted(len(chosen), 'channel')} ({told.reply.sample_bytes} bytes) at {actual:g} Hz"
        if told.asked.decimation >= SLOWEST:
            raise Unknown(f"the link drops frames even at {device.pwm_hz / told.asked.decimation:g} Hz")
        rate = device.pwm_hz / (2 * told.asked.decimation)


def _settle(device: Device) -> None:
    """Read what has waited, until heartbeats are no older than the clock."""
    probe = device.probe
    for _ in range(20):
        now = probe.tick()[1]
        probe.listen(0.12)
        beats = probe.beats
        if beats and beats[-1][1].tick >= now:
            return
    raise Unknown("heartbeats stay delayed")


def _dropped(device: Device) -> int:
    return device.fresh().tx_dropped


@check("seq-counts-dropped", "11.34")
def seq_counts_dropped(device: Device) -> str:
    """Where samples are missing, seq has a gap."""
    found = overload(device)
    for before, after, _ in found.jumps:
        if after.seq == (before.seq + 1) & 0xFFFF:
            raise Failed(
                f"the index jumps from {before.index} to {after.index}, but seq goes from {before.seq} to {after.seq}"
            )
    gaps = len(found.jumps)
    if not gaps:
        raise Unknown("no sample is missing")
    return f"{found.words}: {gaps} gaps in both index and seq, {found.lost_by_seq} frames missing"


@check("tx-dropped", "11.46 11.47")
def tx_dropped(device: Device) -> str:
    """Frames lost by seq are those in tx_dropped plus those received damaged."""
    found = overload(device)
    by_seq, by_index = found.lost_by_seq, sum(blocks for _, _, blocks in found.jumps)
    lost = by_seq if by_seq else by_index
    by = "seq" if by_seq else "index"
    least, most = found.dropped
    told = f"{least}" if least == most else f"{least} to {most}"
    words = f"{found.words}: {lost} lost by {by}, tx_dropped {told}, {found.damaged} received damaged"
    if least <= lost <= most + found.damaged:
        return words
    if found.damaged and lost > most:
        raise Unknown(f"{words}: the link loses bytes")
    raise Failed(words)


@check("overrun-flag", "11.46")
def overrun_flag(device: Device) -> str:
    """The first frame after a dropped one has OVERRUN, and no other has."""
    found = overload(device)
    behind = {after.place for _, after, _ in found.jumps}
    flagged = {block.place for block in found.frames[1:] if block.flags & OVERRUN}
    words = f"{found.words}: {len(behind)} after a gap, {len(flagged)} with OVERRUN"
    if not behind:
        raise Unknown("no frame is missing")
    if found.damaged and flagged < behind:
        raise Unknown(f"{words}; {found.damaged} received damaged")
    if behind != flagged:
        raise Failed(words)
    return words


# -- edges ------------------------------------------------------------------------------------------------------------


@check("edges-before-samples", "11.43")
def edges_before_samples(device: Device) -> str:
    """Every edge comes before any sample taken at or after it."""
    device.require(Feature.EDGES)
    if device.level >= MOTION:
        raise NotApplicable("checked while turning: motion.edges-before-samples")
    device.configure_edges(0)
    told = device.configure(1, ids(device.channels[:1]), RATE, latency_ms=10)
    device.start_streams(3)
    device.probe.listen(0.5)
    return edges_ahead(device, told, "turn the shaft by hand, or use level 4")


def edges_ahead(device: Device, told: Configured, advice: str) -> str:
    """Evidence that no edge came after a sample that is not older; `told`: how the samples are configured.

    Raises Failed, and Unknown with this advice.
    """
    newest: int | None = None
    seen = 0
    period = told.asked.decimation * device.ticks_per_period
    for block in device.blocks():
        if not block.edges:
            newest = (block.tick + (block.n - 1) * period) & MASK
            continue
        for (tick,) in struct.iter_unpack("<I4x", block.data):
            late = 0 if newest is None else (newest - tick) & MASK
            if newest is not None and late < 1 << 31:
                raise Failed(f"an edge with tick {tick} came after a sample with tick {newest}")
            seen += newest is not None
    if not seen:
        raise Unknown(f"no edges received: {advice}")
    return f"{seen} edges, each before the samples taken at or after it"

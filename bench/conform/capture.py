"""Level 2, third part: requests for captures, and captures that begin at once. Chapter 19 of SPEC."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from zlib import crc32

import numpy as np

from bench.conform.captured import (
    NEVER,
    Captured,
    arm,
    armed,
    between,
    captured,
    fitting_records,
    frozen,
    give_up,
    place_of,
    require_capture,
    status,
    taken,
)
from bench.conform.checks import Group
from bench.conform.data import by_index, few, split_sample
from bench.conform.device import EDGE_BYTES, Device, ids, width
from bench.conform.levels import STREAMS
from bench.conform.probe import accepted, read, refusal
from bench.conform.streams import absent
from bench.conform.verdicts import Failed, Unknown
from protocol.codes import CaptureState, CaptureTrigger, ErrorCode, EventCode, Feature, MessageType
from protocol.descriptor import Channel
from protocol.messages import BlobRead, CaptureArm, CaptureReply

check = Group("capture", STREAMS)

OF_BLOB = ("first", "records", "edges", "edges_lost", "first_edge", "size", "crc", "tick", "index", "faults")
"""Fields of a CaptureReply that are 0 while nothing is FROZEN."""
STREAMED = 800.0  # Hz of the samples beside a capture
BESIDE = 0.05  # s that the stream runs before and after
OTHER_DECIMATION = 3  # times that of the first capture
COMMON = 12  # samples that a capture and a stream have in common


@check("stands-by", "19.15 19.26 5.20")
def stands_by(device: Device) -> str:
    """After OFF the device waits for a fault by itself; blob 1 is not there, and nothing is told of it."""
    told = require_capture(device)
    words = (
        f"{told.state.name} with trigger {told.trigger.name}, {told.before} records before and {told.after} after it"
    )
    if (told.state, told.trigger) != (CaptureState.ARMED, CaptureTrigger.FAULT):
        raise Failed(words)
    if not told.number or not told.channels or not told.decimation or not told.before > told.after > 0:
        raise Failed(f"{words}: number {told.number}, decimation {told.decimation}, channels {told.channels}")
    by_id = {channel.id: width(channel) for channel in device.channels}
    size = sum(by_id.get(number, 0) for number in told.channels)
    if set(told.channels) - by_id.keys() or told.sample_bytes != size:
        raise Failed(f"{words}: channels {told.channels}, sample_bytes {told.sample_bytes}, by the descriptor {size}")
    if not size * (told.before + told.after) <= told.room:
        raise Failed(f"{words}: records of {size} bytes do not fit in {told.room} bytes")
    _nothing_told(told)
    return f"{words}; {_no_blob(device)}"


def _nothing_told(told: CaptureReply) -> None:
    for name in OF_BLOB:
        if getattr(told, name):
            raise Failed(f"{name} is {getattr(told, name)} in {told.state.name}")


def _no_blob(device: Device) -> str:
    return device.probe.refused(ErrorCode.UNKNOWN_ID, 1, MessageType.BLOB_READ, BlobRead(1, 16, 0).pack())


def _wrong(device: Device) -> list[tuple[str, dict[str, object], ErrorCode, float]]:
    """What a CAPTURE_ARM may have wrong, in the order in which SPEC looks at it, with the refusal that is due."""
    first, other = device.channels[0], absent(device)
    room = status(device).room
    edges = 2 if room > 4 * EDGE_BYTES else 0
    fits = (room - edges * EDGE_BYTES) // width(first)
    by_channel = CaptureTrigger.CHANGES
    rows: list[tuple[str, dict[str, object], ErrorCode, float]] = [
        ("trigger 11", {"trigger": 11}, ErrorCode.BAD_VALUE, 11),
        ("decimation 0", {"decimation": 0}, ErrorCode.BAD_VALUE, 0),
        ("after 0", {"before": 1, "after": 0}, ErrorCode.BAD_VALUE, 0),
        ("level NaN", {"level": math.nan}, ErrorCode.BAD_VALUE, math.nan),
        ("no channels", {"channels": ()}, ErrorCode.BAD_VALUE, 0),
        (f"channel {other}", {"channels": (first.id, other)}, ErrorCode.UNKNOWN_ID, other),
        (f"channel {first.id} twice", {"channels": (first.id, first.id)}, ErrorCode.BAD_VALUE, first.id),
        (f"the trigger's channel {other}", {"trigger": by_channel, "channel": other}, ErrorCode.UNKNOWN_ID, other),
    ]
    if not device.offers(Feature.EDGES):
        rows.append(("a trigger of edges", {"trigger": CaptureTrigger.PULSE}, ErrorCode.NOT_SUPPORTED, 10))
    many: dict[str, object] = {"before": fits, "after": 1, "edges": edges}
    rows.append((f"{fits + 1} records beside {edges} edges", many, ErrorCode.DOES_NOT_FIT, float(np.float32(fits))))
    return rows


@check("arm-refusals", "19.1 19.2 19.5 19.6 19.7 19.8 19.9 19.10 19.11 19.12 19.13")
def arm_refusals(device: Device) -> Iterator[str]:
    """Each error in CAPTURE_ARM is refused with its code and detail, and what was armed stays."""
    require_capture(device)
    plain = CaptureArm(CaptureTrigger.NOW, channels=ids(device.channels[:1]))
    before = status(device)
    for words, wrong, code, detail in _wrong(device):
        yield refusal(arm(device, replace(plain, **wrong)), code, detail, words)  # type: ignore[arg-type]
    huge = replace(plain, level=-math.inf)
    yield refusal(arm(device, huge), ErrorCode.BAD_VALUE, -math.inf, "level -inf")
    if device.offers(Feature.EDGES):
        edges = replace(plain, trigger=CaptureTrigger.ILLEGAL, before=0xFFFFFFFF)
        yield refusal(arm(device, edges), ErrorCode.DOES_NOT_FIT, None, "2^32 records until an illegal edge")
    if (now := status(device)) != before:
        raise Failed(f"after refusals the capture is number {now.number} in {now.state.name}, not {before.number}")


@check("arm-order", "19.1")
def arm_order(device: Device) -> Iterator[str]:
    """Of two errors in CAPTURE_ARM, the one that is checked first is reported."""
    require_capture(device)
    plain = CaptureArm(CaptureTrigger.NOW, channels=ids(device.channels[:1]))
    rows = _wrong(device)
    for at, (words, wrong, code, detail) in enumerate(rows):
        for then, worse, _, _ in rows[at + 1 :]:
            if wrong.keys() & worse.keys():
                continue
            both = replace(plain, **(wrong | worse))  # type: ignore[arg-type]
            yield refusal(arm(device, both), code, detail, f"{words} and {then}")


@check("off-ignores-the-rest", "19.3 19.15")
def off_ignores_the_rest(device: Device) -> str:
    """OFF is not refused, whatever the rest of the request says."""
    require_capture(device)
    other = absent(device)
    request = CaptureArm(CaptureTrigger.OFF, 0, 0, 0xFFFFFFFF, 0, math.nan, other, 0xFFFF, (other, other))
    words = accepted(arm(device, request), "OFF with decimation 0, after 0, level NaN and unknown channels")
    if (told := status(device)).trigger != CaptureTrigger.FAULT:
        raise Failed(f"{words}; it then waits for {told.trigger.name}")
    return words


@check("numbers", "19.14 3.13")
def numbers(device: Device) -> str:
    """Each CAPTURE_ARM begins anew with a number of its own, and says so; a repeated one is not executed again."""
    require_capture(device)
    chosen = ids(device.channels[:2])
    records = fitting_records(device, device.channels[:2])
    state, found = device.fresh().state, []
    for n in range(4):
        request = CaptureArm(
            CaptureTrigger.ABOVE, 0, n + 1, records - 1, 1, NEVER, chosen[0], channels=chosen[: 1 + n % 2]
        )
        frame = device.probe.frame(MessageType.CAPTURE_ARM, request.pack())
        answer = device.probe.ask_frame(frame)
        told = read(answer.frame, CaptureReply)
        asked = (request.trigger, request.decimation, request.before, request.after, request.channels)
        if (told.trigger, told.decimation, told.before, told.after, told.channels) != asked:
            raise Failed(f"the reply describes {told}, asked for was {request}")
        if told.state != CaptureState.ARMED:
            raise Failed(f"a capture whose trigger cannot come is {told.state.name}")
        _nothing_told(told)
        if device.probe.ask_again(frame).frame != answer.frame or status(device).number != told.number:
            raise Failed(f"a repeated CAPTURE_ARM was executed again: the capture was number {told.number}")
        found.append(told.number)
    if 0 in found or len(set(found)) < len(found):
        raise Failed(f"four captures have numbers {found}")
    if (now := device.fresh().state) != state:
        raise Failed(f"the state was {state.name}, after CAPTURE_ARM it is {now.name}")
    return f"four captures have numbers {', '.join(map(str, found))}"


@check("as-streamed", "19.24 19.25 19.19 19.22 19.26")
def as_streamed(device: Device) -> Iterator[str]:
    """The records of a capture are the samples that a stream has at the same indices, byte for byte."""
    require_capture(device)
    chosen = few(device)
    room = fitting_records(device, chosen)
    for times, order in ((1, chosen), (OTHER_DECIMATION, chosen[::-1])):
        told = device.configure(0, ids(chosen), STREAMED)
        every = 1 << (told.asked.decimation - 1).bit_length()  # what has many divisors
        told = device.configure(0, ids(chosen), device.pwm_hz / every)
        dense = _dense(told.asked.decimation, room)
        decimation, records = times * dense, min(room, COMMON * told.asked.decimation // dense)
        device.start_streams(1)
        device.probe.listen(BESIDE)
        began = device.probe.tick()[0]
        found = captured(device, CaptureArm(CaptureTrigger.NOW, 0, decimation, 0, records, channels=ids(order)))
        device.probe.listen(BESIDE)
        device.stop_streams()
        samples = by_index(device, told, chosen)
        reply = found.reply
        if words := place_of(reply, told.reply.tick0, device.ticks_per_period):
            raise Failed(words)
        if crc32(found.blob) != reply.crc:
            raise Failed(
                f"crc is {reply.crc:08x}, that of the {len(found.blob)} bytes of blob 1 {crc32(found.blob):08x}"
            )
        if reply.records != reply.first + reply.after or reply.channels != ids(order):
            raise Failed(
                f"{reply.records} records of channels {reply.channels}, asked for were {records} of {ids(order)}"
            )
        if not between(began, reply.tick, device.probe.tick()[1]):
            raise Failed(f"the trigger's record has tick {reply.tick}, the request came at {began}")
        yield _same(found, samples, chosen)
        device.probe.forget()


def _dense(decimation: int, records: int) -> int:
    """The least divisor of a stream's decimation with which so many records span COMMON samples of it, or itself."""
    return next(
        (n for n in range(1, decimation) if decimation % n == 0 and n * records >= COMMON * decimation), decimation
    )


def _same(found: Captured, samples: dict[int, bytes], chosen: tuple[Channel, ...]) -> str:
    common = sorted(found.records.keys() & samples.keys())
    if len(common) < 2:
        raise Unknown(f"{len(common)} of {len(found.records)} records have a streamed sample of the same index")
    for index in common:
        streamed = dict(zip(ids(chosen), split_sample(samples[index], chosen), strict=True))
        for channel, raw in zip(found.channels, split_sample(found.records[index], found.channels), strict=True):
            if raw != streamed[channel.id]:
                raise Failed(
                    f"{channel.name} at index {index} is {raw.hex()} in the capture, {streamed[channel.id].hex()} "
                    f"in the stream"
                )
    if len({found.records[index] for index in common}) == 1:
        raise Unknown("all records are the same, so their order is not visible")
    decimation = found.reply.decimation
    return f"{len(common)} of {len(found.records)} records every {decimation} periods: as streamed"


# -- what is FROZEN ---------------------------------------------------------------------------------------------------


@check("held", "19.17 19.4 19.22 19.14 5.21 5.22 5.23")
def held(device: Device) -> Iterator[str]:
    """What is FROZEN stays as it is, however it is read, until OFF; another capture is refused with its number."""
    require_capture(device)
    chosen = device.channels[:2]
    request = CaptureArm(CaptureTrigger.NOW, 0, 1, 0, fitting_records(device, chosen, 60), channels=ids(chosen))
    told = frozen(device, armed(device, request))
    found = taken(device, told)
    yield refusal(arm(device, request), ErrorCode.BUSY, told.number, "CAPTURE_ARM in FROZEN")
    wrong = replace(request, decimation=0, channels=())
    yield refusal(arm(device, wrong), ErrorCode.BUSY, told.number, "CAPTURE_ARM with decimation 0 in FROZEN")
    eleven = replace(request, trigger=CaptureTrigger(11))
    yield refusal(arm(device, eleven), ErrorCode.BAD_VALUE, 11, "CAPTURE_ARM with trigger 11 in FROZEN")
    device.probe.hello()
    device.probe.listen(0.2)
    if device.read_blob(1, 7) != found.blob or (now := status(device)) != told:
        raise Failed(f"it was {told}, with {len(found.blob)} bytes; then it is {now}, or has other bytes")
    past = BlobRead(1, 16, told.size + 1).pack()
    yield device.probe.refused(ErrorCode.OUT_OF_RANGE, told.size, MessageType.BLOB_READ, past)
    accepted(give_up(device), "OFF in FROZEN")
    if (now := status(device)).number == told.number or now.state != CaptureState.ARMED:
        raise Failed(f"after OFF the capture is number {now.number} in {now.state.name}; {told.number} was given up")
    _nothing_told(now)
    yield f"{len(found.blob)} bytes read twice: the same; after OFF: {_no_blob(device)}"


@check("told", "19.23")
def told_when_frozen(device: Device) -> str:
    """A capture of which all records have been taken is FROZEN within a second, and an EVENT tells its number."""
    require_capture(device)
    chosen = device.channels[:1]
    for _ in range(2):  # a device may drop one event
        since = len(device.events(EventCode.CAPTURED))
        request = CaptureArm(CaptureTrigger.NOW, 0, 1, 0, fitting_records(device, chosen), channels=ids(chosen))
        number = (begun := armed(device, request)).number
        try:
            frozen(device, begun)
        except Unknown as late:
            raise Failed(str(late)) from None
        device.fresh()
        give_up(device)
        told = [(event.arg, event.detail) for event in device.events(EventCode.CAPTURED)[since:]]
        if told == [(number, CaptureTrigger.NOW)]:
            return f"EVENT CAPTURED with number {number} and trigger NOW"
        if told:
            break
    raise Failed(f"capture {number} is FROZEN by NOW; EVENTs CAPTURED (number, trigger): {told or 'none, twice'}")

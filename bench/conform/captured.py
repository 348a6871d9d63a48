"""Captures as checks need them: armed, awaited, read whole, and taken apart. Chapter 19 of SPEC."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.conform.data import signed, split_sample
from bench.conform.device import EDGE_BYTES, Device, require_granted, width
from bench.conform.probe import Answer, read
from bench.conform.verdicts import Ended, Failed, Unknown
from protocol.codes import CaptureState, CaptureTrigger, Feature, MessageType
from protocol.descriptor import Channel
from protocol.messages import CaptureArm, CaptureReply, CaptureStatus

FREEZES = 1.0  # s within which a capture is FROZEN once its last record has been taken
PART = 240  # bytes of blob 1 that are asked for at once
RECORDS = 400  # of a capture that is looked at, where there is room
NEVER = 1e30  # a level that no channel reaches


@dataclass(frozen=True)
class Captured:
    """A capture that was read: how the device describes it, its channels, and blob 1."""

    reply: CaptureReply
    channels: tuple[Channel, ...]
    blob: bytes

    @property
    def records(self) -> dict[int, bytes]:
        """The records by index, the trigger's with the index that the device tells."""
        size, first = self.reply.sample_bytes, self.reply.index - self.reply.first * self.reply.decimation
        return {
            (first + k * self.reply.decimation) & 0xFFFFFFFF: self.blob[k * size : (k + 1) * size]
            for k in range(self.reply.records)
        }

    @property
    def edges(self) -> list[bytes]:
        """The records of edges."""
        begin = self.reply.records * self.reply.sample_bytes
        return [self.blob[at : at + EDGE_BYTES] for at in range(begin, len(self.blob), EDGE_BYTES)]

    def values(self, channel: Channel) -> NDArray[np.float64]:
        """A channel's physical values, (records,)."""
        at = self.channels.index(channel)
        raw = b"".join(split_sample(record, self.channels)[at] for record in self.records.values())
        return physical(channel, raw)


def physical(channel: Channel, raw: bytes) -> NDArray[np.float64]:
    """The values in some raw ones, in the channel's unit."""
    return np.frombuffer(raw, channel.raw.dtype).astype(np.float64) * channel.scale + channel.offset


def status(device: Device) -> CaptureReply:
    """Where the capture is. Raises Unknown."""
    return device.probe.get(CaptureStatus(), CaptureReply)


def look_for_held(device: Device) -> None:
    """Remember whether a capture is held that a host may want to read."""
    if device.offers(Feature.CAPTURE):
        with suppress(Ended):
            told = status(device)
            device.held_capture = told.number if told.state == CaptureState.FROZEN else 0


def leave_waiting(device: Device) -> None:
    """Leave the device waiting for a fault, as after boot, unless a host's capture is held. Raises Ended."""
    if device.offers(Feature.CAPTURE) and not device.held_capture:
        give_up(device)


def require_capture(device: Device) -> CaptureReply:
    """Where the capture is, once nothing is held. Raises NotApplicable, and Unknown where a host's capture is held."""
    device.require(Feature.CAPTURE)
    if device.held_capture:
        raise Unknown(f"capture {device.held_capture} was held when this began: read it, or give it up")
    give_up(device)
    return status(device)


def arm(device: Device, request: CaptureArm) -> Answer:
    """Send a CAPTURE_ARM."""
    return device.probe.ask(MessageType.CAPTURE_ARM, request.pack())


def give_up(device: Device) -> Answer:
    """Give up what is held."""
    return arm(device, CaptureArm(CaptureTrigger.OFF))


def fitting_records(device: Device, channels: Sequence[Channel], most: int = RECORDS) -> int:
    """Records of these channels that the memory holds beside no edges, `most` at most. Raises Unknown."""
    records = min(most, status(device).room // sum(map(width, channels)))
    if records < 2:
        raise Unknown(f"there is room for {records} records of {len(channels)} channels")
    return records


def armed(device: Device, request: CaptureArm) -> CaptureReply:
    """Arm this; what the reply says. Raises Unknown."""
    return read(require_granted(arm(device, request), f"CAPTURE_ARM {request.trigger.name}").frame, CaptureReply)


def frozen(device: Device, begun: CaptureReply) -> CaptureReply:
    """Wait until the capture that began like this is FROZEN. Raises Unknown where it is not in time."""
    seconds = FREEZES + (begun.before + begun.after) * begun.decimation / device.pwm_hz
    end = device.probe.now() + seconds
    while (now := status(device)).state != CaptureState.FROZEN:
        if device.probe.now() > end:
            raise Unknown(f"{begun.trigger.name}: the capture is {now.state.name} after {seconds:.1f} s")
        device.probe.listen(0.02)
    return now


def taken(device: Device, reply: CaptureReply) -> Captured:
    """Read what is FROZEN. Raises Unknown, Failed where it is of another length than the device tells."""
    blob = device.read_blob(1, PART)
    by_id = {channel.id: channel for channel in device.channels}
    if set(reply.channels) - by_id.keys():
        raise Failed(f"the capture has channels {reply.channels}, which the descriptor has not")
    found = Captured(reply, tuple(by_id[number] for number in reply.channels), blob)
    size = sum(map(width, found.channels))
    told = reply.records * reply.sample_bytes + EDGE_BYTES * reply.edges
    if not len(blob) == reply.size == told or reply.sample_bytes != size:
        raise Failed(
            f"blob 1 has {len(blob)} bytes, size is {reply.size}, {reply.records} records of {reply.sample_bytes} "
            f"({size} by the descriptor) and {reply.edges} edges make {told}"
        )
    return found


def captured(device: Device, request: CaptureArm) -> Captured:
    """Arm, wait, read, and give up. Raises Unknown, Failed."""
    found = taken(device, frozen(device, armed(device, request)))
    require_granted(give_up(device), "CAPTURE_ARM OFF")
    return found


def place_of(told: CaptureReply, tick0: int, ticks_per_period: int) -> str:
    """What is wrong with the tick or the index of the trigger's record, in words; empty if nothing."""
    period, off = divmod(told.tick - tick0, ticks_per_period)
    if off or period & 0xFFFFFFFF != told.index:
        return f"tick {told.tick} is {off} ticks after period {period}, index is {told.index}"
    return f"index {told.index} is not divisible by {told.decimation}" if period % told.decimation else ""


def between(first: int, tick: int, last: int) -> bool:
    """Whether a tick lies between two others, the low 32 bits of all of them."""
    return signed(tick - first) >= 0 and signed(last - tick) >= 0

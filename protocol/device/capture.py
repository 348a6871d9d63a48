"""Captures: what is held in the device's memory, frozen by a trigger, and read as blob 1. Chapter 19 of SPEC.md.

There is one at a time; where no host has armed one, it waits for a fault by itself. `protocol.device.ring` holds it,
`protocol.device.triggers` finds the trigger. No I/O, no clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from protocol.descriptor import sample_dtype
from protocol.device.app import Identity
from protocol.device.records import Samples, check_channels, made
from protocol.device.ring import EDGE_BYTES, Blob, Ring, Size
from protocol.device.triggers import BY_CHANNEL, BY_EDGE, ChannelTrigger, EdgeTrigger
from protocol.errors import Refused
from protocol.messages import CaptureArm, CaptureReply, CaptureState, CaptureTrigger, ErrorCode, Fault, Feature
from protocol.signals import Flag, Signal
from protocol.streams import TickReference

UNASKED_SECONDS = 0.25  # that a capture which waits for a fault by itself holds at most
UNASKED_AFTER = 5  # of its records one in so many is taken after the fault
UNASKED_EDGES = 1024  # for which it keeps room at most,
UNASKED_SHARE = 16  # in one part of so many of the memory


class Capture:
    """The captures of one device.

    Args:
        identity: of the device; `capture_bytes` is the memory.
        channels: all of the device's, in the order of a sample's fields.
        unasked: names of the channels of a capture that waits for a fault by itself; none = as many as suffice.
        faults: returns those that are latched now.
    """

    def __init__(
        self, identity: Identity, channels: Sequence[Signal], unasked: Sequence[str], faults: Callable[[], Fault]
    ) -> None:
        self.state = CaptureState.OFF
        self.number = 0
        """Of the capture that waits or is held; 0 in OFF."""
        self.trigger = CaptureTrigger.OFF
        """As armed; FAULT once a fault was it."""
        self.channels: frozenset[str] = frozenset()
        """Names of the channels that it needs, none once it is FROZEN."""
        self.news = False
        """A capture has become FROZEN, and nobody has been told yet."""
        self._identity = identity
        self._by_id = {channel.id: channel for channel in channels}
        self._dtype = sample_dtype(channels)
        self._faults = faults
        self._armed = 0  # captures since boot
        self._edges = 0  # since boot
        self._unasked = self._make_unasked(channels, unasked)
        self._begin(self._unasked)

    @property
    def waiting(self) -> bool:
        """Whether it takes samples."""
        return self._ring is not None

    @property
    def blob(self) -> bytes | None:
        """Blob 1; None while the state is not FROZEN."""
        return self._frozen.data if self._frozen else None

    # -- what a host asks -------------------------------------------------------------------------------------------

    def arm(self, request: CaptureArm, tx_max: int) -> CaptureReply:
        """Carry out CAPTURE_ARM and describe the new capture; Refused, nothing changed, if it cannot be done."""
        if request.trigger not in list(CaptureTrigger):
            raise Refused(f"no trigger {request.trigger}", ErrorCode.BAD_VALUE, request.trigger)
        if request.trigger == CaptureTrigger.OFF:
            self._begin(self._unasked)
        else:
            self._check(request)
            self._begin(request)
        return self.describe(tx_max)

    def describe(self, tx_max: int) -> CaptureReply:
        """Return where the capture is, with as many ids as fit."""
        asked, frozen = self._asked, self._frozen
        return CaptureReply(
            state=self.state,
            trigger=self.trigger,
            number=self.number,
            decimation=asked.decimation if asked else 0,
            sample_bytes=self._bytes(asked.channels) if asked else 0,
            before=asked.before if asked else 0,
            after=asked.after if asked else 0,
            first=frozen.first if frozen else 0,
            records=frozen.records if frozen else 0,
            edges=frozen.edges if frozen else 0,
            edges_lost=frozen.edges_lost if frozen else 0,
            first_edge=frozen.first_edge & 0xFFFFFFFF if frozen else 0,
            size=len(frozen.data) if frozen else 0,
            crc=frozen.crc if frozen else 0,
            room=self._identity.capture_bytes,
            tick=frozen.tick if frozen else 0,
            index=frozen.index & 0xFFFFFFFF if frozen else 0,
            faults=self._at_trigger if frozen else Fault(0),
            channels=asked.channels[: (tx_max - CaptureReply.FIXED_BYTES) // 2] if asked else (),
        )

    def _check(self, request: CaptureArm) -> None:
        """Refuse the first of several errors, in the order of SPEC.md."""
        if self._frozen:
            raise Refused(f"capture {self.number} is held", ErrorCode.BUSY, self.number)
        for name, value in (("decimation", request.decimation), ("after", request.after)):
            if not value:
                raise Refused(f"{name} 0", ErrorCode.BAD_VALUE, 0)
        if not math.isfinite(request.level):
            raise Refused(f"level {request.level}", ErrorCode.BAD_VALUE, request.level)
        check_channels(request.channels, self._by_id)
        if request.trigger in BY_CHANNEL and request.channel not in self._by_id:
            raise Refused(f"no channel {request.channel}", ErrorCode.UNKNOWN_ID, request.channel)
        if request.trigger in BY_EDGE and not self._identity.features & Feature.EDGES:
            raise Refused(f"no trigger {request.trigger.name}", ErrorCode.NOT_SUPPORTED, request.trigger)
        fits = self._fits(request.channels, request.edges)
        if request.before + request.after > fits:
            raise Refused(f"{request.before + request.after} records", ErrorCode.DOES_NOT_FIT, fits)

    def _bytes(self, ids: Sequence[int]) -> int:
        """Return the bytes of a record of these channels."""
        return sum(np.dtype(self._by_id[number].raw.dtype).itemsize for number in ids)

    def _fits(self, ids: Sequence[int], edges: int) -> int:
        """Return how many records of these channels fit beside so many edges."""
        return max(0, (self._identity.capture_bytes - EDGE_BYTES * edges) // self._bytes(ids))

    def _make_unasked(self, channels: Sequence[Signal], names: Sequence[str]) -> CaptureArm | None:
        """Return what is armed where nobody asks; None if there is no memory for it."""
        identity, edges = self._identity, 0
        if identity.features & Feature.EDGES:
            edges = min(UNASKED_EDGES, identity.capture_bytes // (UNASKED_SHARE * EDGE_BYTES))
        wanted = round(UNASKED_SECONDS * identity.pwm_hz)
        by_name = {channel.name: channel.id for channel in channels}
        ids = [by_name[name] for name in names]
        if not names:
            usual = [channel.id for channel in channels if not channel.flags & Flag.ON_REQUEST]
            enough = [n for n in range(1, len(usual) + 1) if self._fits(usual[:n], edges) >= wanted]
            ids = usual[: max(enough, default=1)]
        records = min(wanted, self._fits(ids, edges)) if ids else 0
        after = records // UNASKED_AFTER
        if not after:
            return None
        return CaptureArm(CaptureTrigger.FAULT, 0, 1, records - after, after, edges=edges, channels=tuple(ids))

    # -- what happens -----------------------------------------------------------------------------------------------

    def fault(self, tick: int) -> None:
        """A fault has added a bit at this tick."""
        if self.state is CaptureState.ARMED and self._ring:
            self.trigger = CaptureTrigger.FAULT
            self._triggered(self._ring.period_from(tick))

    def state_changed(self, tick: int) -> None:
        """The drive's state has changed at this tick, without a fault."""
        if self.state is CaptureState.ARMED and self._ring and self.trigger is CaptureTrigger.STATE:
            self._triggered(self._ring.period_from(tick))

    def push_edges(self, records: NDArray[np.void], number: int, tick: int) -> None:
        """Take edges in order of time, EDGE_RECORDs, from number `number` since boot on; `tick` is now."""
        self._edges = number + len(records)
        if not self._ring or not len(records):
            return
        ticks = TickReference(tick).unwrap(records["tick"])
        self._ring.push_edges(records, ticks)
        if self._by_edge and self.state is CaptureState.ARMED:
            found = self._by_edge.find(ticks, records["codes"])
            if found is not None:
                self._triggered(self._ring.period_from(found))

    def push_samples(self, index0: int, tick0: int, samples: Samples) -> None:
        """Take samples of consecutive periods: see `DeviceSession.push_samples`."""
        if not self._ring or not len(samples):
            return
        if not self._ring.continues(index0):
            if not self._ring.restart():
                self._freeze(self._ring)
                return
            if self._by_channel:
                self._by_channel.forget()
        if self._by_channel and self.state is CaptureState.ARMED:
            found = self._by_channel.find(made(samples, self._watched))
            if found is not None:
                self._triggered(index0 + found)
        self._ring.push(index0, tick0, samples)
        if self._ring.complete:
            self._freeze(self._ring)

    def _begin(self, request: CaptureArm | None) -> None:
        """Give up what is held, and wait for the trigger of `request`."""
        self._asked = request
        self._frozen: Blob | None = None
        self._at_trigger = Fault(0)
        self._ring: Ring | None = None
        self._by_channel: ChannelTrigger | None = None
        self._by_edge: EdgeTrigger | None = None
        self.news, self.channels = False, frozenset()
        self.state, self.number, self.trigger = CaptureState.OFF, 0, CaptureTrigger.OFF
        if request is None:
            return
        identity, trigger = self._identity, request.trigger
        self.number = self._armed = self._armed % 0xFFFF + 1
        self.state, self.trigger = CaptureState.ARMED, trigger
        channels = [self._by_id[number] for number in request.channels]
        size = Size(request.before, request.after, request.edges, request.decimation)
        period = identity.tick_hz // identity.pwm_hz
        self._ring = Ring(size, self._dtype, channels, period, identity.tick0, self._edges)
        self.channels = frozenset(channel.name for channel in channels)
        if trigger in BY_CHANNEL:
            watched = self._by_id[request.channel]
            self._by_channel = ChannelTrigger(trigger, watched, request.level)
            self._watched = frozenset((watched.name,))
            self.channels |= self._watched
        elif trigger in BY_EDGE:
            self._by_edge = EdgeTrigger(trigger, request.level * identity.tick_hz)
        elif trigger is CaptureTrigger.NOW:
            self._triggered(0)  # the first record that comes

    def _triggered(self, index: int) -> None:
        """The trigger has come in the period `index`."""
        assert self._ring
        self.state, self._at_trigger = CaptureState.TRIGGERED, self._faults()
        self._ring.trigger(index)
        if self._ring.complete:
            self._freeze(self._ring)

    def _freeze(self, ring: Ring) -> None:
        self._frozen = ring.freeze()
        self._ring = None
        self.state, self.channels, self.news = CaptureState.FROZEN, frozenset(), True

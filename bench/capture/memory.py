"""The memory for captures of a node: armed, looked at, read in parts over any outage, given up.

Nothing here energises anything, or changes what the drive does. Waiting is polling: streams go on beside it.
"""

from __future__ import annotations

from collections.abc import Callable
from zlib import crc32

from bench.capture.decode import Captured, streams_of
from bench.capture.trigger import KINDS
from bench.capture.wanted import Wanted, too_large
from bench.device.blob import CAPTURE, part_bytes, read_part
from bench.device.node import Node
from bench.errors import BenchError, DriveFailed, NodeError
from protocol.codes import fault_names
from protocol.descriptor import Channel
from protocol.errors import LinkError, NoReply, Refused
from protocol.messages import (
    CaptureArm,
    CaptureReply,
    CaptureState,
    CaptureStatus,
    CaptureTrigger,
    ErrorCode,
    Hello,
    HelloReply,
)
from protocol.payload import whole_from_wire
from protocol.text import counted

PATIENCE = 30.0
"""s that a link which has gone is waited for."""
COMPLETE = 1.5  # s after its last record within which a capture is FROZEN, and told
_LOOK = 0.1  # s between looks at a capture that waits for its trigger
_AGAIN = 0.2  # s between attempts to reach a drive that does not answer
_LATE, _CATCH_UP = 0.25, 5.0  # s by which streams may be late beside a capture, and in which they are no longer
_MOST_LOAD = 0.9  # of the link by streams, beside which a capture still gets something

Progress = Callable[[int, int], object]
"""Called with the bytes that have come, and with all."""
Until = Callable[[Callable[[], bool], float], bool]
"""Waits until a condition holds, s at most; whether it does."""


class CaptureMemory:
    """That of `node`. Every method raises NodeError where the drive has none, and HbpError of the link."""

    def __init__(self, node: Node, patience: float = PATIENCE) -> None:
        """`patience`: s that a broken link is waited for while a capture is read."""
        if not node.offers_capture:
            raise NodeError(f"node {node.number} holds no captures: it lacks the feature CAPTURE")
        self.node = node
        self.patience = patience
        self._armed: tuple[int, tuple[int, ...]] = 0, ()  # number and channel ids of what was armed from here

    # -- before the trigger -------------------------------------------------------------------------------------

    def status(self) -> CaptureReply:
        """Where the capture is."""
        return self.node.client.request(CaptureStatus(), self.node.number, CaptureReply)

    def arm(self, wanted: Wanted) -> CaptureReply:
        """Arm what is wanted, in place of what was armed. Raises NodeError that says why the drive will not."""
        asked = wanted.request(self.node)
        try:
            reply = self.node.client.request(asked, self.node.number, CaptureReply)
        except Refused as refusal:
            raise self._refusal(refusal, wanted, asked) from None
        self._armed = reply.number, asked.channels
        return reply

    def give_up(self) -> CaptureReply:
        """Give up what is held or armed; the drive then waits for a fault, with channels of its own."""
        return self.node.client.request(CaptureArm(CaptureTrigger.OFF), self.node.number, CaptureReply)

    def disarm(self, number: int) -> None:
        """Give up the capture `number` if it is not complete; what is FROZEN stays, and what a fault freezes."""
        now = self.status()
        if now.number == number and now.state != CaptureState.FROZEN and not self._by_fault(now):
            self.give_up()

    def _by_fault(self, status: CaptureReply) -> bool:
        return status.state == CaptureState.TRIGGERED and status.trigger == CaptureTrigger.FAULT

    def wait(self, number: int, timeout: float, until: Until | None = None) -> CaptureReply | None:
        """Wait until the capture `number` is FROZEN; None where it is not within `timeout` s.

        `until` waits for a condition, None: by polling. Raises NodeError where another one has taken its place.
        """
        client, seen, due = self.node.client, self.status(), 0.0

        def frozen() -> bool:
            nonlocal seen, due
            if client.now() >= due and client.health.down_since is None:
                seen, due = self.status(), client.now() + _LOOK
                if seen.number != number:
                    raise NodeError(
                        f"node {self.node.number} no longer has capture {number}: another host has armed {seen.number}"
                    )
            return seen.state == CaptureState.FROZEN

        return seen if (until or client.wait)(frozen, timeout) else None

    def _refusal(self, refusal: Refused, wanted: Wanted, asked: CaptureArm) -> BenchError:
        node = self.node.number
        match refusal.code:
            case ErrorCode.BUSY:
                return NodeError(held_words(self.node, self.status()) + BUSY_ADVICE)
            case ErrorCode.DOES_NOT_FIT:
                return too_large(self.node, wanted, asked, whole_from_wire(refusal.detail) or 0, self.status().room)
            case _:
                return NodeError(f"node {node} did not arm the capture '{wanted.trigger.text}': {refusal}")

    # -- after it -----------------------------------------------------------------------------------------------

    def frozen(self) -> CaptureReply:
        """What it says of the capture that it holds. Raises NodeError where there is none yet."""
        now = self.status()
        if now.state != CaptureState.FROZEN:
            waits = f"it is {now.state.name}, for {kind_words(now)}"
            raise NodeError(f"node {self.node.number} holds no capture: {waits}; nothing has frozen one since")
        return now

    def read(
        self,
        status: CaptureReply,
        progress: Progress = lambda done, size: None,
        pause: Callable[[float], object] | None = None,
    ) -> Captured:
        """Read the FROZEN capture that `status` describes; the drive still holds it afterwards.

        `pause` lets seconds pass, for the streams beside it (None: by polling). A link that breaks is waited for, and
        the reading goes on where it was. Raises NodeError where it does not come back, or with another capture, and
        DriveFailed where the bytes are not those that the drive has told the CRC of.
        """
        node = self.node
        boot_id, channels = node.identity.boot_id, self._channels(status)
        streams = streams_of(node, status, channels)
        data, part, size = bytearray(), part_bytes(node.client.session.wire), status.size
        pause = pause or node.client.run_for
        while len(data) < size:
            began = node.client.now()
            try:
                reply = read_part(node.client, node.number, CAPTURE, len(data), min(part, size - len(data)))
            except Refused as refusal:
                raise NodeError(f"node {node.number} no longer gives capture {status.number}: {refusal}") from None
            except (LinkError, NoReply) as error:
                self._return(status, boot_id, f"{error}; {left_words(len(data), size)}")
                continue
            if not reply.data or reply.total != size:
                ends = len(data) if reply.total == size else reply.total
                raise DriveFailed(f"capture {status.number} of node {node.number} ends at {ends} of {size} bytes")
            data += reply.data
            progress(len(data), size)
            if len(data) < size:
                self._leave_room(node.client.now() - began, pause)
        if (crc := crc32(data)) != status.crc:
            raise DriveFailed(
                f"capture {status.number} of node {node.number} has CRC {crc:08x}, it told {status.crc:08x}: it is not "
                "what the drive has frozen; it is still there, to be read again"
            )
        return Captured(status, boot_id, *streams, bytes(data))

    def _leave_room(self, took: float, pause: Callable[[float], object]) -> None:
        """After a part that took so many s: what the streams need meanwhile, and until they are no longer late."""
        node, client = self.node, self.node.client
        load = min(node.load, _MOST_LOAD)
        if load > 0.0:
            pause(took * load / (1.0 - load))
        allowed, end = _LATE * node.identity.tick_hz, client.now() + _CATCH_UP
        while client.late(node.number) > allowed and client.now() < end:
            pause(_LOOK)

    def _channels(self, status: CaptureReply) -> tuple[Channel, ...]:
        number, ids = self._armed
        if number != status.number:
            ids = status.channels
        by_id = {channel.id: channel for channel in self.node.descriptor.channels}
        if missing := [each for each in ids if each not in by_id]:
            raise DriveFailed(
                f"node {self.node.number} holds channels with the ids {missing}, which it does not describe"
            )
        return tuple(by_id[each] for each in ids)

    def _return(self, status: CaptureReply, boot_id: int, why: str) -> None:
        """Wait until the drive answers again, and still holds this capture."""
        node, client = self.node, self.node.client
        end = client.now() + self.patience
        while True:
            try:
                client.wait(lambda: False, _AGAIN)
                client.wait(lambda: client.health.down_since is None, max(end - client.now(), 0.0))
                hello = client.request(Hello(nonce=client.nonce()), node.number, HelloReply)
                now = self.status()
                break
            except (LinkError, NoReply) as error:
                if client.now() >= end or (isinstance(error, LinkError) and client.reconnect <= 0.0):
                    advice = "the drive still holds it: --at-fault reads it once the link is back"
                    raise NodeError(f"{why}; {advice}") from None
        if hello.boot_id != boot_id:
            raise NodeError(f"{why}; the drive has rebooted meanwhile, and what it held is gone")
        if (now.state, now.number, now.crc) != (CaptureState.FROZEN, status.number, status.crc):
            raise NodeError(f"{why}; the drive no longer holds capture {status.number}: another host has given it up")


BUSY_ADVICE = " that nobody has fetched: fetch it with --at-fault, or give it up with --discard"


def held_words(node: Node, status: CaptureReply) -> str:
    """What a node holds, in words."""
    at = status.tick / node.identity.tick_hz
    return f"node {node.number} holds capture {status.number} ({frozen_words(status)} at {at:.3f} s)"


def frozen_words(status: CaptureReply) -> str:
    """What has frozen a capture."""
    faults = fault_names(status.faults)
    return f"fault: {', '.join(faults)}" if status.trigger == CaptureTrigger.FAULT and faults else kind_words(status)


def kind_words(status: CaptureReply) -> str:
    """The kind of a capture's trigger."""
    return KINDS.get(status.trigger, str(int(status.trigger)))


def left_words(done: int, size: int) -> str:
    """How much of a capture has not come."""
    return f"{size - done} of {counted(size, 'byte')} ({100 * (size - done) / size:.0f} %) are left"

"""A link in virtual time that loses frames on their way to the host, flips bits, and falls silent for a while."""

from __future__ import annotations

import random
from dataclasses import dataclass

import numpy as np
from cobs import cobs
from virtual_run import WatchedLink

from protocol.canmap.frame import CAN_RECORD, RECORD_BYTES
from protocol.canmap.host import CanWire
from protocol.framing import HEADER_BYTES
from protocol.messages import MessageType
from sim.ports.device import SimulatedDevice

LOSES = (MessageType.DATA, MessageType.EDGES, MessageType.HEARTBEAT)


@dataclass(frozen=True)
class Losses:
    """Shares of frames that are lost, errors a bit, and spans of the link's clock, s, without stream frames."""

    samples: float = 0.0
    edges: float = 0.0
    heartbeats: float = 0.0
    bits: float = 0.0
    outages: tuple[tuple[float, float], ...] = ()


class LosingLink(WatchedLink):
    """Loses what `losses` say, by the dice of `seed`; replies and events always come, and whole."""

    def __init__(self, device: SimulatedDevice, losses: Losses, seed: int = 1) -> None:
        super().__init__(device)
        self.losses, self._dice = losses, random.Random(seed)
        self._noise = np.random.default_rng(seed)

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        data = super().read(timeout, settle)
        can = isinstance(self.wire(), CanWire)
        kinds = ((frame, kind_of(frame, can)) for frame in frames(data, can))
        return b"".join(
            self._damaged(frame, can) if kind in LOSES else frame for frame, kind in kinds if self._comes(kind)
        )

    def _comes(self, kind: int) -> bool:
        losses, now = self.losses, self.clock()
        share = dict(zip(LOSES, (losses.samples, losses.edges, losses.heartbeats), strict=True)).get(kind, 0.0)
        silent = kind in LOSES[:2] and any(first <= now < last for first, last in losses.outages)
        return not silent and self._dice.random() >= share

    def _damaged(self, frame: bytes, can: bool) -> bytes:
        """With bits flipped; a controller drops a CAN frame that has any."""
        flips = self._noise.binomial(8 * len(frame), self.losses.bits) if self.losses.bits else 0
        if not flips:
            return frame
        if can:
            return b""
        damaged = bytearray(frame)
        for at in self._noise.integers(8 * len(frame), size=flips).tolist():
            damaged[at >> 3] ^= 1 << (at & 7)
        return bytes(damaged)


def frames(data: bytes, can: bool) -> list[bytes]:
    """Frames as they are on the link."""
    if can:
        return [data[at : at + RECORD_BYTES] for at in range(0, len(data), RECORD_BYTES)]
    return [b"\0" + part + b"\0" for part in data.split(b"\0") if part]


def kind_of(frame: bytes, can: bool) -> int:
    """Its type; of messages on CAN that are no stream's: heartbeats, else 0."""
    if not can:
        return cobs.decode(frame[1:-1])[0] if len(frame) > HEADER_BYTES else 0
    number = int(np.frombuffer(frame, CAN_RECORD)["id"][0])
    of, slot = number >> 8 & 7, number & 15
    kinds = {4: MessageType.EDGES, 5: MessageType.DATA, 6: MessageType.DATA}
    return kinds.get(of, MessageType.HEARTBEAT if (of, slot) == (1, 4) else 0)

"""A link in virtual time that loses, damages and delays what passes, drawn by dice, and knows what it did."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from protocol.canmap.frame import RECORD_BYTES
from protocol.wire import HostWire
from tests.devices.virtual import VirtualLink


@dataclass(frozen=True)
class Trouble:
    """What a link does: share of frames lost each way, share of bytes damaged, outages and pauses of the host.

    `outages`: from and to, in s of the link's clock: nothing passes. `pauses`: when, and for how long, the host does
    not run; what comes meanwhile waits for it.
    """

    lost_up: float = 0.0
    lost_down: float = 0.0
    damaged: float = 0.0
    outages: tuple[tuple[float, float], ...] = ()
    pauses: tuple[tuple[float, float], ...] = ()

    @property
    def none(self) -> bool:
        """Whether the link is as it should be."""
        return self == Trouble()


@dataclass
class Passed:
    """Frames that came to one end of a link, and what became of them."""

    frames: int = 0
    lost: int = 0
    damaged: int = 0
    cut: bytes = field(default=b"", repr=False)  # a frame that is not complete yet


class LossyLink:
    """`inner` with `trouble` in the way; `up` and `down` say what became of frames to the host and to the device."""

    def __init__(self, inner: VirtualLink, trouble: Trouble, dice: random.Random) -> None:
        self._inner, self._trouble, self._dice = inner, trouble, dice
        self._can = RECORD_BYTES if hasattr(inner.wire(), "rates") else 0
        self._pauses = list(trouble.pauses)
        self.up, self.down = Passed(), Passed()
        self.name = inner.name

    def clock(self) -> float:
        """Virtual seconds."""
        return self._inner.clock()

    def wire(self) -> HostWire:
        """See `Link.wire`."""
        return self._inner.wire()

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        """See `Link.read`."""
        if self._pauses and self.clock() >= self._pauses[0][0]:
            self.idle(self._pauses.pop(0)[1])
        return self._through(self._inner.read(timeout, settle), self.up, self._trouble.lost_up)

    def write(self, data: bytes) -> None:
        """See `Link.write`."""
        self._inner.write(self._through(data, self.down, self._trouble.lost_down))

    def idle(self, seconds: float) -> None:
        """Time passes, and nobody reads."""
        self._inner.idle(seconds)

    def close(self) -> None:
        """See `Link.close`."""

    def reopen(self) -> None:
        """It is there."""

    def _through(self, data: bytes, passed: Passed, lost: float) -> bytes:
        out = any(begin <= self.clock() < end for begin, end in self._trouble.outages)
        return b"".join(self._one(frame, passed, lost, out) for frame in self._frames(data, passed))

    def _frames(self, data: bytes, passed: Passed) -> list[bytes]:
        if self._can:
            return [data[at : at + self._can] for at in range(0, len(data), self._can)]
        *whole, passed.cut = (passed.cut + data).split(b"\0")
        return [each + b"\0" for each in whole]

    def _one(self, frame: bytes, passed: Passed, lost: float, out: bool) -> bytes:
        if len(frame) < 2:  # a delimiter
            return b"" if out else frame
        passed.frames += 1
        if out or self._dice.random() < lost:
            passed.lost += 1
            return b""
        if self._trouble.damaged and not self._can:
            hit = bytearray(frame)
            for at in range(len(hit)):
                if self._dice.random() < self._trouble.damaged:
                    hit[at] ^= 1 << self._dice.randrange(8)
            passed.damaged += bytes(hit) != frame
            frame = bytes(hit)
        return frame


def drawn(dice: random.Random) -> Trouble:
    """Trouble of any size, none in a third of the cases."""
    kind = dice.choice(("none", "lost", "lost", "damaged", "outages", "pauses"))
    share = 10 ** dice.uniform(-3, -0.2)
    if kind == "lost":
        return Trouble(lost_up=share, lost_down=dice.choice((0.0, share, min(0.3, share))))
    if kind == "damaged":
        return Trouble(damaged=10 ** dice.uniform(-5, -2.5))
    spans = sorted((dice.uniform(0.0, 4.0), 10 ** dice.uniform(-1, 0.5)) for _ in range(dice.randint(1, 3)))
    if kind == "outages":
        return Trouble(outages=tuple((at, at + length) for at, length in spans))
    return Trouble(pauses=tuple(spans)) if kind == "pauses" else Trouble()

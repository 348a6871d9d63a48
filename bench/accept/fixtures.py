"""What the fixture `record` gives: the test's way to let time pass and to take it down."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.signal.capture import Capture

if TYPE_CHECKING:
    from bench.rig.rig import Rig


class Record:
    """Calls wait on the bench's clock: virtual for the simulated drive, real on hardware.

    `with record.stretch() as s: …` records what happens inside; after it `s.capture` holds it. Where the link is too
    slow for every PWM period both read the drive's memory, which takes longer; `streamed(seconds)` is what came by it.
    `wait(seconds)`, `until(condition, timeout)`, `latest(channel)`, `note(text)` and `play(profile)` are those of
    the `rig`.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.stretch, self.streamed = rig.recording, rig.streamed
        self.wait, self.until, self.latest, self.note = rig.wait, rig.until, rig.latest, rig.note
        self.play = rig.play

    @property
    def reads_memory(self) -> bool:
        """Whether what is recorded is read out of the drive's memory, which takes a while."""
        return self.rig.full_rate is not None

    def __call__(self, seconds: float) -> Capture:
        """The next `seconds`. Raises DriveTripped, and BenchError when no samples come."""
        return self.rig.record(seconds)

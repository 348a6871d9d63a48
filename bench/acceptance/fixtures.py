"""What the fixture `record` gives: the test's way to let time pass and to take it down."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from bench.analysis.capture import Capture

if TYPE_CHECKING:
    from bench.rig.rig import Rig, Stretch


class Record:
    """Calls wait on the bench's clock: virtual for the simulated drive, real on hardware."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    def __call__(self, seconds: float) -> Capture:
        """The next `seconds`. Raises DriveTripped, and BenchError when no samples come."""
        return self.rig.record(seconds)

    def stretch(self) -> AbstractContextManager[Stretch]:
        """`with record.stretch() as s: …` records what happens inside; after it `s.capture` holds it."""
        return self.rig.recording()

    def wait(self, seconds: float) -> None:
        """Let the bench go on."""
        self.rig.wait(seconds)

    def until(self, condition: Callable[[], bool], timeout: float) -> bool:
        """Go on until `condition()` holds; False when it does not within `timeout` s."""
        return self.rig.until(condition, timeout)

    def latest(self, channel: str) -> float:
        """The newest value of a channel, in its unit."""
        return self.rig.recorder.latest(channel)

    def note(self, text: str) -> None:
        """A line in the recording's log."""
        self.rig.note(text)

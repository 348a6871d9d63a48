"""The recording of a run, for a client: what comes is queued and written by a thread of its own.

The acquisition thread never waits for the disk. A recording that cannot be written (disk full, device gone) raises
`RecordingError` out of `check` or `close`, once: the run ends with an error, and nothing is raised into the calls that
stop the drive. kill -9 leaves a run that reads up to what was queued. A disk that is nearly full ends it the same way,
while there is room to end it whole.
"""

from __future__ import annotations

import errno
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

from bench.errors import RecordingError
from bench.record import space
from bench.record.info import Kept, Mark, RunInfo
from bench.record.later import Later
from bench.record.marks import Inbox
from bench.record.parts import Parts
from bench.record.ring import FOR_EVER, Stored
from bench.signal.percentiles import Percentiles
from protocol.streams import EdgeChunk, SampleChunk

SYNC_PERIOD = 1.0  # s: what a power cut can cost
BACKLOG_LIMIT = 512 << 20  # bytes waiting for the disk: ten minutes of 16 kHz x 26 channels
CLOSE_TIMEOUT = 60.0  # s for the disk to take what is left
INBOX_PERIOD = 0.1  # s between looks for marks that were asked for
UNCALLED, AGAIN = 0.03, 0.01
"""s after a call in which what came without another one is looked for: while a drive is asked something, nobody calls;
and s between looks from then on."""
SPACE_PERIOD = 2.0  # s between looks at the room on the disk
HELD_BACK = 0.001  # s between looks of a caller that is faster than the disk

Now = Callable[[], float]
_Queued = tuple[Kept, float | None]  # and when the first sample of a chunk was taken


class RunSink:
    """Records to the folder `path`. Raises RecordingError if that exists (unless `overwrite`) or cannot be made.

    `news` is what a person should be told, text and level, oldest first: whoever shows it takes it out.

    With `wait` a caller that is faster than the disk is held back instead of failing: for virtual time only. `latency`
    holds, for every sample, the time in s until it was written: since the drive took the oldest sample of its chunk if
    `host_time` (device tick to host time, as `now` counts it) is set, else since it came here. `host_time` is asked as
    a chunk comes, and gives None while the drive's clock is not known: such samples are left out.
    """

    host_time: Callable[[float], float | None] | None = None

    def __init__(
        self,
        path: str | Path,
        run: RunInfo,
        *,
        overwrite: bool = False,
        wait: bool = False,
        now: Now = time.monotonic,
        stored: Stored = FOR_EVER,
        free: space.Free = space.free_bytes,
    ) -> None:
        """`free`: bytes that can be written to a place."""
        self.path, self.run = Path(path), run
        self.news: deque[tuple[str, str]] = deque()
        self.stored, self._free = stored, free
        self.latency = Percentiles()
        self.error: RecordingError | None = None
        self._raised = False
        self._wait, self._now = wait, now
        self._coming: deque[_Queued] = deque()
        self._call: queue.SimpleQueue[bool] = queue.SimpleQueue()  # of the thread: to go on, or to end
        self._patience = AGAIN  # s for which the thread waits for a call
        self._backlog = 0
        self._counting = threading.Lock()  # no Condition: Ctrl-C in the middle of its methods would leave it locked
        self._room = space.Room(stored.keep or math.inf)
        if why := space.too_little(self.path, self._free_bytes()):
            raise RecordingError(f"recording {self.path}: {why}")
        self._inbox = Inbox()
        self._later = Later()
        try:
            self._parts = Parts(self.path, run, stored, overwrite, self._take_marks, self._later)
        except BaseException:
            self._later.close()
            raise
        self._thread = threading.Thread(target=self._work, name="recording", daemon=True)
        self._thread.start()

    # -- what comes ---------------------------------------------------------------------------------------------

    def take(self, item: Kept) -> None:
        """Have an item written: with the next `check`, or a moment later; from any thread."""
        if self.error is not None:
            return
        taken: float | None = None
        if isinstance(item, SampleChunk):
            taken = self._now() if self.host_time is None else self.host_time(float(item.tick[0]))
        if self._wait:
            while self._backlog >= BACKLOG_LIMIT and self.error is None:
                time.sleep(HELD_BACK)
        elif self._backlog > BACKLOG_LIMIT:
            self._fail(f"{self._backlog >> 20} MiB wait to be written; use a faster disk, --rate or --channels")
        self._count(_size(item))
        self._coming.append((item, taken))

    @property
    def parts(self) -> tuple[Path, ...]:
        """The runs that have been begun, oldest first; the last is being written."""
        return self._parts.paths

    # -- the end ------------------------------------------------------------------------------------------------

    @property
    def logged_samples(self) -> int:
        """Samples that have been written."""
        return self._parts.written[0]

    @property
    def logged_edges(self) -> int:
        """Hall edges that have been written."""
        return self._parts.written[1]

    def close(self) -> None:
        """Write what is left and end the run. Raises RecordingError if that fails and nothing was raised before."""
        self._call.put(False)
        self._thread.join(CLOSE_TIMEOUT)
        if self._thread.is_alive():
            self._fail(f"{self._backlog >> 20} MiB could not be written within {CLOSE_TIMEOUT:g} s; the end is missing")
        self.check()

    def check(self) -> None:
        """Have all written that has come: once a turn, when whoever calls needs the core no more.

        Raises RecordingError, once, if the recording has failed.
        """
        if self._coming and self.error is None:
            self._call.put(True)
        if self.error is not None and not self._raised:
            self._raised = True
            raise self.error

    # -- the thread ---------------------------------------------------------------------------------------------

    def _work(self) -> None:
        synced = looked = asked = time.monotonic()
        try:
            while True:
                if not self._write_queued():
                    break
                now = time.monotonic()
                if now - asked >= INBOX_PERIOD:
                    self._take_marks()
                    asked = now
                if now - synced >= SYNC_PERIOD:
                    self._parts.writer.sync()
                    synced = now
                if now - looked >= SPACE_PERIOD:
                    looked = now
                    if why := self._look_at_space():
                        self._parts.writer.close()
                        self._fail(f"{why}; everything before is complete")
                        return
            self._take_marks()
            self._parts.writer.close()
        except Exception as error:
            self._fail(_why(self.path, self._free_bytes(), error), error)
        finally:
            self._parts.writer.abandon()
            self._later.close()

    def _write_queued(self) -> bool:
        """Write what has come when it is called, or after a while. False at the end of it all."""
        goes_on = True
        try:
            goes_on = self._call.get(timeout=self._patience)
            self._patience = UNCALLED
        except queue.Empty:
            self._patience = AGAIN
        for _ in range(len(self._coming)):
            self._write(*self._coming.popleft())
        return goes_on

    def _write(self, item: Kept, taken: float | None) -> None:
        self._parts.take(item)
        if taken is not None and isinstance(item, SampleChunk):
            self.latency.add(self._now() - taken, len(item))
        self._count(-_size(item))

    def _count(self, size: int) -> None:
        """So many bytes more wait to be written."""
        with self._counting:
            self._backlog += size

    def _take_marks(self) -> None:
        """Write the marks that were asked for, at the device time of the moment in which they were."""
        for asked in self._inbox.new(self._parts.writer.path):
            tick, hz = self._parts.writer.newest, self.run.tick_hz
            at = None if self.host_time is None else self.host_time(float(tick))
            if at is not None:
                tick = max(0, tick + round((asked.host - at) * hz))
            self._parts.take(Mark(asked.text, tick, tick, asked=asked.id))
            self.news.append((f"mark: {asked.text}, at {tick / hz:.3f} s", "INFO"))

    # -- the disk -----------------------------------------------------------------------------------------------

    def _free_bytes(self) -> int:
        """Free bytes; as many as can be where nobody knows."""
        try:
            return self._free(self.path.absolute().parent)
        except OSError:
            return 1 << 62

    def _look_at_space(self) -> str:
        """Say how long the disk lasts, where that is not long. Returns why the recording has to end, if it has to."""
        free = self._free_bytes()
        if words := self._room.words(free, *self._parts.writer.stored):
            self.news.append((words, "WARN"))
        return space.too_little(self.path, free)

    def _fail(self, what: str, cause: Exception | None = None) -> None:
        self.error = RecordingError(f"recording {self.path}: {what}")
        self.error.__cause__ = cause


def _size(item: Kept) -> int:
    """Bytes that an item holds, roughly; 0 of what is small."""
    match item:
        case SampleChunk():
            return item.raw.nbytes + item.index.nbytes + item.tick.nbytes
        case EdgeChunk():
            return 21 * len(item)
    return 0


def _why(path: Path, free: int, error: Exception) -> str:
    """What keeps a recording from being written, in words."""
    if getattr(error, "errno", None) == errno.ENOSPC:
        return f"the disk is full ({free >> 10} KiB free); free some space or record elsewhere"
    return f"cannot be written ({error}); what was written before is readable"

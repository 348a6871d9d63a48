"""The recording of a run, for a client: what comes is queued and written by a thread of its own.

The acquisition thread never waits for the disk. A recording that cannot be written (disk full, device gone) raises
`RecordingError` out of `check` or `close`, once: the run ends with an error, and nothing is raised into the calls that
stop the drive. kill -9 leaves a run that reads up to what was queued.
"""

from __future__ import annotations

import queue
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

from bench.analysis.percentiles import Percentiles
from bench.analysis.verdict import Verdict
from bench.device.client import Sink
from bench.errors import RecordingError
from bench.recording.info import Mark, RunInfo
from bench.recording.writer import RunWriter
from protocol.messages import DeviceEvent, Heartbeat
from protocol.streams import EdgeChunk, SampleChunk

SYNC_PERIOD = 1.0  # s: what a power cut can cost
BACKLOG_LIMIT = 512 << 20  # bytes waiting for the disk: ten minutes of 16 kHz x 26 channels
CLOSE_TIMEOUT = 60.0  # s for the disk to take what is left

Now = Callable[[], float]
_Item = tuple[Callable[[RunWriter], None], int] | None  # what is to be done, and its bytes; None ends


class RunSink(Sink):
    """Records to the folder `path`. Raises RecordingError if that exists (unless `overwrite`) or cannot be made.

    With `wait` a caller that is faster than the disk is held back instead of failing: for virtual time only. `latency`
    holds, for every sample, the time in s until it was written: since the drive took the oldest sample of its chunk if
    `host_time` (device tick to host time, as `now` counts it) is set, else since it came here. `host_time` is asked as
    a chunk comes, and gives None while the drive's clock is not known: such samples are left out.
    """

    host_time: Callable[[float], float | None] | None = None

    def __init__(
        self, path: str | Path, run: RunInfo, *, overwrite: bool = False, wait: bool = False, now: Now = time.monotonic
    ) -> None:
        self.path, self.run = Path(path), run
        self.latency = Percentiles()
        self.error: RecordingError | None = None
        self._raised = False
        self._wait, self._now = wait, now
        self._queue: queue.SimpleQueue[_Item] = queue.SimpleQueue()
        self._backlog = 0
        self._room = threading.Condition()
        self._writer = RunWriter(self.path, run, overwrite)
        self._thread = threading.Thread(target=self._work, name="recording", daemon=True)
        self._thread.start()

    # -- what comes ---------------------------------------------------------------------------------------------

    def samples(self, chunk: SampleChunk) -> None:
        """Take samples."""
        taken: float | None = self._now()
        if self.host_time is not None and len(chunk):
            taken = self.host_time(float(chunk.tick[0]))

        def write(writer: RunWriter) -> None:
            writer.samples(chunk)
            if taken is not None:
                self.latency.add(self._now() - taken, len(chunk))

        self._put(write, chunk.raw.nbytes + chunk.index.nbytes + chunk.tick.nbytes)

    def edges(self, chunk: EdgeChunk) -> None:
        """Take Hall edges."""
        self._put(lambda writer: writer.edges(chunk), 21 * len(chunk))

    def heartbeat(self, node: int, heartbeat: Heartbeat) -> None:
        """Take a heartbeat."""
        self._put(lambda writer: writer.heartbeat(node, heartbeat))

    def event(self, node: int, event: DeviceEvent) -> None:
        """Take an event of the drive."""
        self._put(lambda writer: writer.event(node, event))

    def missing(self, node: int, samples: int, edges: int) -> None:
        """Take what was lost at the end of the streams."""
        self._put(lambda writer: writer.missing(node, samples, edges))

    def note(self, text: str, level: str = "INFO", tick: int | None = None) -> None:
        """Take a line of the host's for the log; `level`: INFO, WARN, ERROR.

        It stands at the newest device time seen, or at `tick`.
        """
        self._put(lambda writer: writer.note(text, level, tick))

    def parameter(self, node: int, name: str, value: float) -> None:
        """Take a parameter that was set."""
        self._put(lambda writer: writer.parameter(node, name, value))

    def summary(self, markdown: str) -> None:
        """Take the summary, which replaces an earlier one."""
        self._put(lambda writer: writer.summary(markdown))

    def mark(self, name: str, first_tick: int, last_tick: int, verdict: Verdict | None = None) -> None:
        """Mark a stretch of the run: `name` was measured there, and ended so. From any thread; marks may overlap.

        Raises ValueError for a stretch that ends before it begins.
        """
        mark = Mark(name, first_tick, last_tick, verdict)
        self._put(lambda writer: writer.mark(mark))

    # -- the end ------------------------------------------------------------------------------------------------

    @property
    def logged_samples(self) -> int:
        """Samples that have been written."""
        return self._writer.samples_written

    @property
    def logged_edges(self) -> int:
        """Hall edges that have been written."""
        return self._writer.edges_written

    def close(self) -> None:
        """Write what is left and end the run. Raises RecordingError if that fails and nothing was raised before."""
        self._queue.put(None)
        self._thread.join(CLOSE_TIMEOUT)
        if self._thread.is_alive():
            self._fail(f"{self._backlog >> 20} MiB were not written within {CLOSE_TIMEOUT:g} s; the end is missing")
        self.check()

    def check(self) -> None:
        """Raise RecordingError, once, if the recording has failed."""
        if self.error is not None and not self._raised:
            self._raised = True
            raise self.error

    # -- the thread ---------------------------------------------------------------------------------------------

    def _put(self, write: Callable[[RunWriter], None], size: int = 0) -> None:
        if self.error is not None:
            return
        with self._room:
            if self._wait:
                self._room.wait_for(lambda: self._backlog < BACKLOG_LIMIT or self.error is not None)
            elif self._backlog > BACKLOG_LIMIT:
                self._fail(f"{self._backlog >> 20} MiB wait to be written; use a faster disk, --rate or --channels")
            self._backlog += size
        self._queue.put((write, size))

    def _work(self) -> None:
        writer, synced = self._writer, time.monotonic()
        try:
            while True:
                try:
                    item = self._queue.get(timeout=SYNC_PERIOD)
                except queue.Empty:
                    item = (RunWriter.sync, 0)
                if item is None:
                    break
                write, size = item
                write(writer)
                if size:
                    with self._room:
                        self._backlog -= size
                        self._room.notify_all()
                if time.monotonic() - synced >= SYNC_PERIOD:
                    writer.sync()
                    synced = time.monotonic()
            writer.close()
        except Exception as error:
            self._fail(_why(self.path, error), error)
        finally:
            writer.abandon()

    def _fail(self, what: str, cause: Exception | None = None) -> None:
        self.error = RecordingError(f"recording {self.path}: {what}")
        self.error.__cause__ = cause
        with self._room:
            self._room.notify_all()


def _why(path: Path, error: Exception) -> str:
    """What keeps a recording from being written, in words."""
    try:
        free = shutil.disk_usage(path.parent).free
    except OSError:
        free = -1
    if 0 <= free < 1 << 20 or getattr(error, "errno", None) == 28:
        return f"the disk is full ({max(free, 0) >> 10} KiB free); free some space or record elsewhere"
    return f"cannot be written ({error}); what was written before is readable"

"""The two ends of a run's data: a recording and a live view, each with a thread and a rerun stream of its own.

The acquisition thread calls `samples`, `edges`, … here and never waits: rerun is only called from the sinks' threads.
The recording's queue takes everything (its size is watched); the live view's is short, and what does not fit is
dropped and counted. So a slow, stopped or dead viewer costs live frames, never recorded samples.

A recording that cannot be written (disk full, device gone) raises `RecordingError` out of `check` or `close`, once: the
run ends with an error, and nothing is raised into the calls that stop the drive. kill -9 leaves a readable file.
"""

from __future__ import annotations

import ctypes
import os
import queue
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bench.analysis.percentiles import Percentiles
from bench.analysis.verdict import Verdict
from bench.device.client import Sink
from bench.errors import RecordingError
from bench.rerunio import schema
from bench.rerunio.blocks import Block, BlockBuilder
from bench.rerunio.salvage import mend
from protocol.messages import DeviceEvent, Heartbeat
from protocol.streams import EdgeChunk, SampleChunk
from sim.interrupts import Held

if TYPE_CHECKING:
    import rerun as rr

    from bench.rerunio.log import RunLog

BLOCK_PERIOD = 0.055  # s of signal a message to a live view
FILE_PERIOD = 0.045  # s of signal a message to a file: with what is under way it lacks 0.1 s at most after kill -9
FILE_LOT = 0.5  # s of signal of what only plots need: the samples and edges that it is made of are written before
READY_TIMEOUT = 10.0  # s for rerun to be imported and the dashboard to be written
HOLD_PERIOD = 3.0  # s of signal a message of a live view that holds still in between
TOUCH_PERIOD = 0.4  # s between touches of one that does
FLUSH_PERIOD = 1.0  # s: how soon a full disk is noticed, and how much a power cut can cost
FLUSH_TIMEOUT = 5.0  # s
BACKLOG_LIMIT = 512 << 20  # bytes waiting for the disk: four minutes of 16 kHz x 26 channels
LIVE_QUEUE, HOLD_QUEUE = 20, 3  # blocks
CLOSE_TIMEOUT = 60.0  # s for the disk to take what is left
LIVE_CLOSE_TIMEOUT = 2.0  # s for a viewer to take what is left

Now = Callable[[], float]
_Item = Block | schema.Mark | str | None  # a block, a mark, the text of the summary, or the end


class _BlockSink(Sink):
    """Sink of `bench.device.client`: collects blocks and passes them on to `_put`, which must not wait.

    `latency` holds, for every sample, the time in s until it was handed to rerun: since the drive took the oldest
    sample of its chunk if `host_time` (device tick to host time, as `now` counts it) is set, else since it came here.
    `host_time` is asked as a chunk comes, and gives None while the drive's clock is not known: such samples are left
    out. What is held back on purpose counts until it came here.
    """

    host_time: Callable[[float], float | None] | None = None
    _hold = False

    _thread: threading.Thread

    def __init__(self, run: schema.RunInfo, period: float, now: Now) -> None:
        self.run = run
        self.latency = Percentiles()
        self.logged_samples = 0
        self.logged_edges = 0
        self._now = now
        self._ready = threading.Event()
        self._builder = BlockBuilder(period, run.tick_hz)

    def samples(self, chunk: SampleChunk) -> None:
        """Take samples."""
        now = self._now()
        taken: float | None = now
        if self.host_time is not None and len(chunk):
            taken = self.host_time(float(chunk.tick[0]))
        self._builder.samples(chunk, now, taken)
        self._pass_on(now)

    def edges(self, chunk: EdgeChunk) -> None:
        """Take Hall edges; they go out no later than the samples that follow them."""
        self._builder.edges(chunk, self._now())

    def heartbeat(self, node: int, heartbeat: Heartbeat) -> None:
        """Take a heartbeat."""
        now = self._now()
        self._builder.heartbeat(node, heartbeat, now)
        self._pass_on(now)

    def event(self, node: int, event: DeviceEvent) -> None:
        """Take an event of the drive."""
        self._builder.event(node, event, self._now())

    def missing(self, node: int, samples: int, edges: int) -> None:
        """Take what was lost at the end of the streams into the account of losses."""
        self._builder.missing(samples, edges, self._now())

    def note(self, text: str, level: str = "INFO", tick: int | None = None) -> None:
        """Take a line of the host's for the log; `level` as rerun's: INFO, WARN, ERROR.

        It stands at the newest device time seen, or at `tick`.
        """
        self._builder.note(text, level, self._now(), tick)

    def summary(self, markdown: str) -> None:
        """Take the summary, which replaces an earlier one."""
        self._put(markdown)

    def _start(self) -> None:
        """Start the thread; wait until it has imported and opened what it needs, because streaming data would not."""
        self._thread.start()
        self._ready.wait(READY_TIMEOUT)

    def _pass_on(self, now: float, everything: bool = False) -> None:
        block = self._builder.take(now, everything)
        if block is not None:
            self._put(block)

    def _put(self, item: _Item) -> None:
        raise NotImplementedError

    def _log(self, log: RunLog, item: Block | schema.Mark | str) -> None:
        """Hand one item to rerun; on the sink's own thread."""
        if isinstance(item, str):
            log.summary(item)
            return
        if isinstance(item, schema.Mark):
            log.mark(item)
            return
        log.block(item)
        now = self._now()
        for chunk, arrived, taken in zip(item.samples, item.arrivals, item.taken, strict=True):
            if taken is not None:
                self.latency.add((arrived if self._hold else now) - taken, len(chunk))
        self.logged_samples += item.n_samples
        self.logged_edges += item.n_edges


class FileSink(_BlockSink):
    """Records a run to an .rrd file that opens with the dashboard.

    `live_drops` tells how many blocks the live view has lost, for the record. With `wait` a caller that is faster
    than the disk is held back instead of failing: for virtual time only. Raises RecordingError if the file exists
    (unless `overwrite`) or cannot be created.
    """

    def __init__(
        self,
        path: str | Path,
        run: schema.RunInfo,
        *,
        overwrite: bool = False,
        wait: bool = False,
        live_drops: Callable[[], int] = lambda: 0,
        now: Now = time.monotonic,
    ) -> None:
        super().__init__(run, FILE_PERIOD, now)
        self.path = Path(path)
        self.error: RecordingError | None = None
        self._raised = False
        self._wait = wait
        self._live_drops = live_drops
        self._queue: queue.SimpleQueue[_Item] = queue.SimpleQueue()
        self._backlog = 0
        self._room = threading.Condition()
        _claim(self.path, overwrite)
        self._stream = _open_file(self.path, run)
        self._thread = threading.Thread(target=self._work, name="recording", daemon=True)
        self._start()
        self.check()

    def mark(self, name: str, first_tick: int, last_tick: int, verdict: Verdict) -> None:
        """Mark a stretch of the run: `name` was measured there, and ended so. From any thread; marks may overlap.

        Raises ValueError for a stretch that ends before it begins.
        """
        self._put(schema.Mark(name, first_tick, last_tick, verdict))

    def close(self) -> None:
        """Write what is left and finish the file. Raises RecordingError if that fails and nothing was raised before."""
        try:
            self._pass_on(self._now(), everything=True)
        finally:
            self._queue.put(None)
            self._thread.join(CLOSE_TIMEOUT)
        if self._thread.is_alive():
            self._fail(f"{self._backlog >> 20} MiB were not written within {CLOSE_TIMEOUT:g} s; the end is missing")
        self.check()

    def _put(self, item: _Item) -> None:
        if self.error is not None:
            return
        size = item.nbytes if isinstance(item, Block) else 0
        with self._room:
            if self._wait:
                self._room.wait_for(lambda: self._backlog < BACKLOG_LIMIT or self.error is not None)
            elif self._backlog > BACKLOG_LIMIT:
                self._fail(f"{self._backlog >> 20} MiB wait to be written; use a faster disk, --rate or --channels")
            self._backlog += size
        self._queue.put(item)

    def check(self) -> None:
        """Raise RecordingError, once, if the recording has failed."""
        if self.error is not None and not self._raised:
            self._raised = True
            raise self.error

    def _fail(self, what: str, cause: Exception | None = None) -> None:
        self.error = RecordingError(f"recording {self.path}: {what}")
        self.error.__cause__ = cause
        with self._room:
            self._room.notify_all()

    def _work(self) -> None:
        from bench.rerunio import dashboard
        from bench.rerunio.log import RunLog

        try:
            log = RunLog(self._stream, self.run, FILE_LOT)
            log.start()
            self._stream.flush(timeout_sec=FLUSH_TIMEOUT)
            self._ready.set()
            flushed = time.monotonic()
            while True:
                try:
                    item = self._queue.get(timeout=FLUSH_PERIOD)
                except queue.Empty:
                    item = Block()
                if item is None:
                    break
                if isinstance(item, Block):
                    item.losses["lost:live_blocks"] = self._live_drops()
                self._log(log, item)
                if isinstance(item, Block):
                    with self._room:
                        self._backlog -= item.nbytes
                        self._room.notify_all()
                if time.monotonic() - flushed >= FLUSH_PERIOD:
                    self._stream.flush(timeout_sec=FLUSH_TIMEOUT)
                    flushed = time.monotonic()
            log.finish()
            if log.marks:
                self._stream.send_blueprint(dashboard.blueprint(self.run, log.marks))
            self._stream.flush(timeout_sec=CLOSE_TIMEOUT)
            self._stream.disconnect()
        except Exception as error:
            _abandon(self._stream)
            with suppress(OSError):
                mend(self.path)
            self._fail(_why(self.path, error), error)
        finally:
            self._ready.set()


class LiveSink(_BlockSink):
    """Serves a run to viewers on this machine, at `url`, from a gRPC server in this process on `port`.

    Viewers may come, stall and go at any time; `dropped_blocks` and `dropped_samples` tell what they did not get. With
    `hold` the view moves on every three seconds, all at once, and stands still in between: a browser without a GPU
    draws only a frame or two a second.
    """

    def __init__(self, run: schema.RunInfo, port: int, *, hold: bool = False, now: Now = time.monotonic) -> None:
        super().__init__(run, HOLD_PERIOD if hold else BLOCK_PERIOD, now)
        self.dropped_blocks = 0
        self.dropped_samples = 0
        self.error: str | None = None
        self._queue: queue.Queue[_Item] = queue.Queue(HOLD_QUEUE if hold else LIVE_QUEUE)
        self._closing = threading.Event()
        self._hold = hold
        self._stream, self.url = _serve(run, port)
        self._thread = threading.Thread(target=self._work, name="live view", daemon=True)
        self._start()

    def close(self) -> bool:
        """Give viewers what is queued and end the server; False if a stalled viewer keeps it from ending in time."""
        self._pass_on(self._now(), everything=True)
        self._closing.set()
        self._thread.join(LIVE_CLOSE_TIMEOUT)
        return not self._thread.is_alive()

    def _put(self, item: _Item) -> None:
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            if isinstance(item, Block):
                self.dropped_blocks += 1
                self.dropped_samples += item.n_samples

    def _work(self) -> None:
        from bench.rerunio.log import RunLog

        try:
            log = RunLog(self._stream, self.run)
            log.start()
            self._ready.set()
            while True:
                try:
                    item = self._queue.get(timeout=TOUCH_PERIOD if self._hold else 0.1)
                except queue.Empty:
                    if self._closing.is_set():
                        break
                    if self._hold:
                        log.touch()
                    continue
                if isinstance(item, Block):
                    item.losses["lost:live_blocks"] = self.dropped_blocks
                if item is not None:
                    self._log(log, item)
            log.finish()
            self._stream.flush(timeout_sec=LIVE_CLOSE_TIMEOUT)
            self._stream.disconnect()
        except Exception as error:  # the live view is a convenience: the run goes on without it
            self.error = str(error)
        finally:
            self._ready.set()


def _claim(path: Path, overwrite: bool) -> None:
    try:
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if overwrite else os.O_EXCL), 0o644))
    except FileExistsError:
        raise RecordingError(f"{path} exists: choose another name, or --overwrite to replace it") from None
    except OSError as error:
        raise RecordingError(f"{path} cannot be created: {error.strerror}") from None


def _new_stream(run: schema.RunInfo) -> rr.RecordingStream:
    import rerun as rr

    with Held():  # an unfinished one complains when it is dropped
        stream = rr.RecordingStream(schema.APPLICATION, recording_id=run.recording_id)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def _open_file(path: Path, run: schema.RunInfo) -> rr.RecordingStream:
    from bench.rerunio import dashboard

    stream = _new_stream(run)
    try:
        stream.save(path)  # with a footer: a large file opens at once, and takes 0.8 GB of memory an hour meanwhile
        stream.send_blueprint(dashboard.blueprint(run))
    except RuntimeError as error:
        raise RecordingError(f"recording {path}: {_why(path, error)}") from None
    return stream


def _abandon(stream: rr.RecordingStream) -> None:
    """Let nobody tidy `stream` up: rerun (0.41) may wait for a dead writer for ever, at exit or when it is deleted."""
    import rerun as rr

    rr.unregister_shutdown()
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(stream))


def _serve(run: schema.RunInfo, port: int) -> tuple[rr.RecordingStream, str]:
    import rerun as rr

    from bench.rerunio import dashboard

    stream = _new_stream(run)
    server = rr.GrpcServerSink(bind_ip="127.0.0.1", port=port, server_memory_limit="128MiB")
    stream.set_sinks(server)
    stream.send_blueprint(dashboard.blueprint(run))
    return stream, server.uri


def _why(path: Path, error: Exception) -> str:
    """Rerun says that its writer has ended, not why: look for the usual reason."""
    try:
        free = shutil.disk_usage(path.parent).free
    except OSError:
        free = -1
    if 0 <= free < 1 << 20 or "os error 28" in str(error):
        return f"the disk is full ({max(free, 0) >> 10} KiB free); free some space or record elsewhere"
    return f"cannot be written ({error}); what was written before is readable"

"""The live view of a run: a sink with a thread and a rerun stream of its own.

The acquisition thread calls `take` here and never waits: rerun is only called from the sink's thread.
The queue is short, and what does not fit is dropped and counted. So a slow, stopped or dead viewer costs live frames,
never recorded samples.
"""

from __future__ import annotations

import ctypes
import os
import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from bench.device.heard import ClockRestarted
from bench.record.info import Kept, Mark, RunInfo, SummaryText
from bench.signal.percentiles import Percentiles
from bench.view import schema, switched_off
from bench.view.blocks import Block, BlockBuilder
from protocol.host import HeartbeatReceived
from protocol.streams import SampleChunk
from sim.interrupts import Held

if TYPE_CHECKING:
    import rerun as rr

    from bench.view.log import RunLog

BLOCK_PERIOD = 0.055  # s of signal a message to a live view
READY_TIMEOUT = 10.0  # s for rerun to be imported
HOLD_PERIOD = 3.0  # s of signal a message of a live view that holds still in between
TOUCH_PERIOD = 0.4  # s between touches of one that does
LIVE_QUEUE, HOLD_QUEUE = 20, 3  # blocks
LIVE_CLOSE_TIMEOUT = 2.0  # s for a viewer to take what is left

Now = Callable[[], float]
_Item = Block | SummaryText


class LiveSink:
    """Serves a run to viewers on this machine, at `url`, from a gRPC server in this process on `port`.

    Viewers may come, stall and go at any time; `dropped_blocks` and `dropped_samples` tell what they did not get. With
    `hold` the view is updated every three seconds, all at once, and stands still in between: a browser without a GPU
    draws a frame or two a second.

    `latency` holds, for every sample, the time in s until it was handed to rerun: since the drive took the oldest
    sample of its chunk if `host_time` (device tick to host time, as `now` counts it) is set, else since it came here.
    `host_time` is asked as a chunk comes, and gives None while the drive's clock is not known: such samples are left
    out. What is held back on purpose counts until it came here.
    """

    host_time: Callable[[float], float | None] | None = None

    def __init__(self, run: RunInfo, port: int, *, hold: bool = False, now: Now = time.monotonic) -> None:
        self.run = run
        self.latency = Percentiles()
        self.logged_samples = 0
        self.logged_edges = 0
        self._now = now
        self._ready: queue.SimpleQueue[None] = queue.SimpleQueue()  # no Event, no queue.Queue: see `RunSink`
        self._builder = BlockBuilder(HOLD_PERIOD if hold else BLOCK_PERIOD, run.tick_hz)
        self.dropped_blocks = 0
        self.dropped_samples = 0
        self.error: str | None = None
        self._queue: queue.SimpleQueue[_Item] = queue.SimpleQueue()
        self._closing = False
        self._hold = hold
        self._stream, self.url = _serve(run, port)
        self._thread = threading.Thread(target=self._work, name="live view", daemon=True)
        self._thread.start()
        with suppress(queue.Empty):  # it imports what it needs, because streaming data would not wait
            self._ready.get(timeout=READY_TIMEOUT)

    def take(self, item: Kept) -> None:
        """Have an item shown; edges go out no later than the samples that follow them. Marks are the recording's."""
        now = self._now()
        match item:
            case SummaryText():
                self._put(item)
            case Mark():
                pass
            case SampleChunk():
                self._builder.add(item, now, now if self.host_time is None else self.host_time(float(item.tick[0])))
                self._pass_on(now)
            case _:
                if isinstance(item, ClockRestarted):
                    self._pass_on(now, everything=True)
                self._builder.add(item, now)
                if isinstance(item, HeartbeatReceived):
                    self._pass_on(now)

    def _pass_on(self, now: float, everything: bool = False) -> None:
        block = self._builder.close(now, everything)
        if block is not None:
            self._put(block)

    def close(self) -> bool:
        """Give viewers what is queued and end the server; False if a stalled viewer keeps it from ending in time."""
        self._pass_on(self._now(), everything=True)
        self._closing = True
        self._thread.join(LIVE_CLOSE_TIMEOUT)
        return not self._thread.is_alive()

    def _log(self, log: RunLog, item: _Item) -> None:
        """Hand one item to rerun; on the sink's own thread."""
        if isinstance(item, SummaryText):
            log.summary(item.markdown)
            return
        item.losses["lost:live_blocks"] = self.dropped_blocks
        log.block(item)
        now = self._now()
        for arrived, taken, samples in item.arrivals:
            if taken is not None:
                self.latency.add((arrived if self._hold else now) - taken, samples)
        self.logged_samples += item.n_samples
        self.logged_edges += item.n_edges

    def _put(self, item: _Item) -> None:
        if self._queue.qsize() < (HOLD_QUEUE if self._hold else LIVE_QUEUE):
            self._queue.put(item)
        elif isinstance(item, Block):
            self.dropped_blocks += 1
            self.dropped_samples += item.n_samples

    def _work(self) -> None:
        from bench.view.log import RunLog

        try:
            log = RunLog(self._stream, self.run, live=True)
            log.start()
            self._ready.put(None)
            while True:
                try:
                    item = self._queue.get(timeout=TOUCH_PERIOD if self._hold else 0.1)
                except queue.Empty:
                    if self._closing:
                        break
                    if self._hold:
                        log.touch()
                    continue
                self._log(log, item)
            log.finish()
            self._stream.flush(timeout_sec=LIVE_CLOSE_TIMEOUT)
            self._stream.disconnect()
        except Exception as error:  # the live view is a convenience: the run goes on without it
            self.error = str(error)
        finally:
            self._ready.put(None)


def new_stream(run: RunInfo) -> rr.RecordingStream:
    """A rerun stream of a run, with the device's time as its only time."""
    import rerun as rr

    with Held():  # an unfinished one complains when it is dropped
        stream = rr.RecordingStream(schema.APPLICATION, recording_id=run.recording_id)
    if rr.get_application_id(recording=stream) is None:  # whatever it takes for that
        raise switched_off(f"RERUN={os.environ.get('RERUN', '')}")
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def abandon(stream: rr.RecordingStream) -> None:
    """Let nobody tidy `stream` up: rerun (0.41) may wait for a dead writer for ever, at exit or when it is deleted."""
    import rerun as rr

    rr.unregister_shutdown()
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(stream))


def _serve(run: RunInfo, port: int) -> tuple[rr.RecordingStream, str]:
    import rerun as rr

    from bench.view import dashboard

    stream = new_stream(run)
    server = rr.GrpcServerSink(bind_ip="127.0.0.1", port=port, server_memory_limit="128MiB")
    stream.set_sinks(server)
    stream.send_blueprint(dashboard.blueprint(run))
    return stream, server.uri

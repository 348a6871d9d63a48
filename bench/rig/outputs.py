"""Where a run's data goes besides its statistics: a recording, a live view, both or neither.

Imports rerun only when one of them is asked for.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.analysis.percentiles import Percentiles
from bench.analysis.verdict import Verdict
from bench.device.client import Sink
from bench.errors import RecordingError
from bench.files import check_output
from bench.rerunio.schema import RunInfo
from protocol.messages import DeviceEvent, Heartbeat
from protocol.streams import EdgeChunk, SampleChunk

if TYPE_CHECKING:
    from bench.rerunio.sinks import FileSink
    from bench.rerunio.viewer import LiveView


def has_display() -> bool:
    """Whether a window can be opened on this machine."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class _Recording(Sink):
    """A recording that keeps its failure to itself: nothing is raised into the loop that stops a motor."""

    def __init__(self, file: FileSink) -> None:
        self.file = file
        self.failure: RecordingError | None = None

    def attempt(self, action: Callable[[], None]) -> None:
        """Do it; keep the error."""
        try:
            action()
        except RecordingError as error:
            self.failure = error

    def samples(self, chunk: SampleChunk) -> None:
        """Record."""
        self.attempt(lambda: self.file.samples(chunk))

    def edges(self, chunk: EdgeChunk) -> None:
        """Record."""
        self.attempt(lambda: self.file.edges(chunk))

    def heartbeat(self, node: int, heartbeat: Heartbeat) -> None:
        """Record."""
        self.attempt(lambda: self.file.heartbeat(node, heartbeat))

    def event(self, node: int, event: DeviceEvent) -> None:
        """Record."""
        self.attempt(lambda: self.file.event(node, event))

    def missing(self, node: int, samples: int, edges: int) -> None:
        """Record."""
        self.attempt(lambda: self.file.missing(node, samples, edges))

    def note(self, text: str, level: str = "INFO") -> None:
        """Record."""
        self.attempt(lambda: self.file.note(text, level))


class Outputs:
    """Recording and live view of one run. Raises RecordingError or ViewerError when one cannot be had.

    A recording that fails later raises nothing: `failure` holds the error, and the run should end.
    """

    def __init__(
        self,
        run: RunInfo,
        save: Path | None,
        overwrite: bool,
        viewer: str,
        web_port: int | None = None,
        host_time: Callable[[float], float | None] | None = None,
        wait: bool = False,
    ) -> None:
        """`host_time`: of a device tick; `wait`: hold a caller back that is faster than the disk, for virtual time."""
        self._told = False
        self.file: FileSink | None = None
        self.view: LiveView | None = None
        self._recording: _Recording | None = None
        if viewer == "auto":
            viewer = "native" if has_display() else "web"
        if save is not None:
            check_output(save, str(save), overwrite, recording=True)
            from bench.rerunio.sinks import FileSink

            self.file = FileSink(save, run, overwrite=overwrite, wait=wait, live_drops=self.live_drops)
            self._recording = _Recording(self.file)
        if viewer != "none":
            from bench.rerunio.viewer import LiveView

            try:
                self.view = LiveView(run, viewer, web_port=web_port)
            except BaseException:
                if self.file is not None:
                    self.file.close()
                raise
        for sink in self._block_sinks() if host_time else ():
            sink.host_time = host_time

    def _block_sinks(self) -> list[Any]:
        return [sink for sink in (self.file, self.view and self.view.sink) if sink is not None]

    @property
    def sinks(self) -> list[Sink]:
        """The sinks to hand to the client."""
        view = None if self.view is None else self.view.sink
        return [sink for sink in (self._recording, view) if sink is not None]

    @property
    def failure(self) -> RecordingError | None:
        """Why the recording has failed, None as long as it has not."""
        return None if self._recording is None else self._recording.failure

    def check(self) -> None:
        """Raise RecordingError, once, if the recording has failed."""
        if self.failure is not None and not self._told:
            self._told = True
            raise self.failure

    def mark(self, name: str, first_tick: int, last_tick: int, verdict: Verdict) -> None:
        """See `FileSink.mark`; nothing without a recording."""
        if self.file is not None:
            self.file.mark(name, first_tick, last_tick, verdict)

    def summary(self, markdown: str) -> None:
        """The text that a reader of recording and view sees first."""
        if self.view is not None:
            self.view.sink.summary(markdown)
        if self._recording is not None:
            file = self._recording.file
            self._recording.attempt(lambda: file.summary(markdown))

    def live_drops(self) -> int:
        """Blocks that the live view has lost."""
        return self.view.sink.dropped_blocks if self.view else 0

    @property
    def latency(self) -> Percentiles | None:
        """Sample-to-sink latency, of the recording if there is one, else of the live view."""
        sinks = self._block_sinks()
        return sinks[0].latency if sinks else None

    def end_recording(self, summary: str) -> None:
        """Put `summary` (markdown) into recording and view, and finish the file."""
        self.summary(summary)
        if self._recording is not None:
            self._recording.attempt(self._recording.file.close)

    def recorded(self) -> dict[str, Any]:
        """What the recording holds, as plain data."""
        if self.file is None:
            return {}
        return {
            "path": str(self.file.path),
            "samples": self.file.logged_samples,
            "edges": self.file.logged_edges,
            "bytes": self.file.path.stat().st_size if self.file.path.exists() else 0,
        }

    def viewed(self) -> dict[str, Any]:
        """What the live view got, as plain data."""
        if self.view is None:
            return {}
        sink = self.view.sink
        return {
            "kind": self.view.kind,
            "url": self.view.url,
            "blocks_dropped": sink.dropped_blocks,
            "samples_dropped": sink.dropped_samples,
            "error": sink.error,
        }

    def close(self) -> None:
        """End the live view, and the recording if the run has not come to its regular end."""
        if self.view is not None:
            self.view.close()
        if self._recording is not None:
            self._recording.attempt(self._recording.file.close)

"""Where a run's data goes besides its statistics: a recording, a live view, both or neither.

Imports rerun only when a live view is asked for.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.errors import BenchError, RecordingError
from bench.files import RRD, check_output, run_folder
from bench.record.info import Mark, RunInfo, SummaryText
from bench.record.ring import FOR_EVER, Stored
from bench.signal.percentiles import Percentiles
from bench.signal.verdict import Verdict
from bench.signal.versions import versions
from bench.view import require_rerun
from protocol.framing import compiled

if TYPE_CHECKING:
    from bench.record.sink import RunSink
    from bench.view.sinks import LiveSink
    from bench.view.viewer import LiveView


def load_beside(recording: bool, view: bool) -> None:
    """Import what a link, a recording or a view needs in a thread of its own, while the embedded drive is waited for.

    Not a daemon: an interpreter that ends within the import of an extension may abort.
    """

    def load() -> None:
        with suppress(Exception):  # who needs it is told; an interpreter that ends refuses some
            import protocol.links.tcp  # noqa: F401

            compiled()
            if recording or view:
                import bench.record.sink

                versions()
            if view:
                import bench.view.dashboard
                import bench.view.log
                import bench.view.sinks  # noqa: F401

    threading.Thread(target=load, name="import").start()


def require_viewable(save: Path | None, viewer: str) -> None:
    """Raise ViewerError where rerun is needed, for a live view or a file of its own, and switched off."""
    if viewer != "none":
        require_rerun("choose --viewer none (in Python: viewer='none')")
    elif save is not None and save.suffix == RRD:
        require_rerun("record to a .run")


@dataclass(frozen=True)
class Recording:
    """What is kept and shown of a run: the file, and what it says of itself beside drive and bench; the viewer."""

    path: Path | None = None
    about: dict[str, str] = field(default_factory=dict)
    viewer: str = "none"
    overwrite: bool = True
    web_port: int | None = None
    stored: Stored = FOR_EVER
    """How a recording is kept that goes on for long."""


class Outputs:
    """Recording and live view of one run. Raises RecordingError or ViewerError when one cannot be had.

    A recording that fails later raises nothing: `failure` holds the error, and the run should end.
    """

    def __init__(self, run: RunInfo, recording: Recording, wait: bool = False) -> None:
        """`wait`: hold a caller back that is faster than the disk, for virtual time."""
        save = recording.path
        require_viewable(save, recording.viewer)
        self.file: RunSink | None = None
        self._rrd = save if save is not None and save.suffix == RRD else None
        self.view: LiveView | None = None
        if save is not None:
            check_output(save, str(save), recording.overwrite, recording=True)
            from bench.record.sink import RunSink

            self.file = RunSink(
                run_folder(save), run, overwrite=recording.overwrite, wait=wait, stored=recording.stored
            )
        if recording.viewer != "none":
            from bench.view.viewer import LiveView, chosen

            try:
                kind = chosen(recording.viewer)
                self.view = LiveView(run, kind, web_port=recording.web_port)
            except BaseException:
                if self.file is not None:
                    self.file.close()
                raise

    def time_by(self, host_time: Callable[[float], float | None]) -> None:
        """Tell recording and view the host's time of a device tick, None while that is not known."""
        for sink in self.sinks:
            sink.host_time = host_time

    @property
    def sinks(self) -> list[RunSink | LiveSink]:
        """The sinks to hand to the client."""
        return [*([self.file] if self.file else []), *([self.view.sink] if self.view else [])]

    @property
    def failure(self) -> RecordingError | None:
        """Why the recording has failed, None as long as it has not."""
        return None if self.file is None else self.file.error

    def check(self) -> None:
        """Raise RecordingError, once, if the recording has failed."""
        if self.file is not None:
            self.file.check()

    def news(self) -> Iterator[tuple[str, str]]:
        """What the recording has to tell a person since the last call: text and level."""
        while self.file is not None and self.file.news:
            yield self.file.news.popleft()

    def mark(
        self, name: str, first_tick: int, last_tick: int, verdict: Verdict | None = None, routine: bool = False
    ) -> None:
        """Mark a stretch of the recording, if there is one: `name` was measured there, and ended so.

        `routine`: see `Mark`.
        """
        if self.file is not None:
            self.file.take(Mark(name, first_tick, last_tick, verdict, routine=routine))

    def summary(self, markdown: str) -> None:
        """The text that a reader of recording and view sees first."""
        for sink in self.sinks:
            sink.take(SummaryText(markdown))

    @property
    def latency(self) -> Percentiles | None:
        """Sample-to-sink latency, of the recording if there is one, else of the live view."""
        return next((sink.latency for sink in self.sinks), None)

    def end_recording(self, summary: str) -> None:
        """Put `summary` (markdown) into recording and view, and end the recording. Raises RecordingError, once."""
        self.summary(summary)
        if self.file is not None:
            self.file.close()
            if self._rrd is not None and self.file.error is None:
                from bench.record.reader import Run
                from bench.view.viewing import write_rrd

                write_rrd(Run(self.file.path), self._rrd)

    def recorded(self) -> dict[str, Any]:
        """What the recording holds, as plain data."""
        if self.file is None:
            return {}
        runs = self.file.parts
        return {
            "path": str(runs[0]),
            "samples": self.file.logged_samples,
            "edges": self.file.logged_edges,
            "bytes": sum(file.stat().st_size for run in runs for file in run.glob("*")),
            "parts": len(runs),
            "kept_s": self.file.stored.keep,
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
        if self.file is not None:
            with suppress(BenchError):  # what ended the run matters more
                self.file.close()

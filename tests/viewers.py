"""rerun's headless viewer for tests, driven through its own client."""

from __future__ import annotations

import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
from rerun.experimental import ViewerClient, ViewerState

from bench.view.viewer import HOST, binary

TIMEOUT = 60.0  # s; a viewer that draws in software on a busy machine takes its time


def any_port() -> int:
    """A TCP port that is free now."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


class HeadlessViewer:
    def __init__(self, process: subprocess.Popen[bytes], port: int) -> None:
        self._process = process
        self.client = self._until(lambda: ViewerClient.connect(f"rerun+http://{HOST}:{port}/proxy"))

    def _until(self, attempt):
        end = time.monotonic() + TIMEOUT
        while True:
            try:
                found = attempt()
            except ConnectionError:
                found = None
            if found:
                return found
            assert self._process.poll() is None, "the viewer has ended"
            assert time.monotonic() < end, "the viewer does not answer"
            time.sleep(0.05)

    def await_recording(self) -> ViewerState:
        """The viewer's state once a recording with data is loaded and its views are drawn."""

        def loaded() -> ViewerState | None:
            state = self.client.get_state()
            ready = not state.loading and state.views and state.recordings and state.recordings[0].timelines
            return state if ready else None

        return self._until(loaded)

    def send_signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)


@contextmanager
def headless(*arguments: str) -> Iterator[HeadlessViewer]:
    port = any_port()
    process = subprocess.Popen(
        [str(binary()), "--headless", "--bind", HOST, "--port", str(port), "--hide-welcome-screen", *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield HeadlessViewer(process, port)
    finally:
        process.kill()
        process.wait()


def graphics() -> bool:
    """Whether the headless viewer draws a recording here: it needs a Vulkan driver, Mesa's software one will do."""
    try:
        with tempfile.TemporaryDirectory() as folder, headless() as viewer:
            path = Path(folder, "x.rrd")
            with rr.RecordingStream("trial") as stream:
                stream.save(path)
                stream.log("x", rr.Scalars(1.0))
            viewer.client.open(str(path))
            return bool(viewer.await_recording().views)
    except (AssertionError, ConnectionError):
        return False

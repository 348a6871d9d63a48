"""Starts, watches and ends the programs that show a live view: rerun's native viewer, or its web viewer's server.

Both connect to the gRPC server that `LiveSink` runs in this process; everything listens on 127.0.0.1 only. A viewer
process never outlives its run: it ends with `close`, with the interpreter, and with a guard that sees this process die
(kill -9 too). Ports are tried before they are used, because rerun says nothing when one is busy.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import quote

from bench.errors import ViewerError
from bench.record.info import RunInfo
from bench.system import APART
from bench.view.sinks import LiveSink

HOST = "127.0.0.1"
GRPC_PORT = 9876
WEB_PORT = 9090
PORTS_TRIED = 100
NATIVE_OPTIONS = ("--bind", HOST, "--port", "auto", "--hide-welcome-screen", "--memory-limit", "2GB")
START_TIMEOUT = 15.0  # s
NATIVE_GRACE = 1.0  # s: a viewer without a display ends sooner than that

# Arguments: the viewer. Standard input is a pipe from the bench: when it ends, so does the whole process group, or the
# viewer where there are none.
_GUARD = """
exec 3<&0
"$@" 3<&- </dev/null &
viewer=$!
( cat <&3; kill -9 -$$ ) >/dev/null 2>&1 &
exec 3<&-
wait $viewer
"""
_GUARD_WITHOUT_GROUPS = """
import subprocess, sys, threading
viewer = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
threading.Thread(target=lambda: (sys.stdin.buffer.read(), viewer.kill()), daemon=True).start()
sys.exit(viewer.wait())
"""
_GUARDED = (
    [sys.executable, "-I", "-c", _GUARD_WITHOUT_GROUPS]
    if sys.platform == "win32"
    else ["/bin/sh", "-c", _GUARD, "guard"]
)
# Linux needs SO_REUSEADDR for a port that was used just now; on Windows that takes a port away from who listens there.
_ALONE = getattr(socket, "SO_EXCLUSIVEADDRUSE", socket.SO_REUSEADDR)
_GUARD_TIME = 2.0  # s in which a guard ends its viewer
_SLICE = 0.2  # s: on Windows no signal ends a wait


def free_port(first: int, wanted: int | None = None, use: str = "the live view") -> int:
    """Return a free TCP port on 127.0.0.1: `wanted`, or the first free one from `first` up.

    Raises ViewerError if `wanted` is taken or no port is free.
    """
    if wanted is not None:
        if not _is_free(wanted):
            raise ViewerError(f"port {wanted} for {use} is in use: choose another, or leave it out to take a free one")
        return wanted
    for port in range(first, first + PORTS_TRIED):
        if _is_free(port):
            return port
    raise ViewerError(f"no free port for {use} from {first} to {first + PORTS_TRIED - 1}: name one that is free")


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, _ALONE, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError):
            return False
        return True


def binary() -> Path:
    """The viewer itself. The `rerun` script is a shim: killing that would orphan the viewer."""
    import rerun_cli

    paths = [Path(rerun_cli.__file__).with_name(name) for name in ("rerun", "rerun.exe")]
    for path in paths:
        if path.exists():
            return path
    raise ViewerError(f"rerun's viewer is missing at {paths[0]}: reinstall rerun-sdk, or use --viewer none")


class ViewerProcess:
    """A viewer in a process group of its own, with a guard that ends it when this process dies."""

    def __init__(self, arguments: list[str]) -> None:
        self._process = subprocess.Popen(
            [*_GUARDED, str(binary()), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            creationflags=APART,
        )
        self.group = self._process.pid
        atexit.register(self.close)

    @property
    def running(self) -> bool:
        """Whether the viewer runs; a native viewer ends when its window is closed."""
        return self._process.poll() is None

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the viewer ends (its window is closed); False after `timeout` s."""
        while sys.platform == "win32" and timeout is None:
            if self.wait(_SLICE):
                return True
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """End the viewer and its guard, stopped ones too."""
        atexit.unregister(self.close)
        assert self._process.stdin is not None
        if sys.platform == "win32":
            self._process.stdin.close()
            if not self.wait(_GUARD_TIME):
                self._process.kill()
                self.wait()
        else:
            for number in (signal.SIGTERM, signal.SIGKILL):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(self.group, number)
                if self.wait(0.5 if number == signal.SIGTERM else None):
                    break
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.group, signal.SIGKILL)
            self._process.stdin.close()


def serve_file(path: Path, kind: str, web_port: int | None = None) -> tuple[ViewerProcess, str]:
    """Open an .rrd in a `native` viewer, or serve it to browsers (`web`); the process, and the address of the latter.

    Raises ViewerError when a port is taken or the viewer does not start.
    """
    if kind == "native":
        process = ViewerProcess([str(path), *NATIVE_OPTIONS])
        if process.wait(NATIVE_GRACE):
            raise ViewerError("rerun's viewer ended at once (no display, no graphics driver?): use --viewer web")
        return process, ""
    port, web = free_port(GRPC_PORT), free_port(WEB_PORT, web_port, "the web viewer")
    ports = ["--port", str(port), "--web-viewer-port", str(web)]
    process = ViewerProcess(["--serve-web", "--bind", HOST, *ports, str(path)])
    try:
        _await_port(process, web)
    except BaseException:
        process.close()
        raise
    source = quote(f"rerun+http://{HOST}:{port}/proxy", safe="")
    return process, f"http://{HOST}:{web}/?url={source}&theme=dark"


def chosen(viewer: str) -> str:
    """The kind of viewer that `auto` stands for here: native on a display, else web."""
    if viewer != "auto":
        return viewer
    display = sys.platform in ("darwin", "win32") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    return "native" if display else "web"


class LiveView:
    """A live sink with its viewer. `url` is what to open in a browser, or what a native viewer connects to.

    `kind` is `native` or `web`; a web view holds still between its steps. Raises ViewerError when a port is taken or
    the viewer does not start.
    """

    def __init__(self, run: RunInfo, kind: str, *, grpc_port: int | None = None, web_port: int | None = None) -> None:
        if kind not in ("native", "web"):
            raise ViewerError(f"viewer {kind!r}: choose native, web or none")
        port = free_port(GRPC_PORT, grpc_port)
        web = free_port(WEB_PORT, web_port, "the web viewer") if kind == "web" else 0
        binary()
        self.kind = kind
        self.sink = LiveSink(run, port, hold=kind == "web")
        if kind == "web":
            arguments = ["--serve-web", "--bind", HOST, "--web-viewer-port", str(web), self.sink.url]
            self.url = f"http://{HOST}:{web}/?url={quote(self.sink.url, safe='')}&theme=dark"
        else:
            arguments = ["--connect", self.sink.url, *NATIVE_OPTIONS]
            self.url = self.sink.url
        self.process = ViewerProcess(arguments)
        try:
            if kind == "web":
                _await_port(self.process, web)
            elif self.process.wait(NATIVE_GRACE):
                raise ViewerError("rerun's viewer ended at once (no display, no graphics driver?): use --viewer web")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the server, then the viewer."""
        self.sink.close()
        self.process.close()


def _await_port(process: ViewerProcess, port: int) -> None:
    """Wait until the viewer answers there."""
    end = time.monotonic() + START_TIMEOUT
    while time.monotonic() < end:
        if not process.running:
            raise ViewerError("rerun's web viewer ended at once: use --viewer none, or reinstall rerun-sdk")
        with socket.socket() as probe:
            if probe.connect_ex((HOST, port)) == 0:
                return
        process.wait(0.05)
    raise ViewerError(f"rerun's web viewer did not answer on port {port} within {START_TIMEOUT:g} s")

"""Ports are tried, viewers listen on this machine only, and none outlives its run."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from collections.abc import Callable

import psutil
import pytest
import synthetic

from bench.view.viewer import HOST, LiveView, ViewerError, ViewerProcess, binary, free_port
from tests.viewers import any_port

pytestmark = [pytest.mark.alone, pytest.mark.slow]


def until(condition: Callable[[], bool], timeout: float = 20.0) -> bool:
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def viewers(group: int) -> list[psutil.Process]:
    """The living processes of a group."""
    found = []
    for process in psutil.process_iter():
        try:
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
        except (ProcessLookupError, psutil.NoSuchProcess):
            continue
    return found


def listening(group: int) -> set[tuple[str, int]]:
    """Addresses on which a group's processes listen."""
    return {
        (connection.laddr.ip, connection.laddr.port)
        for process in viewers(group)
        for connection in process.net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    }


def test_a_busy_port_is_named_when_asked_for_and_passed_over_otherwise() -> None:
    with socket.socket() as other:
        other.bind((HOST, 0))
        other.listen()
        port = other.getsockname()[1]
        assert free_port(port) > port
        with pytest.raises(ViewerError, match=f"port {port} for the web viewer is in use"):
            free_port(0, port, "the web viewer")
        with pytest.raises(ViewerError, match=f"port {port}"):
            LiveView(synthetic.run_info(), "web", web_port=port)


def test_a_viewer_that_is_none_is_refused() -> None:
    with pytest.raises(ViewerError, match="viewer 'hologram': choose native, web or none"):
        LiveView(synthetic.run_info(), "hologram")


def test_the_web_viewer_serves_its_page_on_this_machine_only_and_ends_with_the_run() -> None:
    view = LiveView(synthetic.run_info(), "web", grpc_port=any_port(), web_port=any_port())
    try:
        assert urllib.parse.parse_qs(urllib.parse.urlparse(view.url).query)["url"] == [view.sink.url]
        with urllib.request.urlopen(view.url, timeout=10) as page:
            assert b"re_viewer" in page.read()
        group = view.process.group
        assert {address for address, _ in listening(group)} == {HOST}
        mine = {c.laddr.ip for c in psutil.Process().net_connections("tcp") if c.status == psutil.CONN_LISTEN}
        assert mine <= {HOST}
    finally:
        view.close()
    assert until(lambda: not viewers(group))


def test_a_stopped_viewer_ends_all_the_same() -> None:
    port = any_port()
    process = ViewerProcess(["--serve-grpc", "--bind", HOST, "--port", str(port)])
    assert until(lambda: (HOST, port) in listening(process.group))
    os.killpg(process.group, signal.SIGSTOP)
    process.close()
    assert not process.running
    assert until(lambda: not viewers(process.group))


def test_a_viewer_that_cannot_start_is_seen_to_have_ended() -> None:
    process = ViewerProcess(["--no-such-option"])
    assert process.wait(20.0)
    assert not process.running
    process.close()


def test_kill_9_of_the_bench_ends_its_viewer() -> None:
    port = any_port()
    code = f"""
from bench.view.viewer import ViewerProcess
viewer = ViewerProcess(["--serve-grpc", "--bind", "{HOST}", "--port", "{port}"])
print(viewer.group, flush=True)
input()
"""
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        group = int(child.stdout.readline())
        assert until(lambda: (HOST, port) in listening(group))
        child.send_signal(signal.SIGKILL)
    assert until(lambda: not viewers(group))


def test_the_binary_is_the_viewer_not_the_script() -> None:
    assert binary().read_bytes()[:2] != b"#!"

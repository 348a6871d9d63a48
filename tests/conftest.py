"""Lets several workers share the suite (`pytest -n 2`): tests in real time get the machine to themselves.

A drive in real time, a watchdog or a viewer needs a core when its time has come, and a worker beside it that computes
takes it away. So every test holds a lock while it runs: those in real time alone, the others together.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

REAL_TIME = (
    "bench/acceptance/test_safety_accept.py",
    "bench/rerunio/test_viewer.py",
    "bench/test_can_logs.py::test_cantools",
    "bench/test_errors.py::test_a_wrong_baud_rate",
    "bench/test_live_process.py",
    "bench/test_node.py::test_a_client_that_polls",
    "sim/drive/test_server_process.py",
)
"""Tests that a busy neighbour upsets: modules, or the beginning of a test's name in one."""
HERE = Path(__file__).parent


@contextmanager
def _locked(path: Path, how: int) -> Iterator[None]:
    with path.open("w") as file:
        fcntl.flock(file, how)
        yield


@contextmanager
def _turn(alone: bool) -> Iterator[None]:
    """Hold the machine, alone or with others; who waits for it alone lets nobody else in meanwhile."""
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID")
    if run is None:
        yield
        return
    door, room = (Path(tempfile.gettempdir()) / f"hallbench-tests-{run}.{name}" for name in ("door", "room"))
    with ExitStack() as stack:
        with _locked(door, fcntl.LOCK_EX):
            stack.enter_context(_locked(room, fcntl.LOCK_EX if alone else fcntl.LOCK_SH))
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Run a test in its turn."""
    where = f"{item.path.relative_to(HERE).as_posix()}::{item.name}"
    with _turn(where.startswith(REAL_TIME)):
        return (yield)

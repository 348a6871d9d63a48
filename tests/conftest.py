"""Lets several workers share the suite (`pytest -n 2`): those in real time do not run beside those that compute.

A drive in real time, a watchdog or a viewer needs a core when its time has come, and a worker beside it that computes
takes it away. So every test holds a lock of its kind while it runs, which others of that kind share. Those in real time
come last, so that they run beside one another.
"""

from __future__ import annotations

import fcntl
import os
import signal
import tempfile
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's job in the background begins without Ctrl-C

ALONE = (
    "bench/rerunio/test_viewer.py",
    "bench/test_kills.py",
)
REAL_TIME = (
    "bench/acceptance/test_safety_accept.py",
    "bench/test_errors.py::test_a_wrong_baud_rate",
    "bench/test_interrupts.py::test_ctrl_c_in_a_terminal",
    "bench/test_live_process.py",
    "bench/test_node.py::test_a_client_that_polls",
    "sim/drive/test_server_process.py",
)
"""Tests that a busy neighbour upsets, any neighbour or one that computes: modules, or the beginning of a test's name in
one; more are marked real_time."""
KINDS = ("computing", "real-time")
SLOW = (
    *ALONE, *REAL_TIME,
    "bench/acceptance/test_accept.py", "bench/acceptance/test_loads.py", "bench/acceptance/test_own_test.py",
    "bench/acceptance/test_sabotage.py", "bench/acceptance/test_settings.py", "bench/acceptance/test_suite.py",
    "bench/acceptance/test_verdicts.py", "bench/rerunio/test_dashboard.py", "bench/rerunio/test_recording.py",
    "bench/rerunio/test_rendered.py",
    "bench/rerunio/test_sinks.py", "bench/test_account.py", "bench/test_any_drive.py", "bench/test_augment.py",
    "bench/test_bad_drive.py", "bench/test_can_cli.py", "bench/test_can_faults.py", "bench/test_can_logs.py",
    "bench/test_errors.py", "bench/test_estimators.py", "bench/test_hall_check.py", "bench/test_interrupts.py",
    "bench/test_motors.py",
    "bench/test_node.py", "bench/test_notebook_page.py", "bench/test_output.py", "bench/test_parity.py",
    "bench/test_prompt.py", "bench/test_replay.py", "bench/test_score.py", "protocol/c/test_c_hard.py",
    "protocol/canmap/test_can_fuzz.py",
    "protocol/canmap/test_can_streams.py", "protocol/links/test_can_link.py", "protocol/test_lying_device.py",
    "sim/drive/test_edge_kalman_in_the_loop.py", "sim/drive/test_tick_protection.py",
    "sim/observers/test_vector_tracking_q15.py",
)  # fmt: skip
"""What the quick tier leaves out: `pytest -n 2 -m "not slow"`."""
HERE = Path(__file__).parent


@contextmanager
def _locked(path: Path, how: int) -> Iterator[None]:
    with path.open("w") as file:
        fcntl.flock(file, how)
        yield


def _where(item: pytest.Item) -> str:
    return f"{item.path.relative_to(HERE).as_posix()}::{item.name}"


def _kind(item: pytest.Item) -> str:
    where = _where(item)
    if where.startswith(ALONE):
        return "alone"
    marked = any(item.iter_markers("real_time")) or any(item.iter_markers("real_links"))
    return "real-time" if marked or where.startswith(REAL_TIME) else "computing"


@contextmanager
def _turn(kind: str) -> Iterator[None]:
    """Hold the machine for a test of this kind; who waits for it lets nobody else in meanwhile."""
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID")
    if run is None:
        yield
        return
    door, *rooms = (Path(tempfile.gettempdir()) / f"hallbench-tests-{run}.{name}" for name in ("door", *KINDS))
    with ExitStack() as stack:
        with _locked(door, fcntl.LOCK_EX), ExitStack() as waiting:
            for room, others in zip(rooms, KINDS, strict=True):
                if others == kind:
                    stack.enter_context(_locked(room, fcntl.LOCK_SH))
                else:  # until they are done
                    (stack if kind == "alone" else waiting).enter_context(_locked(room, fcntl.LOCK_EX))
        yield


def pytest_addoption(parser: pytest.Parser) -> None:
    """What takes long and need not run each time."""
    parser.addoption("--real-links", action="store_true", help="the test device over pty, TCP and CAN too")


def pytest_configure(config: pytest.Config) -> None:
    """Hand the tests out one by one: two workers are then at the same place of the order, and end together."""
    if getattr(config.option, "maxschedchunk", 1) is None:
        config.option.maxschedchunk = 1
    config.pluginmanager.register(Order())


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what was not asked for, mark what is slow."""
    for item in items:
        if _where(item).startswith(SLOW):
            item.add_marker("slow")
    if not config.getoption("--real-links"):
        left_out = [item for item in items if any(item.iter_markers("real_links"))]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]


class Order:
    """Its own plugin, since what pytest itself puts together by fixtures must be done by then."""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Long tests first, those in real time last."""
        long = {item for item in items if any(item.iter_markers("slow"))}
        items.sort(key=lambda item: (("computing", "real-time", "alone").index(_kind(item)), item not in long))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Run a test in its turn."""
    with _turn(_kind(item)):
        return (yield)

"""Signals that wait until the code that they would break is done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator

import pytest

from sim.interrupts import ENDING, Held


class Stop(BaseException):
    pass


@pytest.fixture(autouse=True)
def raising() -> Iterator[None]:
    def stop(number: int, frame: object) -> None:
        raise Stop(number)

    before = signal.signal(signal.SIGALRM, stop)
    yield
    signal.signal(signal.SIGALRM, before)


def test_a_handler_runs_on_leaving() -> None:
    seen = []

    def work() -> None:
        with Held() as held:
            signal.raise_signal(signal.SIGALRM)
            seen.extend(held.came)
            seen.append("left")
        seen.append("never")

    with pytest.raises(Stop):
        work()
    assert seen == [signal.SIGALRM, "left"]
    assert Held.active is None
    with pytest.raises(Stop):
        signal.raise_signal(signal.SIGALRM)


def test_signals_without_a_handler_keep_their_default_unless_nothing_may_disturb() -> None:
    before = {number: signal.getsignal(number) for number in ENDING}
    assert before[signal.SIGTERM] is signal.SIG_DFL
    with Held():
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    with Held(undisturbed=True):
        assert all(callable(signal.getsignal(number)) for number in ENDING)
    assert {number: signal.getsignal(number) for number in ENDING} == before


def test_a_thread_has_nothing_to_hold() -> None:
    """Handlers run in the main thread: there, and at once, while another thread is in one."""
    entered, leave = threading.Event(), threading.Event()

    def work() -> None:
        with Held():
            entered.set()
            leave.wait(10.0)

    thread = threading.Thread(target=work)
    thread.start()
    entered.wait(10.0)
    assert Held.active is None
    try:
        with pytest.raises(Stop):
            signal.raise_signal(signal.SIGALRM)
    finally:
        leave.set()
        thread.join()

"""Signals while a motor turns: they become exceptions, and none of them gets between us and STOP."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from bench.errors import Interrupted
from sim.interrupts import ENDING, Held

AGAIN = 0.01  # s


@contextmanager
def signals_as_exceptions(kind: type[BaseException] = Interrupted) -> Iterator[None]:
    """SIGTERM, SIGHUP and SIGQUIT raise `kind(number)` in the main thread, as Ctrl-C raises KeyboardInterrupt."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise kind(number)

    before = {number: signal.signal(number, interrupt) for number in ENDING if number != signal.SIGINT}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def none_dropped() -> Iterator[None]:
    """A signal whose exception came where Python drops it, such as in a callback of its import system, comes again."""
    before = sys.unraisablehook

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        dropped = unraisable.exc_value
        if not isinstance(dropped, (KeyboardInterrupt, Interrupted)):
            before(unraisable)
            return
        number = dropped.signum if isinstance(dropped, Interrupted) else signal.SIGINT
        again = threading.Timer(AGAIN, os.kill, (os.getpid(), number))  # not in here
        again.daemon = True
        again.start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before


@contextmanager
def undisturbed() -> Iterator[list[int]]:
    """No signal but SIGKILL takes effect inside; the first that came does on leaving. Gives those that have come.

    An exception of the inside itself goes on instead: it ends what the signal would have ended.
    """
    with Held(undisturbed=True) as held:
        yield held.came

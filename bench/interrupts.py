"""Signals while a motor turns: they become exceptions, and none of them gets between us and STOP."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from bench.errors import Interrupted

_ENDS = (signal.SIGTERM, signal.SIGHUP)


@contextmanager
def signals_as_exceptions(kind: type[BaseException] = Interrupted) -> Iterator[None]:
    """SIGTERM and SIGHUP raise `kind(number)` in the main thread, as Ctrl-C raises KeyboardInterrupt."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise kind(number)

    before = {number: signal.signal(number, interrupt) for number in _ENDS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def undisturbed() -> Iterator[list[int]]:
    """No signal but SIGKILL takes effect inside; the first that came does on leaving. Gives those that have come.

    An exception of the inside itself goes on instead: it ends what the signal would have ended.
    """
    came: list[int] = []

    def remember(number: int, frame: FrameType | None) -> None:
        came.append(number)

    before = {number: signal.signal(number, remember) for number in (signal.SIGINT, *_ENDS)}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])

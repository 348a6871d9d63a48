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
def undisturbed() -> Iterator[None]:
    """No signal but SIGKILL is heard."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, *_ENDS)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

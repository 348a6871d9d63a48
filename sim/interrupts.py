"""Signals that wait, for code that an exception out of a signal handler would break.

A handler, such as Python's own of Ctrl-C, runs in the main thread between any two steps of Python code, and may raise
there. Elsewhere nothing has to wait.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any, ClassVar

# What `signal` makes enums of, for 10 us a call. typeshed does not know it.
from _signal import getsignal, signal as set_handler  # type: ignore[import-not-found]  # isort: skip


def there(*names: str) -> tuple[signal.Signals, ...]:
    """Those of these signals that this system has."""
    return tuple(signal.Signals[name] for name in names if name in signal.Signals.__members__)


ENDING = there("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK")
"""Signals that ask a process to end, and that it may put off. SIGBREAK is Windows' Ctrl-Break."""
HELD = (*ENDING, *there("SIGALRM"))


def send(number: int) -> None:
    """Send this process a signal, from any thread."""
    if sys.platform != "win32":
        os.kill(os.getpid(), number)
    elif getsignal(number) is signal.SIG_DFL:
        os._exit(128 + number)  # as shells elsewhere tell it; Windows' own `os.kill` ends a process with `number`
    else:
        _thread.interrupt_main(signal.Signals(number))


class Held:
    """Context manager: handlers of signals run on leaving, that of the first that came first.

    An exception of the inside goes on instead, and what came is forgotten: it ends what the signal would have ended.
    Inside another one it does nothing, and gives that one. `came`: the signals so far.

    Args:
        undisturbed: signals that have no handler wait too, instead of ending the process or being ignored.
    """

    active: ClassVar[Held | None] = None
    """The outermost one, if the main thread is in one."""

    def __init__(self, undisturbed: bool = False) -> None:
        self.came: list[int] = []
        self.undisturbed = undisturbed
        self._holding = False
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Held:
        if threading.current_thread() is not threading.main_thread():
            return self
        if Held.active is None:
            numbers = ENDING if self.undisturbed else HELD
            self._handlers = {
                n: h for n in numbers if callable(h := getsignal(n)) or (self.undisturbed and h is not None)
            }
            Held.active, self._holding = self, True
            try:
                for number in self._handlers:
                    set_handler(number, self._remember)
            except BaseException:  # out of a handler that was not replaced yet
                self._let_go()
                raise
        return Held.active

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if Held.active is not self:
            return
        self._let_go()
        if self.came and error is None:
            signal.raise_signal(self.came[0])

    def _let_go(self) -> None:
        try:
            for number, handler in self._handlers.items():
                set_handler(number, handler)
        finally:  # a handler that was restored may raise: `_remember` stands in for the others
            self._holding, Held.active = False, None

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if self._holding:
            self.came.append(number)
        elif callable(handler := self._handlers[number]):
            handler(number, frame)
        else:
            set_handler(number, handler)
            signal.raise_signal(number)

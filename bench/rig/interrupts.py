"""Signals while a motor turns: they become exceptions, and none of them gets between us and STOP."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from bench.errors import Interrupted
from sim.interrupts import ENDING, Held, send

AGAIN = 0.01  # s
CONDITION = {found.__code__ for found in vars(threading.Condition).values() if hasattr(found, "__code__")}
IMPORT = "<frozen importlib._bootstrap>"
"""The file that Python gives for the code of its import system."""


def ctrl_c_kills() -> None:
    """Ctrl-C ends this process at once, without a word: while it loads, there is nothing yet to put right."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def killed_by_ctrl_c() -> None:
    """End this process as Ctrl-C does where nobody catches it, without a word."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    send(signal.SIGINT)


@contextmanager
def none_dropped() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt in the main thread, and it does so again where Python drops that exception.

    Python drops what is raised in a finaliser or in a callback of a weak reference, and tells of it. Within an import,
    modules in C drop it without a word, and classes wrap it in another one: there it waits until the import is done.
    Within the methods of a Condition it would leave a lock behind that nobody opens: there it waits as well.
    """
    before = sys.unraisablehook

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if isinstance(unraisable.exc_value, Interrupted):
            _again(unraisable.exc_value.signum)
        elif isinstance(unraisable.exc_value, KeyboardInterrupt):
            _again(signal.SIGINT)
        else:
            before(unraisable)

    wanted = signal.getsignal(signal.SIGINT) is not signal.SIG_IGN  # a shell's `command &`, nohup
    with _handled({signal.SIGINT: lambda _: KeyboardInterrupt()} if wanted else {}):
        sys.unraisablehook = hook
        try:
            yield
        finally:
            sys.unraisablehook = before


@contextmanager
def signals_as_exceptions(kind: type[BaseException] = Interrupted) -> Iterator[None]:
    """All of `ENDING` but SIGINT raise `kind(number)` in the main thread, as Ctrl-C raises KeyboardInterrupt."""
    with _handled(dict.fromkeys((number for number in ENDING if number != signal.SIGINT), kind)):
        yield


@contextmanager
def _handled(exceptions: dict[signal.Signals, Callable[[int], BaseException]]) -> Iterator[None]:
    """Each of these signals raises what its function makes of its number."""

    outside = _imports(sys._getframe())  # this program itself may be run by an import

    def interrupt(number: int, frame: FrameType | None) -> None:
        if _imports(frame) > outside or _locks(frame):
            _again(number)
        else:
            raise exceptions[signal.Signals(number)](number)

    if threading.current_thread() is not threading.main_thread():  # signals come to the main thread, and stay its own
        exceptions = {}
    before = {number: signal.signal(number, interrupt) for number in exceptions}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _imports(frame: FrameType | None) -> int:
    """How many frames of Python's import system `frame` and its callers have."""
    found = 0
    while frame is not None:
        found += frame.f_code.co_filename == IMPORT
        frame = frame.f_back
    return found


def _locks(frame: FrameType | None) -> bool:
    """Whether `frame` is a method of Python's Condition, and may hold its lock; where one waits it does not."""
    if frame is None or frame.f_code not in CONDITION:
        return False
    return frame.f_code.co_name != "wait" or "gotit" not in frame.f_locals  # with that variable an exception is safe


def _again(number: int) -> None:
    """The signal comes again soon, not in here. No Thread: its locks may be held where a handler runs."""

    def later() -> None:
        time.sleep(AGAIN)
        send(number)

    _thread.start_new_thread(later, ())


def signal_of(interrupt: BaseException) -> int:
    """The number of the signal that came as this exception: KeyboardInterrupt or Interrupted."""
    return interrupt.signum if isinstance(interrupt, Interrupted) else signal.SIGINT


class FirstSignal:
    """The number of the first signal that came in a run that goes on to its regular end all the same; 0: none."""

    def __init__(self) -> None:
        self.number = 0
        self.interrupt: BaseException | None = None
        """What it came as: KeyboardInterrupt or Interrupted."""
        self.came: list[int] = []
        """Signals that have come in what is, or was last, not to be interrupted."""

    def remember(self, interrupt: BaseException) -> None:
        """That came as this exception."""
        self.interrupt = self.interrupt or interrupt
        self.number = self.number or signal_of(interrupt)

    def uninterrupted(self, action: Callable[[], object]) -> None:
        """Do it undisturbed, once. A signal that comes before, meanwhile or after is remembered."""
        begun = False
        while not begun:
            try:
                with undisturbed() as self.came:
                    begun = True
                    action()
            except (KeyboardInterrupt, Interrupted) as interrupt:
                self.remember(interrupt)


@contextmanager
def undisturbed() -> Iterator[list[int]]:
    """No signal but SIGKILL takes effect inside; the first that came does on leaving. Gives those that have come.

    An exception of the inside itself goes on instead: it ends what the signal would have ended.
    """
    with Held(undisturbed=True) as held:
        yield held.came

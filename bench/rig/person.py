"""Asking the person at the terminal to do something, while the bench goes on.

Nothing here blocks, knows a drive or decides how long to wait: it shows the words and tells whether Enter was pressed.
"""

from __future__ import annotations

import os
import select
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import click

from bench.errors import BenchError

Answered = Callable[[float], bool]
"""Waits for at most so many s; whether the person has done it. BenchError when nobody is there any more."""
Ask = Callable[[str], AbstractContextManager[Answered]]
"""Shows a person what to do, as long as one is within it."""


def at_terminal() -> bool:
    """Whether somebody can be asked."""
    return sys.__stdin__ is not None and sys.__stdin__.isatty()


@contextmanager
def asked(words: str) -> Iterator[Answered]:
    """Ask on the terminal: an `Ask`. What was typed before the question is no answer."""
    assert sys.__stdin__ is not None
    terminal = sys.__stdin__.fileno()

    def answered(timeout: float) -> bool:
        if not select.select([terminal], [], [], timeout)[0]:
            return False
        try:
            line = os.read(terminal, 1024)
        except OSError:  # it was hung up
            line = b""
        if not line:
            raise BenchError(f"there is no terminal any more to ask: {words}")
        return True

    termios.tcflush(terminal, termios.TCIFLUSH)
    click.echo(f"{words}, then press Enter: ", nl=False, err=True)
    try:
        yield answered
    except BaseException:
        click.echo(err=True)  # what comes next has a line of its own
        raise

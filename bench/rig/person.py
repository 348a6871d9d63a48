"""Asking the person at the terminal to do something, while the bench goes on.

Nothing here blocks, knows a drive or decides how long to wait: it shows the words and tells whether Enter was pressed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import click

from bench.errors import BenchError
from bench.system import forget_typed, typed_line

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
        line = typed_line(terminal, timeout)
        if line == b"":
            raise BenchError(f"there is no terminal any more to ask: {words}")
        return line is not None

    forget_typed(terminal)
    click.echo(f"{words}, then press Enter: ", nl=False, err=True)
    try:
        yield answered
    except BaseException:
        click.echo(err=True)  # what comes next has a line of its own
        raise

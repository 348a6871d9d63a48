"""Tables and progress for people: rich on a terminal, plain tab-free lines when piped.

What stands in them is text, never markup, and without control characters.
"""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Self

import click

from bench.cli.streams import echo, lines, note
from protocol.text import printable

if TYPE_CHECKING:
    from rich.status import Status

NARROW = 11
"""Columns that words keep on a terminal too narrow for a table."""


def table(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print `rows` under `headers`; the first column is left-aligned, numbers to the right."""
    headers, rows = _cells(headers), [_cells(row) for row in rows]
    if sys.stdout.isatty():
        _rich_table(headers, rows)
        return
    widths = [max(len(row[column]) for row in [headers, *rows]) for column in range(len(headers))]
    for row in [headers, *rows]:
        cells = [
            cell.rjust(width) if column and _is_number(cell) else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        echo("  ".join(cells).rstrip())


def pairs(title: str, rows: Sequence[Sequence[str]]) -> None:
    """Print names and values under a title, both to the left."""
    rows = [_cells(row) for row in rows]
    if sys.stdout.isatty():
        from rich.console import Console
        from rich.table import Table
        from rich.text import Text

        heading = Text(printable(title))
        shown = Table(title=heading, title_justify="left", show_header=False, box=None, padding=(0, 2, 0, 1))
        for name, value in rows:
            shown.add_row(Text(name, style="dim"), Text(value))
        Console().print(shown)
        return
    width = max(len(name) for name, _ in rows)
    echo(title)
    for name, value in rows:
        echo(f"  {name.ljust(width)}  {value}".rstrip())


def _cells(row: Sequence[str]) -> list[str]:
    return [printable(cell) for cell in row]


def _is_number(cell: str) -> bool:
    """A number, or two with a stroke between."""
    return re.fullmatch(r"[+-]?\d+(\.\d*)?(e[+-]?\d+)?(/\d+)?", cell) is not None


def _rich_table(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    shown = Table(box=SIMPLE_HEAD)
    needed = 0  # for numbers, which must not fold, and some words
    for column, header in enumerate(headers):
        numeric = column > 0 and any(_is_number(row[column]) for row in rows)
        shown.add_column(Text(header), justify="right" if numeric else "left", overflow="fold", no_wrap=numeric)
        width = max(len(row[column]) for row in [headers, *rows])
        needed += (width if numeric else min(width, NARROW)) + 1
    for row in rows:
        shown.add_row(*[Text(cell) for cell in row])
    if needed + 2 * len(headers) > console.width:
        shown.box, shown.padding = None, (0, 1, 0, 0)
        console.width = max(console.width, needed)
    console.print(shown)


class Progress:
    """Progress of a run on standard error: a status line on a terminal, a plain line every few seconds when piped."""

    PLAIN_PERIOD = 5.0  # s

    def __init__(self, status: bool = True, first: str = "connecting …", quiet: bool = False) -> None:
        """`status`: whether there is a status line at all; without it notes are plain lines. `first`: what it says.

        `quiet`: the first plain line comes after a while, too.
        """
        self._wanted, self._first = status, first
        self._status: Status | None = None
        self._last_plain = time.monotonic() if quiet else -math.inf

    def __enter__(self) -> Self:
        if self._wanted and sys.stderr.isatty():
            from rich.console import Console

            self._status = Console(stderr=True, highlight=False).status(self._first)
            self._status.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.pause()

    def pause(self) -> None:
        """Leave the terminal alone: somebody is about to be asked something, or it is over."""
        if self._status is not None:
            self._status.stop()

    def resume(self) -> None:
        """Show the status line again."""
        if self._status is not None:
            self._status.start()

    def confirm(self, question: str) -> bool:
        """Ask a person; click.Abort for Ctrl-C and the end of the input."""
        self.pause()
        sure = click.confirm(printable(question), err=True)
        self.resume()
        return sure

    def note(self, text: str) -> None:
        """A line that stays."""
        if self._status is not None:
            from rich.text import Text

            self._status.console.print(Text(lines(text)), soft_wrap=True)
        else:
            note(text)

    def progress(self, text: str) -> None:
        """What is going on now."""
        if self._status is not None:
            from rich.text import Text

            self._status.update(Text(printable(text)))
        elif (now := time.monotonic()) - self._last_plain >= self.PLAIN_PERIOD:
            self._last_plain = now
            note(text)

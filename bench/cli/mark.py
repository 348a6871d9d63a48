"""`bench mark`: mark a moment in a run, from another terminal while it is recorded, or later."""

from __future__ import annotations

from pathlib import Path

import click

from bench.cli.files import RUN, check_files
from bench.cli.number import Number
from bench.cli.streams import echo


@click.command("mark")
@click.argument("run", metavar="RUN", type=RUN)
@click.argument("text")
@click.option("--at", "seconds", metavar="S", type=Number(),
              help="Device time to mark, s, in a finished run [default: now, in a running one].")  # fmt: skip
def command(run: Path, text: str, seconds: float | None) -> None:
    """Mark a moment in a run while another terminal records it, or later.

    The recording program confirms the mark and its device time. bench live --keep keeps the data around a mark. In a
    run recorded with --split, the newest part is marked.

    \b
    Examples:
      bench mark a.run 'grease heard'
      bench mark a.run 'load came on here' --at 12.5
    """
    if not text.strip():
        raise click.UsageError("TEXT is empty: describe what the mark is for")
    from bench.record.marks import add, ask, newest
    from bench.record.reader import Run

    folder = newest(run)
    check_files({}, False, [folder])
    folder, mark = ask(run, text) if seconds is None else (folder, add(folder, text, seconds))
    echo(f"marked {Run(folder).at(mark.first_tick)} of {folder}: {mark.name}")

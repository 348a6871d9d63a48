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
              help="Mark this device time, s, in a run that is not being recorded.")  # fmt: skip
def command(run: Path, text: str, seconds: float | None) -> None:
    """Mark this moment in a run that another terminal records.

    The mark is confirmed by the program that records, with the device time of this moment; what is around it stays in
    a ring (bench live --keep). Of a run that is split, the newest part is marked.

    \b
    Examples:
      bench mark a.run 'grease heard'
      bench mark a.run 'load came on here' --at 12.5
    """
    if not text.strip():
        raise click.UsageError("TEXT is empty: say what is marked")
    from bench.recording.marks import add, ask, newest
    from bench.recording.reader import Run

    folder = newest(run)
    check_files({}, False, [folder])
    folder, mark = ask(run, text) if seconds is None else (folder, add(folder, text, seconds))
    echo(f"marked {Run(folder).at(mark.first_tick)} of {folder}: {mark.name}")

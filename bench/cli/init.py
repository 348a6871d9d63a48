"""`bench init`: finds a drive, asks about the bench, writes a bench.toml."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from bench.cli.files import overwrite_option
from bench.cli.number import Number
from bench.cli.streams import echo, note
from bench.cli.target import TARGET
from bench.errors import BenchError
from bench.files import check_output, write

if TYPE_CHECKING:
    from bench.init.search import Seen

FILE = Path("bench.toml")
Read = TypeVar("Read")


@click.command("init")
@click.option("--target", metavar="TARGET", type=TARGET, help="The drive's target; do not ask which.")
@click.option("--yes", is_flag=True, help="Ask nothing: take what the drive and these options say.")
@click.option("--load", metavar="LOAD",
              help="What brakes the shaft: node (number 2 on the link), none, person, a target or FILE.py:Class "
              "[default with --yes: node if it answers, else none].")  # fmt: skip
@click.option("--person/--no-person", default=None,
              help="Whether somebody is at the bench to turn knobs and pull wires when asked.")  # fmt: skip
@click.option("--encoder/--no-encoder", default=None,
              help="Whether the encoder that the drive tells of is mounted.")  # fmt: skip
@click.option("--rated-speed", metavar="RPM", type=Number(above=0),
              help="The most that tests may ask for, r/min [default: by the drive's limit].")  # fmt: skip
@click.option("--rated-current", metavar="A", type=Number(above=0), help="The same, A peak.")
@click.option("--station", metavar="TEXT", help="Which bench this is, for recordings and reports.")
@click.option("--operator", metavar="NAME", help="Who runs it, for recordings and reports.")
@click.option("--motor", metavar="TEXT", help="Which motor the drive has: type and serial number.")
@overwrite_option
def command(target: str | None, yes: bool, overwrite: bool, **given: Any) -> None:
    """Find a drive, ask about the bench, and write bench.toml into the present folder.

    Every command that is given no TARGET takes it from there, also in folders below. Energises nothing: only HELLO and
    questions are sent, and only to the port that was chosen. A serial port is tried at the usual rates.

    \b
    Examples:
      bench init
      bench init --target serial:/dev/ttyUSB0?baud=3000000 --yes
      bench init --target sim --yes --rated-current 4
    """
    if not yes and not sys.stdin.isatty():
        raise BenchError("bench init asks, and there is no terminal to answer: use --target TARGET --yes")
    if FILE.exists() and not overwrite:
        raise BenchError(f"{FILE} exists: --overwrite replaces it")
    check_output(FILE, str(FILE), overwrite=True)
    from bench.init.bench_file import described, text
    from bench.init.questions import Questions
    from bench.rig.connection import VARIABLE

    person = None if yes else _Person()
    seen = _found(target, person)
    for line in described(seen):
        echo(line)
    answers = Questions(seen, given, person).answers()
    write(FILE, text(seen, answers, f"{datetime.now():%Y-%m-%d %H:%M}"), str(FILE))
    echo(f"{FILE} written: commands without TARGET now take {seen.target}")
    if other := os.environ.get(VARIABLE):
        note(f"${VARIABLE} is set, and goes before it: {other}")


class _Person:
    """Whoever is at the terminal; a `Person`."""

    def ask(self, question: str, default: str, read: Callable[[str], Read]) -> Read:
        """See `Person.ask`."""
        from protocol.errors import HbpError

        while True:
            try:
                return read(click.prompt(question, default=default, show_default=bool(default), err=True).strip())
            except (BenchError, HbpError) as error:
                note(f"error: {error}")

    def confirm(self, question: str, default: bool) -> bool:
        """See `Person.confirm`."""
        return click.confirm(question, default=default, err=True)


def _found(target: str | None, person: _Person | None) -> Seen:
    """The drive on `target`, or where a person says; who types a target that has none is asked again."""
    from bench.init.questions import NOTHING, which, which_node
    from bench.init.search import find

    def use(named: str) -> Seen:
        return find(named, note, which_node(person))

    if target is not None:
        return use(target)
    from bench.device.ports import lasting, places

    there = places()
    for number, place in enumerate(there if person else [], 1):
        known = ", ".join(place[key] for key in ("description", "usb_id", "serial_number") if place[key])
        note(f"  {number}  {place['target']}" + (f"  ({known})" if known else ""))
    if person and not there:
        note(NOTHING)
    listed = {place["target"] for place in there}
    return which(there, person, lambda named: use(lasting(named) if named in listed else named))

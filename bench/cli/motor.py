"""`bench motor`: the simulated drive with a motor of one's own, from another tool's file or a data sheet."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.cli.files import FILE, check_files, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.streams import echo, note
from bench.errors import BenchError
from bench.files import STANDARD_OUTPUT

if TYPE_CHECKING:
    from bench.dumps.motor import Given
    from bench.dumps.read import Dump

QUESTIONS = {
    "poles": "Magnet poles (twice the pole pairs)",
    "resistance": "Resistance, ohm",
    "kv": "KV, r/min by volt",
    "current": "Largest phase current, A (amplitude)",
}


@click.command("motor")
@click.argument("file", metavar="[FILE]", required=False, type=click.Path(path_type=Path))
@click.option("--kv", metavar="KV", type=Number(above=0), help="Speed by voltage between terminals, r/min/V.")
@click.option("--kv-rms", is_flag=True, help="KV is by volt rms, not peak.")
@click.option("--resistance", metavar="OHM", type=Number(), help="Resistance between two terminals, ohm.")
@click.option("--inductance", metavar="H", type=Number(),
              help="Inductance between two terminals, H [default: from the resistance].")  # fmt: skip
@click.option("--phase", "of_phase", is_flag=True, help="Resistance and inductance are those of a phase.")
@click.option("--poles", metavar="N", type=int, help="Magnet poles, twice the pole pairs.")
@click.option("--current", metavar="A", type=Number(), help="Largest phase current, A, amplitude.")
@click.option("--voltage", metavar="V", type=Number(), help="DC link voltage, V [default: 24, or what FILE allows].")
@click.option("--axis", metavar="N", type=click.IntRange(0, 9), help="Axis of an ODrive [default: the first].")
@click.option("-o", "--out", metavar="FILE", type=FILE, help="Write the configuration of the simulated drive (.toml).")
@overwrite_option
@json_option("the motor")
def command(
    file: Path | None, axis: int | None, out: Path | None, overwrite: bool, json_file: Path | None, **given: Any
) -> None:
    """Describe a motor to the simulated drive, from another tool's configuration or from a data sheet.

    FILE: VESC Tool's motor configuration (XML), odrivetool's backup (JSON), or the text of moteus_tool --dump-config.
    Options go before what it says. Without FILE, KV, resistance, poles and current are needed; on a terminal they are
    asked for. A table of Hall sensors in FILE becomes the Hall sensors of the simulated motor.

    \b
    Examples:
      bench motor mcconf.xml --out my-motor.toml
      bench motor --kv 190 --resistance 0.05 --poles 14 --current 60 --voltage 48 --out my-motor.toml
      bench live sim --config my-motor.toml
    """
    from bench.cli.output import pairs
    from bench.dumps.motor import Given, described, rows
    from bench.dumps.read import read
    from bench.files import write

    if out is not None and out.suffix != ".toml":
        raise BenchError(f"--out {out}: the name must end in .toml")
    check_files({"--out": out, "--json": json_file}, overwrite, [file])
    dump = None if file is None else read(file, axis)
    if dump is None and axis is not None:
        raise click.UsageError(f"--axis {axis} needs the FILE of an ODrive")
    motor = described(dump, _asked(dump, Given(**given)))
    halls = _halls(dump)
    if out is not None:
        write(out, "\n".join(filter(None, (motor.toml(), halls))), f"--out {out}")
    if json_file is not None:
        write_json(json_file, motor.as_json())
    say = note if json_file == STANDARD_OUTPUT else echo
    if json_file != STANDARD_OUTPUT:
        pairs(f"Motor: {motor.source}", rows(motor))
    for text in motor.notes:
        note(f"note: {text}")
    if out is not None:
        say(f"configuration: {out}")


def at_terminal() -> bool:
    """Whether there is somebody to ask."""
    return sys.stdin.isatty()


def _asked(dump: Dump | None, given: Given) -> Given:
    """With what a person at the terminal says of what is missing."""
    from bench.dumps.motor import lacking

    missing = lacking(dump, given)
    if not missing or not at_terminal():
        return given
    answers: dict[str, Any] = {
        name: click.prompt(QUESTIONS[name], type=int if name == "poles" else Number(), err=True) for name in missing
    }
    if "resistance" in answers and not given.of_phase:
        answers["of_phase"] = not click.confirm("Is that between two terminals (else of a phase)?", True, err=True)
    if "kv" in answers and not given.kv_rms:
        answers["kv_rms"] = not click.confirm("Is the volt of KV a peak (else rms)?", True, err=True)
    return replace(given, **answers)


def _halls(dump: Dump | None) -> str:
    """The sections for the Hall sensors that a file has a table of; none, with a note, where that is unfit."""
    from bench.hall.learn import toml
    from bench.hall.table_reading import configuration, examined
    from bench.hall.tables import of_dump

    if dump is None:
        return ""
    try:
        learnt, sections = configuration(examined(of_dump(dump)))
    except BenchError as error:
        note(f"note: the simulated motor has the Hall sensors of the paper's: {error}")
        return ""
    return sections + toml(learnt)

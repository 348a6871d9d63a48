"""`bench import`: data that another tool recorded, made a run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.cli.files import FILE, RUN, check_files, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.streams import note
from bench.importer import FORMATS

if TYPE_CHECKING:
    from bench.importer.guess import Guess
    from bench.importer.mapping import Mapping
    from bench.importer.source import Source


def _pair(text: str, form: str) -> tuple[str, str]:
    name, sign, value = text.partition("=")
    if not sign or not name.strip() or not value.strip():
        raise click.BadParameter(f"'{text}' is not {form}")
    return name.strip(), value.strip()


def _channel(text: Any) -> tuple[str, dict[str, Any]]:
    """NAME=[-]COLUMN[:UNIT]"""
    from bench.importer.units import scale_of

    if isinstance(text, tuple):
        return text
    name, column = _pair(text, "NAME=COLUMN or NAME=COLUMN:UNIT")
    told: dict[str, Any] = {}
    before, colon, unit = column.rpartition(":")
    if colon and before and scale_of(unit) is not None and unit.strip():
        column, told["unit"] = before, unit.strip()
    if column.startswith("-"):
        column, told["sign"] = column[1:], -1
    return name, {"column": column, **told}


def _unit(text: Any) -> tuple[str, str]:
    return text if isinstance(text, tuple) else _pair(text, "COLUMN=UNIT")


@click.command("import")
@click.argument("file", metavar="FILE", type=FILE)
@click.option("-o", "--out", metavar="RUN", type=RUN, help="Run to write [default: FILE with the ending .run].")
@click.option("--format", "named", type=click.Choice(list(FORMATS)), help="Format [default: from FILE's name].")
@click.option("--map", "mapping", metavar="FILE|PRESET", default="",
              help="What FILE's columns are: a TOML file, or elmo, moteus, odrive, simplefoc, vesc.")  # fmt: skip
@click.option("--save-map", metavar="FILE", type=FILE, help="Write what was used as a TOML file for --map.")
@click.option("--time", "time_", metavar="COLUMN", help="Column of the time; '' for none.")
@click.option("--time-unit", metavar="UNIT", help="Its unit: s, ms, us, ns.")
@click.option("--rate", metavar="HZ", type=Number(above=0),
              help="Rows a second, where FILE tells no time; else samples a second to make.")  # fmt: skip
@click.option("--hall", metavar="A,B,C|COLUMN", help="Columns of Hall sensors a, b, c, or the one with their code.")
@click.option("--threshold", metavar="V", type=Number(), help="Of Hall lines that are voltages [default: half way].")
@click.option("--channel", "channels", metavar="NAME=COLUMN[:UNIT]", multiple=True, type=_channel,
              help="Channel of a run: theta_enc='Position:mech deg'; -COLUMN turns its sign; repeatable.")  # fmt: skip
@click.option("--unit", "units", metavar="COLUMN=UNIT", multiple=True, type=_unit,
              help="Unit of a column of which FILE does not tell it; repeatable.")  # fmt: skip
@click.option("--pole-pairs", metavar="N", type=click.IntRange(1, 64), help="Pole pairs of the motor.")
@click.option("--counts-per-turn", metavar="N", type=Number(above=0), help="Of an encoder whose angle is in counts.")
@click.option("--only-named", is_flag=True, help="Leave out all columns that are not named.")
@click.option("--separator", metavar="CHAR", help="Of a text: a character, or tab, space, comma, semicolon.")
@click.option("--decimal", type=click.Choice([".", ","]), help="Decimal sign of a text.")
@click.option("--long", "long", is_flag=True, help="Each line of a text has a time, a name and a value.")
@click.option("--dbc", metavar="FILE", type=FILE, help="Signals of a CAN log.")
@click.option("--yes", is_flag=True, help="Use what is guessed without asking.")
@json_option("what was imported")
@overwrite_option
def command(file: Path, out: Path | None, json_file: Path | None, overwrite: bool, **given: Any) -> None:
    """Import what another tool recorded: scope, logic analyser, drive, CAN log, MATLAB.

    CSV and other text, JSON lines, VCD, sigrok, Saleae, MDF 4, MAT, Parquet, npz, HDF5, TDMS, CAN logs with a DBC, and
    moteus's Hall captures. Columns that no option names are guessed by name and unit, and the guess is shown. bench
    hall check, score, plot, compare, view and export take the run.

    \b
    Examples:
      bench import scope.csv --hall CH1,CH2,CH3 -o halls.run
      bench import log.csv --channel theta_enc='Position:mech deg' --pole-pairs 7
      bench import capture.vcd --hall D0,D1,D2 --save-map halls.toml
    """
    out = out or file.with_name(f"{file.name.removesuffix('.gz').rpartition('.')[0] or file.name}.run")
    inputs = [file, given["dbc"]]
    check_files({"--out": out, "--json": json_file, "--save-map": given["save_map"]}, overwrite, inputs, ["--out"])
    from bench.cli.output import Progress, pairs
    from bench.files import write as write_text
    from bench.importer.files import naming
    from bench.importer.guess import complete
    from bench.importer.importer import as_json, prepare, rows, write
    from bench.importer.mapping import mapping_of, read, to_toml
    from bench.importer.opened import opened
    from bench.rig.interrupts import signals_as_exceptions

    told = read(given["mapping"]).model_dump(exclude_defaults=True) if given["mapping"] else {}
    with signals_as_exceptions(), naming(file):
        mapping = mapping_of(_with_options(told, given), given["mapping"] or "options")
        source = opened(file, mapping, given["dbc"])
        guess = complete(source, mapping)
        if guess.words and sys.stdin.isatty() and sys.stderr.isatty() and not given["yes"]:
            guess = _asked(source, guess, mapping)
        else:
            for words in guess.words:
                note(f"guessed: {words}" if " may be " not in words else words)
        with Progress(first="reading …", quiet=True) as progress:
            prepared = prepare(source, guess.mapping, guess.guessed, progress.progress)
            for words in prepared.notes:
                progress.note(words)
            done = write(prepared, file, out, overwrite, progress.progress)
    if given["save_map"] is not None:
        write_text(given["save_map"], to_toml(guess.mapping), f"--save-map {given['save_map']}")
    if json_file is not None:
        write_json(json_file, as_json(done))
        return
    pairs(f"{file} imported to {done.path}", rows(done))


def _with_options(told: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """A mapping, as plain data, with the options in the place of what it has."""
    sections: dict[str, dict[str, Any]] = {name: dict(told.get(name, {})) for name in ("text", "time", "motor", "hall")}
    for section, key, option in (
        ("text", "separator", "separator"), ("text", "decimal", "decimal"), ("time", "column", "time_"),
        ("time", "unit", "time_unit"), ("time", "rate_hz", "rate"), ("motor", "n_p", "pole_pairs"),
        ("motor", "counts_per_turn", "counts_per_turn"), ("hall", "threshold", "threshold"),
    ):  # fmt: skip
        if given[option] is not None:
            sections[section][key] = given[option]
    if given["time_"] == "":
        sections["time"]["none"] = True
    if given["long"]:
        sections["text"]["layout"] = "long"
    if given["hall"] is not None:
        sections["hall"] = {k: v for k, v in sections["hall"].items() if k == "threshold"} | _hall(given["hall"])
    channels = {**told.get("channels", {}), **dict(given["channels"])}
    named = {"format": given["named"]} if given["named"] else {}
    others = {"others": False} if given["only_named"] else {}
    units = {**told.get("units", {}), **dict(given["units"])}
    return {**told, **sections, "channels": channels, "units": units, **named, **others}


def _hall(text: str) -> dict[str, Any]:
    names = [name.strip() for name in text.split(",")]
    if len(names) not in (1, 3) or not all(names):
        raise click.UsageError(f"--hall {text}: give the columns of sensors a, b, c, or the one of their code")
    return {"columns": names} if len(names) == 3 else {"column": names[0]}


def _asked(source: Source, guess: Guess, told: Mapping) -> Guess:
    """What somebody at the terminal makes of the guess: taken as it is, or one thing after the other."""
    from bench.importer.guess import complete
    from bench.importer.mapping import mapping_of

    for words in guess.words:
        note(f"  {words}")
    if click.confirm("Use this?", default=True, err=True):
        return guess
    names = [column.name for table in source.tables for column in table.columns]
    note(f"Columns: {', '.join(names[:60])}")
    plain = told.model_dump(exclude_defaults=True)
    times = [table.time for table in source.tables if table.time]
    time = _prompt("Column of the time", times[0] if times else "")
    plain["time"] = {**plain.get("time", {}), **({"column": time} if time else {})}
    hall = _prompt("Hall sensors a, b, c (A,B,C or one column, - for none)", ",".join(guess.mapping.hall.named) or "-")
    plain["hall"] = {} if hall == "-" else _hall(hall)
    channels: dict[str, Any] = {}
    for name in ("theta_enc", "omega_enc", "i_a", "i_b", "i_c", "i_q", "u_dc"):
        column = guess.mapping.channels.get(name)
        known = f"{column.column}{f':{column.unit}' if column.unit else ''}" if column else "-"
        answer = _prompt(f"{name} (COLUMN:UNIT, - for none)", known)
        if answer != "-":
            channels |= [_channel(f"{name}={answer}")]
    plain["channels"] = channels
    if pole_pairs := _prompt("Pole pairs (- if unknown)", "-").strip("-"):
        plain["motor"] = {**plain.get("motor", {}), "n_p": int(pole_pairs) if pole_pairs.isdigit() else pole_pairs}
    answered = complete(source, mapping_of(plain, "answers"))
    asked = {*channels, "hall"}
    kept = {name: column for name, column in answered.mapping.channels.items() if name in channels}
    return type(guess)(answered.mapping.model_copy(update={"channels": kept}), answered.guessed - asked, ())


def _prompt(what: str, default: str) -> str:
    return str(click.prompt(what, default=default, err=True, show_default=bool(default))).strip()

"""`bench export`: a recorded run in the formats of other tools."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import click

from bench.cli.files import FILE, RUN, check_files, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.streams import note
from bench.exports import ENDINGS


@click.command("export")
@click.argument("run", metavar="RUN", type=RUN)
@click.option("-o", "--out", metavar="FILE", type=FILE, required=True,
              help="The file to write; it may tell the format by its ending.")  # fmt: skip
@click.option("--format", "named", type=click.Choice(list(ENDINGS)), help="The format (default: as FILE ends).")
@click.option("--from", "begin", metavar="S", type=Number(), help="From this device time on, s (default: its begin).")
@click.option("--to", "end", metavar="S", type=Number(), help="Up to this device time, s (default: its end).")
@click.option("--channels", metavar="A,B", help="Only these channels, and the edges and marks (default: all).")
@json_option("the files and counts")
@overwrite_option
def command(
    run: Path,
    out: Path,
    named: str | None,
    begin: float | None,
    end: float | None,
    channels: str | None,
    json_file: Path | None,
    overwrite: bool,
) -> None:
    """Export a recorded run for other tools: names, units, times, gaps and marks are kept.

    FILE ends in .csv, .mf4 (MDF 4), .mat (MATLAB), .npz (NumPy), .rrd (rerun) or .parquet. For .csv and .parquet each
    table has a file of its own beside FILE, as FILE-edges. What is stored in RUN pandas, DuckDB and MATLAB open as it
    is: see docs/recordings.md.

    \b
    Examples:
      bench export a.run -o a.csv
      bench export a.run -o a.mf4 --from 2 --to 5 --channels theta_enc,theta_vt
    """
    names = None if channels is None else tuple(name.strip() for name in channels.split(",") if name.strip())
    if names == ():
        raise click.UsageError("--channels names none: give names separated by commas")
    if str(out) == "-":
        raise click.UsageError("--out -: an export needs a file")
    check_files({"--out": out, "--json": json_file}, overwrite, [run])
    from bench.cli.output import pairs
    from bench.exports.export import as_json, export
    from bench.recording.reader import Run
    from bench.rig.interrupts import signals_as_exceptions

    with signals_as_exceptions():  # nothing half done is left
        done = export(Run(run), out, named, begin, end, names, overwrite)
    for words in done.notes:
        note(words)
    if json_file is not None:
        write_json(json_file, as_json(done))
        return
    rows = [(str(path), _held(name, done.rows)) for name, path in done.files.items()]
    pairs(f"{run} from {done.span[0]:.3f} to {done.span[1]:.3f} s exported to", rows)


def _held(name: str, rows: Mapping[str, int]) -> str:
    """What a file holds, in words."""
    held = rows if name == "all" else {name: rows[name]} if name in rows else {}
    return ", ".join(f"{table}: {n} rows" for table, n in held.items()) or name

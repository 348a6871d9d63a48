"""`bench export`: a recorded run in the formats of other tools."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from bench.cli.files import FILE, RUN, check_files, json_option, overwrite_option, write_json
from bench.cli.options import channels_option, part_options
from bench.cli.streams import note
from bench.export import ENDINGS


@click.command("export")
@click.argument("run", metavar="RUN", type=RUN)
@click.option("-o", "--out", metavar="FILE", type=FILE, required=True,
              help="File to write; its extension selects the format.")  # fmt: skip
@click.option("--format", "named", type=click.Choice(list(ENDINGS)),
              help="Format [default: from the extension of FILE].")  # fmt: skip
@part_options()
@channels_option("Export only these channels, with edges and marks [default: all].")
@json_option("file names and row counts")
@overwrite_option
def command(run: Path, out: Path, named: str | None, json_file: Path | None, overwrite: bool, **given: Any) -> None:
    """Export a recorded run for other tools, with names, units, times, gaps and marks.

    FILE ends in .csv, .mf4 (MDF 4), .mat (MATLAB), .npz (NumPy), .rrd (rerun) or .parquet. With .csv and .parquet,
    other tables go to files beside FILE, such as FILE-edges. pandas, DuckDB and MATLAB can also read the files in RUN
    directly: see docs/recordings.md.

    \b
    Examples:
      bench export a.run -o a.csv
      bench export a.run -o a.mf4 --from 2 --to 5 --channels theta_enc,theta_vt
    """
    if str(out) == "-":
        raise click.UsageError("--out -: an export cannot go to standard output; give a file name")
    check_files({"--out": out, "--json": json_file}, overwrite, [run])
    from bench.cli.output import pairs
    from bench.export.export import as_json, export
    from bench.record.reader import Run
    from bench.rig.interrupts import signals_as_exceptions

    with signals_as_exceptions():  # nothing half done is left
        done = export(Run(run), out, named, given["begin"], given["end"], given["channels"], overwrite)
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

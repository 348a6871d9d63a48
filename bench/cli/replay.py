"""`bench replay`: observers run again on a recording, beside the drive's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from bench.cli.files import RUN, check_files, json_option, overwrite_option, write_json
from bench.cli.options import settings_option


@click.command("replay")
@click.argument("run", metavar="RUN", type=RUN, required=False)
@click.option("--observer", "observers", metavar="NAME", multiple=True,
              help="Observer to run, by name or short name; repeatable [default: all].")  # fmt: skip
@settings_option
@click.option("-o", "--out", metavar="RUN", type=RUN, help="New recording [default: RUN.replay.run].")
@json_option("the summary")
@overwrite_option
@click.option("--list", "list_only", is_flag=True,
              help="List the observers and their sources, and exit.")  # fmt: skip
def command(
    run: Path | None, observers: tuple[str, ...], out: Path | None, json_file: Path | None, **given: Any
) -> None:
    """Run observers on a recording, beside the drive's own estimates and the encoder.

    RUN: a recording of bench live --save, with every PWM period for observers that need voltages. The new recording
    holds all its data plus the channels theta_…_host and omega_…_host; bench view opens it.

    \b
    Examples:
      bench replay a.run
      bench replay a.run --observer vector_tracking --set k_p=900 -o slow.run
    """
    settings, overwrite = given["settings"], given["overwrite"]
    if given["list_only"]:
        check_files({"--json": json_file}, overwrite)
        _list(json_file)
        return
    if run is None:
        raise click.UsageError("Missing argument 'RUN'.")
    check_files({"--out": out, "--json": json_file}, overwrite, [run], recordings=["--out"])
    from bench.cli.output import pairs
    from bench.replay.replay import as_json, replay, rows

    result = replay(run, observers, settings, out, overwrite)
    if json_file is not None:
        write_json(json_file, as_json(result))
        return
    pairs(f"{run} replayed to {result.path}", rows(result))


def _list(json_file: Path | None) -> None:
    from bench.cli.output import table
    from sim.observers.catalogue import BROKEN, CATALOGUE

    headers = ("observer", "short", "needs", "source")
    rows = [[entry.name, entry.short, entry.needs.words, entry.source] for entry in CATALOGUE.values()]
    rows += [[name, "", "", f"cannot be used: {why}"] for name, why in BROKEN.items()]
    if json_file is not None:
        write_json(json_file, [dict(zip(headers, row, strict=True)) for row in rows])
        return
    table(headers, rows)

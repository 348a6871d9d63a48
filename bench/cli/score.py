"""`bench score`: how good position observers are on recordings."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from bench.cli.files import check_outputs

_FILE = click.Path(dir_okay=False, path_type=Path)


class Share(click.ParamType[float]):
    """A share above 0 and below 1, as 20% or 0.2."""

    name = "share"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Read it, or say why not."""
        text = str(value).strip()
        try:
            share = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
        except ValueError:
            share = 0.0
        if not 0.0 < share < 1.0:
            self.fail(f"'{value}' is no share above 0 and below 100%, such as 20% or 0.2", param, ctx)
        return share


@click.command("score")
@click.argument("runs", metavar="RUN.rrd…", nargs=-1, required=True, type=_FILE)
@click.option("--observer", "observers", metavar="NAME", multiple=True,
              help="Score only these: a name of `bench replay --list`, or drive_vt, …; repeatable.")  # fmt: skip
@click.option("--html", metavar="FILE", type=_FILE, help="Write all figures and plots as one HTML file.")
@click.option("--json", "json_file", metavar="FILE", type=_FILE, help="Write all figures as JSON.")
@click.option("--csv", "csv_file", metavar="FILE", type=_FILE, help="Write all figures as CSV, one a row.")
@click.option("--expect", metavar="FILE", type=_FILE, help="Bounds on figures (TOML or JSON); outside: exit code 1.")
@click.option("--write-expect", metavar="FILE", type=_FILE, help="Write bounds around this run's figures (TOML).")
@click.option("--overwrite", is_flag=True, help="Let --write-expect replace a file that exists.")
@click.option("--margin", type=Share(), default="20%", show_default=True, help="Of --write-expect, on both sides.")
def command(
    runs: tuple[Path, ...],
    observers: tuple[str, ...],
    html: Path | None,
    json_file: Path | None,
    csv_file: Path | None,
    expect: Path | None,
    write_expect: Path | None,
    overwrite: bool,
    margin: float,
) -> None:
    """Score position observers on recordings: errors, lag and cost, ranked.

    RUN.rrd: recordings of `bench live --save` of a drive with an encoder. Every observer is run on what the drive
    measured, and scored beside the drive's own estimates; several recordings are pooled.

    Exit codes: 0 done, 1 a figure is outside --expect, 2 an error.

    \b
    Examples:
      bench score a.rrd
      bench score a.rrd b.rrd --html score.html --json score.json
      bench score a.rrd --expect bounds.toml
    """
    outputs = {"--html": html, "--json": json_file, "--csv": csv_file, "--write-expect": write_expect}
    check_outputs(outputs, [*runs, expect])
    for option, path in outputs.items():
        if path is not None and not path.parent.is_dir():
            raise click.UsageError(f"{option} {path}: there is no directory {path.parent}")
    if write_expect is not None and write_expect.exists() and not overwrite:
        raise click.UsageError(
            f"--write-expect {write_expect} exists: choose another name, or --overwrite to replace it"
        )
    from bench.score import expect as bounds
    from bench.score.board import score
    from bench.score.table import as_csv, as_text

    expected = None if expect is None else bounds.read(expect)
    board = score(runs, observers)
    for line in as_text(board):
        click.echo(line)
    if html is not None:
        from bench.score.report import write_report

        write_report(board, html)
    _write("--json", json_file, lambda: json.dumps(board.as_json(), indent=2) + "\n")
    _write("--csv", csv_file, lambda: as_csv(board))
    _write("--write-expect", write_expect, lambda: bounds.as_toml(board, margin))
    if expected is None:
        return
    outside = bounds.check(board, expected)
    click.echo(f"{len(expected) - len(outside)} of {len(expected)} figures within {expect}")
    for figure in outside:
        click.echo(f"OUTSIDE  {figure}")
    sys.exit(1 if outside else 0)


def _write(option: str, path: Path | None, text: Callable[[], str]) -> None:
    if path is None:
        return
    try:
        path.write_text(text(), encoding="utf-8")
    except OSError as error:
        raise click.ClickException(f"{option} {path} cannot be written: {error.strerror}") from None

"""`bench score`: position observers, scored and ranked on recordings."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from bench.cli.files import FILE, RUN, check_files, json_option, overwrite_option, write_json
from bench.cli.options import part_options, settings_option
from bench.cli.streams import echo, note
from bench.files import STANDARD_OUTPUT, write


def share(value: Any) -> float:
    """Read a share above 0 and below 1, as 20% or 0.2, or say why not."""
    text = str(value).strip()
    try:
        found = float(text.removesuffix("%")) / (100.0 if text.endswith("%") else 1.0)
    except ValueError:
        found = 0.0
    if not 0.0 < found < 1.0:
        raise click.BadParameter(f"'{value}' is not between 0 and 100%, such as 20% or 0.2")
    return found


@click.command("score")
@click.argument("runs", metavar="RUN…", nargs=-1, required=True, type=RUN)
@click.option("--observer", "observers", metavar="NAME", multiple=True,
              help="Score only this: a name of bench replay --list, or drive_vt, …; repeatable.")  # fmt: skip
@click.option("--reference", metavar="WHAT", default="auto", show_default=True,
              help="Compare with encoder, edges (the run's own), or an observer; auto: encoder or edges.")  # fmt: skip
@settings_option
@part_options()
@click.option("--html", metavar="FILE", type=FILE, help="Write all statistics and plots to one HTML file.")
@json_option("all statistics")
@click.option("--csv", "csv_file", metavar="FILE", type=FILE, help="Write all statistics as CSV, one per row.")
@click.option("--expect", metavar="FILE", type=FILE,
              help="Check the statistics against limits (TOML or JSON); exit code 1 if one is outside.")  # fmt: skip
@click.option("--write-expect", metavar="FILE", type=FILE,
              help="Write limits around the statistics of this run (TOML), for --expect.")  # fmt: skip
@overwrite_option
@click.option("--margin", metavar="SHARE", type=share, default="20%", show_default=True,
              help="With --write-expect: distance of the limits from each statistic.")  # fmt: skip
def command(runs: tuple[Path, ...], observers: tuple[str, ...], overwrite: bool, margin: float, **given: Any) -> None:
    """Rank position observers on recordings by error, lag and cost.

    RUN: recordings of bench live --save. Every observer runs on what it needs of the recorded Hall edges, currents and
    voltages, and is scored like the drive's own estimates; several recordings are pooled. Without an encoder the
    reference is the recording's own edges at steady speed.

    Exit codes: 0 done, 1 a statistic is outside --expect, 2 error.

    \b
    Examples:
      bench score a.run
      bench score a.run b.run --html score.html --json score.json
      bench score a.run --expect limits.toml
      bench score day.run --from 3600 --to 7200
      bench score edges.run --set n_p=15 --set omega_m_max=40
    """
    html, json_file, csv_file, write_expect, expect = (
        given[k] for k in ("html", "json_file", "csv_file", "write_expect", "expect")
    )
    outputs = {"--html": html, "--json": json_file, "--csv": csv_file, "--write-expect": write_expect}
    check_files(outputs, overwrite, [*runs, expect])
    from bench.score import expect as bounds
    from bench.score.board import score
    from bench.score.table import as_csv, as_text

    expected = None if expect is None else bounds.read(expect)
    board = score(
        runs, observers, given["begin"], given["end"], reference=given["reference"], settings=given["settings"]
    )
    say = note if STANDARD_OUTPUT in outputs.values() else echo
    for line in as_text(board):
        say(line)
    if html is not None:
        from bench.score.report import as_html

        write(html, as_html(board), f"--html {html}")
    if json_file is not None:
        write_json(json_file, board.as_json())
    if csv_file is not None:
        write(csv_file, as_csv(board), f"--csv {csv_file}")
    if write_expect is not None:
        write(write_expect, bounds.as_toml(board, margin), f"--write-expect {write_expect}")
    if expected is None:
        return
    outside = bounds.check(board, expected)
    say(f"{len(expected) - len(outside)} of {len(expected)} statistics within the limits of {expect}")
    for words in outside:
        say(f"OUTSIDE  {words}")
    sys.exit(1 if outside else 0)

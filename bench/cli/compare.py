"""`bench compare`: the differences of two recorded runs."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.cli.files import FILE, RUN, check_files, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.options import channels_option, viewer_option
from bench.cli.streams import echo, note
from bench.cli.view import show_until_closed
from bench.files import STANDARD_OUTPUT

if TYPE_CHECKING:
    from bench.compare.compare import Comparison
    from bench.record.times import Side


@click.command("compare")
@click.argument("a", metavar="A", type=RUN)
@click.argument("b", metavar="B", type=RUN)
@click.option("--align", metavar="NAME", default="begin", show_default=True,
              help="Time 0 in both: a mark or an event (START, FAULT, …); NAME#2: the second one.")  # fmt: skip
@click.option("--from", "begin", metavar="S", type=Number(), help="Start S seconds after time 0; may be negative.")
@click.option("--to", "end", metavar="S", type=Number(), help="Stop S seconds after time 0.")
@channels_option("Compare only these channels [default: all in common].")
@viewer_option("Show both in rerun too; ", "none", "auto", "native", "web")
@click.option("--save", metavar="FILE", type=FILE, help="Write both runs to an .rrd file for rerun.")
@json_option("the differences")
@overwrite_option
def command(a: Path, b: Path, align: str, json_file: Path | None, save: Path | None, **given: Any) -> None:
    """Compare two recorded runs and report the differences that exceed noise.

    Prints the mean of B minus A for every channel that both runs have in the same unit, and for every position error,
    over the time they have in common, with the standard error of the difference (from batch means). A difference of
    more than 3 standard errors is marked "differs". Events and parameters that differ follow. Use --viewer or --save to
    see both runs in rerun.

    \b
    Examples:
      bench compare before.run after.run
      bench compare a.run b.run --align START --from 0.5 --to 2
      bench compare a.run b.run --align "load step" --viewer web
    """
    check_files({"--json": json_file, "--save": save}, given["overwrite"], [a, b])
    from bench.compare.alignment import aligned
    from bench.compare.compare import as_json, compare
    from bench.record.recording import readable
    from bench.view.viewer import chosen

    runs = [readable(path) for path in (a, b)]
    sides = aligned(runs[0], runs[1], align, given["begin"], given["end"])
    found = compare(*sides, given["channels"] or ())
    viewer = given["viewer"]
    with tempfile.TemporaryDirectory(prefix="hallbench-", ignore_cleanup_errors=True) as folder:
        file = save or (Path(folder, "compare.rrd") if viewer != "none" else None)
        if file is not None:
            _write(file, sides, viewer)
        for run in runs:
            for words in run.damage:
                note(f"warning: {run.path}: {words}")
        if json_file is not None:
            write_json(json_file, {"aligned_at": align, **as_json(found)})
        if json_file != STANDARD_OUTPUT:
            _print(found, align)
        if file is not None and viewer != "none":
            show_until_closed(file, chosen(viewer), given["web_port"], "both runs")


def _write(file: Path, sides: tuple[Side, Side], viewer: str) -> None:
    from bench.view.overlay import write_overlay
    from bench.view.viewer import chosen
    from bench.view.viewing import lot_for

    write_overlay(file, *sides, lot_for(chosen(viewer)))


def _print(found: Comparison, align: str) -> None:
    from bench.cli.output import table
    from bench.compare.compare import cells

    a, b = found.a, found.b
    for letter, side in (("A", a), ("B", b)):
        echo(f"{letter}: {side.run.path}, time 0 ({align}) is at {side.run.at(side.zero)}")
    echo(f"from {a.seconds(a.first):.3f} to {a.seconds(a.last):.3f} s")
    table(["quantity", "unit", "A", "B", "B - A", "std. error", ""], [cells(row) for row in found.rows])
    if found.left_out:
        echo(f"not compared: {', '.join(found.left_out)}")
    if found.events:
        rows = [[pair.words, *("–" if at is None else f"{at:.4f}" for at in (pair.a, pair.b))] for pair in found.events]
        table(["events that differ", "A [s]", "B [s]"], rows)
    if found.parameters:
        values = ((pair.name, pair.a, pair.b) for pair in found.parameters)
        rows = [[name, *("–" if value is None else f"{value:g}" for value in pair)] for name, *pair in values]
        table(["parameters that differ", "A", "B"], rows)
    if not found.events and not found.parameters:
        echo("events and parameters: the same")

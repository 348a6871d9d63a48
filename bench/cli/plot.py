"""`bench plot`: the standard plots of a recorded run, or a motion profile."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.cli.files import DIRECTORY, RUN, check_files, json_option, overwrite_option, write_json
from bench.cli.options import part_options
from bench.cli.streams import note
from bench.errors import BenchError
from bench.files import RUN as SUFFIX
from bench.files import STANDARD_OUTPUT, check_directory, check_output

if TYPE_CHECKING:
    from bench.plot.plot import Plot


@click.command("plot")
@click.argument("run", metavar="RUN", type=RUN)
@part_options()
@click.option("-o", "--out", metavar="DIR", type=DIRECTORY,
              help="Folder for the plots, created if needed [default: RUN.figures].")  # fmt: skip
@click.option("--svg", is_flag=True, help="Write SVG instead of PNG.")
@json_option("the plotted values")
@overwrite_option
def command(run: Path, out: Path | None, svg: bool, json_file: Path | None, overwrite: bool, **part: Any) -> None:
    """Draw the standard plots of a recorded run, one file each, or a motion profile.

    \b
    spectrum        spectrum, harmonics and THD of the currents during the
                    longest stretch of steady speed
    error_by_angle  position error of each estimate against electrical angle
    error_by_speed  position error of each estimate against speed
    current_plane   i_d and i_q, their references and the current limit
    hall_edges      measured and ideal edge angles of the Hall sensors

    A plot whose channels the run lacks is skipped with the reason. If none can be drawn, the command fails.

    Of a motion profile, a TOML file as bench live --profile plays it, one plot shows what is asked for over time.

    \b
    Examples:
      bench plot a.run
      bench plot a.run --from 2 --to 8 -o plots --svg
      bench plot motion.toml
    """
    check_files({"--json": json_file}, overwrite, [run])
    from bench.plot.plot import NAMES, PROFILE, draw_all, draw_profile, write

    of_profile = run.suffix == ".toml"
    if of_profile and any(value is not None for value in part.values()):
        raise click.UsageError("--from and --to are for a recorded run: a motion profile is drawn whole")
    folder = out or run.absolute().parent / f"{run.name.removesuffix('.toml' if of_profile else SUFFIX)}.figures"
    ending = "svg" if svg else "png"
    files = {name: folder / f"{name}.{ending}" for name in ((PROFILE,) if of_profile else NAMES)}
    check_directory(folder, f"--out {folder}", make=True)
    if folder.is_dir():
        for file in files.values():
            check_output(file, str(file), overwrite)
    if of_profile:
        about: dict[str, Any] = {"profile": str(run)}
        drawn = [draw_profile(run)]
    else:
        about, drawn = _of_run(run, draw_all, part)
    for each in drawn:
        if each.figure is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                write(each, files[each.name])
            except OSError as error:
                raise BenchError(f"{files[each.name]} cannot be written: {error.strerror}") from None
    if json_file is not None:
        figures = [
            {"figure": one.name, "file": str(files[one.name]) if one.figure else None, "why_not": one.why or None,
             "says": one.words or None, "numbers": one.numbers}
            for one in drawn
        ]  # fmt: skip
        write_json(json_file, {**about, "figures": figures})
    if json_file != STANDARD_OUTPUT:
        from bench.cli.output import table

        shown = [[one.name, files[one.name].name if one.figure else "–", one.words or f"not drawn: {one.why}"]
                 for one in drawn]  # fmt: skip
        table(("plot", f"in {folder}", "result"), shown)


def _of_run(run: Path, draw_all: Callable[..., list[Plot]], part: dict[str, Any]) -> tuple[dict[str, Any], list[Plot]]:
    """What JSON says of a run beside its plots, and the plots. BenchError if none can be drawn."""
    from bench.record.reader import Run
    from bench.record.times import ticks_of

    opened = Run(run)
    first, last = ticks_of(opened, **part)
    drawn = draw_all(opened, first, last)
    for words in opened.damage:
        note(f"warning: {words}")
    if not any(each.figure for each in drawn):
        raise BenchError(f"no plot of {run} can be drawn: {'; '.join(f'{one.name}: {one.why}' for one in drawn)}")
    span = {"from_s": first / opened.info.tick_hz, "to_s": last / opened.info.tick_hz}
    return {"run": str(run), **span, "damage": opened.damage}, drawn

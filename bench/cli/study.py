"""`bench study`: many simulated drives through the same tests, and what share of them passes."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from bench.cli.files import DIRECTORY, FILE, check_files, json_option, overwrite_option, write_json
from bench.cli.options import workers_options
from bench.cli.output import Progress
from bench.cli.streams import echo, note
from bench.errors import BenchError, ExitCode
from bench.files import STANDARD_OUTPUT

STUDY = click.Path(path_type=Path)


@click.group("study")
def command() -> None:
    """Run many simulated drives through the same tests: what share passes, why.

    A study is a TOML file: what varies from drive to drive, what is done with each, what is judged. Each drive is a row
    in a folder of Parquet files, and any row can be computed again, bit for bit.

    \b
    Examples:
      bench study run tolerances.toml
      bench study report tolerances.study
      bench study replay tolerances.study 4711 --save row4711
    """


@command.command("run")
@click.argument("file", metavar="STUDY.toml", type=FILE)
@click.option("--out", metavar="DIR", type=DIRECTORY, help="Folder for the rows [default: STUDY.study].")
@click.option("--samples", metavar="N", type=click.IntRange(1), help="Drives, instead of what the file says.")
@workers_options
@json_option("the answers")
@overwrite_option
def run_command(
    file: Path, out: Path | None, samples: int | None, workers: int | None, cluster: str | None,
    json_file: Path | None, overwrite: bool,
) -> None:  # fmt: skip
    """Compute the rows of a study that are missing, then answer.

    What is there is never computed again: after Ctrl-C, a crash or a power cut the same command goes on, and with more
    --samples it adds drives. The report is written to the study's folder.
    """
    check_files({"--json": json_file}, overwrite, [file])
    import time

    from bench.study.run import StudyOptions, run

    options = StudyOptions(file, out, samples, workers, cluster, overwrite)
    with Progress() as screen:
        try:
            folder = run(options, screen, time.monotonic)
        except KeyboardInterrupt:
            screen.note("interrupted: what is done is kept; the same command goes on")
            raise
    _answer(folder, json_file)


@command.command("report")
@click.argument("folder", metavar="STUDY", type=STUDY)
@json_option("the answers")
@overwrite_option
def report_command(folder: Path, json_file: Path | None, overwrite: bool) -> None:
    """Answer from the rows that there are, and write the report to the study's folder."""
    check_files({"--json": json_file}, overwrite)
    _answer(folder, json_file)


@command.command("replay")
@click.argument("folder", metavar="STUDY", type=STUDY)
@click.argument("row", metavar="ROW", type=click.IntRange(0))
@click.option("--save", metavar="DIR", type=DIRECTORY, help="Record there what the drive does; reports of tests, too.")
@click.option("--drive", metavar="FILE", type=FILE, help="Write the drive's configuration, for --config of others.")
@json_option("the row")
@overwrite_option
def replay_command(
    folder: Path, row: int, save: Path | None, drive: Path | None, json_file: Path | None, overwrite: bool
) -> None:
    """Compute a row again, and compare it with the study's, bit for bit.

    Exit code 1 if a value differs.
    """
    check_files({"--json": json_file, "--drive": drive}, overwrite)
    if save is not None and save.exists():
        raise BenchError(f"--save {save} is there already: choose another name")
    from bench.study.replay import described, replay
    from bench.study.store import open_study

    found, differences = replay(folder, row, save, drive)
    if json_file is not None:
        write_json(json_file, found)
    say = note if json_file == STANDARD_OUTPUT else echo
    say(described(open_study(folder), row))
    for name, value in found.items():
        if name.startswith(("m.", "v.", "why.")):
            say(f"  {name.partition('.')[2]} = {value:.6g}" if isinstance(value, float) else f"  {name}: {value}")
    for line in differences:
        say(line)
    say("differs from the study's row" if differences else "equal to the study's row, bit for bit")
    sys.exit(ExitCode.FAILED if differences else ExitCode.DONE)


def _answer(folder: Path, json_file: Path | None) -> None:
    from bench.study.about import about
    from bench.study.report import answer, answers, lines, write_report
    from bench.study.store import open_study, read_rows

    rows = read_rows(folder)
    told = about(open_study(folder), folder)
    found = answer(rows, told)
    report = write_report(folder, rows, told, overwrite=True, found=found)
    if json_file is not None:
        write_json(json_file, answers(rows, told, found))
    say = note if json_file == STANDARD_OUTPUT else echo
    for line in lines(rows, told, found):
        say(line)
    say(f"report: {report}")

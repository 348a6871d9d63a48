"""`bench tune`: parameters of loops and observers by evidence."""

from __future__ import annotations

from pathlib import Path

import click

from bench.cli.files import DIRECTORY, FILE, check_files, json_option, overwrite_option, write_json
from bench.cli.options import workers_options
from bench.cli.output import Progress
from bench.cli.streams import echo, note
from bench.files import STANDARD_OUTPUT


@click.command("tune")
@click.argument("file", metavar="TUNE.toml", type=FILE)
@click.option("--out", metavar="DIR", type=DIRECTORY, help="Folder for what is found [default: TUNE.tune].")
@click.option("--trials", metavar="N", type=click.IntRange(1), help="Trials in all, instead of what the file says.")
@workers_options
@json_option("what was found")
@overwrite_option
def command(
    file: Path, out: Path | None, trials: int | None, workers: int | None, cluster: str | None,
    json_file: Path | None, overwrite: bool,
) -> None:  # fmt: skip
    """Find parameters of loops and observers with which many drives do best.

    TUNE.toml is a study with a section [tune]: what may change within which range, what is to be small. Each trial runs
    the same drives with the same noise. What is found is measured again on other drives, beside what there was. Several
    objectives give a Pareto front.

    Trials are kept: after Ctrl-C or a crash the same command goes on, and with more --trials it searches further.

    \b
    Examples:
      bench tune observer.toml
      bench tune observer.toml --trials 500
      bench sim --pty --config observer.tune/best-drive.toml
    """
    check_files({"--json": json_file}, overwrite, [file])
    import time

    from bench.study.tune import TuneOptions, tune
    from bench.study.tuned import as_json, lines

    with Progress() as screen:
        try:
            tuned = tune(TuneOptions(file, out, trials, workers, cluster, overwrite), screen, time.monotonic)
        except KeyboardInterrupt:
            screen.note("interrupted: trials that were complete are kept; the same command goes on")
            raise
    say = note if json_file == STANDARD_OUTPUT else echo
    for line in lines(tuned):
        say(line)
    say(f"written to {tuned.folder}: best.toml, tune.png, tune.json, trials.csv")
    if json_file is not None:
        write_json(json_file, as_json(tuned))

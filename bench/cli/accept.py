"""`bench accept`: acceptance tests with limits, verdicts and a report."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from bench.cli.target import TARGET

_FILE = click.Path(dir_okay=False, path_type=Path)


@click.command("accept")
@click.argument("target", required=False, type=TARGET)
@click.option("-k", "keyword", metavar="EXPR", help="Only tests whose names match, as pytest's -k: 'fig08 or fig09'.")
@click.option("--tests", metavar="PATH", multiple=True, type=click.Path(path_type=Path),
              help="Tests of your own instead of the shipped ones; repeatable.")  # fmt: skip
@click.option("--report", metavar="DIR", type=click.Path(file_okay=False, path_type=Path),
              help="Write report.html, figures and recordings there.")  # fmt: skip
@click.option("--junit", metavar="FILE", type=_FILE, help="Write JUnit XML, with the measurements as properties.")
@click.option("--json", metavar="FILE", type=_FILE, help="Write every result as JSON.")
@click.option("--bench", "bench_toml", metavar="FILE", type=_FILE,
              help="Target, load and limits of this bench (default: ./bench.toml).")  # fmt: skip
@click.option("--config", metavar="FILE", type=_FILE, help="Figures of the simulated drive (TOML).")
@click.option("--jobs", metavar="N", type=click.IntRange(1, 64), default=1,
              help="Processes that share the tests; on the simulated drive only; needs pytest-xdist.")  # fmt: skip
@click.option("--yes", is_flag=True, help="The shaft is clear: energise a physical drive without asking.")
@click.option("--list", "list_only", is_flag=True, help="Show all measurements and their limits; run nothing.")
def command(**given: Any) -> None:
    """Run acceptance tests on a drive: limits, verdicts, a report.

    TARGET: serial:/dev/ttyACM0, tcp:HOST:PORT, can:socketcan/can0, or sim, the simulated drive in virtual time; without
    it, $BENCH_TARGET, then what bench.toml says, then sim. The tests are those of the paper and of a drive's
    acceptance; a physical drive turns, up to the speed and current that the question states.

    Exit codes: 0 passed, 1 the drive failed, 2 the bench did, 130 interrupted.

    \b
    Examples:
      bench accept --report report
      bench accept -k fig09 --report report
      bench accept serial:/dev/ttyACM0 --report report --junit junit.xml
    """
    from bench.acceptance.accept import AcceptOptions, accept, closing_lines
    from bench.cli.output import Progress

    for name in ("junit", "json"):
        if given[name] is not None and not given[name].parent.is_dir():
            raise click.UsageError(f"--{name} {given[name]}: there is no directory {given[name].parent}")
    with Progress(status=not given["list_only"]) as screen:
        run, code = accept(AcceptOptions(**given), screen)
    if run is not None:
        for line in closing_lines(run):
            click.echo(line)
        if given["report"] is not None:
            click.echo(f"report: {given['report'] / 'report.html'}")
    sys.exit(code)

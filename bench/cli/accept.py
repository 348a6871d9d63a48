"""`bench accept`: acceptance tests with limits, verdicts and a report."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.accept.report_files import holds_report
from bench.cli.files import DIRECTORY, FILE, check_files, config_option, json_option, overwrite_option, write_json
from bench.cli.options import yes_option
from bench.cli.output import Progress
from bench.cli.streams import echo, note
from bench.cli.target import TARGET
from bench.errors import BenchError
from bench.files import STANDARD_OUTPUT, check_directory

if TYPE_CHECKING:
    from bench.signal.limits import Limits


class _Screen(Progress):
    """Also collects what `--list` asks for."""

    def __init__(self, status: bool) -> None:
        super().__init__(status)
        self.limits: dict[str, Limits] = {}

    def listed(self, name: str, limits: Limits) -> None:
        """Keep it."""
        self.limits[name] = limits


@click.command("accept")
@click.argument("target", required=False, type=TARGET)
@click.option("-k", "keyword", metavar="EXPR", help="Only tests whose names match, as pytest's -k: 'fig08 or fig09'.")
@click.option("--tests", metavar="PATH", multiple=True, type=click.Path(path_type=Path),
              help="Tests of your own instead of the shipped ones; repeatable.")  # fmt: skip
@click.option("--report", metavar="DIR", type=DIRECTORY,
              help="Write report.html, plots and recordings there.")  # fmt: skip
@click.option("--junit", metavar="FILE", type=FILE, help="Write JUnit XML, with the measurements as properties.")
@json_option("every result")
@overwrite_option
@click.option("--bench", "bench_toml", metavar="FILE", type=FILE,
              help="Target, load and limits of this bench (default: ./bench.toml).")  # fmt: skip
@config_option
@click.option("--operator", metavar="NAME", help="Who runs this, for the report.")
@click.option("--motor", metavar="TEXT", help="Which motor this is, for the report: type and serial number.")
@click.option("--jobs", metavar="N", type=click.IntRange(1, 64), default=1,
              help="Processes that share the tests; on the simulated drive only; needs pytest-xdist.")  # fmt: skip
@yes_option
@click.option("--allow-skipped", is_flag=True,
              help="PASS, not INCOMPLETE, where tests were skipped for what is missing.")  # fmt: skip
@click.option("--list", "list_only", is_flag=True, help="Show all measurements and their limits; run nothing.")
def command(json_file: Path | None, overwrite: bool, **given: Any) -> None:
    """Run acceptance tests on a drive: limits, verdicts, a report.

    TARGET: serial:/dev/ttyACM0, tcp:HOST:PORT, can:socketcan/can0, or sim, the simulated drive in virtual time; without
    it, $BENCH_TARGET, then what bench.toml says, then sim. The tests are those of the paper and of a drive's
    acceptance; a physical drive turns, up to the speed and current that the question states.

    Exit codes: 0 passed, 1 the drive failed, 2 the bench did, 5 outputs may still be on, 6 INCOMPLETE: all that was
    tested passed, but tests were skipped, 130 interrupted.

    \b
    Examples:
      bench accept --report report
      bench accept -k fig09 --report report
      bench accept serial:/dev/ttyACM0 --report report --junit junit.xml
    """
    junit, report = given["junit"], given["report"]
    if junit == STANDARD_OUTPUT:
        raise click.UsageError("--junit -: only --json goes to standard output; give a file")
    check_files({"--junit": junit, "--json": json_file}, overwrite, [given["bench_toml"], given["config"]])
    if report is not None:
        if holds_report(report) and not overwrite:
            raise BenchError(f"--report {report} holds a report: choose another name, or --overwrite to replace it")
        check_directory(report, f"--report {report}", make=True)
    from bench.accept.accept import AcceptOptions, accept, closing_lines

    with _Screen(status=not given["list_only"]) as screen:
        run, code = accept(AcceptOptions(json=json_file, **given), screen)
    if run is None:
        _show(screen.limits, json_file)
    else:
        say = note if json_file == STANDARD_OUTPUT else echo
        for line in closing_lines(run):
            say(line)
        if report is not None:
            say(f"report: {report / 'report.html'}")
    sys.exit(code)


def _show(listed: dict[str, Limits], json_file: Path | None) -> None:
    if json_file is not None:
        write_json(json_file, [asdict(limits) | {"name": name} for name, limits in listed.items()])
        return
    for name, limits in listed.items():
        echo(f"{name}: {limits}")

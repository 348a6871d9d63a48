"""`bench accept`: acceptance tests with limits, verdicts and a report."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.accept.report_files import holds_report
from bench.cli.files import DIRECTORY, FILE, check_files, config_option, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.options import yes_option
from bench.cli.output import Progress
from bench.cli.streams import echo, note
from bench.cli.target import TARGET, bench_target
from bench.errors import BenchError
from bench.files import STANDARD_OUTPUT, check_directory

if TYPE_CHECKING:
    from bench.signal.limits import Limits


class _Screen(Progress):
    """Also collects what `--list` asks for."""

    def __init__(self, status: bool) -> None:
        super().__init__(status)
        self.limits: dict[str, tuple[Limits, Limits | None]] = {}

    def listed(self, name: str, limits: Limits, specified: Limits | None) -> None:
        """Keep it."""
        self.limits[name] = limits, specified


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
              help="Target, load and limits of this bench [default: bench.toml here or above].")  # fmt: skip
@config_option
@click.option("--operator", metavar="NAME", help="Who runs this, for the report.")
@click.option("--motor", metavar="TEXT", help="Which motor this is, for the report: type and serial number.")
@click.option("--rated-speed", metavar="RPM", type=Number(above=0),
              help="What the motor is rated for, r/min: written to [rated] in bench.toml.")  # fmt: skip
@click.option("--rated-current", metavar="A", type=Number(above=0), help="The same, A peak.")
@click.option("--spec", metavar="FILE|NAME",
              help="What good drives of this kind measure: their bands are judged too; sim is shipped.")  # fmt: skip
@click.option("--learn-limits", "learn", metavar="FILE", type=FILE,
              help="Write such a spec from runs that pass, or add them to the one in FILE.")  # fmt: skip
@click.option(
    "--runs", metavar="N", type=click.IntRange(1, 1000), help="With --learn-limits: run N times (default: 1)."
)
@click.option("--results", metavar="FILE", multiple=True, type=FILE,
              help="With --learn-limits: run nothing, learn from what --json wrote; repeatable.")  # fmt: skip
@click.option("--seed", metavar="N", type=click.IntRange(0), help="Of the simulated drive's noise.")
@click.option("--jobs", metavar="N", type=click.IntRange(1, 64), default=1,
              help="Processes that share the tests; on the simulated drive only; needs pytest-xdist.")  # fmt: skip
@yes_option
@click.option("--allow-skipped", is_flag=True,
              help="PASS, not INCOMPLETE, where tests were skipped for what is missing.")  # fmt: skip
@click.option("--list", "list_only", is_flag=True, help="Show all measurements and their limits; run nothing.")
def command(
    json_file: Path | None,
    overwrite: bool,
    learn: Path | None,
    runs: int | None,
    results: tuple[Path, ...],
    **given: Any,
) -> None:
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
      bench accept serial:/dev/ttyACM0 --learn-limits type42.toml --runs 5
      bench accept serial:/dev/ttyACM0 --spec type42.toml
    """
    junit, report = given["junit"], given["report"]
    _require_fitting(learn, runs, results, given, [json_file, junit, report])
    if junit == STANDARD_OUTPUT:
        raise click.UsageError("--junit -: only --json goes to standard output; give a file")
    check_files({"--junit": junit, "--json": json_file}, overwrite, [given["bench_toml"], given["config"]])
    check_files({"--learn-limits": learn}, True, [*results, given["bench_toml"], given["config"]])
    if report is not None:
        if holds_report(report) and not overwrite:
            raise BenchError(f"--report {report} holds a report: choose another name, or --overwrite to replace it")
        check_directory(report, f"--report {report}", make=True)
    from bench.accept.accept import AcceptOptions, accept, closing_lines

    learned: list[str] = []
    if given["target"] is None and not results:
        given["target"] = bench_target(given["bench_toml"])
    options = AcceptOptions(json=json_file, **given)
    with _Screen(status=not given["list_only"]) as screen:
        if learn is None:
            run, code = accept(options, screen)
        else:
            from bench.accept import learning

            spec, run, code = learning.learn(options, screen, learn, runs or 1, results, overwrite)
            learned = learning.summary(spec, run) if spec.runs else [f"{learn}: nothing learned"]
    if run is None:
        _show(screen.limits, json_file)
    else:
        say = note if json_file == STANDARD_OUTPUT else echo
        for line in [*([] if results else closing_lines(run)), *learned]:
            say(line)
        if report is not None:
            say(f"report: {report / 'report.html'}")
    sys.exit(code)


def _require_fitting(
    learn: Path | None, runs: int | None, results: tuple[Path, ...], given: dict[str, Any], files: list[Path | None]
) -> None:
    """UsageError for options that exclude one another."""
    if learn is None:
        if runs is not None or results:
            raise click.UsageError("--runs and --results are for --learn-limits")
        return
    if given["spec"] or given["list_only"]:
        raise click.UsageError("--learn-limits goes with neither --spec nor --list")
    if results and (runs is not None or given["target"] or any(files)):
        raise click.UsageError("--results runs nothing: omit TARGET, --runs, --report, --junit and --json")
    if runs is not None and any(files):
        raise click.UsageError("--runs writes no --report, --junit or --json: each run would replace the one before")


def _show(listed: dict[str, tuple[Limits, Limits | None]], json_file: Path | None) -> None:
    if json_file is not None:
        both = {name: (asdict(limits), band and asdict(band)) for name, (limits, band) in listed.items()}
        write_json(json_file, [limits | {"name": name, "specified": band} for name, (limits, band) in both.items()])
        return
    for name, (limits, band) in listed.items():
        echo(f"{name}: {limits}" + (f"; specified {band}" if band else ""))

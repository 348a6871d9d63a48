"""`bench conform`: whether a device conforms to HBP, check by check."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.cli.files import FILE, check_files, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.options import operator_option, yes_option
from bench.cli.output import Progress, table
from bench.cli.streams import echo, note
from bench.cli.target import simulated_figures, target_argument
from bench.conform.levels import DEFAULT_LEVEL, LEVELS
from bench.conform.verdicts import WORDS
from bench.files import STANDARD_OUTPUT, write
from bench.signal.verdict import Verdict

if TYPE_CHECKING:
    from bench.conform.checks import Result
    from bench.conform.run import Run

SHORT = 100  # characters of the evidence of a check that passed, in the table


@click.command("conform")
@target_argument()
@click.option("--level", type=click.IntRange(0, len(LEVELS) - 1), default=DEFAULT_LEVEL, show_default=True,
              metavar="N", help="Highest level to run; 3 energises the drive, 4 turns the shaft.")  # fmt: skip
@click.option("--speed", "speed_rpm", metavar="RPM", type=Number(above=0), default=100.0, show_default=True,
              help="Motor speed at level 4, r/min.")  # fmt: skip
@yes_option
@json_option("all checks")
@click.option("--junit", metavar="FILE", type=FILE, help="Write JUnit XML, one test case per check.")
@click.option("--report", metavar="FILE", type=FILE,
              help="Write an HTML report: the device, and the evidence of each check.")  # fmt: skip
@overwrite_option
@operator_option("for the report")
def command(
    target: str, json_file: Path | None, junit: Path | None, report: Path | None, overwrite: bool, **given: Any
) -> None:
    """Check whether the device on TARGET conforms to HBP, the protocol (protocol/SPEC.md).

    TARGET: serial:/dev/ttyACM0?baud=3000000, tcp:HOST:PORT, can:socketcan/can0, or sim; without
    it, what $BENCH_TARGET or bench.toml says.

    \b
    Levels; each includes those below it:
      0  framing, damaged frames, error precedence, retries
      1  identity, descriptor, parameters, heartbeat, clock
      2  streams, and the counting of lost frames (default)
      3  states, STOP, watchdog, zero setpoints: outputs on, at zero current
      4  motion at --speed; STOP and watchdog while turning
      5  CAN; on a bus, most CAN checks already run at lower levels

    Parameters and streams are restored, and outputs are left off. A check that did not observe what it looks for is
    unknown, not passed; the result at the end names it.

    Exit codes: 0 no check failed, 1 a check failed or the link was lost, 2 wrong argument or error, 5 outputs may still
    be on, 6 no check failed, but a level could not be shown (for example START was refused), 130 interrupted.

    \b
    Examples:
      bench conform serial:/dev/ttyACM0
      bench conform serial:/dev/ttyACM0 --level 3 --report conform.html
      bench conform sim --level 4 --json
    """
    if junit == STANDARD_OUTPUT or report == STANDARD_OUTPUT:
        raise click.UsageError("only --json can go to standard output: give file names to --junit and --report")
    check_files({"--json": json_file, "--junit": junit, "--report": report}, overwrite)
    from bench.conform.claim import about, as_data, claim, outcome
    from bench.conform.junit import as_xml
    from bench.conform.report import as_html
    from bench.rig.metadata import about_bench
    from bench.rig.settings import read_settings

    station = read_settings(None)
    station = replace(station, operator=given["operator"] or station.operator, config=None)
    started = datetime.now(UTC).isoformat(timespec="seconds")
    run = _run(target, given["level"], given["speed_rpm"], given["yes"], quiet=json_file == STANDARD_OUTPUT)
    told = about(run, about_bench(station), started)
    if json_file is not None:
        write_json(json_file, as_data(run, told))
    if junit is not None:
        write(junit, as_xml(run, told), f"--junit {junit}")
    if report is not None:
        write(report, as_html(run, told), f"--report {report}")
    say = note if json_file == STANDARD_OUTPUT else echo
    for trouble in run.troubles:
        note(trouble)
    if run.unsafe:
        note(run.unsafe)
    say(claim(run).words)
    if report is not None:
        say(f"report: {report}")
    sys.exit(outcome(run).exit_code)


def _run(target: str, level: int, speed_rpm: float, yes: bool, quiet: bool) -> Run:
    """Run the checks, a table of each level as it ends."""
    from bench.conform.run import Options, conform
    from bench.rig.interrupts import signals_as_exceptions
    from protocol.links import open_link

    with ExitStack() as stack:
        stack.enter_context(signals_as_exceptions())
        if target == "sim":
            from bench.device.simulator import EmbeddedDrive

            target = stack.enter_context(EmbeddedDrive(simulated_figures(target), note)).target
        screen = stack.enter_context(Progress())
        shown = _Tables(screen, quiet)
        confirm = screen.confirm if sys.stdin.isatty() else None
        run = conform(lambda: open_link(target), Options(target, level, speed_rpm, yes), screen, confirm, shown.add)
        shown.end()
    return run


class _Tables:
    """Prints the results of a level when the next one begins."""

    def __init__(self, screen: Progress, quiet: bool) -> None:
        self._screen = screen
        self._quiet = quiet
        self._rows: list[Result] = []

    def add(self, result: Result) -> None:
        """One more."""
        if self._rows and self._rows[0].check.level != result.check.level:
            self.end()
        self._rows.append(result)

    def end(self) -> None:
        """Print what there is."""
        rows, self._rows = self._rows, []
        if not rows or self._quiet:
            return
        level = rows[0].check.level
        self._screen.pause()
        table(
            [f"level {level}: {LEVELS[level]}", "verdict", "evidence"],
            [[row.check.id, WORDS[row.verdict], _short(row)] for row in rows],
        )
        echo()
        self._screen.resume()


def _short(row: Result) -> str:
    words = row.evidence
    return words if row.verdict is not Verdict.PASS or len(words) <= SHORT else f"{words[: SHORT - 1]}…"

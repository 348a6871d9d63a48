"""`bench live`: stream a drive into rerun, spin it on request, summarise the run."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from bench.cli.files import FILE, RUN, check_files, config_option, json_option, overwrite_option, write_json
from bench.cli.number import Duration, Number
from bench.cli.options import Names, channels_option, operator_option, viewer_option, yes_option
from bench.cli.streams import echo, note
from bench.cli.target import simulated_figures, target_argument
from bench.errors import BenchError
from bench.files import RRD, STANDARD_OUTPUT
from bench.record.ring import LEAST, SHORTEST
from bench.signal.sources import source_number
from protocol.signals import SOURCE_NAMES

if TYPE_CHECKING:
    from bench.device.simulator import EmbeddedDrive
    from bench.rig.settings import Settings


class Observer(click.Choice[str]):
    """A name of an observer, written with - or _; also one that the protocol's table lacks."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Read it, or say why not."""
        name = str(value).replace("_", "-")
        if name not in self.choices and source_number(name) is not None:
            return name
        return super().convert(name, param, ctx)


@click.command("live")
@target_argument(needed=False)
@click.option("--speed", "speed_rpm", metavar="RPM", type=Number(),
              help="Spin the motor at this speed, r/min; negative: reverse.")  # fmt: skip
@click.option("--load", "load_a", metavar="A", type=Number(),
              help="Load torque, given as q current, A; needs a load machine.")  # fmt: skip
@click.option("--profile", "profile_file", metavar="FILE", type=FILE,
              help="Play a motion profile: a TOML file of steps, ramps, sines; bench plot FILE draws it.")  # fmt: skip
@click.option("--current", "current_a", metavar="A", type=Number(above=0),
              help="Highest phase current, A peak [default: as the profile says, else rated current in bench.toml, "
              "else i_max].")  # fmt: skip
@click.option("--observer", type=Observer(list(SOURCE_NAMES)),
              help="Angle source of the drive's control [default: unchanged].")  # fmt: skip
@click.option("--duration", metavar="S", type=Number(above=0),
              help="Stop after S seconds; limits the show or the profile, or repeats it.")  # fmt: skip
@click.option("--save", metavar="RUN", type=RUN, help="Record to this folder; NAME.rrd also writes a file for rerun.")
@overwrite_option
@click.option("--keep", metavar="TIME", type=Duration(LEAST),
              help="Keep only the last TIME (such as 2h), and 70 s around faults, triggers and marks.")  # fmt: skip
@click.option("--split", metavar="TIME", type=Duration(SHORTEST),
              help="Start a new run every TIME (such as 1h): NAME-001.run, …")  # fmt: skip
@click.option("--trigger", metavar="COND", multiple=True,
              help="Mark the run when this becomes true, such as 'i_q>8' or 'abs(i_q)>8'; repeatable.")  # fmt: skip
@click.option("--note", metavar="TEXT", default="", help="Note to store in the recording.")
@viewer_option("rerun viewer; ", "auto", "native", "web", "none")
@channels_option("Stream only these channels; +A,+B adds to the default [default: all except those on request].")
@click.option("--rate", "rate_hz", metavar="HZ", type=Number(above=0),
              help="Sample rate, Hz [default: one sample per PWM period].")  # fmt: skip
@click.option("--fit", is_flag=True, help="If the link cannot carry this rate, use the highest that fits.")
@yes_option
@click.option("--clear-faults", is_flag=True, help="Clear latched faults first.")
@click.option("--host-observers", is_flag=True,
              help="Run the drive's observers on the host too, and compare the estimates.")  # fmt: skip
@click.option("--estimate", metavar="NAME", multiple=True,
              help="Run this observer on the host and show its estimate; bench replay --list names them; "
              "repeatable.")  # fmt: skip
@click.option("--tune", metavar="A,B,…", type=Names(),
              help="Change these parameters while it runs: arrow keys and numbers on a terminal, else lines NAME=VALUE "
              "on standard input. The end puts them back.")  # fmt: skip
@config_option
@operator_option("stored in the recording")
@json_option("the summary")
def command(target: str | None, json_file: Path | None, config: Path | None, operator: str, **given: Any) -> None:
    """Stream a drive into rerun: watch it, spin it, record it.

    TARGET: serial:/dev/ttyACM0?baud=3000000, tcp:HOST:PORT, can:socketcan/can0, or sim (the simulated drive); without
    it, what $BENCH_TARGET or bench.toml says. Where neither says anything, the simulated drive runs a short show:
    start-up, speed step and load step, first with the average-speed observer, then with the vector-tracking observer.

    Without --speed, --load and --profile, a drive that is named by any of them is only watched, not energised.

    Ctrl-C switches the outputs off, completes the recording and exits with code 130.

    \b
    Examples:
      bench live
      bench live serial:/dev/ttyACM0
      bench live serial:/dev/ttyACM0 --speed 500 --yes --duration 20 --save a.run --viewer none
      bench live sim --speed 1000 --load 4 --observer average-speed
      bench live sim --profile motion.toml --save a.run
    """
    _check(target, config, given)
    config = simulated_figures(target, config)
    files = {"--save": given["save"], "--json": json_file}
    check_files(files, given["overwrite"], [config, given["profile_file"]], recordings=["--save"])
    if (file := given.pop("profile_file")) is not None:
        from bench.motion.read import read_profile

        given["profile"] = read_profile(file)
    with ExitStack() as stack:
        drive = None
        if target in (None, "sim"):  # it starts while this process still loads what it needs
            from bench.device.simulator import EmbeddedDrive

            drive = EmbeddedDrive(config)
            stack.callback(drive.end)
        from bench.rig.settings import read_settings

        station = read_settings(None)
        _run(target, replace(station, operator=operator or station.operator, config=config), given, json_file, drive)


def _run(
    target: str | None, settings: Settings, given: dict[str, Any], json_file: Path | None, drive: EmbeddedDrive | None
) -> NoReturn:
    """Run it, and exit."""
    from bench.live import run as live

    options = live.LiveOptions(target=target, settings=settings, **given | {"tune": given["tune"] or ()})
    from bench.cli.output import Progress, pairs, table
    from bench.live.summary import ASKED_HEADERS, ERROR_HEADERS, Summary, asked_rows, error_rows, run_rows

    unwritten: list[BenchError] = []

    def report(summary: Summary) -> None:
        screen.pause()
        try:
            if json_file is not None:
                write_json(json_file, summary.as_json())
            if json_file != STANDARD_OUTPUT:
                for headers, rows in ((ASKED_HEADERS, asked_rows(summary)), (ERROR_HEADERS, error_rows(summary))):
                    if rows:
                        table(headers, rows)
                        echo()
                pairs(f"run on {summary.target}", run_rows(summary))
        except BenchError as error:  # how the run ended matters more
            unwritten.append(error)

    with Progress() as screen:
        confirm = screen.confirm if sys.stdin.isatty() else None
        ended = live.run(options, screen, confirm, report, sys.stdin.isatty() and sys.stderr.isatty(), drive)
    if unwritten and ended.exit_code == 0:
        raise unwritten[0]
    for error in unwritten:
        note(f"error: {error}")
    sys.exit(ended.exit_code)


def _check(target: str | None, config: Path | None, given: dict[str, Any]) -> None:
    """Raise UsageError for options that exclude each other."""
    asked = [of for of, name in (("--speed", "speed_rpm"), ("--load", "load_a")) if given[name] is not None]
    if given["profile_file"] is not None and asked:
        raise click.UsageError(f"--profile and {asked[0]} exclude each other: write it into the profile")
    for option, value in (("observer", given["observer"]), ("current", given["current_a"])):
        if value is not None and not asked and given["profile_file"] is None:
            needs = "--speed, --load or --profile"
            raise click.UsageError(f"--{option} needs {needs}: without them the drive is only watched")
    if given["trigger"]:
        from bench.live.triggers import Condition  # numpy costs 70 ms: only those who need it pay

        for text in given["trigger"]:
            Condition.parse(text)
    for option in ("keep", "split", "note"):
        if given[option] and given["save"] is None:
            raise click.UsageError(f"--{option} needs --save: nothing is recorded without it")
    if given["keep"] and given["split"]:
        raise click.UsageError("--keep and --split exclude each other: --keep writes one run")
    if given["split"] and given["save"].suffix == RRD:
        raise click.UsageError(
            "--split cannot write .rrd files: use --save NAME.run and open the parts with bench view"
        )

"""`bench hall`: are the Hall sensors healthy, and where do their edges lie?"""

from __future__ import annotations

import glob
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from bench.cli import fail
from bench.cli.files import FILE, RUN, check_files, config_option, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.streams import echo, note
from bench.cli.target import TargetType
from bench.errors import Interrupted, OutputsMayBeOn
from bench.files import STANDARD_OUTPUT, is_run, run_folder

if TYPE_CHECKING:
    from bench.cli.output import Progress
    from bench.hall.health import Health
    from bench.hall.learn import Learnt
    from bench.hall.source import Options, Source


WAYS = ("encoder", "filter", "drive")


class _SourceType(TargetType):
    """A target or a recording."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The string as it is."""
        return str(value)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Targets, and the recordings that are there."""
        runs = sorted(glob.glob(glob.escape(incomplete) + "*.run"))
        return [*super().shell_complete(ctx, param, incomplete), *map(CompletionItem, runs)]


def _looking(function: Callable[..., None]) -> Callable[..., None]:
    """The argument and the options that both commands have."""
    for decorate in reversed((
        click.argument("source", metavar="TARGET|RUN", type=_SourceType()),
        click.option("--speed", "speed_rpm", metavar="RPM", type=Number(above=0), default=240.0, show_default=True,
                     help="Highest speed at which the shaft turns both ways, r/min."),
        click.option("--current", "current_a", metavar="A", type=Number(above=0),
                     help="Largest phase current, A, peak [default: 2, or what the drive allows]."),
        click.option("--passive", "--no-spin", "passive", is_flag=True,
                     help="Energise nothing: the shaft is turned by hand."),
        click.option("--duration", metavar="S", type=Number(above=0), default=60.0, show_default=True,
                     help="With --passive: watch for S seconds at most."),
        click.option("--from", "begin", metavar="S", type=Number(), help="Of a recording: from this device time, s."),
        click.option("--to", "end", metavar="S", type=Number(), help="Of a recording: up to this device time, s."),
        click.option("--yes", is_flag=True, help="The shaft is clear: energise a physical drive without asking."),
        click.option("--save", metavar="RUN", type=RUN, help="Record to this folder; NAME.rrd: and a file for rerun."),
        overwrite_option,
        config_option,
        click.option("--operator", metavar="NAME", default="", help="Who runs this, for the recording."),
        json_option("everything"),
    )):  # fmt: skip
        function = decorate(function)
    return function


@click.group("hall")
def command() -> None:
    """Hall sensors: check their health, learn where their edges lie.

    \b
    Examples:
      bench hall check sim
      bench hall learn sim --out edges.toml
    """


@command.command("check")
@_looking
def check(source: str, json_file: Path | None, **given: Any) -> None:
    """Find out whether the Hall sensors, their wires and the encoder are healthy, and what is wrong.

    TARGET: serial:/dev/ttyACM0, tcp:HOST:PORT, can:socketcan/can0, or sim, the simulated drive in virtual time. Its
    motor turns slowly both ways, by the encoder where there is one, at no more than --speed and --current; a drive that
    trips meanwhile is recorded all the same. RUN: a recording in which the shaft turned both ways.

    Exit codes: 0 healthy, 1 a fault was found, 2 cannot tell, or an error, 5 outputs may still be on.

    \b
    Examples:
      bench hall check serial:/dev/ttyACM0
      bench hall check tcp:192.168.0.7:7000 --passive
      bench hall check run.run --json health.json
      bench hall check day.run --from 3600 --to 7200
    """
    from bench.cli.output import Progress

    options = _options(source, given, {"--json": json_file})
    with Progress() as screen, _opened(options, screen) as found:
        health = _show(source, found, json_file, screen)
    sys.exit(int(health.outcome))


@command.command("learn")
@_looking
@click.option(
    "--by",
    type=click.Choice(WAYS),
    default="encoder",
    show_default=True,
    help="Who says where they lie: the encoder; the Kalman filter of edge-kalman, run here over what was recorded; or "
    "the drive's own one, by what it has learned so far: nothing turns.",
)
@click.option("--motor", is_flag=True, help="With --by filter or drive: psi_f_hat, R_s_hat, L_s_hat too, as learned.")
@click.option("--write", is_flag=True, help="Set the drive's edge_up_1 … edge_down_6 and edge_sd, and read them back.")
@click.option("--store", is_flag=True, help="Write, and have the drive keep all its parameters for the next boot.")
@click.option("--out", metavar="FILE", type=FILE, help="Write the edges to this .toml or .json, for a firmware.")
def learn(source: str, json_file: Path | None, motor: bool, write: bool, out: Path | None, **given: Any) -> None:
    """Find where the Hall edges lie, for observers that know them; refused where a check finds a fault.

    TARGET and RUN are those of bench hall check. Without --write and --out the edges are only shown. A drive keeps what
    was written until it is switched off, and longer with --store.

    \b
    Examples:
      bench hall learn serial:/dev/ttyACM0 --yes --write
      bench hall learn serial:/dev/ttyACM0 --by filter --speed 1000 --yes --write --store
      bench hall learn run.run --out edges.toml
    """
    from bench.cli.output import Progress
    from bench.hall import learn as learning

    if out is not None:
        learning.check_out(out)
    write = write or given["store"]
    options = _options(source, given | {"write": write}, {"--json": json_file, "--out": out})
    if motor and options.by == "encoder":
        raise click.UsageError("--motor: an encoder says nothing of the motor: give --by filter or --by drive")
    if options.passive and options.by == "filter":
        raise click.UsageError("--passive: with the outputs off the filter sees no voltage: give --by encoder")
    if write and source == "sim":
        raise click.UsageError(
            "--write: the simulated drive ends with this command, and forgets what was written: give --out FILE, "
            "for the --config of another run"
        )
    if write and options.recorded:
        raise click.UsageError(f"--write needs a drive, and {source} is a recording: give --out FILE")
    say = note if json_file == STANDARD_OUTPUT else echo
    with Progress() as screen, _opened(options, screen) as found:
        edges = _learnt(source, found, options, motor, json_file, screen)
        if out is not None:
            learning.save(out, edges)
            say(f"edges: {out}")
        if write and found.drive is not None:
            say(f"{learning.write(found.drive, edges)} parameters written to node {found.drive.number} and read back")
        if options.store and found.drive is not None:
            found.drive.store()
            say(f"node {found.drive.number} keeps its parameters for the next boot")


def _learnt(
    source: str, found: Source, options: Options, motor: bool, json_file: Path | None, screen: Progress
) -> Learnt:
    """What was measured or learned, shown. BenchError where it is not to be used."""
    from bench.cli.output import pairs, table
    from bench.hall import learn as learning
    from bench.hall import lessons

    if options.by == "encoder":
        return learning.learnt(_show(source, found, json_file, screen))
    learned = lessons.learned(found.turned.capture, options.by)
    told = {"lessons": lessons.as_json(learned)}
    if options.by == "filter":
        learning.require_no_fault(_show(source, found, json_file, screen, told))
    elif json_file is not None:
        write_json(json_file, {"source": source, **told})
    screen.pause()
    if json_file != STANDARD_OUTPUT:
        pairs(f"Lessons of {source}", [["learned by", learned.whose]])
        table(lessons.HEADERS, lessons.rows(learned))
    return learning.taught(learned, motor)


def _options(source: str, given: dict[str, Any], outputs: dict[str, Path | None]) -> Options:
    """Checked as far as that can be done before anything is opened."""
    from bench.hall.source import Options

    options = Options(source, **given)
    inputs = [source if options.recorded else None, options.config]
    check_files({"--save": options.save, **outputs}, options.overwrite, inputs, recordings=["--save"])
    if options.config is not None and source != "sim":
        raise click.UsageError(f"--config is for the simulated drive, not for {source}")
    if options.recorded and (options.save is not None or options.passive):
        raise click.UsageError(f"{source} is a recording: --save and --passive are for a drive")
    if not options.recorded and (options.begin, options.end) != (None, None):
        raise click.UsageError(f"{source} is a drive: --from and --to are for a recording")
    return options


@contextmanager
def _opened(options: Options, screen: Progress) -> Iterator[Source]:
    """What `opened` gives; a signal ends the command in a line that says how the drive was left."""
    from bench.hall.source import opened

    try:
        with opened(options, screen, screen.confirm if sys.stdin.isatty() else None) as found:
            yield found
    except (KeyboardInterrupt, Interrupted) as interrupt:
        screen.pause()
        number = interrupt.signum if isinstance(interrupt, Interrupted) else signal.SIGINT
        code = 128 + number
        words = f"interrupted by {signal.Signals(number).name}"
        if isinstance(interrupt.__cause__, OutputsMayBeOn):
            code = interrupt.__cause__.exit_code
        if interrupt.__cause__ is not None:
            words += f"; {interrupt.__cause__}"
        elif not options.recorded and not options.passive:
            words += "; outputs off"
        if options.save is not None and is_run(run_folder(options.save)):
            words += f"; recording: {run_folder(options.save)}"
        fail(words, code)


def _show(
    source: str, found: Source, json_file: Path | None, screen: Progress, more: Mapping[str, Any] | None = None
) -> Health:
    """Examine what was recorded; print it, or write it as JSON, with `more` in it."""
    from bench.cli.output import pairs, table
    from bench.hall import report
    from bench.hall.health import examine
    from bench.hall.trace import trace

    looked_at = trace(found.turned.capture)
    health = examine(looked_at, found.turned.further)
    screen.pause()
    if json_file is not None:
        write_json(json_file, {**report.as_json(health, looked_at, found.turned, source), **(more or {})})
        if json_file == STANDARD_OUTPUT:
            return health
    pairs(f"Hall sensors of {source}", report.fact_rows(health, looked_at, found.turned))
    echo()
    for headers, rows, title in (
        (report.EDGE_HEADERS, report.edge_rows(health), report.EDGE_TITLE),
        (report.SENSOR_HEADERS, report.sensor_rows(health, looked_at.seconds), ()),
        (report.CURRENT_HEADERS, report.current_rows(health), ()),
    ):
        if rows:
            for line in title:
                echo(line)
            table(headers, rows)
            echo()
    for line in report.verdict_lines(health, found.turned.remarks):
        echo(line)
    return health

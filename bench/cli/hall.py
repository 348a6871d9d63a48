"""`bench hall`: health and edge angles of the Hall sensors, and other tools' tables of them."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.cli import fail
from bench.cli.files import FILE, RUN, check_files, config_option, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.options import operator_option, part_options, yes_option
from bench.cli.streams import echo, note
from bench.cli.target import SourceType, simulated_figures, target_argument
from bench.errors import BenchError, ExitCode, Interrupted, OutputsMayBeOn
from bench.files import STANDARD_OUTPUT, is_run, run_folder
from bench.signal.verdict import Verdict

if TYPE_CHECKING:
    from bench.cli.output import Progress
    from bench.findings.health import Health
    from bench.hall.learn import Learnt
    from bench.hall.source import Options, Source
    from bench.hall.table_reading import Comparison, Reading
    from bench.hall.tables import HallTable


def _looking(function: Callable[..., None]) -> Callable[..., None]:
    """The argument and the options that both commands have."""
    for decorate in reversed((
        target_argument("source", SourceType((".run",)), "[TARGET|RUN]"),
        click.option("--speed", "speed_rpm", metavar="RPM", type=Number(above=0), default=240.0, show_default=True,
                     help="Highest speed, forward and reverse, r/min."),
        click.option("--current", "current_a", metavar="A", type=Number(above=0),
                     help="Highest phase current, A peak [default: 2, or the drive's limit if lower]."),
        click.option("--passive", "--no-spin", "passive", is_flag=True,
                     help="Do not energise the drive: turn the shaft by hand."),
        click.option("--duration", metavar="S", type=Number(above=0), default=60.0, show_default=True,
                     help="With --passive: stop after S seconds at the latest."),
        part_options("RUN only: "),
        yes_option,
        click.option("--save", metavar="RUN", type=RUN,
                     help="Record to this folder; NAME.rrd also writes a file for rerun."),
        overwrite_option,
        config_option,
        operator_option("stored in the recording"),
        json_option("all results"),
    )):  # fmt: skip
        function = decorate(function)
    return function


@click.group("hall")
def command() -> None:
    """Check the Hall sensors; learn their edge angles; read another tool's table of them.

    \b
    Examples:
      bench hall check sim
      bench hall learn sim --out edges.toml
      bench hall table 255,166,34,0,101,134,67,255
    """


@command.command("check")
@_looking
def check(source: str, json_file: Path | None, **given: Any) -> None:
    """Check the Hall sensors, their wiring and the encoder, and name the fault.

    TARGET: serial:/dev/ttyACM0, tcp:HOST:PORT, can:socketcan/can0, or sim (the simulated drive, in virtual time);
    without it, what $BENCH_TARGET or bench.toml says. The motor turns slowly forward and reverse, within --speed and
    --current; the control uses the encoder if there is one. If the drive trips, what was recorded is still evaluated.
    RUN: a recording in which the shaft turned forward and reverse.

    Exit codes: 0 healthy, 1 fault found, 2 inconclusive, error, or not completed, such as where the drive tripped or
    rebooted, 5 outputs may still be on.

    \b
    Examples:
      bench hall check serial:/dev/ttyACM0
      bench hall check tcp:192.168.0.7:7000 --passive
      bench hall check run.run --json health.json
      bench hall check day.run --from 3600 --to 7200
    """
    from bench.cli.output import Progress

    options = _options(source, given, {"--json": json_file})
    try:
        with Progress() as screen, _opened(options, screen) as found:
            health = _show(source, found, json_file, screen)
    except BenchError as error:
        if error.exit_code != ExitCode.FAILED:
            raise
        fail(f"the check was not completed: {error}", ExitCode.ERROR)  # of its codes, 1 is a fault that it has found
    sys.exit(health.exit_code)


@command.command("learn")
@_looking
@click.option("--by", type=click.Choice(["encoder", "filter", "drive"]), default="encoder", show_default=True,
              help="What measures the edge angles: the encoder; the Kalman filter edge-kalman, run here on the "
              "recorded data; or the same filter in the drive, read out without turning the motor.")  # fmt: skip
@click.option("--motor", is_flag=True, help="With --by filter or drive: also take psi_f_hat, R_s_hat and L_s_hat.")
@click.option("--write", is_flag=True,
              help="Write edge_up_1 … edge_down_6 and edge_sd to the drive, and hall_offset, hall_swap_hat and "
              "hall_invert_hat where they have to change; read them back.")  # fmt: skip
@click.option("--store", is_flag=True, help="Like --write; the drive also stores all its parameters permanently.")
@click.option("-o", "--out", metavar="FILE", type=FILE, help="Write the edges to this .toml or .json, for firmware.")
def learn(source: str, json_file: Path | None, motor: bool, write: bool, out: Path | None, **given: Any) -> None:
    """Measure the edge angles of the Hall sensors, for observers that use them.

    TARGET and RUN: see bench hall check --help. Refused if the check finds a fault, other than a ring or wires that
    the drive has parameters for. Without --write or --out, the result is only shown. The drive keeps written values
    until it loses power; with --store, permanently.

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
        raise click.UsageError("--motor: the encoder does not measure motor parameters; use --by filter or --by drive")
    if options.passive and options.by == "filter":
        raise click.UsageError("--passive: the filter needs voltages, and the outputs are off; use --by encoder")
    if write and source == "sim":
        raise click.UsageError(
            "--write: the simulated drive exists only during this command; use --out FILE, and --config FILE in the "
            "next run"
        )
    if write and options.recorded:
        raise click.UsageError(f"--write needs a drive, but {source} is a recording; use --out FILE")
    say = note if json_file == STANDARD_OUTPUT else echo
    with Progress() as screen, _opened(options, screen) as found:
        edges = _learnt(source, found, options, motor, json_file, screen)
        if out is not None:
            learning.save(out, edges)
            say(f"edges: {out}")
        if write and found.drive is not None:
            changed = learning.write(found.drive, edges)
            for name, (before, now) in changed.items():
                if name in edges.settings:
                    say(f"{name}: {before:.4g} -> {now:.4g}")
            say(f"{len(changed)} parameters written to node {found.drive.number} and read back")
        if options.store and found.drive is not None:
            found.drive.store()
            say(f"node {found.drive.number} stored its parameters")


@command.command("table")
@click.argument("table", metavar="TABLE|FILE")
@click.option("--compare", "other", metavar="TABLE|FILE",
              help="A second table, such as of the same motor: what is the difference?")  # fmt: skip
@click.option("--axis", metavar="N", type=click.IntRange(0, 9), help="Axis of an ODrive [default: the first].")
@click.option("-o", "--out", metavar="FILE", type=FILE,
              help="Write the edges to this .toml, for the simulated drive, or .json, for firmware.")  # fmt: skip
@overwrite_option
@json_option("all results")
def show_table(
    table: str, other: str | None, axis: int | None, out: Path | None, overwrite: bool, json_file: Path | None
) -> None:
    """Say what a table of Hall sensors tells: their places, their ring, their wires. Needs no drive.

    TABLE: eight entries of a VESC, by code, such as 255,166,34,0,101,134,67,255; or six edges of an ODrive. FILE: VESC
    Tool's motor configuration (XML), odrivetool's backup (JSON), or the text of moteus_tool --dump-config.

    Exit codes: 0 no fault seen, 1 fault found, or with --compare the two differ, 2 inconclusive, or error.

    \b
    Examples:
      bench hall table 255,166,34,0,101,134,67,255 --out edges.toml
      bench hall table mcconf.xml
      bench hall table before.xml --compare after.xml
    """
    from bench.hall import learn as learning
    from bench.hall.table_reading import compared, configuration, examined
    from bench.hall.table_report import as_json, comparison_json
    from bench.hall.tables import parsed

    if out is not None:
        learning.check_out(out)
    files = [name for name in (table, other) if name is not None and Path(name).is_file()]
    check_files({"--json": json_file, "--out": out}, overwrite, files)
    reading = examined(parsed(table, axis))
    second = None if other is None else parsed(other, axis)
    told = None if second is None else compared(reading.table, second)
    if out is not None:
        learning.save(out, *configuration(reading))
    if json_file is not None:
        more = {} if second is None or told is None else {"compared": comparison_json(second, told)}
        write_json(json_file, {**as_json(reading), **more})
    if json_file != STANDARD_OUTPUT:
        _show_reading(reading)
        if second is not None and told is not None:
            _show_comparison(reading.table, second, told)
    if out is not None:
        (note if json_file == STANDARD_OUTPUT else echo)(f"edges: {out}")
    sys.exit(reading.verdict.exit_code if told is None else not told.same)


def _show_reading(reading: Reading) -> None:
    from bench.cli.output import pairs, table
    from bench.hall import table_report as report

    pairs(f"Hall table {reading.table.source}", report.headline(reading))
    echo()
    table(report.SECTOR_HEADERS, report.sector_rows(reading))
    echo()
    table(report.SENSOR_HEADERS, report.sensor_rows(reading))
    echo()
    for line in report.verdict_lines(reading):
        echo(line)


def _show_comparison(first: HallTable, second: HallTable, told: Comparison) -> None:
    from bench.cli.output import table
    from bench.hall import table_report as report

    echo(f"\nCompared with {second.source}")
    if told.codes:
        table(report.COMPARISON_HEADERS, report.comparison_rows(first, second, told))
    for line in report.comparison_lines(told):
        echo(line)


def _learnt(
    source: str, found: Source, options: Options, motor: bool, json_file: Path | None, screen: Progress
) -> Learnt:
    """What was measured or learned, shown. BenchError where it is not to be used."""
    from bench.cli.output import pairs, table
    from bench.hall import learn as learning
    from bench.hall import lessons

    parameters = found.turned.capture.parameters
    if options.by == "encoder":
        edges = learning.learnt(_show(source, found, json_file, screen), parameters)
        if edges.assumed:
            note(f"note: {edges.assumed}")
        return edges
    learned = lessons.learned(found.turned.capture, options.by)
    told = {"lessons": lessons.as_json(learned)}
    if options.by == "filter":
        learning.require_no_fault(_show(source, found, json_file, screen, told), parameters)
    elif json_file is not None:
        write_json(json_file, {"source": source, **told})
    screen.pause()
    if json_file != STANDARD_OUTPUT:
        pairs(f"Learned from {source}", [["learned by", learned.whose]])
        table(lessons.HEADERS, lessons.rows(learned))
    return learning.taught(learned, motor)


def _options(source: str, given: dict[str, Any], outputs: dict[str, Path | None]) -> Options:
    """Checked as far as that can be done before anything is opened."""
    from bench.hall.source import Options

    given["config"] = simulated_figures(source, given["config"])
    options = Options(source, **given)
    inputs = [source if options.recorded else None, options.config]
    check_files({"--save": options.save, **outputs}, options.overwrite, inputs, recordings=["--save"])
    if options.recorded and (options.save is not None or options.passive):
        raise click.UsageError(f"{source} is a recording: --save and --passive need a drive")
    if not options.recorded and (options.begin, options.end) != (None, None):
        raise click.UsageError(f"{source} is a drive: --from and --to need a recording")
    return options


@contextmanager
def _opened(options: Options, screen: Progress) -> Iterator[Source]:
    """What `opened` gives; a signal ends the command in a line that says how the drive was left."""
    from bench.hall.source import opened
    from bench.rig.interrupts import signal_of
    from bench.rig.outcome import RunOutcome

    try:
        with opened(options, screen, screen.confirm if sys.stdin.isatty() else None) as found:
            yield found
    except (KeyboardInterrupt, Interrupted) as interrupt:
        screen.pause()
        number, cause = signal_of(interrupt), interrupt.__cause__
        words = f"interrupted by {signal.Signals(number).name}"
        unsafe = str(cause) if isinstance(cause, OutputsMayBeOn) else ""
        if cause is not None:
            words += "" if unsafe else f"; {cause}"
        elif not options.recorded and not options.passive:
            words += "; outputs off"
        if options.save is not None and is_run(run_folder(options.save)):
            words += f"; recording: {run_folder(options.save)}"
        ended = RunOutcome.of(Verdict.ABORTED, words, unsafe=unsafe, signum=number)
        fail(ended.words, ended.exit_code)


def _show(
    source: str, found: Source, json_file: Path | None, screen: Progress, more: Mapping[str, Any] | None = None
) -> Health:
    """Examine what was recorded; print it, or write it as JSON, with `more` in it."""
    from bench.cli.output import pairs, table
    from bench.findings.health import examine
    from bench.hall import report
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
    for title, headers, rows in report.tables(health, looked_at.seconds):
        for line in title:
            echo(line)
        table(headers, rows)
        echo()
    for line in report.verdict_lines(health, found.turned.remarks):
        echo(line)
    return health

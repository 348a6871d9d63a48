"""`bench twin`: the simulated drive that best reproduces recordings, and what it does under a recording's commands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from bench.cli.files import FILE, RUN, check_files, config_option, json_option, overwrite_option, write_json
from bench.cli.streams import echo, note
from bench.files import STANDARD_OUTPUT

if TYPE_CHECKING:
    from bench.twin.check import Checked
    from bench.twin.fit import Twin


@click.group("twin")
def command() -> None:
    """Make a twin of a drive from recordings: a configuration of the simulated drive; compare the two.

    \b
    Examples:
      bench twin fit steps.run -o twin.toml
      bench twin check reversal.run twin.toml
    """


@command.command("fit")
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=RUN)
@click.option("-o", "--out", metavar="FILE", type=FILE, help="Write the twin's configuration (TOML) to this file.")
@config_option
@json_option("values, intervals, residuals")
@overwrite_option
def fit_command(
    runs: tuple[Path, ...], out: Path | None, config: Path | None, json_file: Path | None, overwrite: bool
) -> None:
    """Fit the simulated drive's configuration to recordings of one drive.

    From currents, voltages and encoder at every PWM period: R_s, L_d, L_q, psi_f, harmonics, dead time, the encoder's
    place, offsets and gains of the current sensors; J, friction, cogging; from Hall edges, also alone: their places,
    hysteresis, delays, jitter. Each with a 95 % interval. What the recordings do not tell is named, and stays as in
    --config, or as the drive's own parameters have it.

    Good recordings begin with the outputs off, and have several speeds, in both directions, without a load.

    Exit codes: 0 fitted, 2 error.

    \b
    Examples:
      bench twin fit steps.run -o twin.toml
      bench twin fit a.run b.run --config my-motor.toml -o twin.toml --json twin.json
      bench live sim --config twin.toml --speed 500
    """
    check_files({"--json": json_file, "--out": out}, overwrite, [*runs, config])
    from bench.record.recording import readable
    from bench.twin.fit import fit

    opened = [readable(run) for run in runs]
    twin = fit(opened, config)
    for run in opened:
        for words in run.damage:
            note(f"warning: {run.path}: {words}")
    if out is not None:
        from bench.files import write

        write(out, twin.toml(), f"--out {out}")
    if json_file is not None:
        write_json(json_file, twin.as_json())
    if STANDARD_OUTPUT not in (json_file, out):
        _print_fit(twin, out)


@command.command("check")
@click.argument("run", metavar="RUN", type=RUN)
@click.argument("twin", metavar="TWIN", type=FILE)
@click.option("--seed", metavar="N", type=int, default=0, show_default=True, help="Seed of the twin's noise.")
@click.option("--repeats", metavar="N", type=click.IntRange(1), default=3, show_default=True,
              help="Runs of the twin, each with other noise.")  # fmt: skip
@click.option("-o", "--out", metavar="PNG", type=FILE, help="Draw both to this file.")
@json_option("the differences")
@overwrite_option
def check_command(
    run: Path, twin: Path, seed: int, repeats: int, out: Path | None, json_file: Path | None, overwrite: bool
) -> None:
    """Run the twin under the commands of a recording, and report in what the two differ.

    State, speed and current references and parameters are those of the recording, at the same PWM periods; the twin
    runs in virtual time, with its own noise, --repeats times. Shows each channel's rms and each position error of both
    while the drive ran, with the standard error of the difference: from batch means, and from what the twin's runs
    differ by. More than 3 of them is marked "differs".

    Exit codes: 0 compared, 1 the twin tripped, 2 error.

    \b
    Examples:
      bench twin check reversal.run twin.toml
      bench twin check reversal.run twin.toml -o both.png --json both.json
    """
    check_files({"--json": json_file, "--out": out}, overwrite, [run, twin])
    from bench.record.recording import readable
    from bench.twin.check import check

    opened = readable(run)
    found = check(opened, twin, seed, repeats)
    for words in (*opened.damage, *found.remarks):
        note(f"warning: {words}")
    if out is not None:
        from bench.report.style import save
        from bench.twin.draw import draw

        save(draw(found), out)
    if json_file is not None:
        write_json(json_file, found.as_json())
    if json_file != STANDARD_OUTPUT:
        _print_check(found)
    if found.tripped:
        from bench.cli import fail
        from bench.errors import ExitCode

        fail(f"the twin tripped: {found.tripped}", ExitCode.FAILED)


def _print_fit(twin: Twin, out: Path | None) -> None:
    from bench.cli.output import pairs, table

    rows = [
        [one.name, one.unit or "–", f"{one.value:.5g}", f"{one.half_width:.2g}", f"{one.absolute_half_width():.2g}",
         one.dominated_by]
        for one in twin.quantities
    ]  # fmt: skip
    table(["quantity", "unit", "value", "95 %, drive's units", "absolute", "mostly"], rows)
    pairs("left unexplained", [[name, f"{value:.3g} {unit} rms"] for name, (value, unit) in twin.residuals.items()])
    for words in twin.untold:
        echo(f"not told: {words}")
    if out is not None:
        echo(f"twin: {out}")


def _print_check(found: Checked) -> None:
    from bench.cli.output import table
    from bench.twin.check import HEADERS, cells

    table(list(HEADERS), [cells(row) for row in found.rows])
    echo(f"Hall edges: {found.edges[0]} recorded, {found.edges[1]} of the twin")
    differ = [row.name for row in found.differing]
    echo(f"beyond noise: {', '.join(differ) if differ else 'nothing'}")

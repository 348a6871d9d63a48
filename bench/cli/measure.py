"""`bench measure`: what lies between two cursors on a recorded run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from bench.cli.files import RUN, check_files, json_option, overwrite_option, write_json
from bench.cli.number import Moment
from bench.cli.options import channels_option
from bench.cli.streams import echo, note
from bench.files import STANDARD_OUTPUT
from protocol.text import counted

if TYPE_CHECKING:
    from bench.measure.channel import Row
    from bench.measure.measure import Between, Statistics

_AT = "device time in s, or a mark or an event (START, FAULT, NAME#2, …)"


@click.command("measure")
@click.argument("run", metavar="RUN", type=RUN)
@click.option("--from", "begin", metavar="S|NAME", type=Moment(),
              help=f"First cursor: {_AT} [default: first sample].")  # fmt: skip
@click.option("--to", "end", metavar="S|NAME", type=Moment(),
              help="Last cursor, likewise; of a mark, its end [default: last sample].")  # fmt: skip
@channels_option("Measure only these channels [default: all].")
@json_option("the measured values")
@overwrite_option
def command(
    run: Path,
    begin: float | str | None,
    end: float | str | None,
    channels: tuple[str, ...] | None,
    json_file: Path | None,
    overwrite: bool,
) -> None:
    """Measure a recorded run between two cursors.

    Prints for each channel mean, rms, standard deviation, minimum, maximum and peak to peak; the values at both
    cursors; the slope of the least-squares line, with its standard error; and the frequency of the fundamental, with
    the half width of its 95 % confidence interval. What is undefined is "–", or says why. Angles that wrap have a
    circular mean and standard deviation, and are followed for slope, difference and frequency. Of codes (hall, status)
    it prints the values and the number of changes.

    \b
    Examples:
      bench measure a.run
      bench measure a.run --from 2 --to 5 --channels i_q,omega_enc
      bench measure a.run --from "load step" --to "load step" --json
    """
    check_files({"--json": json_file}, overwrite, [run])
    from bench.compare.alignment import seconds_of
    from bench.measure.measure import measure
    from bench.record.recording import readable

    opened = readable(run)
    found = measure(opened, channels, seconds_of(opened, begin), seconds_of(opened, end, last=True))
    for words in opened.damage:
        note(f"warning: {words}")
    if json_file is not None:
        write_json(json_file, found.as_json())
    if json_file != STANDARD_OUTPUT:
        _print(found)


def _print(found: Statistics) -> None:
    from bench.cli.output import pairs, table
    from bench.report.words import number

    def cells(row: Row, *names: str) -> list[str]:
        return [number(getattr(row, name), ".5g") for name in names]

    seconds, at = found.seconds, [f"at {each:.6g} s" for each in (found.begin, found.end)]
    per_second = f", 1/dt = {1.0 / seconds:.6g} Hz" if seconds else ""
    pairs(f"{found.run.path} from {found.begin:.6f} to {found.end:.6f} s: dt = {seconds:.6f} s{per_second}",
          _between(found.between))  # fmt: skip
    rows = [row for row in found.rows if row.kind != "code"]
    if rows:
        levels = ("mean", "rms", "std", "min", "max", "peak_to_peak")
        table(["channel", "unit", "mean", "rms", "std. dev.", "min", "max", "peak-peak"],
              [[row.channel, row.unit or "–", *cells(row, *levels)] for row in rows])  # fmt: skip
        table(
            ["channel", "unit", *at, "difference", "slope, per s", "std. error", "frequency [Hz]", "± (95 %)"],
            [[row.channel, row.unit or "–", *cells(row, "at_begin", "at_end", "difference", "slope"),
              f"{row.slope_error:.2g}" if math.isfinite(row.slope_error) else row.why.get("slope_error", "–"),
              _frequency(row), number(row.frequency_half_width, ".2g")] for row in rows],
        )  # fmt: skip
    if codes := [row for row in found.rows if row.kind == "code"]:
        table(
            ["code", *at, "changes", "values"],
            [[row.channel, *cells(row, "at_begin", "at_end"), number(row.changes, "d"), _values(row)] for row in codes],
        )
    for row in found.rows:
        if row.not_finite:
            echo(
                f"{row.channel}: {row.not_finite} of {row.n + row.not_finite} samples are NaN or infinite and left out"
            )
    if wraps := [row for row in rows if row.kind == "angle"]:
        said = dict.fromkeys(why for row in wraps for name, why in row.why.items() if name == "mean")
        echo(f"{', '.join(row.channel for row in wraps)}: an angle that wraps has no rms, minimum and maximum"
             + "".join(f"; – where {why}" for why in said))  # fmt: skip


def _between(of: Between) -> list[tuple[str, str]]:
    gaps = f"{counted(of.missing, 'sample')} missing in {counted(of.gaps, 'gap')}" if of.gaps else "no gap"
    told = [("samples", f"{of.samples}, {gaps}")]
    if of.edges is not None:
        illegal = of.edges - of.forward - of.reverse
        words = [f"{of.edges}: {of.forward} forward, {of.reverse} in reverse"]
        words += [f"{illegal} illegal"] if illegal else []
        words += [counted(of.edge_gaps, "gap")] if of.edge_gaps else []
        told.append(("Hall edges", ", ".join(words)))
    turned = [
        f"unknown by {by}: it cannot be followed" if math.isnan(turns) else f"{turns:.2f} by {by}"
        + (f" ({turns / of.n_p:.3f} of the shaft)" if of.n_p else "")
        for turns, by in ((of.revolutions, "the encoder"), (of.revolutions_by_hall, "Hall edges")) if turns is not None
    ]  # fmt: skip
    if turned:
        told.append(("electrical revolutions", ", ".join(turned)))
    return told


def _frequency(row: Row) -> str:
    """To the digits that its half width leaves."""
    if math.isnan(row.frequency):
        return row.why.get("frequency", "–")
    digits = max(0, 1 - math.floor(math.log10(row.frequency_half_width))) if row.frequency_half_width else 6
    return f"{row.frequency:.{digits}f}"


def _values(row: Row) -> str:
    """Each value with its share of the samples."""
    if row.values is None:
        return "more than are listed"
    return ", ".join(f"{value} ({100 * n / row.n:.3g} %)" for value, n in row.values.items()) or "–"

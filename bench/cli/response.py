"""`bench response`: the frequency response of a loop."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.cli.files import FILE, RUN, check_files, config_option, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.options import operator_option, yes_option
from bench.cli.streams import echo, note
from bench.cli.target import simulated_figures, target_argument
from bench.errors import ExitCode
from bench.files import STANDARD_OUTPUT

if TYPE_CHECKING:
    from bench.response.experiment import Measured
    from bench.signal.waveforms.frequency_response import Value

_NAMES = (
    ("crossover", "crossover of the open loop", "Hz"),
    ("phase_margin", "phase margin", "deg"),
    ("gain_margin", "gain margin", "dB"),
    ("bandwidth", "bandwidth of the closed loop (-3 dB)", "Hz"),
    ("peak", "peak of the closed loop", "dB"),
)


@click.command("response")
@target_argument()
@click.argument("loop", type=click.Choice(["current", "speed"]))
@click.option("--to", "highest", metavar="HZ", type=Number(above=0),
              help="Highest frequency [default: current 2000 Hz, speed 100 Hz].")  # fmt: skip
@click.option("--from", "lowest", metavar="HZ", type=Number(above=0),
              help="Lowest frequency [default: a hundredth of the highest].")  # fmt: skip
@click.option("--amplitude", metavar="A|RPM", type=Number(above=0),
              help="Amplitude of the test signal: current, A [default: 0.3 of --current]; speed, r/min "
              "[default: 5 % of --speed].")  # fmt: skip
@click.option("--current", "current_a", metavar="A", type=Number(above=0),
              help="Highest current, A peak [default: 2 A, or less where the drive allows less; of the speed loop "
              "i_max].")  # fmt: skip
@click.option("--speed", "speed_rpm", metavar="RPM", type=Number(),
              help="Speed meanwhile, r/min [default: current 0, at rest; speed 500].")  # fmt: skip
@click.option("--observer", metavar="NAME", help="Angle source of the drive's control [default: unchanged].")
@click.option("--periods", metavar="N", type=click.IntRange(4), default=8, show_default=True,
              help="Cycles of the test signal that are measured.")  # fmt: skip
@click.option("--phase-margin", "least", metavar="DEG", type=Number(above=0),
              help="Exit with 1 if the phase margin is below this, its interval considered.")  # fmt: skip
@click.option("-o", "--out", metavar="PNG", type=FILE, help="Draw gain, phase and coherence to this file.")
@click.option("--save", metavar="RUN", type=RUN, help="Record to this folder.")
@yes_option
@config_option
@operator_option("stored in the recording")
@json_option("the response and the margins")
@overwrite_option
def command(
    target: str, loop: str, least: float | None, out: Path | None, json_file: Path | None, overwrite: bool, **given: Any
) -> None:
    """Measure the frequency response of the current or the speed loop: gain, phase, margins, coherence.

    The drive adds a multisine to the reference of its loop, in step with the PWM; reference and output are recorded
    at the PWM rate. The current loop is measured on the d axis, at rest or at --speed, beside a d current that keeps
    the phase currents from changing their sign; the speed loop at --speed. Needs a drive with the features COMMISSION
    and WAVEFORM of HBP.

    Intervals are 95 % confidence, from the scatter over the cycles. A response is that of a linear loop: what was at a
    limit is told.

    Exit codes: 0 measured, 1 the phase margin is too small, 2 error, 5 outputs may still be on.

    \b
    Examples:
      bench response sim current --to 2000
      bench response serial:/dev/ttyACM0 speed --speed 800 --to 200 -o speed-loop.png
      bench response sim current --phase-margin 45 --json response.json
    """
    files = {"--json": json_file, "--out": out, "--save": given["save"]}
    given["config"] = simulated_figures(target, given["config"])
    check_files(files, overwrite, [given["config"]], recordings=["--save"])
    from bench.cli.output import Progress
    from bench.response.command import Options, respond

    with Progress() as screen:
        confirm = screen.confirm if sys.stdin.isatty() else None
        measured = respond(Options(target, loop, overwrite=overwrite, **given), screen, confirm)
    if out is not None:
        from bench.report.style import save
        from bench.response.draw import draw

        save(draw(measured), out)
    if json_file is not None:
        write_json(json_file, measured.as_json())
    if json_file != STANDARD_OUTPUT:
        _print(measured)
    for words in measured.remarks:
        note(f"warning: {words}")
    if least is not None:
        margin = measured.margins.phase_margin
        if margin.value is None or margin.value - (margin.half_width or 0.0) < least:
            said = "not known" if margin.value is None else _said(margin, "deg")
            note(f"the phase margin is {said}; at least {least:g} deg are asked for")
            sys.exit(ExitCode.FAILED)


def _print(measured: Measured) -> None:
    from bench.cli.output import pairs

    found = measured.response
    rows = [(words, _said(getattr(measured.margins, name), unit)) for name, words, unit in _NAMES]
    pairs(f"{measured.asked.loop.name} loop, {found.f[0]:.3g} to {found.f[-1]:.4g} Hz", rows)
    weak = found.coherence < 0.9
    if weak.any():
        echo(f"coherence below 0.9 at {int(weak.sum())} of {len(weak)} frequencies, from {found.f[weak][0]:.4g} Hz")


def _said(value: Value, unit: str) -> str:
    if value.value is None:
        return "not known: outside these frequencies, or the answer is too noisy there"
    width = "" if value.half_width is None else f" +- {value.half_width:.2g}"
    return f"{value.value:.4g}{width} {unit}"

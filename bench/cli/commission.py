"""`bench commission`: what an unknown motor and its drive are."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.cli.files import DIRECTORY, FILE, check_files, config_option, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.options import Names, operator_option, yes_option
from bench.cli.streams import echo, note
from bench.cli.target import simulated_figures, target_argument
from bench.errors import ExitCode
from bench.files import STANDARD_OUTPUT, write

if TYPE_CHECKING:
    from bench.cli.output import Progress
    from bench.commission.command import Commissioned
    from bench.commission.quantity import Quantity
    from bench.rig.person import Answered, Ask

_PREFIXES = {-12: "p", -9: "n", -6: "u", -3: "m", 0: "", 3: "k"}
_TITLES = {
    "u_dc": "DC link voltage", "noise": "noise of a current sensor", "R_s": "resistance of a phase",
    "U_dead": "dead time's volts", "t_dead": "dead time, effective", "L_d": "L_d without current",
    "L_q": "L_q without current", "L_d_half": "L_d at half the current", "L_q_half": "L_q at half the current",
    "n_p": "electrical turns in one of the shaft", "encoder_zero": "encoder's zero", "psi_f": "flux linkage",
    "psi_f_blind": "flux linkage, without the encoder", "L_d_run": "L_d at speed", "L_q_run": "L_q under torque",
    "encoder_delay": "delay of the encoder", "current_delay": "delay of the currents", "J": "inertia of the shaft",
    "b": "viscous friction", "tau_c": "dry friction", "hall_offset": "Hall ring", "hall_delay": "delay of Hall edges",
    "step_misfit": "a step of i_d against the model", "R_rough": "resistance, rough", "L_rough": "inductance, rough",
}  # fmt: skip


@click.command("commission")
@target_argument()
@click.option("--step", "steps", metavar="NAMES", type=Names(),
              help="Steps, with commas between them, and those that they need: offsets, first-current, resistance (r), "
              "inductance (l), turn, spin, check [default: all].")  # fmt: skip
@click.option("--current", "current_a", metavar="A", type=Number(above=0),
              help="Largest current of the motor, A peak, by its plate [default: of a simulated drive its i_max]."
              )  # fmt: skip
@click.option("--speed", "speed_rpm", metavar="RPM", type=Number(above=0),
              help="Largest speed that the shaft may turn at, r/min [default: of a simulated drive its limit]."
              )  # fmt: skip
@click.option("--pole-pairs", metavar="N", type=click.IntRange(1, 64),
              help="Pole pairs of the motor, without an encoder: nothing else tells them but one turn of the shaft by "
              "hand, which is asked for; with one they are compared with what it shows.")  # fmt: skip
@click.option("-o", "--out", metavar="TOML", type=FILE,
              help="Write the parameters that were found, for bench param load.")  # fmt: skip
@click.option("--report", metavar="DIR", type=DIRECTORY,
              help="Write the evidence of each step to this folder: recording, pictures, fits.")  # fmt: skip
@yes_option
@config_option
@operator_option("stored in the recording")
@json_option("what was found")
@overwrite_option
def command(
    target: str, out: Path | None, report: Path | None, json_file: Path | None, overwrite: bool, **given: Any
) -> None:
    """Find out what an unknown motor is, step by step: windings, wires, sensors, shaft.

    Each step says before it begins what it will do, and asks. Offsets and noise of the current sensors come first, then
    the smallest current that shows whether all phases are there and in order, then resistance and dead time, told
    apart, then L_d and L_q over the current. Then the shaft is turned slowly, which tells pole pairs, encoder and Hall
    wires, and spun and left to coast, which tells flux, inertia, friction and Hall edges. Gains follow, and a step of
    the current against the model. What a step cannot claim it refuses by name. Without an encoder the shaft is spun on
    its Hall sensors.

    Every value has two 95 % intervals: in the drive's own volts and amperes, which its loops and observers compute in,
    and absolute, with the gains of its sensors. Nothing is stored in the drive: all parameters are put back. Needs a
    drive with the feature COMMISSION of HBP.

    Exit codes: 0 all found, 1 a step was refused, 2 error, 5 outputs may still be on.

    \b
    Examples:
      bench commission sim
      bench commission sim --config gimbal-4310 -o found.toml --report found
      bench commission serial:/dev/ttyACM0 --current 6 --step r -o found.toml
      bench commission serial:/dev/ttyACM0 --current 6 --speed 3000 -o found.toml
      bench commission serial:/dev/ttyACM0 --current 6 --speed 3000 --pole-pairs 7 -o found.toml
    """
    files = {"--json": json_file, "--out": out}
    given["config"] = simulated_figures(target, given["config"])
    given["steps"] = given["steps"] or None
    evidence = {} if report is None or not report.is_dir() else _evidence(report)
    check_files(files | evidence, overwrite, [given["config"]], recordings=evidence.keys())
    from bench.cli.output import Progress
    from bench.commission.command import Options, commission

    with Progress() as screen:
        confirm = screen.confirm if sys.stdin.isatty() else None
        options = Options(target, report=report, overwrite=overwrite, **given)
        done = commission(options, screen, confirm, _asking(screen) if confirm is not None else None)
    text, left = done.as_toml()
    if out is not None:
        write(out, text, f"--out {out}")
    if json_file is not None:
        write_json(json_file, done.as_json())
    if json_file != STANDARD_OUTPUT:
        _print(done)
    for words in [*done.remarks, *left]:
        note(f"warning: {words}")
    for step, reason in done.refused.items():
        note(f"refused: {step}: {reason}")
    if done.refused:
        sys.exit(ExitCode.FAILED)


def _asking(screen: Progress) -> Ask | None:
    """What asks on this terminal, with the status line out of the way; None where there is no terminal."""
    from bench.rig.person import asked, at_terminal

    @contextmanager
    def ask(words: str) -> Iterator[Answered]:
        screen.pause()
        with asked(words) as answered:
            yield answered
        screen.resume()

    return ask if at_terminal() else None


def _evidence(report: Path) -> dict[str, Path]:
    """What stands for all of a report: its recording, whose name no other program writes."""
    from bench.commission.command import RUN_NAME

    return {"--report": report / RUN_NAME}


def _print(done: Commissioned) -> None:
    from bench.cli.output import table

    found, rough = done.found, {"R_rough": "R_s", "L_rough": "L_d"}
    shown = [_row(q) for name, q in found.items() if name in _TITLES and rough.get(name) not in found]
    echo(f"{done.drive.title}, up to {done.i_max:g} A, {done.seconds:.0f} s of drive time")
    table(["quantity", "value", "95 %, drive's units", "mostly", "95 %, absolute", "mostly"], shown)


def _row(quantity: Quantity) -> list[str]:
    return [
        _TITLES[quantity.name], _told(quantity.value, quantity.unit), _width(quantity, quantity.half_width),
        quantity.dominated_by, _width(quantity, quantity.absolute_half_width()), quantity.absolutely_dominated_by(),
    ]  # fmt: skip


def _width(quantity: Quantity, half_width: float) -> str:
    share = 100.0 * half_width / abs(quantity.value) if quantity.value else math.inf
    if quantity.unit == "rad" or quantity.name == "step_misfit" or share >= 100.0:
        return f"+- {_told(half_width, quantity.unit, 2)}"
    return f"+- {share:.2g} %"


def _told(value: float, unit: str, digits: int = 4) -> str:
    """As a person reads it: angles in degrees, shares in percent, others with the prefix of the unit that fits."""
    if unit == "rad":
        return f"{_rounded(math.degrees(value), digits)} deg"
    if unit == "1":
        return f"{_rounded(100.0 * value, digits)} %"
    exponent = 3 * math.floor(math.log10(abs(value)) / 3.0) if value else 0
    exponent = min(max(exponent, min(_PREFIXES)), max(_PREFIXES))
    return f"{_rounded(value / 10.0**exponent, digits)} {_PREFIXES[exponent]}{unit}".rstrip()


def _rounded(value: float, digits: int) -> str:
    return f"{float(f'{value:.{digits}g}'):g}"

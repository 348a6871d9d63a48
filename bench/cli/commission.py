"""`bench commission`: what an unknown motor and its drive are."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from bench.cli.files import DIRECTORY, FILE, check_files, config_option, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.options import Names, operator_option, yes_option
from bench.cli.streams import echo, note
from bench.cli.target import NO_TARGET, simulated_figures, target_argument
from bench.errors import ExitCode
from bench.files import STANDARD_OUTPUT, write

if TYPE_CHECKING:
    from bench.cli.output import Progress
    from bench.commission.commissioned import Commissioned
    from bench.commission.comparison import Comparison
    from bench.commission.meters import Reading
    from bench.rig.person import Answered, Ask

Told = TypeVar("Told", "Commissioned", "Comparison")


class _Voltmeter(click.ParamType["Reading"]):
    """A reading in V, with the instrument's accuracy in percent behind a colon, or not."""

    name = "reading"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Reading:
        """Read it, or say why not."""
        from bench.commission.meters import VOLTMETER, Reading

        volts, accuracy = _accuracy(self, value, VOLTMETER, param, ctx)
        return Reading(Number(above=0).convert(volts, param, ctx), accuracy)


class _Ammeter(click.ParamType[tuple[str, float]]):
    """A phase, with the instrument's accuracy in percent behind a colon, or not."""

    name = "phase"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        """Read it, or say why not."""
        from bench.commission.meters import AMMETER

        phase, accuracy = _accuracy(self, value, AMMETER, param, ctx)
        if phase not in ("a", "b", "c"):
            self.fail(f"'{phase}' is no phase: say in which of a, b and c the ammeter is", param, ctx)
        return phase, accuracy


def _accuracy(
    of: click.ParamType[Any], value: Any, usual: float, param: click.Parameter | None, ctx: click.Context | None
) -> tuple[str, float]:
    """What stands before the colon, and the accuracy, as a share."""
    found = re.fullmatch(r"\s*([^:]*?)\s*(?::\s*([^:%]+?)\s*%\s*)?", str(value))
    if found is None:
        of.fail(f"'{value}' has no accuracy in percent behind its colon, such as 24.13:0.1%", param, ctx)
    return found[1], usual if found[2] is None else Number(above=0).convert(found[2], param, ctx) / 100.0


@click.command("commission")
@target_argument(needed=False)
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
@click.option("--voltmeter", metavar="V[:%]", type=_Voltmeter(),
              help="What a voltmeter at the DC link reads while the drive is at rest, and its accuracy, such as "
              "24.13:0.1% [accuracy: 0.5%].")  # fmt: skip
@click.option("--ammeter", metavar="PHASE[:%]", type=_Ammeter(),
              help="An ammeter is in this phase (a, b, c): a current is held until you have read it [accuracy: 1%]."
              )  # fmt: skip
@click.option("-o", "--out", metavar="TOML", type=FILE,
              help="Write the parameters that were found, for bench param load.")  # fmt: skip
@click.option("--report", metavar="DIR", type=DIRECTORY,
              help="Write report.html to this folder, with the recording, pictures and fits of the steps.")  # fmt: skip
@click.option("--compare", "compare", metavar="JSON", multiple=True, type=FILE,
              help="Compare what was found with an earlier commissioning, by its --json or found.json. Given twice, "
              "the old one first, it compares these two, without a drive.")  # fmt: skip
@yes_option
@config_option
@operator_option("stored in the recording")
@json_option("what was found")
@overwrite_option
def command(
    target: str | None, out: Path | None, report: Path | None, json_file: Path | None, overwrite: bool,
    compare: tuple[Path, ...], **given: Any,
) -> None:  # fmt: skip
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
      bench commission sim --voltmeter 24.05:0.1% --report found
      bench commission sim --compare found/found.json
      bench commission --compare before/found.json --compare found/found.json
    """
    if len(compare) > 2:
        raise click.UsageError("--compare is given more than twice: give the old one, or the old and the new one")
    from bench.commission import comparison

    before = [comparison.read(path) for path in compare]
    files = {"--json": json_file, "--out": out}
    if len(before) == 2:
        if out is not None or report is not None:
            raise click.UsageError("two files are compared without a drive: -o and --report have nothing to write")
        check_files(files, overwrite, compare)
        _tell(comparison.compared(*before), json_file, _print_comparison)
        return
    if target is None:
        raise click.UsageError(NO_TARGET)
    given["before"] = before[0] if before else None
    given["config"] = simulated_figures(target, given["config"])
    given["steps"] = given["steps"] or None
    from bench.cli.output import Progress
    from bench.commission.command import REPORT, RUN_NAME, Options, commission
    from bench.commission.meters import Ammeter

    run = report / RUN_NAME if report is not None and report.is_dir() else None
    check_files(files | {"--report": run}, overwrite, [given["config"], *compare], recordings=["--report"])
    with Progress() as screen:
        confirm = screen.confirm if sys.stdin.isatty() else None
        if given["ammeter"] is not None:
            phase, accuracy = given["ammeter"]
            given["ammeter"] = Ammeter(phase, accuracy, partial(_typed, screen))
        options = Options(target, report=report, overwrite=overwrite, **given)
        done = commission(options, screen, confirm, _asking(screen) if confirm is not None else None)
    text, left = done.as_toml()
    if out is not None:
        write(out, text, f"--out {out}")
    _tell(done, json_file, _print)
    if report is not None:
        note(f"report: {report / REPORT}")
    for words in [*done.remarks, *left]:
        note(f"warning: {words}")
    for step, reason in done.refused.items():
        note(f"refused: {step}: {reason}")
    if done.refused:
        sys.exit(ExitCode.FAILED)


def _tell(what: Told, json_file: Path | None, print_it: Callable[[Told], None]) -> None:
    """As JSON where that is asked for, and printed unless JSON goes there."""
    if json_file is not None:
        write_json(json_file, what.as_json())
    if json_file != STANDARD_OUTPUT:
        print_it(what)


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


def _typed(screen: Progress, words: str) -> float:
    """A number that somebody types."""
    screen.pause()
    number: float = click.prompt(words, type=Number(), err=True)
    screen.resume()
    return number


def _print(done: Commissioned) -> None:
    from bench.cli.output import table
    from bench.commission import words

    echo(f"{done.drive.title}, up to {done.i_max:g} A, {done.seconds:.0f} s of drive time")
    table(*words.table(done.found.values(), done.converters))
    if done.comparison is not None:
        _print_comparison(done.comparison)


def _print_comparison(changed: Comparison) -> None:
    from bench.cli.output import table
    from bench.commission.comparison import COLUMNS

    echo("")
    table(COLUMNS, changed.rows)
    for words in changed.words:
        echo(words)

"""`bench capture`: samples and Hall edges from the drive's own memory, around a trigger or a fault."""

from __future__ import annotations

import re
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bench.cli.files import RUN, check_files, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.options import channels_option, operator_option
from bench.cli.streams import echo, note
from bench.cli.target import simulated_figures, target_argument
from bench.files import STANDARD_OUTPUT
from protocol.text import counted

if TYPE_CHECKING:
    from bench.capture.wanted import Wanted
    from bench.rig.capturing import Capturing, Stored


class Percent(click.ParamType[float]):
    """A share as `20%` or `20`, from 0 to 100, as 0 to 1."""

    name = "percent"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Read it, or say why not."""
        if isinstance(value, float):
            return value
        found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*%?\s*", str(value))
        if found is None or float(found[1]) > 100.0:
            self.fail(f"'{value}' is not a share from 0% to 100%", param, ctx)
        return float(found[1]) / 100.0


@click.command("capture")
@target_argument()
@click.option("--trigger", metavar="COND",
              help="What freezes it: 'i_q > 4', 'i_q rises 4', 'i_q falls 4', 'status changes', 'pulse < 5 us', "
              "fault, state, illegal or now.")  # fmt: skip
@click.option("--pre", metavar="PERCENT", type=Percent(), default="20%", show_default=True,
              help="Share of the capture before the trigger.")  # fmt: skip
@click.option("--for", "seconds", metavar="S", type=Number(above=0), default=0.1, show_default=True,
              help="Length of the capture, s.")  # fmt: skip
@channels_option("Capture only these channels; +A,+B adds to the default [default: all except those on request].")
@click.option("--decimation", metavar="N", type=click.IntRange(1, 65535), default=1, show_default=True,
              help="Keep every N-th PWM period.")  # fmt: skip
@click.option("--edges", metavar="N", type=click.IntRange(0, 65535),
              help="Hall edges to keep room for [default: what the highest speed makes].")  # fmt: skip
@click.option("-o", "--out", metavar="RUN", type=RUN, help="Run to write.")
@click.option("--repeat", metavar="N", type=click.IntRange(1, 999), default=1, show_default=True,
              help="Take N captures, one after the other: NAME-001.run, ...")  # fmt: skip
@click.option("--timeout", metavar="S", type=Number(above=0), help="Give up after S seconds without a trigger.")
@click.option("--arm", is_flag=True, help="Arm the trigger and exit; --held fetches the capture later.")
@click.option("--at-fault", "--held", "held", is_flag=True,
              help="Fetch what the drive holds: that of its last fault, or of a trigger armed earlier.")  # fmt: skip
@click.option("--discard", is_flag=True, help="Give up what the drive holds.")
@click.option("--note", "remark", metavar="TEXT", default="", help="Note to store in the run.")
@overwrite_option
@operator_option("stored in the run")
@json_option("what was captured")
def command(target: str, json_file: Path | None, overwrite: bool, **given: Any) -> None:
    """Capture every PWM period around a trigger in the drive's own memory, and read it at leisure.

    The drive keeps the chosen channels and the Hall edges at its full PWM rate, whatever the link carries, until a
    trigger freezes them. They become a recorded run, which every other command takes. Nothing is energised, and no
    stream is stopped: another host may turn the motor meanwhile. A fault freezes every capture, also where none was
    asked for: --at-fault fetches what came before it.

    \b
    Examples:
      bench capture 'can:socketcan/can0?host_number=1' --trigger 'i_q > 4' --pre 20% -o shot.run
      bench capture serial:/dev/ttyACM0 --trigger 'i_q rises 4' --for 0.05 --arm
      bench capture serial:/dev/ttyACM0 --at-fault -o fault.run
    """
    _check(given)
    check_files({"--json": json_file, "--out": given["out"] if given["repeat"] == 1 else None}, overwrite,
                recordings=["--out"])  # fmt: skip
    from bench.cli.output import Progress
    from bench.device.simulator import EmbeddedDrive
    from bench.rig.capturing import listening
    from bench.rig.interrupts import signals_as_exceptions
    from bench.rig.settings import read_settings

    wanted = _wanted(given)
    settings = read_settings(None)
    settings = replace(settings, operator=given["operator"] or settings.operator)
    with ExitStack() as stack:
        stack.enter_context(signals_as_exceptions())
        if target == "sim":
            target = stack.enter_context(EmbeddedDrive(simulated_figures(target), note)).target
        screen = stack.enter_context(Progress())
        _act(stack.enter_context(listening(target, settings, screen)), wanted, given, overwrite, json_file)


def _act(
    capturing: Capturing, wanted: Wanted | None, given: dict[str, Any], overwrite: bool, json_file: Path | None
) -> None:
    """Do what was asked for, and tell it."""
    stored: list[Stored] = []
    told = (lambda text: None) if json_file == STANDARD_OUTPUT else echo
    if given["discard"]:
        told(f"given up: {capturing.discard()}")
    elif wanted is None:
        stored.append(capturing.fetch(given["out"], overwrite, given["remark"]))
        _tell(stored[-1], told)
    elif given["arm"]:
        number = capturing.memory.arm(wanted).number
        told(f"capture {number} is armed and waits for '{wanted.trigger.text}'; --held -o RUN fetches it")
    else:
        for each in capturing.take(wanted, given["out"], given["repeat"], given["timeout"], overwrite, given["remark"]):
            stored.append(each)
            _tell(each, told)
    if json_file is not None:
        write_json(json_file, [each.as_json() for each in stored])


def _tell(stored: Stored, told: Any) -> None:
    about, (first, last) = stored.about, stored.span
    what = f"{counted(about['records'], 'sample')} of {counted(stored.channels, 'channel')}"
    edges = f"{counted(about['edges'], 'Hall edge')}"
    if about["edges_lost"]:
        edges += f" ({about['edges_lost']} more found no room: --edges)"
    told(f"{stored.path}: {what}, {edges}, {first:.4f} ... {last:.4f} s, read in {stored.reading:.1f} s")
    if about["faults"]:
        told(f"the drive tripped: {', '.join(about['faults'])}")
    elif about["frozen_by"] != about["trigger"]:
        told(f"frozen by {about['frozen_by']}")


def _wanted(given: dict[str, Any]) -> Wanted | None:
    """What is to be captured; None where something is there already."""
    if given["trigger"] is None:
        return None
    from bench.capture.trigger import Trigger
    from bench.capture.wanted import Wanted

    of = {name: given[name] for name in ("seconds", "pre", "channels", "decimation", "edges")}
    return Wanted(Trigger.parse(given["trigger"]), **of)


def _check(given: dict[str, Any]) -> None:
    """Raise UsageError for options that exclude each other, or lack another one."""
    chosen = [option for option in ("trigger", "held", "discard") if given[option] not in (None, False)]
    names = {"trigger": "--trigger", "held": "--at-fault", "discard": "--discard"}
    if len(chosen) != 1:
        listed = " and ".join(names[option] for option in chosen)
        words = f"{listed} exclude each other" if chosen else "say what to capture: --trigger COND, or --at-fault"
        raise click.UsageError(words)
    for option in ("arm", "timeout"):
        if given[option] and given["trigger"] is None:
            raise click.UsageError(f"--{option} needs --trigger")
    if given["repeat"] > 1 and (given["trigger"] is None or given["arm"]):
        raise click.UsageError("--repeat needs --trigger, without --arm")
    keeps = not given["discard"] and not given["arm"]
    if keeps and given["out"] is None:
        raise click.UsageError("--out RUN is missing: where the capture is to go")
    if not keeps and given["out"] is not None:
        raise click.UsageError(
            f"--out is for a capture that is fetched, not for {'--arm' if given['arm'] else '--discard'}"
        )

"""`bench param`: parameters of a drive listed, set, stored, dumped, loaded, compared and watched."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from bench.cli.files import FILE, OR_STANDARD_OUTPUT, check_files, json_option, overwrite_option, write_json
from bench.cli.number import Number
from bench.cli.options import once, setting
from bench.cli.streams import echo, note
from bench.cli.target import SourceType, target_argument
from bench.errors import BenchError, ExitCode, UnsafeError
from bench.files import STANDARD_OUTPUT, write
from bench.param.groups import GROUP_NAMES
from protocol.text import counted

if TYPE_CHECKING:
    from bench.device.node import Node
    from bench.param.differences import Differences
    from bench.param.table import Parameters

Command = TypeVar("Command", bound=Callable[..., Any])

_SOURCE = SourceType((".toml", ".run"), ("defaults",))
_SIM = (
    "the simulated drive exists only during this command: start one with `bench sim --store FILE`, and use its target"
)

node_option = click.option("--node", metavar="N", type=click.IntRange(1, 255),
                           help="Number of the device on the link, such as 2 for a load machine [default: the one "
                           "that answers].")  # fmt: skip
group_option = click.option("--group", "groups", metavar="NAME", type=click.Choice(GROUP_NAMES), multiple=True,
                            help=f"Only parameters of this group: {', '.join(GROUP_NAMES)}; repeatable.")  # fmt: skip
reason_option = click.option("--reason", metavar="TEXT", default="", help="Why; kept with the change.")
save_option = click.option("--save", is_flag=True, help="Then have the drive store all its parameters permanently.")


@click.group("param")
def command() -> None:
    """List, set, store, dump, load, compare and watch parameters of a drive.

    Unit, range, default, group and meaning come from the drive. Nothing here energises it.

    \b
    Examples:
      bench param list sim
      bench param set serial:/dev/ttyACM0 k_p_vt=900 --reason "rings at 300 r/min" --save
      bench param dump serial:/dev/ttyACM0 -o drive17.toml
      bench param diff drive17.toml serial:/dev/ttyACM0
    """


@contextmanager
def _device(target: str, number: int | None, writes: bool = False) -> Iterator[tuple[Node, Parameters]]:
    """The device, and its parameters."""
    from bench.param.sources import connected, of_node
    from bench.rig.connection import SIM
    from bench.rig.interrupts import signals_as_exceptions

    if writes and target == SIM:
        raise BenchError(_SIM)
    with signals_as_exceptions(), connected(target, number, writes) as node:
        yield node, of_node(node, target)


@command.command("list")
@target_argument()
@group_option
@click.option("--changed", is_flag=True, help="Only parameters that are not at their default.")
@node_option
@json_option("all of this")
@overwrite_option
def list_(
    target: str, groups: tuple[str, ...], changed: bool, node: int | None, json_file: Path | None, overwrite: bool
) -> None:
    """List the parameters of a drive: value, unit, default, range, group, flags, meaning. Read-only.

    \b
    Examples:
      bench param list serial:/dev/ttyACM0
      bench param list sim --group tuning --changed
      bench param list serial:/dev/ttyACM0 --node 2 --json
    """
    check_files({"--json": json_file}, overwrite)
    from bench.cli.output import table
    from bench.param.table import flag_words, shortest

    with _device(target, node) as (_, parameters):
        entries = parameters.chosen(groups, changed)
    if json_file is not None:
        write_json(json_file, [entry.as_json() for entry in entries])
    if json_file == STANDARD_OUTPUT:
        return
    echo(parameters.title)
    headers = ("parameter", "value", "unit", "default", "lowest", "highest", "group", "flags", "meaning")
    table(
        headers,
        [
            [e.name, *(shortest(e.value), e.unit), *("" if v is None else shortest(v)
             for v in (e.default, e.lo, e.hi)), e.group, ", ".join(flag_words(e.flags)), e.meaning]
            for e in entries
        ],
    )  # fmt: skip
    echo(f"{counted(len(entries), 'parameter')} of {len(parameters)}")


@command.command("get")
@target_argument()
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@node_option
@json_option("the values")
@overwrite_option
def get(target: str, names: tuple[str, ...], node: int | None, json_file: Path | None, overwrite: bool) -> None:
    """Print the value of one parameter or several. Read-only.

    \b
    Examples:
      bench param get serial:/dev/ttyACM0 k_p_vt
      bench param get sim n_p psi_f_hat --json
    """
    check_files({"--json": json_file}, overwrite)
    from bench.param.table import shortest

    with _device(target, node) as (_, parameters):
        entries = [parameters.entry(name) for name in names]
    if json_file is not None:
        write_json(json_file, {entry.name: entry.value for entry in entries})
    if json_file != STANDARD_OUTPUT:
        for entry in entries:
            echo(f"{entry.name} = {shortest(entry.value)} {entry.unit}".rstrip())


@command.command("set")
@target_argument()
@click.argument("settings", metavar="NAME=VALUE...", nargs=-1, required=True, type=setting, callback=once)
@reason_option
@save_option
@node_option
def set_(target: str, settings: dict[str, float], reason: str, save: bool, node: int | None) -> None:
    """Set parameters, all or none: where the drive refuses one, the others get their old values again.

    Values are in the unit that bench param list shows. Without --save they last until the drive loses power.

    \b
    Examples:
      bench param set serial:/dev/ttyACM0 k_p_vt=900 k_i_vt=40000
      bench param set serial:/dev/ttyACM0 i_max=6 --reason "smaller motor" --save
    """
    from bench.param.writing import Why, carry_out

    with _device(target, node, writes=True) as (device, parameters):
        stored = carry_out(device, parameters, settings, save, note, Why(reason, "set"))
        _say_written(parameters, settings, stored)
        if save:
            echo(f"node {device.number} stored its parameters")


def _say_written(parameters: Parameters, wanted: dict[str, float], stored: dict[str, float]) -> None:
    """What was written, a line for each."""
    from bench.param.table import same, shortest

    for name, value in stored.items():
        unit = f" {parameters.entry(name).unit}".rstrip()
        rounded = "" if same(value, wanted[name]) else f" (the drive rounds {shortest(wanted[name])})"
        echo(f"{name}: {shortest(parameters[name])} -> {shortest(value)}{unit}{rounded}")


@command.command("save")
@target_argument()
@node_option
def save(target: str, node: int | None) -> None:
    """Have the drive store all its parameters permanently, as they are.

    \b
    Example:
      bench param save serial:/dev/ttyACM0
    """
    from bench.param.writing import require_store

    with _device(target, node, writes=True) as (device, _):
        require_store(device)
        device.store()
        echo(f"node {device.number} stored its parameters")


@command.command("dump")
@target_argument()
@click.option("-o", "--out", metavar="FILE", type=OR_STANDARD_OUTPUT, default="-", help="File to write [default: -].")
@reason_option
@node_option
@overwrite_option
def dump(target: str, out: Path, reason: str, node: int | None, overwrite: bool) -> None:
    """Write all parameters of a drive to a file that you can read, edit, load and keep under version control.

    The file says which drive it was, who wrote it, when and why, and for each parameter that is not at its default the
    reason of its last change, where that was made from this computer.

    \b
    Examples:
      bench param dump serial:/dev/ttyACM0 -o drive17.toml --reason "as delivered"
      bench param dump sim
    """
    check_files({"--out": out}, overwrite)
    from bench.param import dump as dumps
    from bench.param import history

    with _device(target, node) as (device, parameters):
        known = history.read(parameters)
        reasons = dumps.listed_reasons(parameters, known.reasons(device.number))
    if known.damaged:
        note(f"{counted(known.damaged, 'line')} of {history.place(parameters.serial)} cannot be read")
    write(out, dumps.text(parameters, history.now(), history.who(), reason, reasons), f"--out {out}")
    if out != STANDARD_OUTPUT:
        lasting = sum(entry.lasts for entry in parameters.entries.values())
        echo(f"{counted(lasting, 'parameter')} of {parameters.title}: {out}")


@command.command("load")
@click.argument("file", metavar="FILE", type=FILE)
@target_argument()
@click.option("--check", "check_only", is_flag=True, help="Write nothing; exit code 1 if the drive differs from FILE.")
@group_option
@click.option("--other-drive", is_flag=True, help="Load calibration of a drive with another serial number, too.")
@click.option("--yes", is_flag=True, help="Write without asking.")
@reason_option
@save_option
@node_option
def load(file: Path, target: str, check_only: bool, **given: Any) -> None:
    """Write a dump to a drive: shows what differs, asks, writes, reads back.

    Where the drive refuses one value, all get their old values again. What is read-only, and what does not last, is
    left alone.

    Exit codes: 0 the drive has what FILE says; 1 it differs (--check), or was lost and does not have all of it; 2
    refused, or error.

    \b
    Examples:
      bench param load drive17.toml serial:/dev/ttyACM0 --save
      bench param load drive17.toml serial:/dev/ttyACM0 --check
      bench param load drive17.toml serial:/dev/ttyACM1 --group tuning --yes --reason "as no. 17"
    """
    from bench.param import dump as dumps
    from bench.param.loading import prepare, require_own
    from bench.param.writing import Why, carry_out, check

    kept = dumps.read(file)
    if check_only and given["save"]:
        raise click.UsageError("--check writes nothing: without --save")
    with _device(target, given["node"], writes=not check_only) as (device, parameters):
        what = prepare(kept, parameters, given["groups"])
        _show(what.differences, (str(file), "drive"))
        for remark in what.remarks():
            echo(remark)
        if check_only:
            sys.exit(ExitCode.DONE if what.agrees else ExitCode.FAILED)
        if not given["other_drive"]:
            require_own(what)
        check(parameters, what.wanted)
        if not what.wanted and not given["save"]:
            return
        if not given["yes"]:
            _ask(len(what.wanted), parameters, given["save"])
        reason = given["reason"] or str(kept.about.get("reason", ""))
        carry_out(device, parameters, what.wanted, given["save"], note, Why(reason, "load"))
        stored = "; it stored them" if given["save"] else ""
        echo(f"{counted(len(what.wanted), 'parameter')} written to {parameters.title} and read back{stored}")


def _ask(count: int, parameters: Parameters, save: bool) -> None:
    """UnsafeError unless a person agrees."""
    what = f"Write {counted(count, 'parameter')} to {parameters.title}" + (" and store them" if save else "")
    if not sys.stdin.isatty():
        raise UnsafeError(f"nothing was written: no terminal to confirm '{what}?'; pass --yes")
    if not click.confirm(f"{what}?", err=True):
        raise UnsafeError("not confirmed: nothing was written")


def _show(found: Differences, titles: tuple[str, str]) -> None:
    """The differences as a table."""
    from bench.cli.output import table

    if found.values:
        table(["parameter", *titles, "unit"], found.rows())
    echo(f"{counted(len(found.values), 'difference')} in {counted(found.compared, 'parameter')}")


@command.command("diff")
@click.argument("a", metavar="A", type=_SOURCE)
@target_argument("b", _SOURCE, "[B]")
@group_option
@node_option
@json_option("the differences")
@overwrite_option
def diff(a: str, b: str, groups: tuple[str, ...], node: int | None, json_file: Path | None, overwrite: bool) -> None:
    """Compare the parameters of two: drives, dumps, recordings (as they began), or a drive with its defaults.

    A, B: a target, a dump (.toml), a recording (.run), or the word defaults. Values that are one float32 to a drive are
    equal.

    Exit codes: 0 nothing differs, 1 something does, 2 error.

    \b
    Examples:
      bench param diff drive17.toml serial:/dev/ttyACM0
      bench param diff defaults sim
      bench param diff before.run after.run --json
    """
    check_files({"--json": json_file}, overwrite)
    from bench.param import history, sources
    from bench.param.differences import compare

    one, other = sources.read_two(a, b, node)
    known = {side.serial: (history.read(side), int(side.identity.get("node", 1))) for side in (one, other)}

    def alike(name: str, first: float, second: float) -> bool:
        pairs = ((first, second), (second, first))
        return any(past.rounds(number, name, *pair) for past, number in known.values() for pair in pairs)

    found = compare(one, other, groups, alike)
    if json_file is not None:
        write_json(json_file, found.as_json())
    if json_file != STANDARD_OUTPUT:
        echo(f"A: {one.title}\nB: {other.title}")
        _show(found, ("A", "B"))
        for line in found.lines():
            echo(line)
    sys.exit(ExitCode.DONE if found.none else ExitCode.FAILED)


@command.command("watch")
@target_argument()
@click.option("--duration", metavar="S", type=Number(above=0), help="Stop after S seconds [default: at Ctrl-C].")
@node_option
def watch(target: str, duration: float | None, node: int | None) -> None:
    """Print each parameter that changes, whoever changes it: device time, old and new value. Read-only.

    A drive that tells changes by itself (HBP 1.1) dates them; of others the parameters are asked for in turn.

    \b
    Examples:
      bench param watch can:socketcan/can0
      bench param watch serial:/dev/ttyACM0 --duration 60
    """
    import math

    from bench.param.table import shortest
    from bench.param.watching import watch as watched

    with _device(target, node) as (device, parameters):
        echo(f"watching {counted(len(parameters), 'parameter')} of {parameters.title}")
        for change in watched(device, parameters, math.inf if duration is None else duration):
            about = "" if change.exact else "about "
            unit = f" {parameters.entry(change.name).unit}".rstrip()
            before, value = shortest(change.before), shortest(change.value)
            echo(f"{about}{change.seconds:.4f} s  {change.name}: {before} -> {value}{unit}")

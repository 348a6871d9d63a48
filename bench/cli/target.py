"""The TARGET argument, with completion of the ports that are there; left out, it is that of the bench."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

from bench.cli.streams import note
from bench.files import RRD, RUN, found_above, is_run

Command = TypeVar("Command", bound=Callable[..., Any])


class TargetType(click.ParamType[str]):
    """A target string; read by `protocol.links`, completed with the serial ports and CAN interfaces of this machine."""

    name = "target"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The string as it is; for a file, what to do with that."""
        target = str(value)
        if target.endswith((RUN, RRD)) or is_run(Path(target)):
            self.fail(
                f"{target} is a recording, not a target: open it with `bench view {target}`, or use `bench score "
                f"{target}`, `bench replay {target}` and `bench hall check {target}`"
            )
        if target != "sim" and os.path.isfile(target):
            from protocol.links.target import Target

            self.fail(f"{target} is a file, not a target: use {', '.join(kind.form for kind in Target.kinds.values())}")
        return target

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """`sim`, and the targets of each kind that are there."""
        from protocol.links.target import Target

        known = ["sim", *(target for kind in Target.kinds.values() for target in kind.here())]
        return [CompletionItem(target) for target in known if target.startswith(incomplete)]


TARGET = TargetType()


def target_argument(
    name: str = "target", kind: TargetType = TARGET, metavar: str | None = None, needed: bool = True
) -> Callable[[Command], Command]:
    """The argument TARGET. Left out, it is what $BENCH_TARGET or bench.toml says, which standard error tells.

    Where neither does, the command ends with a line that says what to do or, unless it is `needed`, gets None.
    """

    def choose(context: click.Context, _parameter: click.Parameter, given: str | None) -> str | None:
        if given is not None or context.resilient_parsing:
            return given
        if (target := bench_target()) is None and needed:
            raise click.UsageError(
                "no TARGET: name one, set $BENCH_TARGET, or let `bench init` write a bench.toml", context
            )
        return target

    return click.argument(name, type=kind, metavar=metavar, required=False, callback=choose)


def bench_target(bench_toml: Path | None = None) -> str | None:
    """The target by $BENCH_TARGET or the bench.toml, which standard error tells; None where neither names one.

    BenchError for a bench.toml that cannot be used.
    """
    if not (bench_toml or os.environ.get("BENCH_TARGET") or found_above("bench.toml")):
        return None  # the usual case, and what reads the file costs 150 ms to load
    from bench.rig.connection import chosen_target
    from bench.rig.settings import read_settings

    target, by = chosen_target(read_settings(bench_toml))
    if target:
        note(f"target: {target}, from {by}")
    return target or None


def simulated_figures(config: Path | None) -> Path | None:
    """The configuration of the simulated drive by --config, `config`, else by bench.toml. BenchError as above."""
    if config is not None or found_above("bench.toml") is None:
        return config
    from bench.rig.settings import read_settings

    return read_settings(None).config

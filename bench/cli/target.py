"""The TARGET argument, with completion of the ports that are there; left out, it is that of the bench."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Mapping
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


class SourceType(TargetType):
    """A target, a file whose name ends with one of `endings`, or one of `words`; whoever reads it tells which it is."""

    def __init__(self, endings: tuple[str, ...], words: tuple[str, ...] = ()) -> None:
        self._endings, self._words = endings, words

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The string as it is."""
        return str(value)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Targets, the words, and the files that are there."""
        files = [file for end in self._endings for file in sorted(glob.glob(f"{glob.escape(incomplete)}*{end}"))]
        known = [*(word for word in self._words if word.startswith(incomplete)), *files]
        return [*super().shell_complete(ctx, param, incomplete), *map(CompletionItem, known)]


class TargetArgument(click.Argument):
    """TARGET; where another argument follows, it may be left out: a first word that names no target is of that one.

    Names of parameters, NAME=VALUE and loops have no colon, slash or point before a sign =; targets and files have.
    """

    def handle_parse_result(
        self, ctx: click.Context, opts: Mapping[str, Any], args: list[str]
    ) -> tuple[Any, list[str]]:
        """Give the word to the argument that follows, if it is that one's; then as every argument."""
        word, after = opts.get(self.name or ""), self._following(ctx)
        if isinstance(word, str) and after is not None and not _like_a_target(word):
            assert isinstance(opts, dict)
            more = opts.get(after.name)
            if after.nargs == -1:
                opts[after.name] = (word, *(more if isinstance(more, tuple) else ()))
                del opts[self.name]
            elif not isinstance(more, str):
                opts[after.name] = word
                del opts[self.name]
        return super().handle_parse_result(ctx, opts, args)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Targets, and what may stand in their place."""
        after = self._following(ctx)
        return [
            *super().shell_complete(ctx, incomplete),
            *(after.shell_complete(ctx, incomplete) if after is not None else ()),
        ]

    def _following(self, ctx: click.Context) -> click.Argument | None:
        arguments = [each for each in ctx.command.params if isinstance(each, click.Argument)]
        return next(iter(arguments[arguments.index(self) + 1 :]), None)


def _like_a_target(word: str) -> bool:
    name = word.partition("=")[0]
    return word == "sim" or any(mark in name for mark in ":/\\.")


NO_TARGET = "no TARGET: name one, set $BENCH_TARGET, or let `bench init` write a bench.toml"


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
            raise click.UsageError(NO_TARGET, context)
        return target

    return click.argument(name, cls=TargetArgument, type=kind, metavar=metavar, required=False, callback=choose)


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


def simulated_figures(target: str | None, config: Path | None = None) -> Path | None:
    """The configuration of the simulated drive by --config, `config`, else by bench.toml. BenchError as above.

    For another `target` there is none: UsageError where --config is given.
    """
    simulated = target in (None, "sim")
    if config is not None and not simulated:
        raise click.UsageError(f"--config is for the simulated drive, not for {target}")
    if config is not None or not simulated or found_above("bench.toml") is None:
        return config
    from bench.rig.settings import read_settings

    return read_settings(None).config

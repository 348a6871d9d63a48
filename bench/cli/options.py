"""Options that several commands have: each stands here once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from bench.cli.number import Number

Command = TypeVar("Command", bound=Callable[..., Any])

FROM_HELP = "First device time to include, s [default: start of the run]."
TO_HELP = "Last device time to include, s [default: end of the run]."


def part_options(before: str = "") -> Callable[[Command], Command]:
    """`--from` and `--to`, as `begin` and `end`: the part of a run. `before`: what the help of both begins with."""

    def decorate(function: Command) -> Command:
        end = click.option("--to", "end", metavar="S", type=Number(), help=before + TO_HELP)
        return click.option("--from", "begin", metavar="S", type=Number(), help=before + FROM_HELP)(end(function))

    return decorate


class _Names(click.ParamType[tuple[str, ...]]):
    """Names with commas between them, one or more."""

    name = "names"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Read them, or say why not."""
        if names := tuple(name.strip() for name in str(value).split(",") if name.strip()):
            return names
        raise click.UsageError("--channels is empty: give names separated by commas", ctx)


def channels_option(what: str) -> Callable[[Command], Command]:
    """`--channels`, as a tuple of names or None; `what` it does, for the help."""
    return click.option("--channels", metavar="A,B,…", type=_Names(), help=what)


def viewer_option(words: str, *choices: str) -> Callable[[Command], Command]:
    """`--viewer`, the first of the choices by default, and `--web-port`; the help begins with these words."""

    def decorate(function: Command) -> Command:
        port = click.option("--web-port", metavar="PORT", type=click.IntRange(1, 65535),
                            help="Port of the web viewer [default: first free port from 9090].")  # fmt: skip
        text = f"{words}auto: native if there is a display, otherwise web."
        viewer = click.option("--viewer", type=click.Choice(choices), default=choices[0], show_default=True,
                              help=text)  # fmt: skip
        return viewer(port(function))

    return decorate


yes_option = click.option("--yes", is_flag=True, help="The shaft is clear: energise a physical drive without asking.")


def operator_option(where: str) -> Callable[[Command], Command]:
    """`--operator`, empty by default; `where` the name goes, for the help."""
    words = f"Operator's name, {where} [default: from bench.toml]."
    return click.option("--operator", metavar="NAME", default="", help=words)

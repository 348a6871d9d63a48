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


def setting(value: Any) -> tuple[str, float]:
    """Split NAME=VALUE with a finite number, or say why not."""
    if isinstance(value, tuple):
        return value
    name, sign, number = str(value).partition("=")
    if not sign or not name.strip():
        raise click.BadParameter(f"'{value}' is not NAME=VALUE")
    return name.strip(), Number().convert(number.strip(), None, None)


def once(_context: click.Context, parameter: click.Parameter, settings: tuple[tuple[str, float], ...]) -> Any:
    """Callback: settings as a table; UsageError for a name that is given twice."""
    names = [name for name, _ in settings]
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        given = " ".join([*(parameter.opts if isinstance(parameter, click.Option) else ()), twice[0]])
        raise click.UsageError(f"{given} is given {names.count(twice[0])} times: give it once")
    return dict(settings)


settings_option = click.option(
    "--set", "settings", metavar="NAME=VALUE", multiple=True, type=setting, callback=once,
    help="Replace a drive parameter for the observers, such as k_p=900 or n_p=15; repeatable.",
)  # fmt: skip


class Names(click.ParamType[tuple[str, ...]]):
    """Names with commas between them, one or more."""

    name = "names"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Read them, or say why not."""
        if names := tuple(name.strip() for name in str(value).split(",") if name.strip()):
            return names
        option = param.opts[0] if param is not None else "it"
        raise click.UsageError(f"{option} is empty: give names separated by commas", ctx)


def channels_option(what: str) -> Callable[[Command], Command]:
    """`--channels`, as a tuple of names or None; `what` it does, for the help."""
    return click.option("--channels", metavar="A,B,…", type=Names(), help=what)


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


def workers_options(function: Command) -> Command:
    """`--workers` and `--cluster`: where many drives are computed. Both None: on all cores of this machine."""
    cluster = click.option("--cluster", metavar="ADDRESS", callback=_one_place,
                           help="A dask scheduler, as tcp://host:8786, instead of this machine.")  # fmt: skip
    workers = click.option("--workers", metavar="N", type=click.IntRange(1, 1024), is_eager=True,
                           help="Processes on this machine [default: one per core]; 1 needs no dask.")  # fmt: skip
    return workers(cluster(function))


def _one_place(context: click.Context, _parameter: click.Parameter, cluster: str | None) -> str | None:
    if cluster is not None and context.params.get("workers") is not None:
        raise click.UsageError("--workers is for this machine, --cluster for others: give one of them")
    return cluster


yes_option = click.option("--yes", is_flag=True, help="The shaft is clear: energise a physical drive without asking.")


def operator_option(where: str) -> Callable[[Command], Command]:
    """`--operator`, empty by default; `where` the name goes, for the help."""
    words = f"Operator's name, {where} [default: from bench.toml]."
    return click.option("--operator", metavar="NAME", default="", help=words)

"""`bench completion`: the script that teaches a shell to complete bench's commands."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from bench.cli.streams import echo


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def command(shell: str) -> None:
    """Print the completion script of a shell.

    \b
    Example:
      bench completion bash >> ~/.bashrc
    """
    from bench.cli import cli

    complete = get_completion_class(shell)
    assert complete is not None
    echo(complete(cli, {}, "bench", "_BENCH_COMPLETE").source())

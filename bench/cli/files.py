"""Output files of a command: the options that name them, the check before it runs, and JSON."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click
from click.shell_completion import CompletionItem

from bench.device.simulator import configuration, shipped
from bench.files import STANDARD_OUTPUT, check_output, finite, write
from protocol.text import did_you_mean

FILE = click.Path(dir_okay=False, path_type=Path)
"""A file that may not exist yet."""
DIRECTORY = click.Path(file_okay=False, path_type=Path)
RUN = click.Path(path_type=Path)
"""A recorded run, which is a folder, or where one is to be."""
OR_STANDARD_OUTPUT = click.Path(dir_okay=False, allow_dash=True, path_type=Path)

Command = TypeVar("Command", bound=Callable[..., Any])


class _JsonFile(click.Path):
    """A file or -; what is plainly an argument of the command is not taken for it."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read it, or say why not."""
        if re.match(r"sim$|.*\.(run|rrd)$", str(value)) or _begins_as_target(str(value)):
            raise click.UsageError(f"--json would write to a file named {value}: put --json last, or use --json=-", ctx)
        return super().convert(value, param, ctx)


def _begins_as_target(text: str) -> bool:
    kind, colon, _ = text.partition(":")
    if not colon:
        return False
    from protocol.links.target import Target  # numpy costs 70 ms: only those who need it pay

    return kind in Target.kinds


def json_option(what: str) -> Callable[[Command], Command]:
    """`--json [FILE]`, as `json_file`, "-" where no FILE is given; `what`: what is written, for the help."""
    return click.option(
        "--json", "json_file", metavar="[FILE]", is_flag=False, flag_value="-",
        type=_JsonFile(dir_okay=False, allow_dash=True, path_type=Path),
        help=f"Write {what} as JSON to FILE; to standard output if FILE is omitted or -.",
    )  # fmt: skip


class _Configuration(click.Path):
    """A configuration of the simulated drive: a file, or the name of a motor that is shipped."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read it, or say why not."""
        file = configuration(Path(value), str(value))
        if file.suffix != ".toml" and not file.exists():
            hint = did_you_mean(str(value), shipped(), form="did you mean {}? ", cutoff=0.3)
            self.fail(f"no file and no motor named '{value}'; {hint}bench sim --motors lists the motors", param, ctx)
        return super().convert(str(file), param, ctx)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Names of motors, then files."""
        names = [CompletionItem(name) for name in shipped() if name.startswith(incomplete)]
        return names or super().shell_complete(ctx, param, incomplete)


config_option = click.option(
    "--config", metavar="FILE|MOTOR", type=_Configuration(exists=True, dir_okay=False, path_type=Path),
    help="Configuration of the simulated drive: a TOML file, or a motor that bench sim --motors lists.",
)  # fmt: skip
"""`--config`, the same for every command that may start a simulated drive."""
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace existing output files.")
"""`--overwrite`, the same for every command that writes files."""


def check_files(
    outputs: Mapping[str, Path | None],
    overwrite: bool,
    inputs: Iterable[Path | str | None] = (),
    recordings: Iterable[str] = (),
) -> None:
    """Find out before the run whether `inputs` are there and `outputs`, by option, can be written. Changes nothing.

    None is no file, - is standard output. UsageError for a file that would be lost, and for an input that cannot be
    reached; BenchError as `check_output`, RecordingError for the options that are `recordings`.
    """
    read = {os.path.realpath(source): source for source in inputs if source is not None}
    for source in read.values():
        try:
            os.stat(source)
        except FileNotFoundError:
            raise click.UsageError(f"{source}: no such file") from None
        except OSError as error:
            raise click.UsageError(f"{source} cannot be read: {error.strerror}") from None
    paths = {option: path for option, path in outputs.items() if path is not None}
    written: dict[str, str] = {}
    for option, path in paths.items():
        file = os.path.realpath(path)
        if file in read:
            raise click.UsageError(f"{option} {path} is also an input: choose another name")
        if file in written:
            raise click.UsageError(f"{written[file]} and {option} name the same file, {path}: choose another name")
        written[file] = option
    for option, path in paths.items():
        if path == STANDARD_OUTPUT and option in recordings:
            raise click.UsageError(f"{option} -: a recording cannot go to standard output; give a name")
        if path != STANDARD_OUTPUT:
            check_output(path, f"{option} {path}", overwrite, option in recordings)


def write_json(path: Path, data: object) -> None:
    """Write plain data to a file of `--json`; numbers that JSON lacks are null. Raises BenchError."""
    import json

    write(path, json.dumps(finite(data), indent=2, allow_nan=False) + "\n", f"--json {path}")

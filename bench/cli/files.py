"""Output files of a command: none may be what the command reads, and no two may be the same."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import click


def check_outputs(outputs: Mapping[str, Path | str | None], inputs: Iterable[Path | str | None] = ()) -> None:
    """`outputs` by option, such as {"--json": path}; None and "-" are no files. UsageError where one would be lost."""
    read = {Path(path).resolve() for path in inputs if path is not None}
    written: dict[Path, str] = {}
    for option, path in outputs.items():
        if path is None or str(path) == "-":
            continue
        file = Path(path).resolve()
        if file in read:
            raise click.UsageError(f"{option} {path} is a file that is read: choose another name")
        if file in written:
            raise click.UsageError(f"{written[file]} and {option} are the same file, {path}: choose another name")
        written[file] = option

"""The TARGET argument, with completion of the ports that are there."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from bench.files import RRD, RUN, is_run


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

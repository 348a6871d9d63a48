"""The TARGET argument, with completion of the ports that are there."""

from __future__ import annotations

import click
from click.shell_completion import CompletionItem


class TargetType(click.ParamType[str]):
    """A target string; read by `protocol.links`, completed with the serial ports of this machine."""

    name = "target"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """`sim`, the serial ports that are there, and the form of a TCP target."""
        from serial.tools import list_ports

        known = ["sim", "tcp:127.0.0.1:", *(f"serial:{port.device}" for port in list_ports.comports())]
        return [CompletionItem(target) for target in known if target.startswith(incomplete)]


TARGET = TargetType()

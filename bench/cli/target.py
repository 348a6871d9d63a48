"""The TARGET argument, with completion of the ports that are there."""

from __future__ import annotations

import os
import socket
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
            self.fail(f"{target} is a file, not a target: use serial:PORT, tcp:HOST:PORT, can:INTERFACE/CHANNEL")
        return target

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """`sim`, the form of a TCP target, and the ports that are there, serial ones also as slcan adapters."""
        from serial.tools import list_ports

        ports = [port.device for port in list_ports.comports()]
        known = ["sim", "tcp:127.0.0.1:", *(f"serial:{port}" for port in ports)]
        known += [f"can:socketcan/{name}" for _, name in socket.if_nameindex() if "can" in name]
        known += [f"can:slcan/{port}" for port in ports]
        return [CompletionItem(target) for target in known if target.startswith(incomplete)]


TARGET = TargetType()

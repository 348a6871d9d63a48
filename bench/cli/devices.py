"""`bench devices`: the available ports and buses, and the nodes on one of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from bench.cli.files import check_files, json_option, overwrite_option, write_json
from bench.cli.streams import echo
from bench.cli.target import TARGET
from protocol.text import told


@click.command("devices")
@click.argument("target", type=TARGET, required=False)
@json_option("the list")
@overwrite_option
def command(target: str | None, json_file: Path | None, overwrite: bool) -> None:
    """List serial ports and CAN interfaces as targets; with TARGET, list the nodes on it.

    Takes no target from bench.toml: without TARGET it lists what there is.

    \b
    Examples:
      bench devices
      bench devices can:socketcan/can0
    """
    check_files({"--json": json_file}, overwrite)
    if target is None:
        from bench.device.ports import places

        rows: list[dict[str, Any]] = places()
        headers, keys = ["target", "description", "USB id", "serial number"], list(_PORT)
        nothing = (
            "no serial ports and no CAN interfaces found; `bench live` runs the simulated drive, "
            "tcp:HOST:PORT connects to a drive on the network"
        )
    else:
        rows, several, advice = _nodes(target)
        headers, keys = ["node", "role", "name", "firmware", "serial", "build", "state", "boot"], list(_NODE)
        nothing = "; ".join(several) or f"no HBP device answered on {target}: {advice}"
    if json_file is not None:
        write_json(json_file, rows)
    elif not rows and target is None:
        echo(nothing)
    elif rows:
        from bench.cli.output import table

        shown = str if target is None else told
        table(headers, [[shown(row[key]) for key in keys] for row in rows])
    if not rows and target is not None:
        raise click.ClickException(nothing)
    if target is not None and several:
        raise click.ClickException("; ".join(several))


_PORT = ("target", "description", "usb_id", "serial_number")
_NODE = ("node", "role", "name", "firmware", "serial", "build", "state", "boot_id")


def _nodes(target: str) -> tuple[list[dict[str, Any]], list[str], str]:
    """The nodes that answer, words for those that are several devices, and what to look at if nobody answers."""
    from bench.device.description import describe
    from bench.device.scan import look_around
    from protocol.links import open_link

    link = open_link(target)
    try:
        found = look_around(link)
    finally:
        link.close()
    return [describe(reply) | {"state": reply.state.name} for reply in found.replies], found.several, found.advice

"""`bench devices`: the available ports and buses, and the nodes on one of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from bench.cli.files import check_files, json_option, overwrite_option, write_json
from bench.cli.streams import echo
from bench.cli.target import TARGET
from protocol.text import told

_NO_ADAPTERS = {"virtual", "udp_multicast", "serial", "slcan", "socketcand"}
"""Interfaces of python-can that have no adapter to find, or only serial ports, which are listed anyway."""

_DETECTION = 2.0  # s


@click.command("devices")
@click.argument("target", type=TARGET, required=False)
@json_option("the list")
@overwrite_option
def command(target: str | None, json_file: Path | None, overwrite: bool) -> None:
    """List serial ports and CAN interfaces as targets; with TARGET, list the nodes on it.

    \b
    Examples:
      bench devices
      bench devices can:socketcan/can0
    """
    check_files({"--json": json_file}, overwrite)
    if target is None:
        rows: list[dict[str, Any]] = [*_serial_ports(), *_can_interfaces()]
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


def _serial_ports() -> list[dict[str, Any]]:
    from serial.tools import list_ports

    return [
        {
            "target": f"serial:{port.device}",
            "description": port.description if port.description != "n/a" else "",
            "manufacturer": port.manufacturer or "",
            "serial_number": port.serial_number or "",
            "usb_id": f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None and port.pid is not None else "",
        }
        for port in sorted(list_ports.comports())
    ]


def _can_interfaces() -> list[dict[str, Any]]:
    import logging

    import can

    logging.getLogger("can").setLevel(logging.CRITICAL)  # it tells of each driver that is not installed
    found = can.detect_available_configs(sorted(can.VALID_INTERFACES - _NO_ADAPTERS), timeout=_DETECTION)
    return [
        {
            "target": f"can:{config['interface']}/{config['channel']}",
            "description": f"CAN by {config['interface']}",
            "manufacturer": "",
            "serial_number": str(config.get("serial", "") or config.get("unique_hardware_id", "") or ""),
            "usb_id": "",
        }
        for config in found
    ]


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

"""`bench devices`: the ports that a drive may be on."""

from __future__ import annotations

import json

import click


@click.command("devices")
@click.option("--json", "as_json", is_flag=True, help="Print JSON for scripts.")
def command(as_json: bool) -> None:
    """List serial ports with their descriptions, and the target string of each.

    \b
    Example:
      bench devices --json
    """
    from serial.tools import list_ports

    ports = [
        {
            "target": f"serial:{port.device}",
            "description": port.description if port.description != "n/a" else "",
            "manufacturer": port.manufacturer or "",
            "serial_number": port.serial_number or "",
            "usb_id": f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None and port.pid is not None else "",
        }
        for port in sorted(list_ports.comports())
    ]
    if as_json:
        click.echo(json.dumps(ports, indent=2))
        return
    if not ports:
        click.echo(
            "no serial ports found; `bench live` runs the simulated drive, tcp:HOST:PORT reaches one on the network"
        )
        return
    from bench.cli.output import table

    table(
        ["target", "description", "USB id", "serial number"],
        [[p["target"], p["description"], p["usb_id"], p["serial_number"]] for p in ports],
    )

"""`bench info`: a drive's identity, descriptor, parameters and health."""

from __future__ import annotations

import json
from contextlib import ExitStack
from typing import Any

import click

from bench.cli.target import TARGET


@click.command("info")
@click.argument("target", type=TARGET)
@click.option("--json", "as_json", is_flag=True, help="Print JSON for scripts.")
def command(target: str, as_json: bool) -> None:
    """Show identity, channels, parameters and health of every node on TARGET. Changes nothing in the drive.

    \b
    Examples:
      bench info serial:/dev/ttyACM0?baud=3000000
      bench info sim --json
    """
    from bench.cli.output import note
    from bench.inspect import inspect_link

    with ExitStack() as stack:
        if target == "sim":
            from bench.embedded import EmbeddedDrive

            target = stack.enter_context(EmbeddedDrive(note=note)).target
        found = inspect_link(target)
    if as_json:
        click.echo(json.dumps(found, indent=2))
        return
    for node in found["nodes"]:
        _show(target, node)
    if found["bus"] is not None:
        _show_bus(target, found["bus"])


def _show(target: str, node: dict[str, Any]) -> None:
    from bench.cli.output import pairs, table

    identity, health = node["identity"], node["health"]
    title = f"node {identity['node']}: {identity['name']} ({identity['role']}) on {target}"
    pairs(title, [[key.replace("_", " "), _text(value)] for key, value in (identity | health).items()])
    click.echo()
    table(
        ["channel", "id", "unit", "type", "scale", "flags"],
        [[c["name"], str(c["id"]), c["unit"], c["type"], f"{c['scale']:.6g}", c["flags"]] for c in node["channels"]],
    )
    click.echo()
    table(
        ["parameter", "value", "default", "lowest", "highest", "unit"],
        [
            [p["name"], *(f"{p[key]:.6g}" for key in ("value", "default", "lo", "hi")), p["unit"]]
            for p in node["parameters"]
        ],
    )
    click.echo()


def _show_bus(target: str, bus: dict[str, Any]) -> None:
    from bench.bus import bus_rows
    from bench.cli.output import pairs, table

    pairs(f"the bus of {target}, watched for a second", bus_rows(bus))
    click.echo()
    if not bus["fits"]:
        click.echo(f"no stream of node {bus['fits_node']} fits on it beside its Hall edges: it is too slow")
        return
    table(
        [f"what fits on it of node {bus['fits_node']}", "rate, Hz", "load at most"],
        [[_channels(fit["channels"]), f"{fit['rate_hz']:g}", f"{fit['load']:.0%}"] for fit in bus["fits"]],
    )
    click.echo()


def _channels(n: int) -> str:
    return "1 channel" if n == 1 else f"{n} channels"


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return str(value)

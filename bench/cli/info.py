"""`bench info`: a drive's identity, descriptor, parameters and health."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from bench.cli.files import check_files, json_option, overwrite_option, write_json
from bench.cli.streams import echo, note
from bench.cli.target import simulated_figures, target_argument
from bench.report.words import number
from protocol.text import counted, told


@click.command("info")
@target_argument()
@json_option("all of this")
@overwrite_option
def command(target: str, json_file: Path | None, overwrite: bool) -> None:
    """Show identity, channels, parameters and health of every node on TARGET. Read-only.

    Without TARGET, what $BENCH_TARGET or bench.toml says.

    \b
    Examples:
      bench info serial:/dev/ttyACM0?baud=3000000
      bench info sim --json
    """
    check_files({"--json": json_file}, overwrite)
    from bench.device.description import inspect_link
    from bench.errors import NodeError

    with ExitStack() as stack:
        if target == "sim":
            from bench.device.simulator import EmbeddedDrive

            target = stack.enter_context(EmbeddedDrive(simulated_figures(target), note)).target
        found = inspect_link(target)
    if json_file is not None:
        write_json(json_file, found)
    else:
        for node in found["nodes"]:
            _show(target, node)
        if found["bus"] is not None:
            _show_bus(target, found["bus"])
    if found["unread"]:
        raise NodeError("; ".join(dict.fromkeys(found["unread"].values())))


def _show(target: str, node: dict[str, Any]) -> None:
    from bench.cli.output import pairs, table

    identity, health = node["identity"], node["health"]
    title = f"node {identity['node']}: {identity['name']} ({identity['role']}) on {target}"
    pairs(title, [[key.replace("_", " "), told(value)] for key, value in (identity | health).items()])
    echo()
    table(
        ["channel", "id", "unit", "type", "scale", "flags"],
        [[c["name"], str(c["id"]), c["unit"], c["type"], f"{c['scale']:.6g}", c["flags"]] for c in node["channels"]],
    )
    echo()
    table(
        ["parameter", "value", "default", "lowest", "highest", "unit", "flags"],
        [
            [p["name"], *(number(p[key], ".6g") for key in ("value", "default", "lo", "hi")), p["unit"], p["flags"]]
            for p in node["parameters"]
        ],
    )
    echo()
    for oddity in node["odd"]:
        echo(f"odd: {oddity}")


def _show_bus(target: str, bus: dict[str, Any]) -> None:
    from bench.cli.output import pairs, table
    from bench.device.bus import bus_rows

    pairs(f"the bus of {target}, watched for a second", bus_rows(bus))
    echo()
    if not bus["fits"]:
        echo(f"the bus is too slow: beside the Hall edges, no stream of node {bus['fits_node']} fits")
        return
    table(
        [f"streams of node {bus['fits_node']} that fit", "rate, Hz", "max. load"],
        [[counted(fit["channels"], "channel"), f"{fit['rate_hz']:g}", f"{fit['load']:.0%}"] for fit in bus["fits"]],
    )
    echo()

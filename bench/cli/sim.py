"""`bench sim`: the simulated drive on its own."""

from __future__ import annotations

from typing import Any

import click

from bench.cli.files import FILE, config_option
from bench.cli.streams import echo


def _list_motors(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if not value:
        return
    from bench.cli.output import table
    from bench.device.simulator import shipped

    rows = [(name, file.read_text(encoding="utf-8").partition("\n")[0].strip("# ")) for name, file in shipped().items()]
    table(("motor", "description"), rows)
    ctx.exit()


@click.command("sim")
@click.option("--pty", is_flag=True, help="Serve on a pseudo terminal, like a serial port (default; not on Windows).")
@click.option("--tcp", metavar="HOST:PORT", help="Serve on TCP, one client at a time; port 0: any free port.")
@click.option("--slcan", is_flag=True, help="Serve on a CAN bus, through an slcan adapter on a pseudo terminal.")
@click.option("--bitrate", metavar="N", type=int, help="CAN bit rate, bit/s [default: 1000000].")
@click.option("--fd", is_flag=True, help="Use CAN FD.")
@click.option("--data-bitrate", metavar="N", type=int,
              help="Bit rate of the CAN FD data phase, bit/s [default: 5000000].")  # fmt: skip
@click.option("--ext", is_flag=True, help="Use 29-bit CAN identifiers, for a bus shared with CANopen.")
@click.option("--link", metavar="PATH", type=FILE,
              help="Create this symbolic link to the pty; it stays valid after a replug.")  # fmt: skip
@click.option("--baud", metavar="N", type=int, help="Act as a UART of this rate, bit/s [default: as a USB port].")
@config_option
@click.option("--set", "settings", metavar="SECTION.NAME=VALUE", multiple=True,
              help="Set one value of the configuration; repeatable.")  # fmt: skip
@click.option("--seed", type=int, metavar="N", help="Seed of noise and jitter [default: random].")
@click.option("--store", metavar="FILE", type=FILE,
              help="Store parameters in this file on PARAM_COMMIT [default: refused].")  # fmt: skip
@click.option("--device", type=click.Choice(["python", "c"]), default="python", show_default=True,
              help="Implementation of the device side of HBP; c (protocol/c) needs a C compiler.")  # fmt: skip
@click.option("--motors", is_flag=True, is_eager=True, expose_value=False, callback=_list_motors,
              help="List the motors for --config, and exit.")  # fmt: skip
def command(
    bitrate: int | None,
    fd: bool,
    data_bitrate: int | None,
    ext: bool,
    device: str,
    settings: tuple[str, ...],
    **given: Any,
) -> None:
    """Run the simulated drive and load machine in real time, and print the target to connect to.

    Ctrl-C stops it. kill -USR1 PID pulls the cable, kill -USR2 PID plugs it in again, on the same --link or port.

    \b
    Examples:
      bench sim --pty
      bench sim --tcp 127.0.0.1:7000 --set inverter.dead_time=2e-6
      bench sim --slcan --fd
      bench sim --config maxon-ec60-flat
      bench sim --device c
    """
    places = [name for name in ("tcp", "slcan", "pty") if given[name]]
    if len(places) > 1:
        raise click.UsageError(f"give only one of {', '.join(f'--{name}' for name in places)}")
    if data_bitrate is not None and not fd:
        raise click.UsageError("--data-bitrate needs CAN FD: add --fd")
    for name, value in (("--bitrate", bitrate), ("--fd", fd), ("--ext", ext)):
        if value and not given["slcan"]:
            raise click.UsageError(f"{name} needs a CAN bus: add --slcan")
    from protocol.canmap.frame import BusRates
    from protocol.links.target import DEFAULT_DATA_BITRATE
    from sim.ports.server import ServeOptions, parse_override, serve

    rates = BusRates(bitrate or 1_000_000, (data_bitrate or DEFAULT_DATA_BITRATE) if fd else None)
    overrides = dict(parse_override(text) for text in settings)
    options = ServeOptions(rates=rates, extended=ext, overrides=overrides, compiled=device == "c", **given)
    serve(options, echo)

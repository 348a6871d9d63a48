"""`bench protocol`: HBP for other tools."""

from __future__ import annotations

from pathlib import Path

import click

from bench.cli.files import OR_STANDARD_OUTPUT, check_files, overwrite_option
from bench.cli.target import target_argument
from bench.files import STANDARD_OUTPUT, write


@click.group("protocol")
def command() -> None:
    """Describe the protocol, HBP, to other tools.

    \b
    Example:
      bench protocol dbc can:socketcan/can0 -o drive.dbc
    """


@command.command("dbc")
@target_argument()
@click.option("-o", "--out", "--output", "output", metavar="FILE", type=OR_STANDARD_OUTPUT, default=STANDARD_OUTPUT,
              help="File to write; - is standard output [default: -].")  # fmt: skip
@overwrite_option
def dbc(target: str, output: Path, overwrite: bool) -> None:
    """Write a DBC file of the streams on a CAN bus, for CANalyzer, SavvyCAN, cantools and the like.

    TARGET: can:INTERFACE/CHANNEL; without it, what $BENCH_TARGET or bench.toml says. The file describes the
    streams that the devices are configured to send now; they keep streaming. If another program uses the same bus, add
    ?host_number=1 to TARGET.

    Identifiers and layout depend on the stream configuration: write the file again after a change of channels or rate,
    and after a reboot of the device.

    \b
    Examples:
      bench protocol dbc can:socketcan/can0 -o drive.dbc
      bench protocol dbc 'can:slcan//dev/ttyACM0?fd=1&ext=1' -o drive.dbc
    """
    check_files({"-o": output}, overwrite)
    from bench.device.dbc import ENCODING, target_dbc

    write(output, target_dbc(target).encode(ENCODING), f"-o {output}")

"""`bench protocol`: HBP for other tools."""

from __future__ import annotations

from pathlib import Path

import click

from bench.cli.files import OR_STANDARD_OUTPUT, check_files, overwrite_option
from bench.cli.target import TARGET
from bench.files import STANDARD_OUTPUT, write


@click.group("protocol")
def command() -> None:
    """HBP for other tools.

    \b
    Example:
      bench protocol dbc can:socketcan/can0 -o drive.dbc
    """


@command.command("dbc")
@click.argument("target", type=TARGET)
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    type=OR_STANDARD_OUTPUT,
    default=STANDARD_OUTPUT,
    help="Write to this file; - is standard output (the default).",
)
@overwrite_option
def dbc(target: str, output: Path, overwrite: bool) -> None:
    """Write a DBC file of the streams on a CAN bus, for CANalyzer, SavvyCAN, cantools and the like.

    TARGET: can:INTERFACE/CHANNEL. Its devices are asked what they are configured to stream at present, and go on
    streaming; where another program is connected to them too, give this one a number of its own: ?host_number=1.

    Identifiers and layout follow the configuration: write the file anew when the channels, their rate or the device's
    boot change.

    \b
    Examples:
      bench protocol dbc can:socketcan/can0 -o drive.dbc
      bench protocol dbc 'can:slcan//dev/ttyACM0?fd=1&ext=1' -o drive.dbc
    """
    check_files({"-o": output}, overwrite)
    from bench.device.dbc import ENCODING, target_dbc

    write(output, target_dbc(target).encode(ENCODING), f"-o {output}")

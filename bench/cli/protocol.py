"""`bench protocol`: HBP for other tools."""

from __future__ import annotations

from pathlib import Path

import click

from bench.cli.files import OR_STANDARD_OUTPUT, check_files, overwrite_option
from bench.cli.number import Number
from bench.cli.target import TARGET
from bench.files import STANDARD_OUTPUT, write


@click.group("protocol")
def command() -> None:
    """HBP for other tools.

    \b
    Example:
      bench protocol dbc --channels i_a,i_b,i_c -o drive.dbc
    """


@command.command("dbc")
@click.argument("target", required=False, type=TARGET)
@click.option(
    "-o",
    "--output",
    metavar="FILE",
    type=OR_STANDARD_OUTPUT,
    default=STANDARD_OUTPUT,
    help="Write to this file; - is standard output (the default).",
)
@overwrite_option
@click.option(
    "--channels", metavar="A,B,…", help="Without TARGET: only these channels (default: all but those on request)."
)
@click.option(
    "--rate",
    "rate_hz",
    metavar="HZ",
    type=Number(above=0),
    help="Without TARGET: sample rate (default: the highest that the bus carries).",
)
@click.option("--fd", is_flag=True, help="Without TARGET: CAN FD at 1 and 5 Mbit/s, not classic CAN at 1 Mbit/s.")
@click.option("--ext", is_flag=True, help="Without TARGET: 29-bit identifiers.")
def dbc(
    target: str | None,
    output: Path,
    overwrite: bool,
    channels: str | None,
    rate_hz: float | None,
    fd: bool,
    ext: bool,
) -> None:
    """Write a DBC file of the streams on a CAN bus, for CANalyzer, SavvyCAN, cantools and the like.

    TARGET: can:INTERFACE/CHANNEL. Its devices are asked what they are configured to stream at present, and go on
    streaming; where another program is connected to them too, give this one a number of its own: ?host_number=1.
    Without TARGET: the streams of the simulated drive, as an example: identifiers differ from boot to boot.

    Identifiers and layout follow the configuration: write the file anew when the channels or their rate change.

    \b
    Examples:
      bench protocol dbc can:socketcan/can0 -o drive.dbc
      bench protocol dbc can:slcan//dev/ttyACM0?fd=1&ext=1 -o drive.dbc
      bench protocol dbc --channels hall,i_a,i_b --rate 2000 -o drive.dbc
    """
    names = None if channels is None else tuple(name.strip() for name in channels.split(",") if name.strip())
    if names == ():
        raise click.UsageError("--channels names none: give names separated by commas")
    if target and (names or rate_hz is not None or fd or ext):
        raise click.UsageError(
            "--channels, --rate, --fd and --ext go without TARGET: the devices there say what they send"
        )
    check_files({"-o": output}, overwrite)
    from bench.dbc import ENCODING, simulated_dbc, target_dbc

    text = target_dbc(target) if target else simulated_dbc(names, rate_hz, fd, ext)
    write(output, text.encode(ENCODING), f"-o {output}")

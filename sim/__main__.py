"""`python -m sim`: the simulated drive on its own, behind a pty or a TCP port."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from protocol.errors import HbpError
from sim.config.params import ConfigError
from sim.ports.server import CONTROLS, ServeOptions, can_rates, parse_override, serve


def main(arguments: list[str] | None = None) -> int:
    """Parse, serve, and turn an error into one line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m sim",
        description="A simulated bench (drive and load machine) that a host reaches as it would reach hardware. "
        "The first line that it prints is the target to connect with.",
        epilog=CONTROLS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--pty", action="store_true", help="behind a pseudo terminal, like a serial port (default)")
    where.add_argument("--tcp", metavar="HOST:PORT", help="behind TCP, for one client at a time; port 0 = any free")
    where.add_argument("--slcan", action="store_true", help="on a CAN bus, behind an slcan adapter on a pty")
    where.add_argument("--socketcand", metavar="HOST:PORT", help="on a CAN bus (classic), behind a socketcand server")
    parser.add_argument("--bitrate", type=int, default=1_000_000, metavar="N", help="of the CAN bus")
    parser.add_argument("--fd", action="store_true", help="CAN FD")
    parser.add_argument("--data-bitrate", type=int, metavar="N", help="of CAN FD's data phase; without: 5000000")
    parser.add_argument("--ext", action="store_true", help="29-bit identifiers on the CAN bus")
    parser.add_argument("--link", type=Path, metavar="PATH", help="symbolic link to the pty, kept across a replug")
    parser.add_argument("--baud", type=int, metavar="N", help="act as a UART of this rate; without: as a USB port")
    parser.add_argument("--config", type=Path, metavar="FILE", help="TOML file with the figures that differ")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.NAME=VALUE", help="one such figure")
    parser.add_argument("--seed", type=int, help="of noise and jitter; without: another one each time")
    parser.add_argument("--store", type=Path, metavar="FILE", help="where PARAM_COMMIT keeps the parameters")
    parser.add_argument("--exit-with-parent", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    try:
        serve(
            ServeOptions(
                tcp=given.tcp,
                slcan=given.slcan,
                socketcand=given.socketcand,
                rates=can_rates(given.bitrate, given.fd, given.data_bitrate),
                extended=given.ext,
                link=given.link,
                baud=given.baud,
                config=given.config,
                overrides=dict(parse_override(text) for text in given.set),
                seed=given.seed,
                store=given.store,
                exit_with_parent=given.exit_with_parent,
            )
        )
    except (HbpError, ConfigError) as error:
        print(f"sim: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

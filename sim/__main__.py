"""`python -m sim`: the simulated drive on its own, behind a pty or a TCP port."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from protocol.errors import HbpError
from sim.drive.server import CONTROLS, ServeOptions, parse_override, serve
from sim.params import ConfigError


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

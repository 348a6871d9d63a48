"""The `bench` command, also as `python -m bench`."""

from __future__ import annotations

from bench.rig.interrupts import ctrl_c_kills


def main() -> None:
    """Load the command line and run it."""
    ctrl_c_kills()
    from bench.cli import main as run

    run()


if __name__ == "__main__":
    main()

"""The `bench` command, also as `python -m bench`."""

from __future__ import annotations

from bench.rig.interrupts import ctrl_c_kills, killed_by_ctrl_c


def main() -> None:
    """Load the command line and run it."""
    ctrl_c_kills()
    from bench.cli import main as run

    try:
        run()
    except KeyboardInterrupt:  # it came when all was done, and handlers were being put back
        killed_by_ctrl_c()


if __name__ == "__main__":
    main()

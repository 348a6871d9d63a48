"""The `bench` command, also as `python -m bench`."""

from __future__ import annotations

import os

from bench.rig.interrupts import ctrl_c_kills, killed_by_ctrl_c


def main() -> None:
    """Load the command line and run it."""
    ctrl_c_kills()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads spin as they wait: half of a live view's CPU time
    from bench.cli import main as run

    try:
        run()
    except KeyboardInterrupt:  # it came when all was done, and handlers were being put back
        killed_by_ctrl_c()


if __name__ == "__main__":
    main()

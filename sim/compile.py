"""What the simulated drive may run, compiled before it runs in real time: it must not stand still for an observer.

`python -m sim.compile` compiles all but the drive's loop, which takes as long as all the others: `compile_all` runs it
beside itself. In virtual time nothing waits, and each is compiled when it is first used.
"""

from __future__ import annotations

import os
import subprocess
import sys

from sim.drive import tick, tick_record
from sim.native import Native
from sim.observers import sample
from sim.observers.catalogue import CATALOGUE
from sim.ports import can_bits


def others() -> list[Native]:
    """All compiled functions but the drive's loop."""
    return [tick_record.pack, sample.run, can_bits.count, *(entry.function for entry in CATALOGUE.values())]


def compile_all() -> None:
    """Compile what is not kept yet, on two cores, and load it all."""
    beside = None
    if not tick.advance.kept and not all(one.kept for one in others()):
        nothing = subprocess.DEVNULL
        command = [sys.executable, "-m", "sim.compile"]
        beside = subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing)
    tick.advance.load()
    if beside is not None:
        beside.wait()
    for one in others():
        one.load()


def main() -> None:
    """Compile the others, as long as whoever asked for it is there."""
    parent = os.getppid()
    for one in others():
        if os.getppid() != parent:
            return
        one.load()


if __name__ == "__main__":
    main()

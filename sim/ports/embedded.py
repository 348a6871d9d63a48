"""A simulated drive for its parent alone: `python -m sim.ports.embedded [FILE]`, behind a free TCP port of loopback.

It has the figures of FILE, a configuration; without one the default ones with a watchdog of 1 s. Standard output gets
`target: …` when it answers, or `error: …`. It ends when standard input does. Its time begins when the parent connects,
so that nothing that it sends is lost before.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import suppress
from pathlib import Path

from protocol.errors import LinkError
from sim.config.errors import ConfigError
from sim.interrupts import send
from sim.ports.server import ServeOptions, serve

# A browser that draws the dashboard without a GPU can keep two cores busy, and this process from feeding the watchdog
# in time. Nothing real turns, so the drive may wait for a second.
PATIENT = {"firmware.watchdog": 1.0, "load.watchdog": 1.0}


def main() -> None:
    """Serve until standard input ends, or a signal comes."""
    threading.Thread(target=_end_with_input, daemon=True).start()
    config = Path(sys.argv[1]) if sys.argv[1:] else None
    try:
        serve(ServeOptions(tcp="127.0.0.1:0", config=config, overrides={} if config else PATIENT, awaits=True), _tell)
    except (ConfigError, LinkError) as error:
        _tell(f"error: {error}")
        sys.exit(2)


def _end_with_input() -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    send(signal.SIGTERM)


def _tell(line: str) -> None:
    """The end of standard input ends this process, not that of output: the parent reads up to the target only."""
    with suppress(OSError):
        os.write(sys.stdout.fileno(), f"{line}\n".encode())


if __name__ == "__main__":
    main()

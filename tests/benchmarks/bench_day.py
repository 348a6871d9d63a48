"""A working day of eight hours, recorded live while others keep a core busy for a twentieth of the time.

`python -m tests.benchmarks day`. Over TCP, as an hour is.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing

from tests.benchmarks.bench_hour import WARM, recorded
from tests.benchmarks.table import Row

HOURS = 8.0
LOAD = """
import time
while True:
    end = time.perf_counter() + 0.005
    while time.perf_counter() < end:
        pass
    time.sleep(0.095)
"""


class Load:
    """Another process, busy for 5 ms in each 100."""

    def __init__(self) -> None:
        self._process = subprocess.Popen([sys.executable, "-c", LOAD])

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()


def rows(short: bool) -> Iterator[Row]:
    """The day, live, recorded."""
    with closing(Load()):
        yield from recorded(*(4.0, 1.0) if short else (3600.0 * HOURS, WARM))

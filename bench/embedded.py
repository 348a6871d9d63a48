"""The simulated drive as a child process behind loopback TCP: what `bench live` plays with when it is given no target.

The bench reaches it only over that link, as it would reach hardware. The child ends when its standard input does, so it
cannot outlive the bench, however the bench ends.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from types import TracebackType
from typing import Self

from bench.errors import BenchError

# A browser that draws the dashboard without a GPU can keep two cores busy, and this process from feeding the watchdog
# in time. Nothing real turns, so the drive may wait for a second.
PATIENT = ("--set", "firmware.watchdog=1.0", "--set", "load.watchdog=1.0")


class EmbeddedDrive:
    """Context manager: starts the child, gives its `target`, ends it.

    The figures are those of the file `config`; without one, the default ones with a watchdog of 1 s.

    `note` gets what the child says before it is ready: that it compiles, when numba's cache is cold. Raises BenchError
    with the child's own words if it does not start.
    """

    def __init__(self, config: str | None = None, note: Callable[[str], None] = lambda text: None) -> None:
        self.target = ""
        self._note = note
        arguments = ("--config", config) if config else PATIENT
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sim", "--tcp", "127.0.0.1:0", "--exit-with-parent", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Self:
        try:
            self.target = self._await_target()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def _await_target(self) -> str:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("target: "):
                return line.removeprefix("target: ").strip()
            self._note(line.strip())
        words = self._process.communicate()[1].strip().splitlines()
        raise BenchError(words[-1].removeprefix("sim: ") if words else "the simulated drive did not start")

    def _end(self) -> None:
        if self._process.stdin:
            self._process.stdin.close()
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdout, self._process.stderr):
            if pipe:
                pipe.close()

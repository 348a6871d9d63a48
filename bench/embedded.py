"""The simulated drive as a child process behind loopback TCP: what `bench live` plays with when it is given no target.

The bench reaches it only over that link, as it would reach hardware. The child ends when its standard input does, so it
cannot outlive the bench, however the bench ends.
"""

from __future__ import annotations

import select
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import IO, Self

from bench.errors import BenchError

START_TIMEOUT = 120.0  # s: a cold numba cache compiles first


class EmbeddedDrive:
    """Context manager: starts the child, gives its `target`, ends it."""

    def __init__(self, arguments: Sequence[str] = (), note: Callable[[str], None] = lambda text: None) -> None:
        self._note = note
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sim", "--tcp", "127.0.0.1:0", "--exit-with-parent", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self.target = ""

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

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def _await_target(self) -> str:
        output: IO[bytes] | None = self._process.stdout
        assert output is not None
        deadline = time.monotonic() + START_TIMEOUT
        while select.select([output], [], [], max(deadline - time.monotonic(), 0))[0]:
            line = output.readline().decode().strip()
            if line.startswith("target: "):
                return line.removeprefix("target: ")
            if not line:
                errors = self._process.communicate()[1].decode().strip().splitlines()
                raise BenchError((errors[-1] if errors else "the simulated drive did not start").removeprefix("sim: "))
            self._note(line)
        raise BenchError(f"the simulated drive did not start within {START_TIMEOUT:g} s")

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

"""The simulated drive as a child process behind loopback TCP: what `bench live` plays with when it is given no target.

The bench reaches it only over that link, as it would reach hardware. The child ends when its standard input does, so it
cannot outlive the bench, however the bench ends.
"""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import IO, Self

from bench.errors import BenchError

START_TIMEOUT = 30.0  # s until the target is known
COMPILE_TIMEOUT = 180.0  # s until it answers: with a cold numba cache it compiles first


class EmbeddedDrive:
    """Context manager: starts the child, gives its `target`, ends it. `note` gets what it says before it answers."""

    def __init__(self, arguments: Sequence[str] = (), note: Callable[[str], None] = lambda text: None) -> None:
        self.target = ""
        self._note = note
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._errors: list[str] = []
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sim", "--tcp", "127.0.0.1:0", "--exit-with-parent", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._readers = [
            threading.Thread(target=self._read_output, args=(self._process.stdout,), daemon=True),
            threading.Thread(target=self._read_errors, args=(self._process.stderr,), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def __enter__(self) -> Self:
        try:
            first = self._lines.get(timeout=START_TIMEOUT)
        except queue.Empty:
            first = ""
        if not first.startswith("target: "):
            self._end()
            raise self.failure()
        self.target = first.removeprefix("target: ")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def failure(self) -> BenchError:
        """Why the child failed, in its own words."""
        words = self._errors[-1].removeprefix("sim: ") if self._errors else "the simulated drive did not start"
        return BenchError(words)

    def _read_output(self, output: IO[str]) -> None:
        for number, line in enumerate(output):
            if number == 0:
                self._lines.put(line.strip())
            elif line.startswith("compiling"):
                self._note(line.strip())
        self._lines.put("")

    def _read_errors(self, errors: IO[str]) -> None:
        self._errors += [line.strip() for line in errors if line.strip()]

    def _end(self) -> None:
        if self._process.stdin:
            self._process.stdin.close()
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for reader in self._readers:
            reader.join(1.0)
        for pipe in (self._process.stdout, self._process.stderr):
            if pipe:
                pipe.close()

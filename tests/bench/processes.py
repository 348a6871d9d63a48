"""Real processes for tests: the simulated drive and `bench`, their lines with the time at which they came."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import IO, Any

LIMIT = 60.0  # s, for whatever is awaited; a cold numba cache is the longest

ENVIRONMENT = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")}


class Program:
    """`python -m MODULE ARGUMENTS…`, whose lines are collected by threads and awaited with a deadline."""

    def __init__(
        self,
        *arguments: str,
        limit_resources: Callable[[], None] | None = None,
        more: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """`more`: variables of its environment."""
        self.process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**ENVIRONMENT, **more},
            preexec_fn=limit_resources,
        )
        self.out: list[str] = []
        self.err: list[str] = []
        self._changed = threading.Condition()
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self._readers = [
            threading.Thread(target=self._read, args=pair, daemon=True)
            for pair in ((self.process.stdout, self.out), (self.process.stderr, self.err))
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, pipe: IO[str], lines: list[str]) -> None:
        for line in pipe:
            with self._changed:
                lines.append(line.rstrip("\n"))
                self._changed.notify_all()

    def line(self, pattern: str, after: int = 0) -> re.Match[str]:
        """The first line of either output, from number `after` of it on, that matches the pattern."""
        end = time.monotonic() + LIMIT

        def found() -> re.Match[str] | None:
            for lines in (self.out, self.err):
                for line in lines[after:]:
                    if match := re.search(pattern, line):
                        return match
            return None

        with self._changed:
            while (match := found()) is None:
                left = end - time.monotonic()
                over = not any(reader.is_alive() for reader in self._readers)
                assert left > 0 and not over, f"no line '{pattern}' in {self.out + self.err}"  # noqa: PT018
                self._changed.wait(min(left, 0.2))
        return match

    def send(self, number: signal.Signals) -> None:
        self.process.send_signal(number)

    def end(self, limit: float = LIMIT) -> int:
        """The exit code, once it has ended, within `limit` s, and all its lines are here."""
        code = self.process.wait(limit)
        for reader in self._readers:
            reader.join(LIMIT)
        return code

    def close(self) -> None:
        self.process.kill()
        self.end()
        for pipe in (self.process.stdout, self.process.stderr):
            if pipe:
                pipe.close()


class Sim(Program):
    """`bench sim`; `target` is what it says to connect with."""

    def __init__(self, *arguments: str, **options: Any) -> None:
        super().__init__("bench", "sim", *arguments, **options)
        self.target = self.line("^target: (.*)").group(1)
        self.line("^simulated drive")

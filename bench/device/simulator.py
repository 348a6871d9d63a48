"""The simulated drive as a child process behind loopback TCP: what `bench live` plays with when it is given no target.

The bench reaches it only over that link, as it would reach hardware. The child ends when its standard input does, so it
cannot outlive the bench, however the bench ends. It is in a session of its own: Ctrl-C in a terminal reaches the bench
alone, which still needs the drive for its STOP.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Self

import sim
from bench.errors import BenchError
from bench.system import APART

_SHIPPED = Path(sim.__file__).parent


def motors() -> dict[str, Path]:
    """The motors that are shipped as configurations of the simulated drive, by name."""
    return {file.stem: file for file in sorted(_SHIPPED.glob("motors/*.toml"))}


def shipped() -> dict[str, Path]:
    """All configurations that are shipped, by name: the motors, and the paper's motor on an unkind bench."""
    return motors() | {"bench24v": _SHIPPED / "bench24v.toml"}


def configuration(path: Path, name: str) -> Path:
    """The file of a configuration: `path`, or where there is none that of the shipped one `name`."""
    return path if path.exists() else shipped().get(name, path)


class EmbeddedDrive:
    """Context manager: starts the child, gives its `target`, ends it.

    The figures are those of the file `config`; without one, the default ones with a watchdog of 1 s.

    It starts when this is made; to enter the context waits until it is ready. `note` gets what the child says before
    that: that it compiles, on the first start. Raises BenchError with the child's own words if it does not start.
    """

    def __init__(self, config: Path | str | None = None, note: Callable[[str], None] = lambda text: None) -> None:
        self.target = ""
        self.note = note
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sim.ports.embedded", *([str(config)] if config else [])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "PYTHONIOENCODING": "utf-8"},  # whatever that of this terminal is
            start_new_session=True,
            creationflags=APART,
        )

    def __enter__(self) -> Self:
        try:
            self.target = self._await_target()
        except BaseException:
            self.end()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        self.end()

    def end(self) -> None:
        """End the child, and wait for that."""
        if self._process.stdin:
            self._process.stdin.close()
        self._process.terminate()
        try:
            self._process.wait(2.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _await_target(self) -> str:
        assert self._process.stdout is not None
        words = "the simulated drive did not start"
        with self._process.stdout as lines:  # nobody reads what it says later: closed, it cannot block the child
            for line in lines:
                words = line.strip()
                if words.startswith("target: "):
                    return words.removeprefix("target: ")
                if not words.startswith("error: "):
                    self.note(words)
        raise BenchError(words.removeprefix("error: "))

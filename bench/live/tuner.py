"""Keys and lines that tune parameters while `bench live` streams: what was typed becomes changes, one after the other.

On a terminal keys: up and down choose a parameter, right and left change it by a step, a number and Enter sets it.
Otherwise lines: `name=value`.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue

from bench.errors import BenchError
from bench.rig.tuning import Tuning
from bench.system import Keys
from protocol.errors import HbpError

KEYS = "up and down choose, right and left change by 5 %, a number and Enter sets; all are put back at the end"
_UP, _DOWN, _RIGHT, _LEFT = "\x1b[A", "\x1b[B", "\x1b[C", "\x1b[D"
_NUMBER = frozenset("0123456789.-+eE")


class Knobs:
    """What keys mean: which parameter is chosen, and what has been typed so far."""

    def __init__(self, tuning: Tuning) -> None:
        self._tuning = tuning
        self._names = tuple(tuning)
        self._chosen = 0
        self.typed = ""

    @property
    def chosen(self) -> str:
        """The name of the parameter that keys change."""
        return self._names[self._chosen]

    def press(self, key: str) -> None:
        """Do what a key means, or nothing. Raises BenchError or HbpError for what the drive does not take."""
        if key in (_UP, _DOWN):
            self._chosen = (self._chosen + (1 if key == _DOWN else -1)) % len(self._names)
            self.typed = ""
        elif key in (_RIGHT, _LEFT):
            self.typed = ""
            self._tuning.step(self.chosen, 1 if key == _RIGHT else -1)
        elif key in ("\x7f", "\b"):
            self.typed = self.typed[:-1]
        elif key in ("\r", "\n"):
            typed, self.typed = self.typed, ""
            if typed:
                self._tuning[self.chosen] = number(typed)
        elif key in _NUMBER:
            self.typed += key

    def line(self, text: str) -> None:
        """Do what a line `name=value` says. Raises BenchError or HbpError."""
        name, sign, value = text.partition("=")
        if not sign:
            raise BenchError(f"'{text.strip()}' is not name=value")
        self._tuning[name.strip()] = number(value)

    def words(self) -> str:
        """All of them with their values, the chosen one in brackets."""
        shown = []
        for name, value in self._tuning.items():
            text = f"{name} {value:.6g}" + (f" < {self.typed}_" if self.typed and name == self.chosen else "")
            shown.append(f"[{text}]" if name == self.chosen else text)
        return ", ".join(shown)


def number(text: str) -> float:
    """A finite number. BenchError for anything else."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise BenchError(f"'{text.strip()}' is not a finite number")
    return value


class Tuner:
    """Does what is typed; `say` tells what was refused. A context manager: after it the terminal is as it was."""

    def __init__(self, tuning: Tuning, terminal: int, keys: bool, say: Callable[[str], None]) -> None:
        """`terminal`: descriptor of standard input; `keys`: whether it is a terminal, so that keys come one by one."""
        self.tuning, self.knobs = tuning, Knobs(tuning)
        self._say = say
        self._keys = Keys(terminal) if keys else None
        self._lines: SimpleQueue[str] = SimpleQueue()
        if not keys:
            threading.Thread(target=self._read, args=(terminal,), daemon=True).start()

    def __enter__(self) -> Tuner:
        if self._keys is not None:
            self._keys.begin()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._keys is not None:
            self._keys.end()

    def _read(self, terminal: int) -> None:
        """Lines of standard input, until it ends. Not by `sys.stdin`, whose lock this thread would hold at the end."""
        data = b""
        while True:
            try:
                more = os.read(terminal, 4096)
            except OSError:
                return
            *lines, data = (data + more).split(b"\n")
            for line in lines if more else [*lines, data]:
                self._lines.put(line.decode("utf-8", "replace"))
            if not more:
                return

    def poll(self) -> bool:
        """Do what was typed since the last call; whether anything was."""
        acts: list[tuple[Callable[[str], None], str]] = []
        if self._keys is not None:
            acts += [(self.knobs.press, key) for key in self._keys.typed()]
        else:
            while True:
                try:
                    line = self._lines.get_nowait()
                except Empty:
                    break
                if line.strip():
                    acts.append((self.knobs.line, line))
        for act, what in acts:
            try:
                act(what)
            except (BenchError, HbpError) as error:
                self._say(str(error))
        return bool(acts)

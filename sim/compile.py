"""Kernels are compiled in processes of their own: no handler of a signal runs inside numba.

`compile_apart` starts a child for each group of functions and waits. If an exception ends the wait, Ctrl-C say, the
children are killed. Otherwise what they have made is on disk (`protocol.machine_code`), to be loaded. A child is
`python -m sim.compile NAME...`; it also ends when its standard input does, which it does when the parent is gone.

`python -m sim.compile --ship` writes the IR that comes with the sources: to be run when a kernel was edited.
`--ir NAME` prints that of one function.

Importing this module does not import numba.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Protocol

from sim.numba_cache import store

TELL_EVERY = 1.0  # s
POLL = 0.02  # s between two looks at the children
GENERIC = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
"""Environment of a process in which numba makes IR for any machine: LLVM makes the best of it for the one at hand."""


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


_tell: Callable[[str], None] = _print


class Compiled(Protocol):
    """A function that can be compiled, as `sim.native` has it."""

    name: str
    """MODULE:NAME where another process finds it; with :ARGUMENT, NAME is a function that gives it for that text."""

    @property
    def kept(self) -> bool:
        """Whether nothing is to be compiled."""

    @property
    def key(self) -> str:
        """What it is kept under."""

    def ir(self) -> str:
        """Its LLVM IR, by numba."""

    def make(self) -> None:
        """Load it; compile it here, if nothing of it is there."""


def tell_by(tell: Callable[[str], None]) -> None:
    """From now on `tell` gets a line each second while something is compiled; before, standard error does."""
    global _tell
    _tell = tell


def compile_apart(*groups: Sequence[Compiled]) -> None:
    """Compile those functions that are not kept yet and that a child can find, a child for each group."""
    wanted = [[one for one in group if not one.kept and findable(one)] for group in groups]
    every = [one for group in wanted for one in group]
    children: list[subprocess.Popen[bytes]] = []
    begun, told = time.monotonic(), -math.inf
    try:
        for group in wanted:
            if group:
                command = [sys.executable, "-m", "sim.compile", *(one.name for one in group)]
                pipe, nothing = subprocess.PIPE, subprocess.DEVNULL
                environment = {**GENERIC, **os.environ}
                made = subprocess.Popen(
                    command, stdin=pipe, stdout=nothing, stderr=nothing, env=environment,
                    start_new_session=True, creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )  # fmt: skip
                children.append(made)
        while any(child.poll() is None for child in children):
            if (now := time.monotonic()) - told >= TELL_EVERY:
                told = now
                done = sum(one.kept for one in every)
                _tell(f"compiling, once on this machine: {done} of {len(every)} functions, {now - begun:.0f} s")
            time.sleep(POLL)
    finally:
        for child in children:
            child.kill()
            child.communicate()


def findable(function: Compiled) -> bool:
    """Whether another process finds a function by its name."""
    try:
        return found(function.name) is function
    except (ImportError, AttributeError):
        return False


def found(name: str) -> Compiled:
    """The function of this name (`Compiled.name`)."""
    module, attribute, *argument = name.split(":")
    at = getattr(import_module(module), attribute)
    result: Compiled = at(*argument) if argument else at
    return result


def main() -> None:
    """Compile the functions named on the command line, as long as the parent is there; or `--ir NAME`, or `--ship`."""
    if sys.argv[1:] == ["--ship"]:
        _ship()
    elif sys.argv[1] == "--ir":
        print(found(sys.argv[2]).ir(), end="")
    else:
        threading.Thread(target=_end_with_input, daemon=True).start()
        for name in sys.argv[1:]:
            found(name).make()


def ir_apart(name: str) -> str:
    """The IR of a function for any machine, by numba in a process of its own: in one it depends on what was before."""
    command = [sys.executable, "-m", "sim.compile", "--ir", name]
    return subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, **GENERIC}).stdout


def _ship() -> None:
    os.environ.update(GENERIC)
    from concurrent.futures import ThreadPoolExecutor

    from protocol.compiled_framing import ship
    from protocol.ir_by_numba import VERSIONS

    kernels = import_module("sim.ports.device").kernels()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        texts = list(pool.map(ir_apart, [one.name for one in kernels]))
    store().ship({one.key: text for one, text in zip(kernels, texts, strict=True)}, VERSIONS)
    ship()


def _end_with_input() -> None:
    sys.stdin.buffer.read()
    os._exit(1)


if __name__ == "__main__":
    main()

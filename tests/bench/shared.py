"""What tests share: folders that a test run makes once, whichever worker needs them first, cases, a terminal."""

from __future__ import annotations

import io
import os
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock


class Terminal(io.StringIO):
    """A standard stream of a terminal, for all that a program asks it."""

    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that `make` has filled, the same for all workers. Not to be changed by a test."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    done = folder.with_suffix(".done")
    with FileLock(folder.with_suffix(".lock")):
        if not done.exists():
            folder.mkdir()
            make(folder)
            done.touch()
    return folder


def table(name: str) -> dict[str, Any]:
    """The cases of a file in `tables`."""
    return tomllib.loads((Path(__file__).parent / "tables" / f"{name}.toml").read_text("utf-8"))


_ANGLE = re.compile(r"-?\d+(?:\.\d+)?(?= deg)")


def same_cause(said: str, expected: str, within: float = 1.5) -> bool:
    """Whether a cause is the one expected: angles as good as the configuration is known to a check, in degrees."""
    pairs = zip(_ANGLE.findall(said), _ANGLE.findall(expected), strict=False)
    return _ANGLE.sub("", said) == _ANGLE.sub("", expected) and all(abs(float(a) - float(b)) < within for a, b in pairs)

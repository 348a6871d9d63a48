"""Which program made a result, and what it is built on."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

from protocol import __version__

PROGRAM = "hallbench"
BUILT_ON = ("numpy", "numba", "rerun-sdk", "pyserial", "python-can", "pytest")


def versions() -> dict[str, str]:
    """Of the program, of Python, of the packages that there are, and of the machine."""
    found = {PROGRAM: __version__, "python": platform.python_version()}
    found |= {name: told for name in BUILT_ON if (told := _version(name))}
    return found | {"platform": platform.platform()}


@cache  # a recording needs them, and reading them takes 10 ms
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""

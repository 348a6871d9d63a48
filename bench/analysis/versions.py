"""Which program made a result, and what it is built on."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version

PROGRAM = "hallbench"
BUILT_ON = ("numpy", "numba", "rerun-sdk", "pyserial", "python-can", "pytest")


def program_version() -> str:
    """Of this program."""
    return _version(PROGRAM) or "0+unknown"  # a source tree that was never installed


def versions(packages: Iterable[str] = BUILT_ON) -> dict[str, str]:
    """Of the program, of Python, of the packages that there are, and of the machine."""
    found = {PROGRAM: program_version(), "python": platform.python_version()}
    found |= {name: told for name in packages if (told := _version(name))}
    return found | {"platform": platform.platform()}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""

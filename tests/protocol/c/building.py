"""Compilers that are here, and programs made of the device side in C by them."""

from __future__ import annotations

import subprocess
from pathlib import Path

from tests.tools import require

ROOT = Path(__file__).resolve().parents[3]
SOURCE = ROOT / "protocol" / "c"
HERE = Path(__file__).parent
FILES = ("hbp.c", "hbp_capture.c", "hbp_means.c", "hbp_can.c")
STRICT = (
    "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wcast-align", "-Wshadow", "-Werror",
)  # fmt: skip
SANITIZED = ("-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-Wall", "-Wextra", "-Werror")
SMALL = {
    "RX_MAX": 128, "TX_MAX": 128, "TX_BYTES": 512, "CHANNELS": 5, "POOLS": 1, "POOL_BYTES": 264, "EDGES": 1,
    "CAN_MESSAGES": 64, "CAN_STREAMED": 16, "CAN_TRANSFERS": 2,
}  # fmt: skip
LARGE = {
    "RX_MAX": 1024, "TX_MAX": 1024, "TX_BYTES": 8192, "CHANNELS": 499, "POOLS": 4, "POOL_BYTES": 4096, "EDGES": 128,
    "HOSTS": 16, "CRC_TABLE": 256, "CAN_BYTES": 64, "CAN_MESSAGES": 512, "CAN_STREAMED": 64, "CAN_TRANSFERS": 34,
    "MEANS": 1,
}  # fmt: skip
"""Options of hbp.h and hbp_can.h: the least that a firmware can do with, and more than any has."""
LIMIT = 100.0  # s, for any one program


def compiler(name: str, *flags: str) -> str:
    """Its name; the test is skipped where it is missing, or cannot do what these flags ask for."""
    require(name)
    for flag in flags:
        if flag == "-m32" or flag.startswith("-fsanitize="):
            require(f"{name} {flag}")
    return name


def options(values: dict[str, int]) -> list[str]:
    """For a command line."""
    return [f"-DHBP_{name}={value}" for name, value in values.items()]


def run(*command: str | Path, text: str | None = None) -> str:
    """What it prints; it must end well, within the limit."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, input=text, timeout=LIMIT)
    assert done.returncode == 0, f"{' '.join(map(str, command))} ended with {done.returncode}:\n{done.stderr[-3000:]}"
    return done.stdout


def build(to: Path, name: str, main: str, *flags: str, can: bool = True) -> Path:
    """A program of `main` in this folder and the device side, by the compiler `name`."""
    files = [HERE / main, *(SOURCE / file for file in FILES if can or file != "hbp_can.c")]
    run(compiler(name, *flags), "-std=c99", *flags, *files, "-o", to)
    return to

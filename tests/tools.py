"""Tools and drivers that some tests need: each is tried out once in a test run, and a test is skipped without its tool.

`@needs("clang")` marks a test, `require("clang")` stands in a fixture. A tool is there when it does its work, not when
its file exists: gcc without a 32-bit libc cannot do `-m32`. With $HALLBENCH_REQUIRE_TOOLS=1 (CI with everything
installed) a missing tool fails the test. `python -m tests.doctor` tells what is missing on this machine.
"""

from __future__ import annotations

import fcntl
import functools
import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from protocol.device.compiled import NoCompiler, compiler
from tests import viewers

REQUIRED = "HALLBENCH_REQUIRE_TOOLS"
LIMIT = 60.0  # s, for one trial
PROGRAM = "#include <string.h>\nint main(int n, char **of) { return n == 1 ? (int)strlen(of[0]) < 1 : 1; }\n"
FUZZED = "int LLVMFuzzerTestOneInput(const char *d, unsigned long n) { return !d + !n; }\n"


class Missing(Exception):
    """What a trial found: why the tool cannot be used."""


@dataclass(frozen=True)
class Tool:
    """`attempt` uses the tool in an empty folder and raises Missing; `brought_by` is a command that installs it."""

    name: str
    attempt: Callable[[Path], object]
    brought_by: str


def run(*command: str | Path, text: str | None = None) -> str:
    """What a command prints. Raises Missing where it cannot be started, fails or takes too long."""
    try:
        done = subprocess.run([*map(str, command)], capture_output=True, text=True, input=text, timeout=LIMIT)
    except FileNotFoundError:
        raise Missing(f"no {command[0]}") from None
    except (OSError, subprocess.TimeoutExpired) as error:
        raise Missing(str(error)) from None
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines() or [f"exit code {done.returncode}"]
        raise Missing(next((line for line in lines if "error" in line), lines[-1])[:160])
    return done.stdout


def compiles(command: str, suffix: str = ".c", source: str = PROGRAM, runs: bool = True) -> Callable[[Path], None]:
    """A trial that compiles, links and runs a small program."""

    def attempt(folder: Path) -> None:
        (folder / f"x{suffix}").write_text(source)
        made = ["-o", folder / "x"] if runs else ["-c", "-o", folder / "x.o"]
        run(*command.split(), folder / f"x{suffix}", *made)
        if runs:
            run(folder / "x", *(["-runs=1"] if "fuzzer" in command else []))

    return attempt


def says(*command: str) -> Callable[[Path], str]:
    """A trial that only asks for the version: of tools that come whole or not at all."""
    return lambda _: run(*command)


def _any_compiler(folder: Path) -> None:
    try:
        command = compiler()
    except NoCompiler as error:
        raise Missing(str(error).partition(":")[0]) from None
    compiles(" ".join(command))(folder)


def _vulkan(_: Path) -> None:
    if not viewers.graphics():
        raise Missing("rerun's headless viewer cannot draw")


def chromium() -> str:
    """The browser's command. Raises Missing."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if shutil.which(name):
            return name
    raise Missing("no chromium")


def _chromium(folder: Path) -> None:
    options = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}/c")
    (folder / "x.html").write_text("<p>drawn</p>")
    if "drawn" not in run(chromium(), *options, "--dump-dom", (folder / "x.html").as_uri()):
        raise Missing("it draws no page")


def _small_disk(folder: Path) -> None:
    run("mount", "-t", "tmpfs", "-o", "size=4096", "none", folder)
    run("umount", folder)


def _apt(*packages: str) -> str:
    return f"apt-get install {' '.join(packages)}"


_SANITIZED = "-fsanitize=address,undefined"
TOOLS = {
    tool.name: tool
    for tool in (
        Tool("C compiler", _any_compiler, _apt("gcc")),
        Tool("gcc", compiles("gcc"), _apt("gcc")),
        Tool("gcc -m32", compiles("gcc -m32"), _apt("gcc-multilib")),
        Tool(f"gcc {_SANITIZED}", compiles(f"gcc {_SANITIZED}"), _apt("gcc")),
        Tool("g++", compiles("g++", ".cpp"), _apt("g++")),
        Tool("clang", compiles("clang"), _apt("clang")),
        Tool("clang -m32", compiles("clang -m32"), _apt("clang", "gcc-multilib")),
        Tool("clang++", compiles("clang++", ".cpp"), _apt("clang", "g++")),
        Tool(f"clang {_SANITIZED}", compiles(f"clang {_SANITIZED}"), _apt("clang", "libclang-rt-dev")),
        Tool("clang -fsanitize=fuzzer", compiles("clang -fsanitize=fuzzer", source=FUZZED),
             _apt("clang", "libclang-rt-dev")),
        Tool("arm-none-eabi-gcc", compiles("arm-none-eabi-gcc -specs=nano.specs", runs=False),
             _apt("gcc-arm-none-eabi", "libnewlib-arm-none-eabi")),
        Tool("qemu-system-arm", says("qemu-system-arm", "--version"), _apt("qemu-system-arm")),
        Tool("make", says("make", "--version"), _apt("make")),
        Tool("cmake", says("cmake", "--version"), _apt("cmake")),
        Tool("Vulkan driver", _vulkan, _apt("libvulkan1", "mesa-vulkan-drivers")),
        Tool("chromium", _chromium, _apt("chromium")),
        Tool("pdftotext", says("pdftotext", "-v"), _apt("poppler-utils")),
        Tool("sigrok-cli", says("sigrok-cli", "--version"), _apt("sigrok-cli")),
        Tool("small disk", _small_disk, "run the tests as root"),
    )
}  # fmt: skip


@functools.cache
def missing(name: str) -> str:
    """Why a tool of TOOLS cannot be used here, "" if it can; tried once in a test run, whichever worker asks first."""
    run_id = os.environ.get("PYTEST_XDIST_TESTRUNUID")
    if run_id is None:
        return _tried(TOOLS[name])
    kept = Path(tempfile.gettempdir()) / f"hallbench-tests-{run_id}.tools"
    with kept.open("a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        known: dict[str, str] = dict(json.loads(line) for line in file)
        if name not in known:
            known[name] = _tried(TOOLS[name])
            file.write(json.dumps([name, known[name]]) + "\n")
    return known[name]


def _tried(tool: Tool) -> str:
    with tempfile.TemporaryDirectory() as folder:
        try:
            tool.attempt(Path(folder))
        except Missing as why:
            return str(why)
    return ""


def require(name: str) -> None:
    """Skip the running test where the tool is missing; with $HALLBENCH_REQUIRE_TOOLS fail it."""
    if why := missing(name):
        reason = f"needs {name}: {why}"
        if os.environ.get(REQUIRED):
            pytest.fail(reason)
        pytest.skip(reason)


def needs(*names: str) -> pytest.MarkDecorator:
    """A mark: the test is skipped where one of these tools is missing. Raises KeyError for one that is unknown."""
    return pytest.mark.needs(*(TOOLS[name].name for name in names))


def skipped_table(reasons: dict[str, int]) -> list[str]:
    """Lines of a table of what was skipped: how many tests, why, and the command that brings what is missing.

    Args:
        reasons: how many tests were skipped for each reason.
    """
    rows = [("tests", "skipped because", "brought by")]
    for reason, count in sorted(reasons.items()):
        found = re.match(r"needs (.+?): ", reason)
        tool = TOOLS.get(found[1]) if found else None
        rows.append((str(count), reason, tool.brought_by if tool else ""))
    widths = [max(len(row[k]) for row in rows) for k in range(3)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]

"""Code, memory and instructions of the device side in C on a Cortex-M4, as docs/firmware.md tells them.

    python -m tests.protocol.c.sizes            prints them
    python -m tests.protocol.c.sizes --write    and puts them into docs/firmware.md, between its two marks

Needs arm-none-eabi-gcc with newlib, and qemu-system-arm for the instructions.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
SOURCE = ROOT / "protocol" / "c"
BOARD = SOURCE / "examples" / "mps2-an386"
PAGE = ROOT / "docs" / "firmware.md"
BEGIN, END = "<!-- sizes -->\n", "<!-- end -->"
COMPILER = "arm-none-eabi-gcc"
CORE = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-std=c99")
FLAGS = (*CORE, "-Os", "-ffunction-sections", "-fdata-sections", "-DHBP_CHANNELS=8")
FILES = [SOURCE / "hbp.c", SOURCE / "hbp_capture.c", SOURCE / "hbp_means.c"]
LIMIT = 60.0  # s, for QEMU

COMMON = ("hbp_tick", "hbp_edge", "hbp_may_run", "hbp_raise", "hbp_fault", "hbp_log")
BYTES = (*COMMON, *(f"hbp_{name}" for name in ("link_init_sized", "add_sized", "rx", "poll", "tx_peek", "tx_advance")))
CAN = (
    *COMMON,
    *(f"hbp_can_{name}" for name in ("init_sized", "add_sized", "rx", "poll", "peek", "advance", "gave_up")),
)


@dataclass(frozen=True)
class Cost:
    """What a link costs: bytes. `helpers`: what comes from the compiler's and the C library, in `code`."""

    what: str
    code: int
    helpers: int
    link: int
    device: int

    @property
    def ram(self) -> int:
        """Bytes of the structures that an application owns."""
        return self.link + self.device


def _run(*command: str | Path) -> str:
    return subprocess.run([*map(str, command)], check=True, capture_output=True, text=True, timeout=LIMIT).stdout


def _sections(file: Path) -> int:
    """Bytes of flash."""
    sizes = _run("arm-none-eabi-size", "-A", file)
    listed = re.findall(r"^(\.text|\.rodata|\.data|\.ARM\.exidx)\S*\s+(\d+)", sizes, re.MULTILINE)
    return sum(int(size) for _, size in listed)


def _structures(folder: Path, flags: tuple[str, ...]) -> dict[str, int]:
    """Bytes of each structure that an application owns."""
    source, compiled = folder / "structures.c", folder / "structures.o"
    source.write_text('#include "hbp_can.h"\nstruct hbp_link link_; struct hbp_can can; struct hbp device;\n')
    _run(COMPILER, *flags, f"-I{SOURCE}", "-c", source, "-o", compiled)
    symbols = _run("arm-none-eabi-nm", "-S", compiled)
    return {name: int(size, 16) for size, name in re.findall(r"^\w+ (\w+) \w (\w+)$", symbols, re.M)}


def cost(what: str, can: bool, capture: bool, waveform: bool, means: bool = False) -> Cost:
    """Of a byte link, or of a classic CAN bus, compiled for size with 8 channels and otherwise as hbp.h is."""
    files = [*FILES, *([SOURCE / "hbp_can.c"] if can else [])]
    flags = (*FLAGS, f"-DHBP_CAPTURE={capture:d}", f"-DHBP_WAVEFORM={waveform:d}", f"-DHBP_MEANS={means:d}")
    keep = CAN if can else BYTES
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        elf = folder / "whole.elf"
        link = ("-nostartfiles", "-specs=nano.specs", "-Wl,--gc-sections", f"-Wl,-e,{keep[0]}")
        _run(COMPILER, *flags, *link, *(f"-Wl,-u,{each}" for each in keep), *files, "-o", elf)
        bare = folder / "bare.elf"  # the same without what the libraries give
        alone = ("-nostdlib", "-Wl,--gc-sections", "-Wl,--unresolved-symbols=ignore-all", f"-Wl,-e,{keep[0]}")
        _run(COMPILER, *flags, *alone, *(f"-Wl,-u,{each}" for each in keep), *files, "-o", bare)
        sizes = _structures(folder, flags)
        code = _sections(elf)
        return Cost(what, code, code - _sections(bare), sizes["can" if can else "link_"], sizes["device"])


def instructions() -> list[tuple[str, int, int]]:
    """Name, mean and most of some calls, counted on QEMU's Cortex-M4F; each time the same."""
    return _counted() + _counted("-DHBP_MEANS=1")


def _counted(*flags: str) -> list[tuple[str, int, int]]:
    with tempfile.TemporaryDirectory() as name:
        elf = Path(name, "cost.elf")
        files = (Path(__file__).with_name("cost.c"), BOARD / "start.c", *FILES, SOURCE / "hbp_can.c")
        link = ("-nostartfiles", "-specs=nano.specs", "-T", str(BOARD / "mps2.ld"), "-Wl,--gc-sections")
        _run(COMPILER, *FLAGS, *flags, *link, *files, "-o", elf)
        command = ["qemu-system-arm", "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "null"]
        command += ["-semihosting-config", "enable=on,target=native", "-icount", "shift=10,sleep=off"]
        command += ["-kernel", str(elf)]
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=LIMIT)
    lines = re.findall(r"^(.+)\t(\d+)\t(\d+)$", done.stdout + done.stderr, re.M)
    return [(what, int(mean), int(most)) for what, mean, most in lines]


def table(costs: list[Cost], counted: list[tuple[str, int, int]]) -> str:
    """Both tables, in Markdown."""

    def lines() -> Iterator[str]:
        yield "| bytes | code | of it libraries | structure of the link | of the device | RAM in all |"
        yield "|---|---|---|---|---|---|"
        for each in costs:
            yield f"| {each.what} | {each.code} | {each.helpers} | {each.link} | {each.device} | {each.ram} |"
        yield ""
        yield "| instructions | mean | most |"
        yield "|---|---|---|"
        for what, mean, most in counted:
            yield f"| {what} | {mean} | {most} |"

    return "".join(f"{line}\n" for line in lines())


def write(text: str) -> None:
    """Put the tables into the page."""
    before, mark, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not mark or not end:
        raise ValueError(f"no {BEGIN.strip()} … {END} in {PAGE}")
    PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


def costs() -> list[Cost]:
    """Of all links."""
    with_can, with_capture = ", hbp_can.c", ", hbp_capture.c"
    return [
        cost("byte link: hbp.c", False, False, False),
        cost(f"classic CAN: hbp.c{with_can}", True, False, False),
        cost(f"byte link with captures: hbp.c{with_capture}", False, True, False),
        cost(f"classic CAN with captures: hbp.c{with_can}{with_capture}", True, True, False),
        cost("byte link with captures and a waveform, as hbp.h is", False, True, True),
        cost("classic CAN with captures and a waveform", True, True, True),
        cost("byte link with captures, a waveform and means (HBP_MEANS=1): hbp_means.c, too", False, True, True, True),
    ]


if __name__ == "__main__":
    made = table(costs(), instructions())
    print(made, end="")
    if "--write" in sys.argv[1:]:
        write(made)

"""The device side in C under sanitizers: vectors, any frames, and interrupts between any two instructions."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from building import LARGE, ROOT, SANITIZED, SMALL, build, compiler, options, run

pytestmark = [pytest.mark.long("compiles with sanitizers")]

VECTORS = {file.stem: json.loads(file.read_text()) for file in (ROOT / "protocol" / "vectors").glob("*.json")}
AS_IN_VECTORS = {
    "RX_MAX": 1024, "TX_MAX": 1024, "TX_BYTES": 8192, "POOL_BYTES": 4096, "CAN_BYTES": 64, "CAN_MESSAGES": 512,
}  # fmt: skip
MANY_CHANNELS = {"HOSTS": 2, "CHANNELS": 60}
WITH_MEANS = MANY_CHANNELS | {"MEANS": 1}
SHAPES = [
    pytest.param("gcc", MANY_CHANNELS, "byte", 20_000, id="gcc, byte link"),
    pytest.param("gcc", MANY_CHANNELS, "can", 20_000, id="gcc, CAN"),
    pytest.param("clang", WITH_MEANS, "byte", 20_000, id="clang, byte link, means"),
    pytest.param("gcc", WITH_MEANS, "byte", 300_000, id="means, long", marks=pytest.mark.campaign("c")),
    pytest.param("gcc", MANY_CHANNELS, "byte", 300_000, id="gcc, byte link, long", marks=pytest.mark.campaign("c")),
    pytest.param("gcc", MANY_CHANNELS, "can", 500_000, id="gcc, CAN, long", marks=pytest.mark.campaign("c")),
    pytest.param("clang", SMALL, "byte", 100_000, id="clang, byte link, small", marks=pytest.mark.campaign("c")),
    pytest.param("clang", LARGE, "can", 100_000, id="clang, CAN FD, large", marks=pytest.mark.campaign("c")),
]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A program, made when it is first asked for."""
    folder = tmp_path_factory.mktemp("c")
    made: dict[tuple[str, ...], Path] = {}

    def program(*what: str, can: bool = True) -> Path:
        if what not in made:
            made[what] = build(folder / f"program{len(made)}", *what, can=can)
        return made[what]

    return program


# -- vectors ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def replay(built: Callable[..., Path]) -> Callable[[list[str]], list[list[str]]]:
    """Runs a script; what the drive told after each line, first how many damaged frames there were, in hexadecimal."""
    program = built("gcc", "replay.c", "-O1", *SANITIZED, *options(AS_IN_VECTORS))

    def replay(lines: list[str]) -> list[list[str]]:
        told = [line.split(" ") for line in run(program, text="\n".join([*lines, ""])).splitlines()]
        assert len(told) == len(lines)
        return told

    return replay


def test_vectors_do_no_harm(replay: Callable[[list[str]], list[list[str]]]) -> None:
    """All of them, requests or not. What a drive answers, tests/protocol/test_vectors.py compares."""
    lines, damaged = [], {}
    for case in VECTORS["framing"]:
        for cut in {0, len(case["wire_hex"]) // 4 * 2, 2}:
            lines += ["new 1", f"rx {case['wire_hex'][:cut]}", f"rx {case['wire_hex'][cut:]}"]
            damaged[len(lines) - 1] = case
    for case in VECTORS["exchanges"]:
        for features in ("1", "69"):  # and with captures, meanings and a waveform
            lines += [f"new {features}", *[f"rx {case['request_hex']}"] * 2, "fault 2", f"rx {case['request_hex']}"]
    for case in VECTORS["sequences"]:
        lines += [f"new {case['features']:x}", *(f"rx {step['request_hex']}" for step in case["steps"])]
    for case in (*VECTORS["messages"], *VECTORS["streams"]):
        lines += [f"rx {wire}" for wire in (case["wire_hex"] if "config" in case else [case["wire_hex"]])]
    for case in (*VECTORS["can_messages"], *VECTORS["can_streams"]):
        fd = case.get("fd", case.get("config", {}).get("fd", False))
        lines.append(f"bus {fd:x} {case.get('extended', False):x}")
        for number, data in case["frames"]:
            lines += [f"can {identifier:x} {data}" for identifier in (number, number & ~0x700 | 0x200, 0x210)]
    told = replay(lines)
    for k, case in damaged.items():
        assert int(told[k][0], 16) == (case["verdict"] not in ("ok", "nothing")), case["name"]


# -- whatever comes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "values", "link", "frames"), SHAPES)
def test_any_frames(built: Callable[..., Path], name: str, values: dict[str, int], link: str, frames: int) -> None:
    said = run(built(name, "fuzz.c", "-O1", *SANITIZED, *options(values)), link, str(frames), "1")
    assert said.startswith(f"{frames} frames, ")


def test_frames_for_a_32_bit_core(built: Callable[..., Path]) -> None:
    program = built("gcc", "fuzz.c", "-m32", "-O2", "-DHBP_MEANS=1")
    for link in ("byte", "can"):
        run(program, link, "10000", "2")


@pytest.mark.campaign("c")
def test_a_fuzzer_that_looks_for_new_paths(built: Callable[..., Path], tmp_path: Path) -> None:
    compiler("clang", "-fsanitize=fuzzer")
    flags = ("-O1", "-fsanitize=fuzzer", *SANITIZED[1:2], "-fno-sanitize-recover=all")
    program = built("clang", "fuzz.c", *flags, "-DLIBFUZZER", "-DHBP_HOSTS=2")
    run(program, "-runs=1000", "-seed=1", "-max_len=4096", "-len_control=0", f"-artifact_prefix={tmp_path}/")


# -- interrupts -------------------------------------------------------------------------------------------------------


@pytest.fixture
def interrupts(built: Callable[..., Path]) -> Path:
    return built("gcc", "interrupts.c", "-O2", "-Wall", "-Wextra", "-Werror", "-g", "-DHBP_CHANNELS=8", can=False)


@pytest.mark.parametrize("steps", ["60000", pytest.param("300000", marks=pytest.mark.campaign("c"))])
def test_an_interrupt_between_any_two_instructions(interrupts: Path, steps: str) -> None:
    said = run(interrupts, "step", steps, "4")
    assert re.match(r"[1-9]\d* sessions", said)


@pytest.mark.real_time
def test_a_timer_interrupts(interrupts: Path) -> None:
    said = run(interrupts, "timer", "1", "1")
    assert re.match(r"[1-9]\d* sessions", said)

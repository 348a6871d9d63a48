"""The device side in C compiles without a warning wherever it may be put."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest
from building import FILES, LARGE, SMALL, SOURCE, STRICT, compiler, options, run

from tests.choice import sampled

pytestmark = pytest.mark.slow

CORTEX_M4 = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-std=c99", "-Os")


def compile_all(folder: Path, name: str, *flags: str) -> None:
    for file in FILES:
        run(compiler(name, *flags), *flags, *STRICT, "-c", SOURCE / file, "-o", folder / "x.o")


@pytest.mark.parametrize(
    ("name", "standard", "bits"),
    sampled("compiler", product(("gcc", "clang"), ("c99", "c11"), ("-m32", "-m64")), 2, campaign="c"),
)
def test_compiles_without_a_warning(tmp_path: Path, name: str, standard: str, bits: str) -> None:
    compile_all(tmp_path, name, f"-std={standard}", bits, "-O1")


@pytest.mark.parametrize(("name", "bits", "values"), [("gcc", "-m32", SMALL), ("clang", "-m64", LARGE)])
def test_compiles_with_other_options(tmp_path: Path, name: str, bits: str, values: dict[str, int]) -> None:
    compile_all(tmp_path, name, "-std=c99", bits, "-O1", *options(values))


@pytest.mark.parametrize("values", [{"CAPTURE": 0}, {"WAVEFORM": 0}, {"MEANS": 1}, {"MEANS": 1, "PORTABLE": 1}])
def test_compiles_without_what_is_optional(tmp_path: Path, values: dict[str, int]) -> None:
    compile_all(tmp_path, "gcc", "-std=c99", "-O1", *options(values))


def test_options_that_cannot_be_do_not_compile(tmp_path: Path) -> None:
    for wrong in ("TX_BYTES=1000", "RX_MAX=127", "EDGES=12", "CHANNELS=500", "POOL_BYTES=500", "CAPTURE=2", "MEANS=2"):
        with pytest.raises(AssertionError, match="hbp_check_"):
            run(compiler("gcc"), "-std=c99", "-fsyntax-only", f"-DHBP_{wrong}", SOURCE / "hbp.c")


def test_an_options_file(tmp_path: Path) -> None:
    (tmp_path / "mine.h").write_text("#define HBP_TX_MAX 512\n#define HBP_TX_BYTES 2048\n#define HBP_POOL_BYTES 2048\n")
    flags = (f"-I{tmp_path}", '-DHBP_OPTIONS="mine.h"', "-fsyntax-only")
    run(compiler("gcc"), "-std=c99", *flags, *STRICT, SOURCE / "hbp.c")


@pytest.mark.parametrize("name", ["g++", "clang++"])
def test_cxx_takes_the_headers(tmp_path: Path, name: str) -> None:
    (tmp_path / "x.cpp").write_text('#include "hbp_can.h"\nhbp_link a; hbp_can b; hbp c;\n')
    run(compiler(name), "-std=c++11", *STRICT, f"-I{SOURCE}", "-c", tmp_path / "x.cpp", "-o", tmp_path / "x.o")


@pytest.mark.parametrize("link", [(), ("-DEXAMPLE_CAN",)], ids=["serial", "CAN"])
def test_the_stm32g4_example_compiles(tmp_path: Path, link: tuple[str, ...]) -> None:
    main = SOURCE / "examples" / "stm32g4" / "main.c"
    run(compiler("arm-none-eabi-gcc"), *CORTEX_M4, *STRICT, *link, "-c", main, "-o", tmp_path / "x.o")


def test_the_posix_example_compiles_without_a_warning(tmp_path: Path) -> None:
    for name in ("gcc", "clang"):
        main = SOURCE / "examples" / "posix.c"
        run(compiler(name), "-std=c99", "-O1", *STRICT, "-c", main, "-o", tmp_path / "x.o")

"""What lets other build systems take the device side in C, and that an installed hallbench has it."""

from __future__ import annotations

import json
import re
import subprocess
import tomllib
from pathlib import Path

import pytest
from building import FILES, LIMIT, ROOT, SOURCE, compiler, run

import protocol
from tests.tools import require

pytestmark = pytest.mark.slow

VERSION = protocol.__version__
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
C_FILES = {*FILES}


def kept_files() -> list[Path]:
    """All of protocol/c that is under version control, relative to it; all that is there where nothing is."""
    listed = subprocess.run(["git", "-C", SOURCE, "ls-files"], capture_output=True, text=True)
    if listed.returncode:
        return [file.relative_to(SOURCE) for file in SOURCE.rglob("*") if file.is_file() and file.suffix != ".elf"]
    return [Path(line) for line in listed.stdout.splitlines()]


def properties() -> dict[str, str]:
    lines = (SOURCE / "library.properties").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines)


def test_all_tell_the_same_version() -> None:
    assert json.loads((SOURCE / "library.json").read_text())["version"] == VERSION
    assert properties()["version"] == VERSION
    assert f"project(hbp VERSION {VERSION} " in (SOURCE / "CMakeLists.txt").read_text()


def test_a_wheel_ships_all_of_it() -> None:
    """Each file fits a pattern of package-data, as setuptools reads them: `**` is any number of folders."""
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["protocol"]
    shipped = {file for pattern in patterns for file in (ROOT / "protocol").glob(pattern)}
    assert {SOURCE / file for file in kept_files()} <= shipped


def test_the_platformio_manifest() -> None:
    """The fields that its manual asks for; the sources that it compiles are the right ones."""
    manifest = json.loads((SOURCE / "library.json").read_text())
    assert {"name", "version", "description", "keywords", "authors", "license"} < set(manifest)
    assert re.fullmatch(r"[\w.-]{1,50}", manifest["name"])
    assert len(manifest["description"]) <= 255
    assert manifest["build"]["srcFilter"] == [f"+<{name}>" for name in sorted(C_FILES)]
    for header in manifest["headers"]:
        assert (SOURCE / manifest["build"]["includeDir"] / header).is_file()


def test_the_arduino_properties_and_layout() -> None:
    """Without a folder `src`, Arduino compiles what lies in the library's own folder and in `utility`."""
    fields = properties()
    required = ("name", "version", "author", "maintainer", "sentence", "paragraph", "category", "url", "architectures")
    assert all(fields[name] for name in required)
    assert fields["category"] in ("Communication", "Device Control", "Signal Input/Output", "Other")
    assert fields["name"] == json.loads((SOURCE / "library.json").read_text())["name"]
    assert not (SOURCE / "src").exists()
    assert not (SOURCE / "utility").exists()
    assert {file.name for file in SOURCE.glob("*.c*")} == C_FILES


def test_cmake_builds_library_and_example_in_a_project_with_options_of_its_own(tmp_path: Path) -> None:
    cmake, build = compiler("cmake"), tmp_path / "build"
    require("C compiler")
    (tmp_path / "mine.h").write_text("#define HBP_CHANNELS 3\n")
    (tmp_path / "main.c").write_text(
        '#include "hbp_can.h"\n_Static_assert(HBP_CHANNELS == 3, "mine");\nstruct hbp_can can;\n'
        "int main(void) { struct hbp_can_bus bus = {0}; hbp_can_init(&can, &bus); return 0; }\n"
    )
    (tmp_path / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.13)\nproject(firmware C)\n"
        f"add_subdirectory({SOURCE} hbp)\nadd_executable(firmware main.c)\ntarget_link_libraries(firmware hbp)\n"
    )
    run(cmake, "-S", tmp_path, "-B", build, f"-DHBP_OPTIONS={tmp_path / 'mine.h'}", "-DHBP_CAN=ON", "-DHBP_EXAMPLES=ON")
    run(cmake, "--build", build)
    run(build / "firmware")
    with subprocess.Popen([build / "hbp" / "drive"], stdout=subprocess.PIPE, text=True) as drive:
        assert drive.stdout is not None
        assert drive.stdout.readline().startswith("target: serial:/dev/")
        drive.kill()


@pytest.mark.parametrize("can", ["y", "n"])
def test_the_zephyr_module_names_what_there_is(tmp_path: Path, can: str) -> None:
    """Zephyr's own functions stand here for themselves; each option has its default of hbp.h."""
    kconfig = (SOURCE / "zephyr" / "Kconfig").read_text()
    defaults = dict(
        re.findall(r"^config (HBP_\w+)\n\tint .*\n(?:\trange .*\n)?\tdefault (\d+)$", kconfig, re.MULTILINE)
    )
    headers = "".join((SOURCE / name).read_text() for name in ("hbp.h", "hbp_can.h"))
    told = dict(re.findall(r"^#ifndef (HBP_\w+)\n#define \1 (\d+)", headers, re.MULTILINE))
    assert defaults == {name: value for name, value in told.items() if name != "HBP_CRC_TABLE"}
    module = (SOURCE / "zephyr" / "module.yml").read_text()
    assert re.search(r"^name: hbp\nbuild:\n  cmake: zephyr\n  kconfig: zephyr/Kconfig$", module, re.MULTILINE)
    script = tmp_path / "zephyr.cmake"
    lines = [f"set(CONFIG_{name} {value})" for name, value in defaults.items()]
    lines += ["set(CONFIG_HBP y)", f"set(CONFIG_HBP_CAN {can})"]
    for function in ("library_named", "library_sources", "include_directories", "compile_definitions"):
        lines += [f"function(zephyr_{function})", f'  message("{function} ${{ARGN}}")', "endfunction()"]
    script.write_text("\n".join([*lines, f"include({SOURCE / 'zephyr' / 'CMakeLists.txt'})\n"]))
    done = subprocess.run([compiler("cmake"), "-P", script], capture_output=True, text=True, timeout=LIMIT)
    assert done.returncode == 0, done.stderr
    sources = re.findall(r"^library_sources (.*)$", done.stderr, re.MULTILINE)
    assert {Path(file).name for file in sources} == (C_FILES if can == "y" else C_FILES - {"hbp_can.c"})
    assert all(Path(file).is_file() for file in sources)
    assert "compile_definitions HBP_CHANNELS=16" in done.stderr
    assert ("HBP_CAN_BYTES=8" in done.stderr) == (can == "y")

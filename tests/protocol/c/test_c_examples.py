"""The examples of the device side in C, as whole drives for `bench`: a process on a pty, a Cortex-M4F in QEMU."""

from __future__ import annotations

import ctypes
import itertools
import json
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import IO

import pytest
from building import LIMIT, SOURCE, compiler, run

from protocol.signals import HallSwap, hall_map
from tests.bench.processes import Program

pytestmark = [pytest.mark.real_time, pytest.mark.long("whole processes in real time, some up to three times")]
EXAMPLES = SOURCE / "examples"
OWN = SOURCE / "hbp.c", SOURCE / "hbp_capture.c"
MPS2 = EXAMPLES / "mps2-an386"
SETTLED = ("--viewer", "none", "--json", "-")
PR_SET_PDEATHSIG = 1
QEMU = pytest.mark.campaign("qemu")
_libc = ctypes.CDLL(None)


def ends_with_this() -> None:
    """In a child: it is killed when its parent is gone."""
    _libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


@pytest.fixture
def start() -> Iterator[Callable[..., Program]]:
    """Start `bench …`."""
    with ExitStack() as started:
        yield lambda *arguments: started.enter_context(closing(Program("bench", *arguments)))


def target_in(output: IO[str]) -> str:
    """The port that a drive says it is at, in the first line it prints."""
    match = re.search(r"(/dev/pts/\d+)", output.readline())
    assert match, "the drive did not say where it is"
    return f"serial:{match[1]}"


@pytest.fixture(scope="module")
def on_a_pty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """examples/posix.c, built as its first comment says."""
    comment = (EXAMPLES / "posix.c").read_text().partition("*/")[0]
    line = re.search(r"^ \* +cc (.*) -o drive (.*) && \./drive$", comment, re.MULTILINE)
    assert line, "no line that builds it"
    program = tmp_path_factory.mktemp("posix") / "drive"
    run(compiler("gcc"), *line[1].split(), "-o", program, *(SOURCE / file for file in line[2].split()))
    return program


@pytest.fixture(scope="module")
def in_qemu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bare-metal example, built by its Makefile."""
    compiler("arm-none-eabi-gcc")
    compiler("qemu-system-arm")
    elf = tmp_path_factory.mktemp("mps2") / "drive.elf"
    run(compiler("make"), "-C", MPS2, f"OUT={elf}")
    return elf


@pytest.fixture(params=["posix", pytest.param("mps2-an386", marks=QEMU)])
def target(request: pytest.FixtureRequest) -> Iterator[str]:
    """A drive that runs; killed at the end of the test, and when the tests are."""
    if request.param == "posix":
        command = [str(request.getfixturevalue("on_a_pty"))]
    else:
        command = ["qemu-system-arm", "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "pty"]
        command += ["-device", "loader,addr=0x203FFFF0,data=0x5EED,data-len=4"]
        command += ["-kernel", str(request.getfixturevalue("in_qemu"))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=ends_with_this) as drive:
        try:
            assert drive.stdout is not None
            yield target_in(drive.stdout)
            assert drive.poll() is None
        finally:
            drive.kill()


def told(program: Program) -> dict:
    """What a command wrote as JSON; it must have done well."""
    assert program.end() == 0, program.err
    return json.loads("\n".join(program.out))


def health(start: Callable[..., Program], target: str) -> dict:
    (node,) = told(start("info", target, "--json", "-"))["nodes"]
    return node["health"]


def test_a_drive_is_known_turns_loses_nothing_and_stops(start: Callable[..., Program], target: str) -> None:
    (node,) = told(start("info", target, "--json", "-"))["nodes"]
    assert node["identity"]["features"] == ["edges", "simulated", "capture", "meanings"]
    assert [channel["name"] for channel in node["channels"]][:4] == ["hall", "status", "theta_enc", "omega_enc"]
    assert node["health"]["state"] == "IDLE"
    for _ in range(3):  # in real time, whoever takes the machine for long makes a drive drop samples, or trip
        program = start("live", target, "--speed", "300", "--duration", "2", "--clear-faults", *SETTLED)
        if program.end() == 0 and not any(told(program)["lost"].values()):
            break
    run_ = told(program)
    assert run_["result"] == "ok"
    assert not any(run_["lost"].values())
    rate = node["identity"]["pwm_hz"]
    assert run_["samples"] >= 1.9 * rate
    assert 2 * 60 < run_["edges"] < 3 * 130  # 300 r/min, 4 pole pairs: 120 edges/s once it turns
    assert not any(run_["link"][count] for count in ("damaged", "reboots", "out_of_order", "late"))
    after = health(start, target)
    assert (after["state"], after["outputs_on"], after["faults"]) == ("IDLE", False, [])


def test_the_watchdog_turns_off_what_a_killed_host_left(start: Callable[..., Program], target: str) -> None:
    live = start("live", target, "--speed", "300", "--viewer", "none")
    live.line("RUNNING, [1-9]")
    live.send(signal.SIGKILL)
    live.process.wait(LIMIT)
    left = health(start, target)
    assert (left["state"], left["outputs_on"], left["faults"]) == ("FAULT", False, ["WATCHDOG"])


def test_every_wiring_is_put_right_as_in_the_specification(tmp_path: Path) -> None:
    """motor_code over all input words, for each swap and inversion."""
    (tmp_path / "codes.c").write_text(
        """
        #define MOTOR_TICK_HZ 10000000u
        #define MOTOR_PWM_HZ 10000u
        #define MOTOR_NAME ""
        #include "motor.h"
        #include <stdio.h>
        int main(void)
        {
            int n;
            for (n = 0; n < 6 * 8 * 8; n++) {
                motor.hall_swap = (float)(n / 64);
                motor.hall_invert = (float)(n / 8 % 8);
                printf("%d ", motor_code((uint8_t)(n % 8)));
            }
            return motor_config.n_channels == 0;
        }
        """
    )
    program = tmp_path / "codes"
    run(compiler("gcc"), f"-I{EXAMPLES}", "-Wno-unused-function", "-o", program, tmp_path / "codes.c", *OWN)
    codes = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
    wirings = itertools.product(HallSwap, range(8))
    assert list(map(int, codes)) == [code for swap, invert in wirings for code in hall_map(swap, invert)]


@pytest.mark.campaign("c")
def test_its_hall_sensors_are_healthy(start: Callable[..., Program], on_a_pty: Path) -> None:
    with subprocess.Popen([on_a_pty], stdout=subprocess.PIPE, text=True, preexec_fn=ends_with_this) as drive:
        assert drive.stdout is not None
        try:
            check = start("hall", "check", target_in(drive.stdout), "--yes")
            assert check.end() == 0, check.out + check.err
        finally:
            drive.kill()
    assert any(line.startswith("HEALTHY") for line in check.out)


@pytest.mark.parametrize("target", [pytest.param("mps2-an386", marks=QEMU)], indirect=True)
def test_it_conforms_and_is_never_blamed(start: Callable[..., Program], target: str) -> None:
    for _ in range(3):  # as above
        program = start("conform", target, "--level", "4", "--yes", "--json", "-")
        code = program.end(4 * LIMIT)  # 90 s on an idle machine
        verdicts = [check["verdict"] for check in json.loads("\n".join(program.out))["checks"]]
        assert "failed" not in verdicts, program.out
        if code == 0:
            break
    assert told(program)["conforms_at_level"] == 4
    assert verdicts.count("passed") > 140

"""`bench` where only what Windows has is there: tests/windows hides the rest, and refuses what Windows refuses.

No Windows runs here. What it says of a serial port is in tests/protocol/links/test_serial_link.py; that nothing is used
that it lacks is seen by `mypy --platform win32` too.
"""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import ENVIRONMENT, LIMIT, Program, Sim

from bench.record.reader import Run
from tests.choice import sampled

pytestmark = [pytest.mark.real_time, pytest.mark.long("drive and host in real time, several programs")]

ROOT = Path(__file__).parents[2]
PLACE = ROOT / "tests" / "windows"
SIGBREAK = 21  # Ctrl-Break, by Windows' number
PATIENT = ("--set", "firmware.watchdog=1.0", "--set", "load.watchdog=1.0")
Start = Callable[..., Program]
StartSim = Callable[..., Sim]


@pytest.fixture
def windows(tmp_path: Path) -> dict[str, str]:
    """Variables with which a program finds itself on such a machine; ASCII is its encoding, and output's cp1252."""
    return {
        "PYTHONPATH": f"{PLACE}{os.pathsep}{ROOT}", "HALLBENCH_TESTS_WINDOWS": str(tmp_path), "LC_ALL": "C",
        "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "cp1252",
    }  # fmt: skip


def bench(*arguments: str, more: Mapping[str, str]) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "bench", *arguments]
    return subprocess.run(
        command, env={**ENVIRONMENT, **more}, stdin=subprocess.DEVNULL, capture_output=True, timeout=LIMIT
    )


def files_of(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize(
    ("number", "code"), sampled("end", [(signal.SIGINT, 130), (SIGBREAK, 149)], 1, campaign="windows")
)
def test_a_recorded_run_over_tcp_ends_with_the_outputs_off_however_it_is_ended(
    start: Start, start_sim: StartSim, windows: dict[str, str], tmp_path: Path, number: int, code: int
) -> None:
    sim = start_sim("--tcp", "127.0.0.1:0", *PATIENT, more=windows)
    save, summary = tmp_path / "a.run", tmp_path / "a.json"
    spin = ("--speed", "500", "--yes", "--viewer", "none", "--save", str(save), "--json", str(summary))
    live = start("live", sim.target, *spin, more=windows)
    sim.line("^outputs on")
    marked = bench("mark", str(save), "grease heard", more=windows)
    assert marked.returncode == 0, marked.stderr
    other = bench("mark", str(save), "--at", "0.1", "too early", more=windows)
    assert b"is being recorded: omit --at" in other.stderr or b"has no 0.1 s" in other.stderr
    second = bench("live", sim.target, "--speed", "500", "--yes", "--viewer", "none", more=windows)
    assert (second.returncode, b"is in use by another run" in second.stderr) == (2, True)
    live.send(number)  # type: ignore[arg-type]
    assert live.end() == code, live.err
    sim.line("^outputs off: STOP")
    told = json.loads(summary.read_text())
    assert any(re.search("outputs at the end +off, by the drive's heartbeat", line) for line in live.out)
    run = Run(save)
    assert not run.being_written
    assert run.damage == []
    assert [mark.name for mark in run.marks] == ["grease heard"]
    assert len(run.samples) == told["samples"] > 8000
    assert (np.diff(run.samples.index) > 0).all()
    assert not [name for name in files_of(save) if name.endswith(".part") or "journal" in name]
    sim.send(SIGBREAK)  # type: ignore[arg-type]
    assert sim.end() == 0
    assert any(line.startswith("stopped after") for line in sim.out)


KINDS = {
    "serial": ["--pty"],
    "serial, as a UART": ["--pty", "--baud", "3000000"],
    "CAN FD": ["--slcan", "--fd", "--data-bitrate", "8000000"],
}


@pytest.mark.parametrize("where", sampled("kind", KINDS, 1, campaign="windows"))
def test_a_port_is_read_and_written_by_pyserial_alone(
    start: Start, start_sim: StartSim, windows: dict[str, str], tmp_path: Path, where: list[str]
) -> None:
    """The drive runs on a machine as it is: there are no ptys on the other."""
    sim = start_sim(*where, *PATIENT)
    save = tmp_path / "a.run"
    spin = ("--speed", "500", "--yes", "--duration", "2", "--viewer", "none", "--save", str(save), "--fit")
    live = start("live", sim.target, *spin, more=windows)
    assert live.end() == 0, live.err
    run = Run(save)
    gaps = np.diff(run.samples.index) != run.samples.config.decimation
    assert len(run.samples) > 500
    assert gaps.mean() < 0.01


WITH_PTY = {"--pty": ["--pty"], "--slcan": ["--slcan"], "--baud": ["--baud", "115200"], "--link": ["--link", "drive"]}


@pytest.mark.parametrize("option", sampled("pty", WITH_PTY, 1, campaign="windows"))
def test_a_machine_without_ptys_says_what_to_use(windows: dict[str, str], option: list[str]) -> None:
    done = bench("sim", *option, more=windows)
    assert (done.returncode, done.stdout) == (2, b"")
    words = f"error: {option[0]}: this system has no pseudo terminals: serve on TCP, bench sim --tcp 127.0.0.1:7000"
    assert done.stderr.decode() == words + "\n"


def test_there_tcp_is_where_the_simulated_drive_is_by_itself(start_sim: StartSim, windows: dict[str, str]) -> None:
    assert re.fullmatch(r"tcp:127\.0\.0\.1:\d+", start_sim(more=windows).target)


COMMANDS: dict[str, tuple[tuple[str, ...], Callable[[Any], Any]]] = {
    "accept": (("accept", "sim", "-k", "stop", "--report", "{}/report", "--json", "{}/a.json"),
               lambda told: [(test["name"], test["verdict"]) for test in told["tests"]]),
    "hall check": (("hall", "check", "sim", "--json", "{}/a.json"), lambda told: (told["outcome"], told["wiring"])),
    "info": (("info", "sim", "--json", "{}/a.json"), lambda told: [node["channels"] for node in told["nodes"]]),
}  # fmt: skip


@pytest.mark.parametrize(("arguments", "of"), sampled("command", COMMANDS, 1, campaign="windows"))
def test_a_command_gives_what_it_gives_elsewhere(
    windows: dict[str, str], tmp_path: Path, arguments: tuple[str, ...], of: Callable[[Any], Any]
) -> None:
    seen = []
    for name, more in (("here", {}), ("there", windows)):
        (tmp_path / name).mkdir()
        done = bench(*(text.format(tmp_path / name) for text in arguments), more=more)
        told = json.loads((tmp_path / name / "a.json").read_text())
        seen.append((done.returncode, of(told), files_of(tmp_path / name)))
    assert seen[0] == seen[1]


FORMS = (".csv", ".npz", ".parquet", ".mat", ".mf4")


@pytest.mark.parametrize("form", sampled("form", FORMS, 0, campaign="windows"))
def test_an_export_has_the_bytes_that_it_has_elsewhere(
    windows: dict[str, str], tmp_path: Path, drive_run: Path, form: str
) -> None:
    for name, more in (("here", {}), ("there", windows)):
        (tmp_path / name).mkdir()
        done = bench("export", str(drive_run), "-o", str(tmp_path / name / f"x{form}"), more=more)
        assert done.returncode == 0, done.stderr
    names = files_of(tmp_path / "here")
    assert names == files_of(tmp_path / "there")
    for name in names if form in (".csv", ".parquet") else ():  # the others hold the moment of writing
        assert (tmp_path / "here" / name).read_bytes() == (tmp_path / "there" / name).read_bytes()


@pytest.mark.parametrize(("encoding", "key"), [("cp1252", "Größe µ in Ohm"), ("ascii", r"Gr\xf6\xdfe u in Ohm")])
def test_the_drive_s_own_words_are_read_whatever_the_terminal_can_show(
    windows: dict[str, str], tmp_path: Path, encoding: str, key: str
) -> None:
    file = tmp_path / "m.toml"
    file.write_text('[motor]\n"Größe µ in Ω" = 3\n', encoding="utf-8")
    done = bench("live", "--config", str(file), "--viewer", "none", more={**windows, "PYTHONIOENCODING": encoding})
    assert done.returncode == 2
    assert done.stderr.decode(encoding).startswith(f"error: unknown key motor.{key} in m.toml; allowed here: R_s")


def viewers(run: Path) -> list[int]:
    """Processes of rerun that show something of the folder of `run`, or of a temporary one made for it."""
    found = []
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = place.read_bytes().split(b"\0")
        except OSError:
            continue
        if Path(words[0].decode()).name == "rerun" and any(os.fsencode(run) in word for word in words):
            found.append(int(place.parent.name))
    return found


@pytest.mark.parametrize("number", sampled("view", [signal.SIGINT, SIGBREAK, signal.SIGKILL], 1, campaign="windows"))
def test_a_viewer_ends_with_the_program_that_shows_a_run(
    start: Start, windows: dict[str, str], tmp_path: Path, drive_run: Path, number: int
) -> None:
    place = tmp_path / "shown"
    place.mkdir()
    view = start("view", str(drive_run), "--viewer", "web", more={**windows, "TMPDIR": str(place)})
    view.line("^dashboard: http")
    assert viewers(place)
    view.send(number)  # type: ignore[arg-type]
    view.end()
    end = time.monotonic() + LIMIT
    while viewers(place):
        assert time.monotonic() < end, "the viewer outlives it"
        time.sleep(0.02)


PROBE = """
import sys
from bench.rig.person import asked
with asked("block the shaft") as answered:
    print("asked", flush=True)
    print(answered(0.05), flush=True)
    print(answered(30.0), flush=True)
"""


def test_what_was_typed_before_a_question_is_no_answer(windows: dict[str, str]) -> None:
    controller, terminal = pty.openpty()
    os.write(controller, b"typed too early\n")
    command = [sys.executable, "-c", PROBE]
    with subprocess.Popen(
        command, stdin=terminal, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env={**ENVIRONMENT, **windows}
    ) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"asked\n"
        assert program.stdout.readline() == b"False\n"
        os.write(controller, b"done\n")
        assert program.stdout.readline() == b"True\n"
    os.close(controller)
    os.close(terminal)


HELD = """
import sys
from pathlib import Path
from bench.system import removed
file = Path(sys.argv[1])
with file.open("rb") as held:
    print(removed(file), file.exists())
print(removed(file), file.exists(), removed(file))
"""


def test_a_file_that_is_open_stays_until_it_is_closed(windows: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    command = [sys.executable, "-c", HELD, str(tmp_path / "x")]
    told = subprocess.run(command, env={**ENVIRONMENT, **windows}, capture_output=True, check=True, text=True)
    assert told.stdout.split() == ["False", "True", "True", "False", "True"]


def test_memory_is_what_is_free_by_windows_own_account(windows: dict[str, str]) -> None:
    told = subprocess.run(
        [sys.executable, "-c", "from bench.record.memory import available; print(available())"],
        env={**ENVIRONMENT, **windows}, capture_output=True, check=True, text=True,
    )  # fmt: skip
    assert int(told.stdout) == 3 << 30

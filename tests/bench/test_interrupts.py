"""Ctrl-C at some moments of every command: no crash, no traceback, exit code 130, and no process left behind.

`HALLBENCH_INTERRUPTS` sets how many for each command; a hundred take a quarter of an hour.
"""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import threading
import time
import uuid
import weakref
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
from processes import ENVIRONMENT, LIMIT
from test_prompt import on_terminal

from bench.rig.interrupts import none_dropped
from tests.bench.often_interrupted import OF
from tests.choice import CAMPAIGN, sampled

pytestmark = pytest.mark.slow

MOMENTS = int(os.environ.get("HALLBENCH_INTERRUPTS", "6" if os.environ.get(CAMPAIGN) else "2"))
AT_ONCE = 3  # processes: more would starve each other
LONGEST = 3.0  # s of a command's life in which it is interrupted
SOON = 10.0  # s from Ctrl-C to the end, on a busy machine
COMPILING = (0.8, 1.2)  # s after the start
READY = "import sys; from bench.__main__ import main; print('ready', flush=True); main()"
"""What `bench` runs, with a line when it is called: until then, Ctrl-C is Python's own business."""
INTERRUPTED = (130, -signal.SIGINT)  # a shell shows 130 for both
COMMANDS: dict[str, Sequence[str]] = {
    "live": ("live", "sim", "--speed", "300", "--viewer", "none", "--duration", "60", "--save", "NEW"),
    "info": ("info", "SIM"),
    "hall check": ("hall", "check", "sim"),
    "hall learn": ("hall", "learn", "sim"),
    "accept": ("accept",),
    "sim": ("sim", "--pty"),
    "score": ("score", "RUN"),
    "replay": ("replay", "RUN", "-o", "NEW"),
    "devices": ("devices", "SIM"),
}


@dataclass
class Ended:
    """How a command ended that was interrupted `moment` s after it could be."""

    moment: float
    code: int
    text: str
    seconds: float
    """From the signal to the end; from the start, if it ended before."""
    left: list[int]
    """Processes that it left behind."""


def interrupted(command: Sequence[str], moment: float, limit: float = SOON, **more: str) -> Ended:
    """Run a command, interrupt it and look what is left."""
    mark = f"HALLBENCH_TEST_MARK={uuid.uuid4()}"
    name, _, value = mark.partition("=")
    process = subprocess.Popen(
        [sys.executable, "-c", READY, *command],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**ENVIRONMENT, **more, name: value},
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    since = time.monotonic()
    with suppress(subprocess.TimeoutExpired):
        process.wait(moment)
    if process.poll() is None:
        since = time.monotonic()
        process.send_signal(signal.SIGINT)
    try:
        text, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        process.kill()
        text = f"still there {limit:g} s after Ctrl-C: {process.communicate()[0]}"
    seconds = time.monotonic() - since
    end = time.monotonic() + limit
    while (left := _with(mark)) and time.monotonic() < end:
        time.sleep(0.02)
    return Ended(moment, process.returncode, text, seconds, left)


def _with(mark: str) -> list[int]:
    """Processes with a variable in their environment."""
    found = []
    for place in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if mark.encode() in place.read_bytes().split(b"\0"):
                found.append(int(place.parent.name))
    return found


def check(ended: Ended, *codes: int) -> None:
    """No crash, no traceback, one of these exit codes, nothing left."""
    assert ended.code in codes, ended
    assert not any(word in ended.text for word in ("Traceback", "Exception ignored", "Fatal")), ended
    assert ended.left == [], ended


LATE = pytest.mark.campaign("interrupts")
ENERGISING = sampled("interrupts", ("live", "accept", "hall check"), 1, campaign="interrupts")
OTHERS = [pytest.param(name, marks=LATE) for name in COMMANDS if name not in ("live", "accept", "hall check")]


@pytest.mark.long("a process for each moment")
@pytest.mark.parametrize("name", ENERGISING + OTHERS)
def test_ctrl_c_ends_a_command_at_any_moment(name: str, drive_run: Path, tmp_path: Path, start_sim: object) -> None:
    known = {"RUN": str(drive_run)}
    if "SIM" in COMMANDS[name]:
        known["SIM"] = start_sim("--pty").target  # type: ignore[operator]

    def command(file: str) -> list[str]:
        names = known | {"NEW": str(tmp_path / f"{file}.run")}
        return [names.get(word, word) for word in COMMANDS[name]]

    whole = interrupted(command("whole"), LONGEST)
    life = min(whole.seconds, LONGEST) if whole.code not in INTERRUPTED else LONGEST
    moments = [life * (k + 0.5) / MOMENTS for k in range(MOMENTS)]
    at_once = 1 if "SIM" in COMMANDS[name] else AT_ONCE
    with ThreadPoolExecutor(at_once) as pool:
        tried = list(pool.map(lambda t: interrupted(command(f"{t:.4f}"), t), moments))
    for ended in (whole, *tried):
        check(ended, *INTERRUPTED, 0)
    if name != "sim":
        assert any(ended.code in INTERRUPTED for ended in tried), tried


@pytest.mark.real_time
def test_ctrl_c_in_a_terminal_leaves_the_embedded_drive_there_for_stop() -> None:
    """A terminal interrupts the whole group in the foreground, children too."""
    command = ["live", "sim", "--speed", "300", "--viewer", "none", "--duration", "60"]
    code, text = on_terminal(command, b"300 r/min, 0 A\r\n", b"\x03", after=1.0)  # said when it has been energised
    assert code == 130
    assert "ended by SIGINT" in text, text
    assert "STOP not confirmed" not in text
    assert "Traceback" not in text


@pytest.mark.long("compiles")
@pytest.mark.parametrize("moment", [COMPILING[0], pytest.param(COMPILING[1], marks=LATE)])
def test_ctrl_c_ends_a_compilation_at_once(moment: float, tmp_path: Path) -> None:
    ended = interrupted(COMMANDS["hall check"], moment, LIMIT, NUMBA_CACHE_DIR=str(tmp_path))
    check(ended, *INTERRUPTED)
    assert ended.seconds < SOON


def test_ctrl_c_where_python_drops_it_comes_again() -> None:
    def gone(reference: object) -> None:
        raise KeyboardInterrupt

    things = [Ended(0.0, 0, "", 0.0, [])]
    reference = weakref.ref(things[0], gone)  # what this raises, Python only tells of

    def drop() -> None:
        things.clear()
        threading.Event().wait(LIMIT)

    with pytest.raises(KeyboardInterrupt), none_dropped():
        drop()
    assert reference() is None


IMPORTED = {
    "modules in C drop it": "try: signal.raise_signal(signal.SIGINT)\nexcept KeyboardInterrupt: pass",
    "Python makes another exception of it": """
class Place:
    def __set_name__(self, owner: type, name: str) -> None:
        signal.raise_signal(signal.SIGINT)
class Owner:
    place = Place()
""",
}


@pytest.mark.parametrize("text", IMPORTED.values(), ids=IMPORTED)
def test_ctrl_c_within_an_import_waits_until_it_is_done(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"imported_{uuid.uuid4().hex}"
    (tmp_path / f"{name}.py").write_text(f"import signal\n{text}\nDONE = True\n")
    monkeypatch.syspath_prepend(tmp_path)

    def load() -> None:
        importlib.import_module(name)
        threading.Event().wait(LIMIT)

    with pytest.raises(KeyboardInterrupt), none_dropped():
        load()
    assert sys.modules[name].DONE


def test_ctrl_c_ends_what_an_import_itself_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"imported_{uuid.uuid4().hex}"
    lines = "import signal\nfrom bench.rig.interrupts import none_dropped\nwith none_dropped():\n"
    (tmp_path / f"{name}.py").write_text(f"{lines}    signal.raise_signal(signal.SIGINT)\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        importlib.import_module(name)


LATE = """
import os, signal, sys
from contextlib import contextmanager
import bench.cli as cli
def late(handled=cli.none_dropped):
    with handled():
        yield
        os.kill(os.getpid(), signal.SIGINT)
cli.none_dropped = contextmanager(late)
from bench.__main__ import main
main()
"""


def test_ctrl_c_when_all_is_done_ends_without_a_word() -> None:
    """As handlers are put back."""
    done = subprocess.run([sys.executable, "-c", LATE, "--version"], capture_output=True, text=True, env=ENVIRONMENT)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")
    assert done.stdout.startswith("bench, version ")


@pytest.mark.long("hundreds of signals")
@pytest.mark.parametrize("name", sampled("what Ctrl-C may leave locked", list(OF), 2, campaign="interrupts"))
def test_ctrl_c_at_any_moment_leaves_nothing_locked(name: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.bench.often_interrupted", name, str(tmp_path)]
    subprocess.run(command, check=True, timeout=LIMIT)  # what is locked waits for ever

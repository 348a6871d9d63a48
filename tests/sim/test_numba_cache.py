"""The cache of compiled kernels: keyed to the sources, importable without numba."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest

from sim import numba_cache
from sim.drive import tick
from sim.native import Cells, Native, Pointer, native
from sim.numba_cache import is_kept, kernels_of, tell_by

SOURCE = """
from sim.native import Pointer
from sim.numba_cache import kernel

@kernel
def twice(x):
    return 2.0 * x

@kernel
def four_times(x):
    return twice(twice(x))

def fill(x: float, y: Pointer[float]) -> None:
    y[0] = four_times(x)
"""


@pytest.fixture
def fill() -> FunctionType:
    """A function of kernels that nothing has compiled yet."""
    names: dict[str, Any] = {"__name__": __name__}
    exec(compile(SOURCE, __file__, "exec"), names)
    made: FunctionType = names["fill"]
    return made


def filled(function: Native, x: float) -> float:
    y = Cells(float)
    function(x, y.at)
    return float(y.first)


def test_module_imports_without_numba() -> None:
    code = "import sys, sim.numba_cache as c; c.is_kept(print); sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("sim/kernel.py", True),
        ("sim/plant/pmsm.py", True),
        ("sim/drive/tick.py", True),
        ("sim/drive/server.py", False),
        ("protocol/codes.py", True),
        ("protocol/messages.py", True),
        ("protocol/signals.py", True),
        ("protocol/streams.py", True),
        ("protocol/host.py", False),
    ],
)
def test_hash_is_that_of_the_kernels_and_of_the_constants_that_they_take(
    name: str, counts: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba_cache, "_HERE", tmp_path / "sim")
    hashes = []
    for text in (None, "x = 1\n", "x = 1\n", "x = 2\n"):
        if text:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)
        hashes.append(numba_cache.source_hash.__wrapped__())
    assert hashes[1] == hashes[2]
    assert len(set(hashes)) == (3 if counts else 1)


def test_old_directories_are_pruned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(10):
        (tmp_path / f"numba-{k:016x}").mkdir()
    monkeypatch.setattr(numba_cache, "cache_dir", lambda: tmp_path / "numba-now")
    assert numba_cache._prepare.__wrapped__() == str(tmp_path / "numba-now")
    assert len(list(tmp_path.iterdir())) == numba_cache.KEPT + 1


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """What is told of compiling, in an empty cache."""
    monkeypatch.setattr(numba_cache, "cache_dir", lambda: tmp_path / "numba-now")
    monkeypatch.setattr(numba_cache, "_prepare", lambda: str(tmp_path))
    monkeypatch.setattr(
        numba_cache, "Progress", type("Fresh", (numba_cache.Progress,), {"told": -1e9, "done": 0, "of": 0})
    )
    monkeypatch.setattr(numba_cache, "TELL_EVERY", 0.0)
    told: list[str] = []
    tell_by(told.append)
    return told


def test_what_is_compiled_is_kept_and_told_and_found_again_by_a_copy_installed_elsewhere(
    fill: FunctionType, lines: list[str], tmp_path: Path
) -> None:
    assert not is_kept(fill)
    assert filled(native(fill), 1.5) == 6.0
    assert is_kept(fill)
    assert lines[0] == "compiling, once on this machine: 0 of 3 kernels"
    assert lines[-1] == "compiling, once on this machine: 2 of 3 kernels"
    before = len(lines)
    elsewhere = fill.__code__.replace(co_filename=str(tmp_path / "elsewhere" / Path(__file__).name))
    copy = FunctionType(elsewhere, fill.__globals__, "fill")
    copy.__annotations__, copy.__module__ = fill.__annotations__, fill.__module__
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / Path(__file__).name).write_text("")
    assert filled(native(copy), 2.5) == 10.0
    assert len(lines) == before


def test_kernels_are_found_by_the_names_in_the_code(fill: FunctionType) -> None:
    assert {one.__name__ for one in kernels_of(fill)} == {"twice", "four_times"}
    names = {f"{one.__module__}.{one.__name__}" for one in kernels_of(tick.advance._function)}
    assert {"sim.plant.integrator.rotation", "sim.control.transforms.park", "sim.plant.noise.uniform"} <= names


def test_unwritable_cache_still_compiles(monkeypatch: pytest.MonkeyPatch, fill: FunctionType, lines: list[str]) -> None:
    monkeypatch.setattr(numba_cache.Locator, "from_function", classmethod(lambda cls, function, file: None))
    assert filled(native(fill), 1.0) == 4.0
    assert not is_kept(fill)


def test_a_division_by_zero_raises_nothing_in_compiled_code() -> None:
    def divide(x: float, y: Pointer[float]) -> None:
        y[0] = 1.0 / x

    assert filled(native(divide), 0.0) == math.inf


STORM = """
import random, signal, sys, time
from bench.observers.estimators import HostObservers
from protocol.messages import StreamEvent
from protocol.signals import DRIVE_CHANNELS
from protocol.streams import StreamConfig
from sim.config.params import load_params
from sim.drive.machine import SimulatedBench

class Stop(BaseException):
    pass

def stop(number, frame):
    raise Stop

def advance():
    before = bench.n
    try:
        bench.advance(1)
    finally:
        assert bench.n - before in (0, 1)

params = load_params()
bench = SimulatedBench(params)
streamed = tuple(channel for channel in DRIVE_CHANNELS if channel.name in ("theta_vt", "theta_ek"))
config = StreamConfig(1, 0, 1, StreamEvent.PWM, 1, streamed, 9, tick_hz=20_000_000, pwm_hz=16_000)
action = {
    "advance": advance,
    "make a drive": lambda: SimulatedBench(params),
    "make observers": lambda: HostObservers(params.drive_parameters(), config),
}[sys.argv[1]]
begun = time.perf_counter()
action()
begun = time.perf_counter()
action()
longest = 2.0 * (time.perf_counter() - begun) + 1e-4
signal.signal(signal.SIGALRM, stop)
stopped = 0
while stopped < 150:
    try:
        signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-5, longest))
        while True:
            action()
    except Stop:
        stopped += 1
"""


@pytest.mark.parametrize("action", ["advance", "make a drive", "make observers"])
def test_a_handler_that_raises_while_a_kernel_runs_does_no_harm(action: str) -> None:
    """Without `Held` some of them end in a segmentation fault: numba makes NamedTuples by Python code."""
    ended = subprocess.run([sys.executable, "-c", STORM, action], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr

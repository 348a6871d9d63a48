"""What is kept of compiled kernels: keyed to the sources, shipped with them, loaded without numba."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import FunctionType

import pytest

from protocol import machine_code
from protocol.machine_code import Store
from sim import native as natives
from sim import numba_cache
from sim.compile import findable, found, ir_apart
from sim.drive import tick
from sim.native import Cells, Native, Pointer, native, specialised
from sim.numba_cache import kernel
from sim.observers.catalogue import CATALOGUE
from sim.ports.device import kernels
from tests.choice import sampled


@kernel
def twice(x: float) -> float:
    return 2.0 * x


def fill(x: float, y: Pointer[float]) -> None:
    y[0] = twice(twice(x))


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FunctionType:
    """A function of kernels that nothing has compiled yet."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    made = Store(tmp_path / "shipped", "now")
    monkeypatch.setattr(natives, "store", lambda: made)
    return specialised(fill, "fill", fill.__annotations__)


def filled(function: Native, x: float) -> float:
    y = Cells(float)
    function(x, y.at)
    return float(y.first)


def test_a_drive_and_every_observer_run_without_numba_on_what_comes_with_the_sources(tmp_path: Path) -> None:
    code = """
import sys
from sim.config.params import load_params
from sim.observers.catalogue import CATALOGUE
from sim.ports.device import SimulatedDevice, compile_all

compile_all()
SimulatedDevice(load_params()).bench.advance(100)
for entry in CATALOGUE.values():
    entry.start(entry.make_params(16_000, load_params().drive_parameters()))
sys.exit("numba" in sys.modules)
"""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert "compiling" in done.stderr


def test_what_is_shipped_was_made_of_these_sources() -> None:
    """If not: `python -m sim.compile --ship`, with the kernels' edits in one commit."""
    assert [one.key for one in kernels() if not numba_cache.store().is_shipped(one.key)] == []


@pytest.mark.slow
@pytest.mark.parametrize("one", sampled("shipped", kernels(), 1, campaign="kernels"), ids=lambda one: one.key)
def test_what_is_shipped_is_what_numba_makes_of_the_sources(one: Native) -> None:
    shipped = numba_cache.store()
    made_by = f"numba {version('numba')}, llvmlite {version('llvmlite')}"
    assert shipped.made_by != made_by or ir_apart(one.name) == shipped.text(one.key)


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("sim/plant/pmsm.py", True),
        ("sim/drive/tick.py", True),
        ("sim/drive/server.py", False),
        ("protocol/signals.py", True),
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
    tmp_path /= "hallbench"
    for k in range(20):
        (tmp_path / f"kernels-{k:016x}").mkdir(parents=True)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path.parent))
    own = Store(tmp_path, "now").folder
    assert own.parent == tmp_path
    assert own in list(tmp_path.iterdir())
    assert len(list(tmp_path.iterdir())) == machine_code.KEPT + 1


def test_a_cache_that_cannot_be_written_is_a_temporary_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    made = Store(tmp_path, "now").folder
    assert tmp_path not in made.parents
    assert Store(tmp_path, "now").folder == made
    assert made.is_dir()


def nothing_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Native, "ir", None)


def test_what_is_compiled_here_is_kept_and_found_by_a_copy_installed_elsewhere(
    fresh: FunctionType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not native(fresh).kept
    assert filled(native(fresh), 1.5) == 6.0
    assert native(fresh).kept
    elsewhere = fresh.__code__.replace(co_filename=str(tmp_path / "elsewhere" / Path(__file__).name))
    copy = FunctionType(elsewhere, fresh.__globals__, "fill")
    copy.__annotations__, copy.__module__ = fresh.__annotations__, fresh.__module__
    nothing_compiles(monkeypatch)
    assert filled(native(copy), 2.5) == 10.0


@pytest.mark.parametrize("left", [0, 10, 300])
def test_kept_code_that_is_cut_short_is_made_again(fresh: FunctionType, tmp_path: Path, left: int) -> None:
    assert filled(native(fresh), 1.5) == 6.0
    (kept,) = tmp_path.rglob("*.o")
    whole = kept.read_bytes()
    kept.write_bytes(whole[:left])
    assert filled(native(fresh), 1.5) == 6.0
    assert kept.read_bytes() == whole


def test_shipped_ir_that_llvm_does_not_take_is_made_again(fresh: FunctionType, tmp_path: Path) -> None:
    made = natives.store()
    made.ship({native(fresh).key: "define i32 @nothing() { ret what }"}, "nobody")
    assert made.is_shipped(native(fresh).key)
    assert filled(native(fresh), 1.5) == 6.0


def test_shipped_ir_of_other_sources_is_left_alone(fresh: FunctionType, tmp_path: Path) -> None:
    Store(tmp_path / "shipped", "before").ship({native(fresh).key: ""}, "nobody")
    assert not natives.store().is_shipped(native(fresh).key)


def test_where_nothing_can_be_kept_it_compiles(monkeypatch: pytest.MonkeyPatch, fresh: FunctionType) -> None:
    monkeypatch.setattr(machine_code.tempfile, "TemporaryDirectory", fails)
    assert filled(native(fresh), 1.0) == 4.0
    assert not native(fresh).kept


def fails(dir: Path) -> None:
    raise OSError(f"{dir} is full")


def test_a_kernel_that_fails_says_so() -> None:
    def third(x: float, y: Pointer[float]) -> None:
        y[0] = (x, x)[int(x)]

    with pytest.raises(SystemError, match="third failed"):
        filled(native(third), 2.0)


def test_functions_are_found_by_their_names_and_others_compiled_here(fresh: FunctionType) -> None:
    for one in (tick.advance, *(entry.function for entry in CATALOGUE.values())):
        assert found(one.name) is one
    assert not findable(native(fresh))


def test_a_division_by_zero_raises_nothing_in_compiled_code() -> None:
    def divide(x: float, y: Pointer[float]) -> None:
        y[0] = 1.0 / x

    assert filled(native(divide), 0.0) == math.inf


STORM = """
import random, signal, sys, time
from sim.config.params import load_params
from sim.drive.machine import SimulatedBench
from sim.observers.catalogue import CATALOGUE

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
observing = CATALOGUE["edge_kalman"].make_params(16_000, params.drive_parameters())
action = {
    "advance": advance,
    "make a drive": lambda: SimulatedBench(params),
    "make an observer": lambda: CATALOGUE["edge_kalman"].start(observing),
}[sys.argv[1]]
begun = time.perf_counter()
action()
begun = time.perf_counter()
action()
longest = 2.0 * (time.perf_counter() - begun) + 1e-4
signal.signal(signal.SIGALRM, stop)
stopped = 0
while stopped < 60:
    try:
        signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-5, longest))
        while True:
            action()
    except Stop:
        stopped += 1
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "action", sampled("storm", ("advance", "make a drive", "make an observer"), 1, campaign="kernels")
)
def test_a_handler_that_raises_while_a_kernel_runs_does_no_harm(action: str) -> None:
    """Without `Held` some of them end in a segmentation fault: numba makes NamedTuples by Python code."""
    ended = subprocess.run([sys.executable, "-c", STORM, action], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr

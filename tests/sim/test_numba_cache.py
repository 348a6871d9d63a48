"""The cache of compiled kernels: keyed to the sources, importable without numba."""

import subprocess
import sys
from pathlib import Path

import pytest

from sim import numba_cache
from sim.numba_cache import jit


@jit
def double(x: float) -> float:
    return 2.0 * x


def test_module_imports_without_numba() -> None:
    code = "import sys, sim.numba_cache as c; c.is_warm(); sys.exit('numba' in sys.modules)"
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


def test_compiled_kernel_lands_in_the_cache() -> None:
    assert double(1.5) == 3.0
    assert numba_cache.is_warm("test_numba_cache", "double") or not hasattr(double, "py_func")
    assert not numba_cache.is_warm("test_numba_cache", "no_such_kernel")


def test_unwritable_cache_still_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba_cache, "_prepare", lambda: "")
    assert jit(lambda x: x + 1.0)(1.0) == 2.0


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
streamed = tuple(channel for channel in DRIVE_CHANNELS if channel.name in ("theta_vt", "theta_le"))
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

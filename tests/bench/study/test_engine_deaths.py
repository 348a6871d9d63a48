"""The engine where a worker, the scheduler or the program itself dies, or somebody ends it: real processes."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from bench.errors import BenchError
from bench.study import cluster as clusters
from bench.study.engine import open_engine
from bench.study.schedule import Done
from tests.bench.processes import Program

pytest.importorskip("distributed")

ROOT = Path(__file__).parents[3]
HELD = "tests.bench.study.engine_work:held"
LIMIT = 60.0  # s


def await_file(file: Path) -> str:
    """Its content, once it is there."""
    end = time.monotonic() + LIMIT
    while not file.exists():
        assert time.monotonic() < end, f"no {file}"
        time.sleep(0.01)
    return file.read_text()


@contextmanager
def when_held(folder: Path, act: Any) -> Iterator[None]:
    """Call `act` with the number of the worker's process once it holds, before it may go on."""

    def wait() -> None:
        pid = int(await_file(folder / "held"))
        (folder / "go").touch()  # for whoever computes the row again; the one that holds may see it too: it dies first
        act(pid)

    thread = threading.Thread(target=wait)
    thread.start()
    yield
    thread.join()


def plan(folder: Path, hold: int = 40, ms: float = 1.0) -> bytes:
    return json.dumps({"folder": str(folder), "hold": hold, "ms": ms}).encode()


def check_all(came: list[Any], count: int) -> None:
    """Each row once, each with its value."""
    assert all(isinstance(one, Done) for one in came)
    values = [pair for one in came for pair in zip(one.rows, json.loads(one.result), strict=True)]
    assert sorted(values) == [(row, 3 * row) for row in range(count)]


def kill(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)


def descendants(pid: int) -> list[psutil.Process]:
    return psutil.Process(pid).children(recursive=True)


def await_gone(processes: list[psutil.Process], limit: float) -> None:
    _, alive = psutil.wait_procs(processes, timeout=limit)
    assert not [process for process in alive if process.status() != psutil.STATUS_ZOMBIE]


def test_a_worker_that_is_killed_costs_a_batch(tmp_path: Path) -> None:
    notes: list[str] = []
    killed: list[int] = []
    with open_engine(2, None, notes.append) as engine, when_held(tmp_path, lambda pid: (kill(pid), killed.append(pid))):
        came = [*engine.run(plan(tmp_path), HELD, range(400))]
    check_all(came, 400)
    (note,) = notes
    assert f":{killed[0]} has gone" in note


def test_a_scheduler_that_is_killed_is_started_again_with_its_workers(tmp_path: Path) -> None:
    notes: list[str] = []
    with open_engine(2, None, notes.append) as engine:
        scheduler = engine._process.pid  # type: ignore[attr-defined]
        first = descendants(scheduler)
        with when_held(tmp_path, lambda pid: kill(scheduler)):
            came = [*engine.run(plan(tmp_path), HELD, range(400))]
    check_all(came, 400)
    assert "the dask scheduler of this machine is gone: a new one is started" in notes
    await_gone(first, 2.0)


CLIENT = f"""
import json, signal, sys, tempfile
from bench.errors import Interrupted
from bench.rig.interrupts import none_dropped, signals_as_exceptions
from bench.study.engine import open_engine

tempfile.tempdir = sys.argv[1] + "/temporary"
try:
    with none_dropped(), signals_as_exceptions(), open_engine(2, None, print) as engine:
        for came in engine.run(open(sys.argv[1] + "/plan", "rb").read(), {HELD!r}, range(10**6)):
            print("rows", *came.rows, flush=True)
except (KeyboardInterrupt, Interrupted) as interrupt:
    print("interrupted", type(interrupt).__name__, flush=True)
"""


@pytest.fixture
def client(tmp_path: Path) -> Iterator[Program]:
    """A program with two workers, one of which holds for good."""
    (tmp_path / "temporary").mkdir()
    (tmp_path / "plan").write_bytes(plan(tmp_path, hold=1))
    (tmp_path / "client_of_engine.py").write_text(CLIENT)
    more = {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    program = Program("client_of_engine", str(tmp_path), more=more)
    program.line("^rows")
    await_file(tmp_path / "held")
    yield program
    program.close()


def test_nothing_stays_when_the_program_is_killed(client: Program, tmp_path: Path) -> None:
    processes = descendants(client.process.pid)
    assert len(processes) >= 4
    client.send(signal.SIGKILL)
    await_gone(processes, 5.0)
    assert not [*(tmp_path / "temporary").iterdir()]


@pytest.mark.parametrize(
    ("number", "name"), [(signal.SIGINT, "KeyboardInterrupt"), (signal.SIGTERM, "Interrupted")], ids=["INT", "TERM"]
)
def test_a_program_that_is_interrupted_ends_at_once_and_says_nothing_more(
    client: Program, tmp_path: Path, number: signal.Signals, name: str
) -> None:
    processes = descendants(client.process.pid)
    begun = time.monotonic()
    client.send(number)
    assert client.end() == 0
    assert time.monotonic() - begun < 4.0  # 2 s, on a machine that nobody else uses
    assert client.out[-1] == f"interrupted {name}"
    assert not client.err
    await_gone(processes, 2.0)
    assert not [*(tmp_path / "temporary").iterdir()]


# -- a cluster that somebody has started ------------------------------------------------------------------------------


class Somebodys:
    """`dask scheduler` and `dask worker`, as in the manual."""

    def __init__(self) -> None:
        self.programs: list[Program] = []
        local = ("--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0")
        self.address = self._start("scheduler", *local).line(r"Scheduler at: +(tcp://127.0.0.1:\d+)").group(1)

    def _start(self, kind: str, *arguments: str, **more: str) -> Program:
        paths = {"PYTHONSAFEPATH": "1", "PYTHONPATH": str(ROOT), "DASK_LOGGING__DISTRIBUTED": "info"}
        self.programs.append(Program(f"distributed.cli.dask_{kind}", *arguments, more=paths | more))
        return self.programs[-1]

    def worker(self, *arguments: str, **more: str) -> str:
        """Another worker's address, once it has joined."""
        program = self._start("worker", self.address, "--nthreads", "1", "--no-dashboard", *arguments, **more)
        address = program.line(r"Start worker at: +(tcp://[\d.:]+)").group(1)
        program.line("Registered to:")
        return address

    def close(self) -> None:
        for program in reversed(self.programs):
            children = descendants(program.process.pid)
            program.close()
            for child in children:
                child.kill()


@pytest.fixture
def somebodys(tmp_path: Path) -> Iterator[Somebodys]:
    cluster = Somebodys()
    yield cluster
    cluster.close()


@pytest.fixture(scope="module")
def another_version(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A folder with this program but for one line of it."""
    folder = tmp_path_factory.mktemp("other")
    for package in ("bench", "protocol", "sim"):
        ignored = shutil.ignore_patterns("__pycache__", "c", "vectors")
        shutil.copytree(ROOT / package, folder / package, ignore=ignored)
    changed = folder / "sim" / "plant" / "noise.py"
    changed.write_text(changed.read_text() + "\nCHANGED = True\n")
    return str(folder)


@pytest.mark.slow
def test_a_worker_of_another_version_is_refused_by_name_and_the_others_work(
    somebodys: Somebodys, another_version: str, tmp_path: Path
) -> None:
    other = somebodys.worker("--no-nanny", PYTHONPATH=f"{another_version}{os.pathsep}{ROOT}")
    notes: list[str] = []
    with open_engine(None, somebodys.address, notes.append) as engine:
        with pytest.raises(BenchError, match=r"^no worker of .* can be used: .*sources of sim") as raised:
            [*engine.run(plan(tmp_path), HELD, range(3))]
        assert other in str(raised.value)
        assert len(notes) == 1
        somebodys.worker("--no-nanny")
        (tmp_path / "go").touch()
        came = [*engine.run(plan(tmp_path), HELD, range(300))]
    check_all(came, 300)
    assert {one.worker.partition(":")[2] for one in came} == {str(somebodys.programs[-1].process.pid)}
    differs = rf"the worker {other} \(\S+:\d+\) is not used: sources of sim \w+ there, \w+ here"
    assert len(notes) == 2
    assert all(re.fullmatch(differs, note) for note in notes)


@pytest.mark.slow
def test_a_worker_that_joins_late_helps_and_one_that_comes_back_is_met_anew(
    somebodys: Somebodys, tmp_path: Path
) -> None:
    somebodys.worker()
    notes: list[str] = []
    with open_engine(None, somebodys.address, notes.append) as engine:
        run = engine.run(plan(tmp_path, hold=-1, ms=2.0), HELD, range(100_000))
        first = next(run)
        late = somebodys.worker("--no-nanny")
        names = {first.worker}  # type: ignore[union-attr]
        while len(names) < 2:
            names.add(next(run).worker)  # type: ignore[union-attr]
        assert late
        kill(int(first.worker.partition(":")[2]))  # type: ignore[union-attr]
        while len(names) < 3:
            names.add(next(run).worker)  # type: ignore[union-attr]
        run.close()
    assert len(notes) == 1


def test_a_cluster_without_workers_and_one_that_is_gone_are_errors_that_say_what_to_do(
    somebodys: Somebodys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("JOIN", "STRANGERS"):
        monkeypatch.setattr(clusters, limit, 0.5)
    with open_engine(None, somebodys.address) as engine:
        with pytest.raises(BenchError, match=rf"no worker has come within \d+ s: .*`dask worker {somebodys.address} "):
            [*engine.run(plan(tmp_path), HELD, range(3))]
        monkeypatch.undo()
        somebodys.programs[0].send(signal.SIGKILL)
        with pytest.raises(BenchError, match=rf"^the dask scheduler {somebodys.address} is gone; what is done is kept"):
            [*engine.run(plan(tmp_path), HELD, range(3))]
    monkeypatch.setattr(clusters, "CONNECT", 0.5)
    with pytest.raises(BenchError, match=f"^no dask scheduler answers at {somebodys.address} .*: start one there"):
        open_engine(None, somebodys.address).__enter__()

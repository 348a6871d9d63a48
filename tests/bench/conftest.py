"""Fixtures of the bench's tests: processes that do not outlive their test, and virtual benches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from unittest.mock import patch

import pytest
from processes import Program, Sim
from recorded import record_drive
from shared import once
from virtual_run import RecordingScreen

from bench.accept.accept import AcceptOptions, accept


@pytest.fixture(scope="session", autouse=True)
def _locks_of_this_worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Another worker may use the same made-up target meanwhile. Programs in processes of their own lock as always."""
    with patch("bench.rig.lock.folder", lambda: tmp_path_factory.getbasetemp()):
        yield


@pytest.fixture
def start() -> Iterator[Callable[..., Program]]:
    """Start `python -m bench …`; killed at the end of the test."""
    with ExitStack() as started:
        yield lambda *arguments, **options: started.enter_context(closing(Program("bench", *arguments, **options)))


@pytest.fixture
def start_sim() -> Iterator[Callable[..., Sim]]:
    """Start `bench sim …`; killed at the end of the test."""
    with ExitStack() as started:
        yield lambda *arguments, **options: started.enter_context(closing(Sim(*arguments, **options)))


@pytest.fixture(params=("bytes", "CAN"))
def network(request: pytest.FixtureRequest) -> str:
    """A kind of link in virtual time."""
    return str(request.param)


@pytest.fixture(scope="session")
def suite_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped suite on the untouched simulated drive: `a.json`, `code`, `report/`. Not to be changed."""

    def make(folder: Path) -> None:
        options = AcceptOptions(target="sim", report=folder / "report", json=folder / "a.json")
        (folder / "code").write_text(str(accept(options, RecordingScreen())[1]))

    return once(tmp_path_factory, "suite", make)


@pytest.fixture(scope="session")
def drive_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the simulated drive: start-up, speed step, load step, reversal. Not to be changed."""
    return once(tmp_path_factory, "drive", lambda folder: record_drive(folder / "run.run")) / "run.run"

"""Fixtures of the bench's tests: processes that do not outlive their test, and virtual benches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import Program, Sim
from recorded import record_drive


@pytest.fixture
def start() -> Iterator[Callable[..., Program]]:
    """Start `python -m bench …`; killed at the end of the test."""
    started: list[Program] = []

    def run(*arguments: str, **options: object) -> Program:
        started.append(Program("bench", *arguments, **options))  # type: ignore[arg-type]
        return started[-1]

    yield run
    for program in started:
        program.close()


@pytest.fixture
def start_sim() -> Iterator[Callable[..., Sim]]:
    """Start `bench sim …`; killed at the end of the test."""
    started: list[Sim] = []

    def run(*arguments: str) -> Sim:
        started.append(Sim(*arguments))
        return started[-1]

    yield run
    for program in started:
        program.close()


@pytest.fixture(scope="session")
def drive_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the simulated drive: start-up, speed step, load step, reversal. Not to be changed."""
    path = tmp_path_factory.mktemp("drive") / "run.rrd"
    record_drive(path)
    return path

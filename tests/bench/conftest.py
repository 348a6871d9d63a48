"""Fixtures of the bench's tests: processes that do not outlive their test, and virtual benches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from processes import Program, Sim
from recorded import record_drive


@pytest.fixture
def start() -> Iterator[Callable[..., Program]]:
    """Start `python -m bench …`; killed at the end of the test."""
    with ExitStack() as started:
        yield lambda *arguments, **options: started.enter_context(closing(Program("bench", *arguments, **options)))


@pytest.fixture
def start_sim() -> Iterator[Callable[..., Sim]]:
    """Start `bench sim …`; killed at the end of the test."""
    with ExitStack() as started:
        yield lambda *arguments: started.enter_context(closing(Sim(*arguments)))


@pytest.fixture(scope="session")
def drive_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of the simulated drive: start-up, speed step, load step, reversal. Not to be changed."""
    path = tmp_path_factory.mktemp("drive") / "run.run"
    record_drive(path)
    return path

"""Acceptance runs in this process, of tests that are given as text."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from accepting import Accepting, SpoiltLink, accepting_in
from virtual_run import simulated


@pytest.fixture
def accepting(tmp_path: Path) -> Iterator[Accepting]:
    """In a directory of its own, which is the present one."""
    with accepting_in(tmp_path) as accepting:
        yield accepting


@pytest.fixture
def link() -> SpoiltLink:
    """One of a simulated drive."""
    return SpoiltLink(simulated())

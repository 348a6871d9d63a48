"""Acceptance runs in this process, of tests that are given as text."""

from __future__ import annotations

from pathlib import Path

import pytest
from accepting import Accepting, SpoiltLink
from virtual_run import simulated


@pytest.fixture
def accepting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Accepting:
    """In a directory of its own, which is the present one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_TARGET", raising=False)
    return Accepting(tmp_path)


@pytest.fixture
def link() -> SpoiltLink:
    """One of a simulated drive."""
    return SpoiltLink(simulated())

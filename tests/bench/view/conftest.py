from __future__ import annotations

from pathlib import Path

import pytest
import rerun as rr
import synthetic

from bench.record.info import SummaryText
from bench.record.sink import RunSink


@pytest.fixture(autouse=True)
def _strict() -> None:
    """Let rerun raise where it would only warn: a length mismatch, for one."""
    rr.set_strict_mode(True)


@pytest.fixture(scope="session")
def made() -> synthetic.SyntheticRun:
    """Three seconds of a made-up drive."""
    return synthetic.SyntheticRun(3.0)


@pytest.fixture(scope="session")
def recording(made: synthetic.SyntheticRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, recorded."""
    path = tmp_path_factory.mktemp("recording") / "run.run"
    sink = RunSink(path, synthetic.run_info(), wait=True)
    made.feed(sink)
    sink.take(SummaryText("# Summary\n\nall well"))
    sink.close()
    return path

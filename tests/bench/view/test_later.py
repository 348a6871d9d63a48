"""What can wait in a recording: done in order, never in the way of the journal, and what goes wrong is told."""

from __future__ import annotations

import errno
import threading
import time
from pathlib import Path

import pytest
import synthetic

from bench.errors import RecordingError
from bench.record import later, layout
from bench.record.later import Later
from bench.record.reader import Run
from bench.record.sink import RunSink

LIMIT = 20.0  # s


def written(file: RunSink, n: int) -> bool:
    """Whether `n` samples are written within the limit."""
    end = time.monotonic() + LIMIT
    while file.logged_samples < n and time.monotonic() < end:
        file.check()
        time.sleep(0.002)
    return file.logged_samples == n


def test_the_journal_does_not_wait_for_columns(tmp_path: Path, made: synthetic.SyntheticRun, monkeypatch) -> None:
    """All of a run can be read from it while not one column has been made."""
    hold, table = threading.Event(), layout.to_table
    monkeypatch.setattr(layout, "to_table", lambda *given: (hold.wait(LIMIT), table(*given))[1])
    file = RunSink(tmp_path / "a.run", synthetic.run_info())
    made.feed(file)
    try:
        assert written(file, len(made.index))
        assert Run(tmp_path / "a.run").samples.raw.tobytes() == made.raw.tobytes()
    finally:
        hold.set()
        file.close()
    run = Run(tmp_path / "a.run")
    assert run.ended
    assert run.samples.raw.tobytes() == made.raw.tobytes()
    assert len(run.edges) == len(made.edge_tick)


def test_columns_that_cannot_be_made_end_the_recording_and_the_journal_reads(tmp_path, made, monkeypatch) -> None:
    def full(*given: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(layout, "to_table", full)
    file = RunSink(tmp_path / "a.run", synthetic.run_info(), wait=True)
    made.feed(file)
    with pytest.raises(RecordingError, match=r"a\.run: the disk is full"):
        file.close()
    run = Run(tmp_path / "a.run")
    assert not run.ended
    assert len(run.samples) > 0
    assert run.samples.raw.tobytes() == made.raw[: len(run.samples)].tobytes()


def test_work_is_done_in_order_and_after_a_failure_none_is() -> None:
    done: list[int] = []
    work = Later()
    for k in range(10):
        work.do(lambda k=k: done.append(k))
    work.wait()
    assert done == list(range(10))
    work.do(lambda: [][0])
    with pytest.raises(IndexError):
        work.wait()
    with pytest.raises(IndexError):
        work.do(lambda: done.append(10))
    with pytest.raises(IndexError):
        work.wait()
    work.close()
    assert done == list(range(10))


def test_whoever_adds_too_much_waits(monkeypatch) -> None:
    monkeypatch.setattr(later, "MOST", 3)
    hold, done, work = threading.Event(), [], Later()
    work.do(lambda: hold.wait(LIMIT))
    adding = threading.Thread(target=lambda: [work.do(lambda k=k: done.append(k)) for k in range(20)])
    adding.start()
    adding.join(0.1)
    assert adding.is_alive()
    hold.set()
    adding.join(LIMIT)
    work.wait()
    work.close()
    assert done == list(range(20))

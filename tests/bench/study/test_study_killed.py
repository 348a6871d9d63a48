"""A study that is killed three times at random, a worker, the scheduler and the client, ends with the same rows."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import numpy as np
import psutil
import pytest
from processes import LIMIT, Program
from test_study_cli import columns, study
from test_study_file import TEN_LINES, written

from tests.choice import commit

T = TypeVar("T")

ROWS = 160
KILLS = ("worker", "scheduler", "client")


def files(folder: Path) -> int:
    return len(list(folder.glob("rows-*.parquet")))


def awaited(what: Callable[[], T]) -> T:
    """What is there, or holds, in the end: after as long as anything may take at most."""
    end = time.monotonic() + LIMIT
    while not (found := what()):
        assert time.monotonic() < end
        time.sleep(0.01)
    return found


def cluster_of(client: psutil.Process) -> list[psutil.Process]:
    """The process of the scheduler, then the workers; none while they start."""
    with suppress(psutil.NoSuchProcess):
        for scheduler in client.children():
            workers = [each for each in scheduler.children(recursive=True) if not each.children()]
            return [scheduler, *workers] if workers else []
    return []


@pytest.mark.slow
@pytest.mark.long("three clusters start, and 160 drives are computed twice")
def test_a_study_killed_three_times_has_the_rows_of_one_that_was_not(
    tmp_path: Path, start: Callable[..., Program]
) -> None:
    rng = np.random.default_rng(int(commit(), 16) if commit() != "none" else 0)
    file = written(tmp_path, TEN_LINES.replace("samples = 8", f"samples = {ROWS}"))
    whole, out = tmp_path / "whole.study", tmp_path / "killed.study"
    assert study("run", file, "--workers", 1, "--out", whole).exit_code == 0
    command = ["study", "run", str(file), "--workers", "2", "--out", str(out)]
    program = start(*command)
    for victim in rng.permutation(KILLS):
        before = files(out)
        awaited(lambda before=before, program=program: files(out) > before or program.process.poll() is not None)
        assert program.process.poll() is None, program.err
        client = psutil.Process(program.process.pid)
        scheduler, *workers = awaited(lambda client=client: cluster_of(client))
        dies = {"worker": workers[int(rng.integers(len(workers)))], "scheduler": scheduler, "client": client}[victim]
        dies.send_signal(signal.SIGKILL)
        if victim == "client":
            program.end()
            awaited(lambda all_of=(scheduler, *workers): not any(map(alive, all_of)))
            program = start(*command)
    assert program.end() == 0, program.err
    assert columns(out) == columns(whole)


def alive(process: psutil.Process) -> bool:
    with suppress(psutil.NoSuchProcess):
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    return False

"""The shipped suite on an untouched drive: it passes, with other noise too, and is the same in several processes.

That it fails where something is wrong is for `test_sabotage`. Nothing here knows a limit or a value.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any
from unittest.mock import patch
from zlib import crc32

import pytest
from accepting import Run, Screen

from bench.acceptance.accept import AcceptOptions, accept
from bench.acceptance.results import Verdict

MAP = "fig13_thd_map"  # the longest, of which each point is as quiet as the next
SOME = "hall_wire_broken or hall_glitches or torque_constant or fig09"  # noise, draws of the sensors, parameters


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an empty directory, on the simulated drive."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_TARGET", raising=False)


def suite(keyword: str | None = None) -> Run:
    screen = Screen()
    result, code = accept(AcceptOptions(keyword=keyword), screen)
    return Run(result, code, screen)


def test_an_untouched_drive_passes_everything_and_everything_is_explained() -> None:
    run = suite()
    assert run.result is not None
    assert run.code == 0
    assert {test.verdict for test in run.result.tests} == {Verdict.PASS}
    assert {m.verdict for m in run.result.measurements} == {Verdict.PASS}

    assert [name for name, often in Counter(test.name for test in run.result.tests).items() if often > 1] == []
    assert [name for name, often in Counter(m.name for m in run.result.measurements).items() if often > 1] == []
    assert [test.name for test in run.result.tests if not test.title] == []
    assert [m.name for m in run.result.measurements if not m.limits.about] == []
    bounds = [(m.name, bound) for m in run.result.measurements for bound in (m.limits.lo, m.limits.hi)]
    assert [name for name, bound in bounds if bound is not None and not math.isfinite(bound)] == []
    unlimited = {m.name for m in run.result.measurements if m.limits.lo is None and m.limits.hi is None}
    assert unlimited == {"back_emf_and_encoder.psi_f"}  # its deviation from the drive's own has limits


@pytest.mark.parametrize("other", [1])
def test_an_untouched_drive_passes_whatever_the_noise(other: int) -> None:
    seeds = []

    def seed_of(test: bytes) -> int:
        seeds.append(crc32(test, other))
        return seeds[-1]

    with patch("bench.rig.connection.crc32", seed_of):
        run = suite(f"not {MAP}")
    assert {name: m.value for name, m in run.measured.items() if m.verdict is not Verdict.PASS} == {}
    assert run.code == 0
    assert len(set(seeds)) > len(run.tests) > 20  # one more to try whether the drive can be made


def test_two_processes_measure_the_same_as_one(tmp_path: Path) -> None:
    one, two = (in_processes(n, tmp_path / f"{n}.json") for n in (1, 2))
    assert len(one) > 30
    assert one == two


def in_processes(n: int, file: Path) -> list[tuple[str, str, Any]]:
    """Name, verdict and value of each measurement of some tests, run by pytest itself with `n` workers."""
    command = [sys.executable, "-m", "pytest", "--pyargs", "bench.acceptance.suite", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, "-n", str(n), "-k", SOME, "--bench-json", str(file)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    run = json.loads(file.read_text())
    return [(m["name"], m["verdict"], m["value"]) for test in run["tests"] for m in test["measurements"]]

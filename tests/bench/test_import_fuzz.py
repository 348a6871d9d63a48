"""Damaged files of every format: samples, or one line; no exception, no crash, no number that is not in the file."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from zlib import crc32

import import_fuzz
import pytest
from processes import ENVIRONMENT

from tests.choice import commit

PROGRAM = Path(import_fuzz.__file__)
PART, OF_EACH = 4_000, 100_000
FOUND = (
    ("digital.csv", 400_095), ("scope.csv", 12_651), ("log.jsonl", 54_365), ("log.parquet", 32_989),
    ("log.npz", 400_035), ("log.npz", 500_067),
    ("halls.sr", 27_335), ("halls.vcd", 2_509), ("halls.vcd", 24_084), ("halls.vcd", 35_940), ("bus.blf", 22_727),
    ("log.tdms", 73_411), ("log.tdms", 77_608),
)  # fmt: skip
"""Files over which the import once failed, or did not come to an end."""
CRASHED = (("log.mat", 3_420),)
"""Over which a library crashed."""


def fuzzed(name: str, seed: int, count: int, limit: float) -> None:
    """In a process of its own, which a library may crash."""
    command = [sys.executable, PROGRAM, name, str(seed), str(count)]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=limit)
    assert done.returncode == 0, done.stderr[-2000:]
    told = json.loads(done.stdout)
    assert told.pop("refused") + told.pop("taken", 0) == count, told


@pytest.mark.parametrize(("name", "seed"), FOUND)
def test_what_failed_once_does_not_again(name: str, seed: int) -> None:
    assert sum(import_fuzz.run(name, seed, 1).values()) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), CRASHED)
def test_what_crashed_once_does_not_again(name: str, seed: int) -> None:
    fuzzed(name, seed, 1, 60)


@pytest.mark.slow
@pytest.mark.long("twenty-one formats, each in a process of its own")
@pytest.mark.parametrize("name", import_fuzz.FORMATS)
def test_damaged_files(name: str) -> None:
    fuzzed(name, OF_EACH + int(crc32(commit().encode())), 25, 120)


@pytest.mark.campaign("imports")
@pytest.mark.parametrize("part", range(OF_EACH // PART))
@pytest.mark.parametrize("name", import_fuzz.FORMATS)
def test_many_damaged_files(name: str, part: int) -> None:
    fuzzed(name, part * PART, PART, 1800)

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


def fuzzed(name: str, seed: int, count: int, limit: float) -> None:
    """In a process of its own, which a library may crash."""
    command = [sys.executable, PROGRAM, name, str(seed), str(count)]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=limit)
    assert done.returncode == 0, done.stderr[-2000:]
    told = json.loads(done.stdout)
    assert told.pop("refused") + told.pop("taken", 0) == count, told


@pytest.mark.slow
@pytest.mark.long("twenty formats, each in a process of its own")
@pytest.mark.parametrize("name", import_fuzz.FORMATS)
def test_damaged_files(name: str) -> None:
    fuzzed(name, OF_EACH + int(crc32(commit().encode())), 25, 120)


@pytest.mark.campaign("imports")
@pytest.mark.parametrize("part", range(OF_EACH // PART))
@pytest.mark.parametrize("name", import_fuzz.FORMATS)
def test_many_damaged_files(name: str, part: int) -> None:
    fuzzed(name, part * PART, PART, 1800)

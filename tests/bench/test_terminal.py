"""What a terminal shows that a pipe does not: tables that fit it, a status line only where something is waited for."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from unittest.mock import patch

import pytest

from bench.cli.output import table

HEADERS = ("edge", "up", "down", "passed", "remark")
ROWS = [
    ["III a rises", "-112.55", "112.05", "44/45", "a remark that is long enough to fold"],
    ["I", "-", "-", "-", "-"],
]


def shown(capsys: pytest.CaptureFixture[str], columns: int) -> list[str]:
    with patch.dict(os.environ, COLUMNS=str(columns), LINES="30"), patch("sys.stdout.isatty", lambda: True):
        table(HEADERS, ROWS)
    plain = re.sub("\x1b\\[[0-9;]*m", "", capsys.readouterr().out)
    return [line.rstrip() for line in plain.splitlines() if line.strip()]


@pytest.mark.parametrize("columns", [20, 40, 50, 60, 120])
def test_numbers_are_whole_on_a_terminal_of_any_width(capsys: pytest.CaptureFixture[str], columns: int) -> None:
    lines = shown(capsys, columns)
    assert sum(re.search(r"-112\.55 +112\.05 +44/45", line) is not None for line in lines) == 1
    assert max(map(len, lines)) <= max(columns, 50)
    folded = sum(word in line for line in lines for word in ("a remark", "long enough"))
    assert folded == 2 if columns >= 50 else folded >= 1


@pytest.mark.long("a program in a terminal")
def test_a_list_has_no_status_line() -> None:
    controller, terminal = pty.openpty()
    try:
        asked = [sys.executable, "-m", "bench", "accept", "--list", "-k", "fig08"]
        ended = subprocess.run(
            asked, stdout=terminal, stderr=terminal, stdin=subprocess.DEVNULL, check=False, timeout=60
        )
        shown = os.read(controller, 65536)
    finally:
        os.close(terminal)
        os.close(controller)
    assert ended.returncode == 0
    assert shown.startswith(b"fig08")
    assert b"\x1b" not in shown

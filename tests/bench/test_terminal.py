"""What a terminal shows that a pipe does not: tables that fit it, a status line only where something is waited for."""

from __future__ import annotations

import io
import os
import re
import sys
from unittest.mock import patch

import pytest
from shared import Terminal

from bench.cli import main
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


def test_a_list_has_no_status_line(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = Terminal()
    for name, value in (("stdout", shown), ("stderr", shown), ("stdin", io.StringIO())):
        monkeypatch.setattr(sys, name, value)
    monkeypatch.setenv("TERM", "xterm")
    with pytest.raises(SystemExit) as ended:
        main(["accept", "--list", "-k", "fig08"])
    assert ended.value.code == 0
    assert shown.getvalue().startswith("fig08")
    assert "\x1b" not in shown.getvalue()

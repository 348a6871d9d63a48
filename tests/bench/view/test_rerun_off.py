"""Where the environment switches rerun off, in any way that it takes: who needs it is told, before anything turns."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from against import said
from processes import ENVIRONMENT, LIMIT
from virtual_run import WatchedLink, never_armed, physical, reached_by

from bench.view import require_rerun

LIVE = {
    ("--viewer", "auto"): "choose --viewer none",
    ("--viewer", "web"): "choose --viewer none",
    ("--viewer", "none", "--save", "new.rrd"): "record to a .run",
}


@pytest.mark.parametrize("value", ["off", "OFF", "0", "false", "False"])
@pytest.mark.parametrize("options", LIVE)
def test_a_run_that_needs_rerun_is_refused_before_anything_turns(
    options: tuple[str, ...], value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch
) -> None:
    monkeypatch.setenv("RERUN", value)
    monkeypatch.chdir(tmp_path)
    link = WatchedLink(physical())
    with reached_by(link):
        command = ("live", "serial:/dev/ttyRERUN", "--speed", "300", "--yes", "--duration", "0.2", *options)
        _, err = said(capsys, *command, code=4)
    assert f"error: rerun is switched off by RERUN={value} in the environment: unset RERUN, or {LIVE[options]}" in err
    assert never_armed(link)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("value", ["", "1", "on", "true", "no"])
def test_what_rerun_does_not_take_for_off_is_not_off(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN", value)
    require_rerun()


@pytest.mark.parametrize("command", ["view RUN --viewer web", "export RUN -o NEW", "compare RUN RUN --save NEW"])
def test_a_file_for_rerun_cannot_be_made_without_it(command: str, drive_run: Path, tmp_path: Path) -> None:
    """In a process of its own: rerun looks at the environment when it is loaded."""
    words = {"RUN": str(drive_run), "NEW": str(tmp_path / "new.rrd")}
    arguments = [words.get(word, word) for word in command.split()]
    done = subprocess.run(
        [sys.executable, "-m", "bench", *arguments],
        capture_output=True, text=True, timeout=LIMIT, env={**ENVIRONMENT, "RERUN": "off"},
    )  # fmt: skip
    assert done.returncode == 4, done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: rerun is switched off by RERUN=off in the environment")
    assert not list(tmp_path.iterdir())

"""TARGET left out is that of the bench, for every command: $BENCH_TARGET, else bench.toml here or in a folder above."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import click
import pytest
from against import said

from bench.cli import cli
from bench.cli.target import TargetType
from bench.record.reader import Run

NOWHERE = "serial:/dev/nowhere"
WITHOUT = {
    "info": "", "live": "--viewer none", "hall check": "--passive", "hall learn": "", "conform": "",
    "protocol dbc": "", "accept": "-k test_stop --yes", "capture": "--trigger now -o a.run", "param list": "",
    "param save": "", "param dump": "", "param watch": "--duration 1", "param get": "k_p_vt n_p",
    "param set": "k_p_vt=900.5 k_i_vt=-2e-3", "param load": "a.toml", "param diff": "a.toml", "response": "current",
    "commission": "--yes",
}  # fmt: skip
"""Each command that may be given no target, and what it is given besides."""
AFTER = {"param get", "param set", "response"}
"""Those whose target stands before what else they are given; all others have it at the end."""
OTHERWISE = {"live": "the show", "accept": "sim"}
"""Those that have something to do where nobody names one."""
LISTS = {"devices"}
"""Without a target it lists what there is, whatever the bench's is."""


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_TARGET", raising=False)
    Path("a.toml").write_text("[parameters]\nk_p_vt = 900.0\n")


def commands(group: click.Group, context: click.Context, before: str = "") -> Iterator[tuple[str, click.Command]]:
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, context, f"{before}{name} ")
        else:
            yield before + name, command


def failing(capsys: pytest.CaptureFixture[str], name: str, *target: str) -> list[str]:
    """What the command says on standard error; it moves nothing and ends with 2."""
    besides = shlex.split(WITHOUT[name])
    given = [*target, *besides] if name in AFTER else [*besides, *target]
    _, err = said(capsys, *name.split(), *given, code=2)
    assert "Traceback" not in err
    return err.splitlines()


def test_these_are_all_commands_that_have_a_target() -> None:
    """A new one belongs here: `target_argument` makes its argument."""
    having = {
        name
        for name, command in commands(cli, click.Context(cli))
        if any(isinstance(p.type, TargetType) for p in command.params if isinstance(p, click.Argument))
    }
    assert having == WITHOUT.keys() | LISTS


@pytest.mark.parametrize("name", WITHOUT)
def test_a_command_takes_the_target_of_the_bench_and_says_so(name: str, capsys, monkeypatch) -> None:
    """The one of the command line goes before that of the environment, and that before the file's."""
    Path("bench.toml").write_text(f'target = "{NOWHERE}"\n')
    first, *_, last = failing(capsys, name)
    assert first == f"target: {NOWHERE}, from bench.toml"
    assert last.startswith("error: ")
    assert "/dev/nowhere" in last
    monkeypatch.setenv("BENCH_TARGET", f"{NOWHERE}2")
    first, *_, last = failing(capsys, name)
    assert first == f"target: {NOWHERE}2, from $BENCH_TARGET"
    assert "/dev/nowhere2" in last
    lines = failing(capsys, name, f"{NOWHERE}3")
    assert "/dev/nowhere3" in lines[-1]
    assert not any(line.startswith("target: ") for line in lines)


@pytest.mark.parametrize("target", ["serial:/dev/nowhere?baud=9600", "tcp:x=y:1", "usb:1", "/dev/nowhere", "a.run"])
@pytest.mark.parametrize("name", sorted(AFTER))
def test_a_first_word_in_the_form_of_a_target_is_one(name: str, target: str, capsys) -> None:
    """Also one that cannot be used, with a sign = in it, or that is misspelt: the bench's is not taken for it."""
    Path("bench.toml").write_text('target = "serial:/dev/other"\n')
    lines = failing(capsys, name, target)
    assert not any("/dev/other" in line for line in lines)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("param get", "Missing argument 'NAME...'"),
        ("param get sim", "Missing argument 'NAME...'"),
        ("param set sim", "Missing argument 'NAME=VALUE...'"),
        ("param set k_p_vt", "'k_p_vt' is not NAME=VALUE"),
        ("response", "Missing argument '{current|speed}'. Choose from: current, speed"),
        ("response sim", "Missing argument '{current|speed}'. Choose from: current, speed"),
        ("response torque", "'torque' is not one of 'current', 'speed'"),
        ("response ttyACM0 current", "unknown target 'ttyACM0'"),
    ],
)
def test_what_is_missing_or_wrong_is_told_in_one_line(words: str, says: str, capsys) -> None:
    Path("bench.toml").write_text(f'target = "{NOWHERE}"\n')
    *_, last = said(capsys, *words.split(), code=2)[1].splitlines()
    assert (says in last, "\\n" in last) == (True, False)


@pytest.mark.parametrize(("words", "offered"), [("response", {"sim", "current", "speed"}), ("response sim", {"speed"})])
def test_completion_offers_what_may_stand_in_the_place_of_a_target(
    words: str, offered: set, capsys, monkeypatch
) -> None:
    count = len(words.split()) + 1
    for name, value in {"COMPLETE": "bash_complete", "WORDS": f"bench {words} ", "CWORD": str(count)}.items():
        monkeypatch.setenv(f"{'_BENCH_' if name == 'COMPLETE' else 'COMP_'}{name}", value)
    out, _ = said(capsys)
    assert offered <= {line.partition(",")[2] for line in out.splitlines()}


@pytest.mark.parametrize("name", sorted(WITHOUT.keys() - OTHERWISE.keys()))
def test_without_any_the_error_says_what_brings_one(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Also where a bench.toml says everything but that."""
    for _ in range(2):
        (line,) = failing(capsys, name)
        assert line.startswith("error: no TARGET: name one, set $BENCH_TARGET, or let `bench init` write a bench.toml")
        Path("bench.toml").write_text('station = "bench 3"\n')


@pytest.mark.parametrize("name", WITHOUT)
def test_a_file_that_cannot_be_used_is_named_with_its_line(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("bench.toml").write_text('# mine\n\ntarget = "usb:ttyACM0"\n')
    (line,) = failing(capsys, name)
    assert line.startswith("error: target in bench.toml:3: unknown target 'usb:ttyACM0': write serial:")


def test_the_nearest_folder_above_counts(tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    below = tmp_path / "a" / "b"
    below.mkdir(parents=True)
    for folder in (tmp_path, tmp_path / "a"):
        (folder / "bench.toml").write_text(f'target = "serial:/dev/nowhere-{folder.name}"\n')
    monkeypatch.chdir(below)
    assert failing(capsys, "info")[0] == f"target: serial:/dev/nowhere-a, from {tmp_path}/a/bench.toml"
    (below / "bench.toml").write_text("")
    assert "no TARGET" in failing(capsys, "info")[-1]


def test_one_above_that_another_user_owns_is_not_followed(tmp_path: Path, capsys, monkeypatch) -> None:
    """It may name a drive, or a class of a load whose code would run. In the folder itself it is meant."""
    file = tmp_path / "bench.toml"
    file.write_text(f'target = "{NOWHERE}"\n')
    if os.geteuid() == 0:
        os.chown(file, 12345, -1)
    else:
        somebody_else = os.geteuid() + 1
        monkeypatch.setattr(os, "geteuid", lambda: somebody_else)
    assert failing(capsys, "info")[0] == f"target: {NOWHERE}, from bench.toml"
    (tmp_path / "below").mkdir()
    monkeypatch.chdir("below")
    (line,) = failing(capsys, "info")
    assert line.startswith(f"error: {file} belongs to another user: go to {tmp_path} to use it, or put")
    Path("bench.toml").touch()
    assert "no TARGET" in failing(capsys, "info")[-1]


def test_a_folder_that_is_gone_has_no_file(tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir("gone")
    Path.cwd().rmdir()
    assert "no TARGET" in failing(capsys, "info")[-1]


def test_the_list_of_ports_is_that_of_the_machine(capsys: pytest.CaptureFixture[str]) -> None:
    Path("bench.toml").write_text(f'target = "{NOWHERE}"\n')
    with patch("bench.device.ports.places", list):
        out, err = said(capsys, "devices")
    assert (out.startswith("no serial ports"), err) == (True, "")


def test_completion_says_nothing_of_it(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    Path("bench.toml").write_text(f'target = "{NOWHERE}"\n')
    for name, value in {"_BENCH_COMPLETE": "bash_complete", "COMP_WORDS": "bench info --j", "COMP_CWORD": "2"}.items():
        monkeypatch.setenv(name, value)
    out, err = said(capsys)
    assert ("--json" in out, err) == (True, "")


@pytest.mark.long("starts a drive, and turns another for a check")
def test_the_simulated_drive_is_the_one_that_the_file_describes(capsys: pytest.CaptureFixture[str]) -> None:
    """Unless --config does; its largest phase current tells which it is."""
    for name, amperes in (("bench", 3.5), ("other", 2.5)):
        Path(f"{name}-motor.toml").write_text(f"[firmware]\ni_max = {amperes}\n")
    Path("bench.toml").write_text('target = "sim"\nconfig = "bench-motor.toml"\n')
    info = json.loads(said(capsys, "info", "--json")[0])
    assert {p["name"]: p["value"] for p in info["nodes"][0]["parameters"]}["i_max"] == 3.5
    assert said(capsys, "param", "get", "i_max")[0] == "i_max = 3.5 A\n"
    said(capsys, "response", "current", "--from", "400", "--save", "loop.run")
    assert Run("loop.run").info.parameters["i_max"] == 3.5
    said(capsys, "hall", "check", "--speed", "480", "--save", "a.run", "--config", "other-motor.toml")
    told = Run("a.run").info.identity["configuration"]
    assert told == {"file": "other-motor.toml", "firmware.i_max": 2.5}


@pytest.mark.real_time
@pytest.mark.long("starts two drives, and waits for them in real time")
def test_live_watches_what_the_bench_names_and_plays_the_show_only_where_it_names_nothing(capsys) -> None:
    Path("bench.toml").write_text('target = "sim"\n')
    out, err = said(capsys, "live", "--viewer", "none", "--duration", "0.3", "--json")
    told = json.loads(out)
    assert "target: sim, from bench.toml" in err
    assert (told["edges"], told["result"]) == (0, "ok")
    Path("bench.toml").write_text('station = "bench 3"\n')
    out, err = said(capsys, "live", "--viewer", "none", "--duration", "1.5", "--json")
    assert json.loads(out)["edges"] > 0
    assert "target: " not in err

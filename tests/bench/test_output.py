"""Files and streams of every command: what cannot be written is told in one line, and nothing is lost."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

import pytest
from processes import ENVIRONMENT, LIMIT
from shared import table
from virtual_run import WatchedLink, reached_by, simulated

from bench.cli import main
from bench.cli.streams import echo, standard_streams
from bench.errors import BenchError
from bench.files import write
from tests.choice import sampled

pytestmark = pytest.mark.slow

Ran = tuple[int, str, str]


@pytest.fixture
def bench(capsys: pytest.CaptureFixture[str]) -> Callable[..., Ran]:
    """Run `bench ARGUMENTS…` in this process, with a simulated drive behind every target; its code and outputs."""

    def run(*arguments: str) -> Ran:
        code = 0
        with reached_by(WatchedLink(simulated())):
            try:
                main(list(arguments))
            except SystemExit as ended:
                code = ended.code if isinstance(ended.code, int) else 0
        return code, *capsys.readouterr()

    return run


# -- files: places that cannot be written --------------------------------------------------------------------------

OUTPUTS = {row["name"]: (row["line"].split(), row["code"]) for row in table("outputs")["outputs"]}
BAD_PLACES = {
    "missing/x": "there is no directory",
    "run.run/x": "Not a directory",
    "loop/x": "Too many levels of symbolic links",
    "n" * 300: "File name too long",
    "closed/x": "Permission denied",
}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The present directory, an empty one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def places(here: Path) -> Iterator[Path]:
    """The present directory, with what `BAD_PLACES` needs."""
    Path("run.run").write_text("precious")
    Path("loop").symlink_to("loop")
    Path("closed").mkdir(0o000)
    yield here
    Path("closed").chmod(0o700)


@pytest.mark.parametrize("place", BAD_PLACES)
def test_a_place_that_cannot_be_written_is_told_before_the_run(bench: Callable[..., Ran], places: Path, place: str):
    if place.startswith("closed") and os.geteuid() == 0:
        pytest.skip("root may write anywhere")
    before = sorted(path.name for path in places.iterdir())
    for name, (arguments, expected) in OUTPUTS.items():
        if (name, place) == ("accept --report", "missing/x"):  # it is made
            continue
        code, out, err = bench(*(text.format(place) for text in arguments))
        assert (code, out, len(err.splitlines())) == (expected, "", 1), f"{name}: {code} {out} {err}"
        assert re.fullmatch(rf"error: {arguments[-2]} \S+ cannot be written: {BAD_PLACES[place]}.*\n", err), name
        assert sorted(path.name for path in places.iterdir()) == before, name


def test_what_is_there_is_neither_replaced_nor_cut_without_overwrite(bench: Callable[..., Ran], places: Path) -> None:
    for name, (arguments, _) in OUTPUTS.items():
        path = Path(arguments[-1].format("there"))
        if name == "accept --report":
            path = Path("a_report/report.html")
            path.parent.mkdir()
            arguments = [*arguments[:-1], "a_report"]
        path.write_text("precious")
        code, out, err = bench(*(text.format("there") for text in arguments))
        assert (code, out, len(err.splitlines())) == (2, "", 1), f"{name}: {code} {out} {err}"
        assert re.search(r"(exists|holds a report): (choose .*--overwrite to|it is not a recorded run)", err), name
        assert path.read_text() == "precious", name


def test_a_directory_is_no_file(bench: Callable[..., Ran], places: Path) -> None:
    Path("a_directory.run").mkdir()
    for name, (arguments, _) in OUTPUTS.items():
        if name == "accept --report" or arguments[-1] == "{}.toml":
            continue
        code, out, err = bench(*arguments[:-1], "a_directory.run" if "--json" not in arguments else str(places))
        assert (code, out, len(err.splitlines())) == (2, "", 1), f"{name}: {code} {out} {err}"
        assert "is a directory" in err or "is not a recorded run" in err, name


@pytest.mark.parametrize("place", [place for place in BAD_PLACES if "/" in place])
def test_an_input_that_cannot_be_reached_is_told(bench: Callable[..., Ran], places: Path, place: str) -> None:
    if place.startswith("closed") and os.geteuid() == 0:
        pytest.skip("root may read anything")
    for arguments in (
        ("score", place),
        ("replay", place),
        ("hall", "check", f"{place}.run"),
        ("score", "run.run", "--expect", place),
        ("accept", "sim", "--bench", place),
        ("accept", "sim", "--tests", place),
    ):
        code, out, err = bench(*arguments)
        assert (code, out, len(err.splitlines())) == (2, "", 1), f"{arguments}: {code} {out} {err}"
        assert err.startswith("error: ")
        assert "unexpected" not in err


@pytest.mark.parametrize("json_at", ["/dev/full", "full.json"])
def test_a_device_that_fills_up_is_told_after_the_run(bench: Callable[..., Ran], places: Path, json_at: str) -> None:
    Path("full.json").symlink_to("/dev/full")
    code, out, err = bench("live", "serial:x", "--viewer", "none", "--duration", "0.1", "--json", json_at)
    assert (code, out) == (2, "")
    assert err.splitlines()[-1] == f"error: --json {json_at} cannot be written: No space left on device"


def test_a_file_is_written_whole_or_not_at_all(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, link = Path("kept"), Path("link")
    kept.write_text("before")
    kept.chmod(0o640)
    link.symlink_to(kept)
    write(link, "after Ω \udcff", "--x link")
    assert (kept.read_text("utf-8"), kept.stat().st_mode & 0o777, link.is_symlink()) == ("after Ω \\udcff", 0o640, True)

    def full(path: Path, data: bytes) -> int:
        path.open("wb").write(data[:1])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(BenchError, match=r"^--x link cannot be written: No space left on device$"):
        write(link, "later", "--x link")
    assert kept.read_text("utf-8") == "after Ω \\udcff"
    assert not [path for path in places.iterdir() if path.name.endswith(".part")]


# -- files: JSON ---------------------------------------------------------------------------------------------------


def with_json(run: Path) -> dict[str, tuple[str, ...]]:
    """Every command that has --json, on a recording or on a target that is there."""
    return {
        "info": ("info", "serial:x"),
        "devices": ("devices",),
        "live": ("live", "serial:x", "--viewer", "none", "--duration", "0.1"),
        "hall": ("hall", "check", str(run)),
        "score": ("score", str(run), "--observer", "drive_vt"),
        "replay": ("replay", str(run), "--observer", "hv", "--overwrite", "--out", "again.run"),
        "replay --list": ("replay", "--list"),
        "accept --list": ("accept", "sim", "--list", "-k", "fig08"),
    }


def test_json_goes_to_standard_output_alone_or_to_a_file(bench: Callable[..., Ran], drive_run: Path, here: Path):
    for name, arguments in with_json(drive_run).items():
        code, out, _ = bench(*arguments, "--json")
        assert isinstance(json.loads(out), dict | list), name
        assert not Path("-").exists()
        file = here / f"{name}.json"
        same, table, _ = bench(*arguments, "--json", str(file))
        assert same == code, name
        assert type(json.loads(file.read_text())) is type(json.loads(out)), name
        assert not table.startswith(("{", "[")), name
        if "--overwrite" not in arguments:
            again, _, err = bench(*arguments, "--json", str(file))
            assert again == 2, name
            assert f"--json {file} exists" in err, name


@pytest.mark.parametrize("taken", ["sim", "serial:/dev/ttyACM0", "other.run"])
def test_json_does_not_swallow_an_argument(bench: Callable[..., Ran], taken: str) -> None:
    code, out, err = bench("info", "--json", taken)
    assert (code, out) == (2, "")
    assert err.startswith(f"error: --json would write to a file named {taken}: put --json last, or use --json=-")


def test_only_text_goes_to_a_stream(bench: Callable[..., Ran], places: Path) -> None:
    for arguments, says in (
        (("live", "serial:x", "--save", "-"), "--save -: a recording cannot go to standard output"),
        (("live", "serial:x", "--save", "/dev/null"), "--save /dev/null exists"),
        (("replay", "run.run", "--out", "-"), "--out -: a recording cannot go to standard output"),
        (("accept", "sim", "--junit", "-"), "--junit -: only --json goes to standard output"),
        (("score", "run.run", "--json", "--csv", "-"), "--json and --csv name the same file, -"),
    ):
        code, out, err = bench(*arguments)
        assert (code, out) == (2, "")
        assert says in err
    assert not Path("-").exists()


# -- standard output -----------------------------------------------------------------------------------------------


def printing(run: Path) -> list[tuple[str, ...]]:
    """Every command that prints, each as short as it can be."""
    return [
        ("--help",),
        ("--version",),
        ("completion", "bash"),
        *with_json(run).values(),
        ("info", "serial:x", "--json"),
    ]


@contextlib.contextmanager
def stdout_is(stream: TextIO) -> Iterator[None]:
    before, sys.stdout = sys.stdout, stream
    try:
        yield
    finally:
        sys.stdout = before
        with contextlib.suppress(OSError):
            stream.close()


def test_standard_output_on_a_full_device_is_told_and_a_reader_that_has_gone_ends_as_sigpipe_does(
    bench: Callable[..., Ran], drive_run: Path, here: Path
) -> None:
    for arguments in printing(drive_run):
        with stdout_is(open("/dev/full", "w")):
            code, _, err = bench(*arguments)
        last = err.splitlines()[-1]
        assert (code, last) == (2, "error: standard output cannot be written: No space left on device"), arguments
        assert err.count("error: ") == 1, arguments
        reader, writer = os.pipe()
        os.close(reader)
        with stdout_is(open(writer, "w")):
            code, _, err = bench(*arguments)
        assert code == 141, arguments
        assert "error" not in err, arguments


def test_a_terminal_without_the_characters_gets_others(bench, drive_run, here) -> None:
    shown = ""
    for arguments in printing(drive_run):
        expected, utf8, _ = bench(*arguments)
        file = here / "shown"
        with stdout_is(file.open("w", encoding="ascii")):
            code, _, err = bench(*arguments)
        assert "unexpected" not in err, arguments
        assert code == expected, arguments
        text = file.read_text("ascii")
        assert len(text.splitlines()) == len(utf8.splitlines()) > 0, arguments
        shown += text
    assert "Ohm" in shown
    assert "<= " in shown


def test_standard_error_that_cannot_be_written_ends_nothing(bench: Callable[..., Ran], monkeypatch) -> None:
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        code, out, _ = bench("live", "serial:x", "--viewer", "none", "--duration", "0.1")
    assert code == 0
    assert re.search(r"result +ok", out)


def test_control_characters_are_shown_and_not_obeyed(capsys: pytest.CaptureFixture[str]) -> None:
    with standard_streams():
        echo("one\x1b[2J\ntwo\r\u202e")
    assert capsys.readouterr().out == "one\\x1b[2J\ntwo\\r\\u202e\n"


@pytest.mark.parametrize(("shell", "code", "err"), sampled("streams", (
    ("replay --list >&-", 141, ""),
    ("replay --list >&- 2>&- <&-", 141, ""),
    ("replay --list 2>&- <&-", 0, ""),
    ("replay --list > /dev/full", 2, "error: standard output cannot be written: No space left on device\n"),
    ("replay --list | true; exit ${PIPESTATUS[0]}", 141, ""),
), 3, campaign="terminal"))  # fmt: skip
def test_streams_of_a_real_process(shell: str, code: int, err: str) -> None:
    done = subprocess.run(
        ["bash", "-c", f"{sys.executable} -m bench {shell}"],
        env=ENVIRONMENT, capture_output=True, text=True, timeout=LIMIT, check=False,
    )  # fmt: skip
    assert ((done.returncode, done.stderr), bool(done.stdout)) == ((code, err), code == 0)


# -- what nobody foresaw -------------------------------------------------------------------------------------------


def test_an_error_that_is_not_foreseen_is_one_line_and_no_verdict_on_the_drive(bench: Callable[..., Ran], monkeypatch):
    def broken(target: str) -> None:
        raise KeyError("n_p\x1b[2J")

    monkeypatch.setattr("bench.device.description.scan", broken)
    monkeypatch.setattr("bench.device.description.Client", broken)
    monkeypatch.delenv("BENCH_TRACEBACK", raising=False)
    code, out, err = bench("info", "serial:x")
    assert (code, out) == (2, "")
    (line,) = err.splitlines()
    assert line.startswith(r"error: unexpected KeyError: 'n_p\x1b[2J'; this is a bug in hallbench")
    monkeypatch.setenv("BENCH_TRACEBACK", "1")
    code, _, err = bench("info", "serial:x")
    assert code == 2
    assert err.startswith("Traceback (most recent call last)")
    assert err.splitlines()[-1] == line


# -- a file in place of a target -----------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["live", "info", "devices", "accept"])
def test_a_recording_in_place_of_a_target(bench: Callable[..., Ran], command: str) -> None:
    code, out, err = bench(command, "run.run")
    assert (code, out) == (2, "")
    for tool in ("bench view", "bench score", "bench replay", "bench hall check"):
        assert f"`{tool} run.run`" in err


def test_another_file_in_place_of_a_target(bench: Callable[..., Ran], places: Path) -> None:
    Path("bench.toml").touch()
    code, _, err = bench("live", "bench.toml")
    assert code == 2
    assert "bench.toml is a file, not a target: use serial:PORT" in err


def test_edges_are_not_written_to_a_drive_that_ends_with_the_command(bench: Callable[..., Ran]) -> None:
    code, out, err = bench("hall", "learn", "sim", "--write")
    assert (code, out) == (2, "")
    assert "the simulated drive exists only during this command; use --out FILE" in err

"""`bench accept` as a whole: files it writes, what it selects and lists, its processes, and pytest without it."""

from __future__ import annotations

import json
import os
import re
import signal
import xml.etree.ElementTree as ET
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from accepting import HEAD, Accepting, Run, SpoiltLink, accepting_in, plain_pytest
from processes import Program
from test_prompt import PhysicalDrive, on_terminal
from virtual_run import simulated

from bench.accept.accept import closing_lines
from bench.accept.results import run_from_json, to_json
from bench.errors import BenchError
from bench.rig.lock import alone_on
from protocol.messages import DriveState
from tests.choice import sampled

pytestmark = pytest.mark.slow

TESTS = '''
@limit("n_p", "", lo=6, hi=6, about="pole pairs")
@limit("spread", "deg", hi=np.float32(5))
def test_good(drive, record, measure):
    """It turns.

    And more.
    """
    turn(drive, record)
    some = record(0.1)
    measure("n_p", drive.n_p)
    measure("spread", np.float32(np.degrees(some.position_error("theta_vt").std())), some)

@limit("spread", "deg", hi=0.001)
@limit("nan", "deg", hi=1)
def test_bad(drive, record, measure):
    turn(drive, record)
    some = record(0.1)
    measure("spread", np.degrees(some.position_error("theta_vt").std()), some)
    measure("nan", math.nan)

@limit("x", hi=1)
@needs("parameter:no_such")
def test_cannot(measure): pass
'''


def refusal(run: Callable[[], object]) -> str:
    with pytest.raises(BenchError) as refused:
        run()
    assert refused.value.exit_code == 2
    assert "\n" not in str(refused.value)
    return str(refused.value)


# -- what is written --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """What `TESTS` find, with all files that are written of it."""
    with accepting_in(tmp_path_factory.mktemp("written")) as accepting:
        return accepting(TESTS, json=Path("a.json"), junit=Path("a.xml"), report=Path("out/report"))


def test_what_is_written_holds_every_measurement(ran: Run) -> None:
    run, folder = ran, ran.directory
    assert run.tests == {"good": "PASS", "bad": "FAIL", "cannot": "SKIPPED"}
    written = json.loads((folder / "a.json").read_text())
    assert written == to_json(run.result) == to_json(run_from_json(written))
    assert run_from_json(written).tests[0] == run["good"]
    assert (folder / "out/report/report.html").is_file()
    assert sorted(path.name for path in (folder / "out/report/recordings").iterdir()) == ["bad.run", "good.run"]
    assert (run["good"].recording, run["cannot"].recording) == ("recordings/good.run", "")
    assert (run["good"].title, run["good"].about) == ("It turns.", "And more.")
    assert run.result.identity["name"] == "simulated drive"
    assert {p.name: p.value for p in run.result.parameters}["n_p"] == 6

    suite = ET.parse(folder / "a.xml").getroot().find("testsuite")
    assert suite is not None
    assert {key: suite.get(key) for key in ("tests", "failures", "errors", "skipped")} == {
        "tests": "3", "failures": "1", "errors": "0", "skipped": "1",
    }  # fmt: skip
    properties = {p.get("name"): p.get("value", "") for p in suite.iter("property")}
    assert properties.keys() == run.measured.keys()
    assert properties["good.n_p"] == "6 [= 6] PASS"
    spread = run.measured["bad.spread"].value
    assert properties["bad.spread"] == f"{spread:.4g} deg [≤ 0.001 deg] FAIL"
    assert properties["bad.nan"] == "nan deg [≤ 1 deg] FAIL (is not a number)"
    assert properties["cannot.x"] == "not measured [≤ 1] SKIPPED (needs the parameter no_such)"
    message = next(suite.iter("failure")).get("message", "")
    assert message.startswith("2 of 2 measurements did not pass")
    assert "bad.nan = nan deg" in message


def test_the_closing_line_counts(ran: Run, accepting: Accepting) -> None:
    untested, line = closing_lines(ran.result)
    assert untested == "not tested: 1 measurement: needs the parameter no_such (cannot)"
    assert re.fullmatch(
        r"FAIL: 3 tests \(1 failed, 1 passed, 1 skipped\), "
        r"5 measurements \(2 failed, 2 passed, 1 skipped\), \d+ s on sim",
        line,
    )
    good = accepting(TESTS, keyword="test_good", json=Path("/dev/full"))
    (line,) = closing_lines(good.result)
    assert re.fullmatch(r"PASS: 1 test passed, 2 measurements, \d+ s on sim", line)
    assert good.code == 2  # a result that cannot be written is no success


@pytest.mark.parametrize(
    ("option", "place", "why"),
    [("report", "a_file/report", "report a_file/report cannot be written: Not a directory"),
     ("report", "a_file", "report a_file cannot be written: File exists"),
     ("json", "nowhere/a.json", "results nowhere/a.json cannot be written: there is no directory {}/nowhere")],
)  # fmt: skip
def test_a_place_that_cannot_be_written_is_told_before_anything_moves(
    accepting: Accepting, option: str, place: str, why: str, link: SpoiltLink
) -> None:
    Path("a_file").touch()
    assert refusal(lambda: accepting(TESTS, link, **{option: Path(place)})) == why.format(Path.cwd())
    assert link.opened == []


def test_a_load_machine_that_another_run_holds_is_left_alone(accepting: Accepting, link: SpoiltLink) -> None:
    machine = f"serial:{accepting.directory}/brake"
    Path("bench.toml").write_text(f"[rig]\nload = '{machine}'\n")
    with alone_on(machine):
        assert refusal(lambda: accepting(TESTS, link)).startswith(f"{machine} is in use by another run")
    assert link.opened == []


def files_in(directory: str) -> set[str]:
    """Files, and recorded runs by their folders."""
    files = [path for path in Path(directory).rglob("*") if path.is_file()]
    found = {path.parent if path.parent.suffix == ".run" else path for path in files}
    return {str(path.relative_to(directory)) for path in found}


REPORTS = """
from matplotlib.figure import Figure

@limit("n_p", lo=1)
def test_one(drive, measure, figure):
    measure("n_p", drive.n_p)
    figure("angle", "an angle", Figure)

@limit("n_p", lo=1)
def test_two(drive, measure, figure):
    measure("n_p", drive.n_p)
    figure("angle", "an angle", Figure)
"""


def test_a_second_report_leaves_nothing_of_the_first_and_all_else(accepting: Accepting) -> None:
    accepting(REPORTS, report=Path("out"))
    made = {"report.html", ".report-files", *(f"recordings/{name}.run" for name in ("one", "two")),
            *(f"figures/{name}/angle.png" for name in ("one", "two"))}  # fmt: skip
    assert files_in("out") == made
    own = {"notes.txt", "recordings/mine.run", "figures/two/mine.png"}
    for name in own:
        Path("out", name).touch()
    Path("out/recordings/killed.run").touch()  # of a run that came to no end
    Path("outside").touch()
    with Path("out/.report-files").open("a") as names:
        names.write("recordings/killed.run\nrecordings/../../outside\nnotes.txt\n")
    only_one = REPORTS.replace("test_two", "other")
    accepting(only_one, report=Path("out"))
    assert files_in("out") == {name for name in made if "two" not in name} | own
    assert Path("outside").exists()
    for name in own:
        Path("out", name).unlink()
    accepting(only_one, report=Path("out"))
    assert sorted(path.name for path in Path("out/figures").iterdir()) == ["one", "two"]  # empty, it was the user's


# -- what is selected and listed --------------------------------------------------------------------------------


def test_the_list_shows_names_and_limits_of_what_is_selected_and_writes_and_opens_nothing(accepting: Accepting) -> None:
    link = SpoiltLink(simulated())
    selected = "test_good or test_cannot"
    run = accepting(TESTS, link, keyword=selected, list_only=True, json=Path("a.json"), report=Path("report"))
    assert (run.found, run.code) == (None, 0)
    assert sorted(run.screen.notes) == ["cannot.x: ≤ 1", "good.n_p: = 6", "good.spread: ≤ 5 deg"]
    assert link.opened == []
    assert not Path("a.json").exists()
    assert not Path("report").exists()
    assert list(accepting(TESTS, keyword=selected).tests) == ["good", "cannot"]


@pytest.mark.parametrize("listing", [False, True])
def test_nothing_to_run_is_said(accepting: Accepting, listing: bool) -> None:
    assert refusal(lambda: accepting(TESTS, keyword="fig99", list_only=listing)) == (
        "no test matches -k 'fig99'; bench accept --list shows all"
    )
    nothing = "def test_plain(): pass"
    assert refusal(lambda: accepting(nothing, list_only=listing)) == (
        "no test uses the bench's fixtures; bench accept --list shows all"
    )
    assert refusal(lambda: accepting(Path("nowhere.py"))) == "no tests at nowhere.py"


@pytest.mark.parametrize(
    ("text", "why"),
    [("def (:\n", "{}.py: SyntaxError: invalid syntax"),
     ("import no_such_module\n", "{}.py: ModuleNotFoundError: No module named 'no_such_module'"),
     ('@limit("x", lo=2, hi=1)\ndef test_a(measure): pass\n',
      "{}.py: ValueError: x: the lower limit 2 is above the upper one, 1"),
     ('@limit("x", hi=1)\n@limit("x", hi=2)\ndef test_a(measure): pass\n', "{}.py::test_a declares 'x' twice"),
     ("class TestA:\n    def test_same(self, drive): pass\nclass TestB(TestA): pass\n",
      "2 tests are called '{}.same', and limits go by name: rename all but one"),
     ('@pytest.mark.parametrize("x", ["a b", "a/b"])\ndef test_p(measure, x): pass\n',
      "'p[a b]' and 'p[a/b]' would write to the same files: rename one of them")],
    ids=("syntax", "import", "limits", "two limits of one name", "two tests of one name", "two files of one name"),
)  # fmt: skip
def test_a_file_that_cannot_be_run_is_one_line(
    accepting: Accepting, capfd: pytest.CaptureFixture[str], text: str, why: str
) -> None:
    file = accepting.write(text)
    assert refusal(lambda: accepting(file)) == why.format(file.stem)
    assert capfd.readouterr() == ("", "")


def test_another_test_that_fails_beside_them_is_no_success(accepting: Accepting) -> None:
    run = accepting(TESTS + "def test_plain(): assert False\n", keyword="test_good or test_plain")
    assert run.tests == {"good": "PASS"}
    assert run.code == 2
    assert any("test_plain: not an acceptance test, but it failed" in note for note in run.screen.notes)


def test_a_recording_of_an_earlier_run_is_not_taken_for_one_of_this(accepting: Accepting) -> None:
    text = """
import os

def test_first(drive):
    if os.path.exists("again"):
        raise KeyboardInterrupt

def test_second(drive): pass

@pytest.mark.skipif("os.path.exists('again')", reason="later")
def test_third(drive): pass
"""
    file = accepting.write(text)
    before = accepting(file, report=Path("report"))
    assert [before[name].recording for name in ("second", "third")] == ["recordings/second.run", "recordings/third.run"]
    Path("again").touch()
    run = accepting(file, report=Path("report"))
    assert run.tests["second"] == "ABORTED"
    assert [run[name].recording for name in ("second", "third")] == ["", ""]
    Path("report/recordings/third.run").mkdir()
    Path("report/recordings/third.run/run.jsonl").write_bytes(b"of an earlier run")
    assert accepting(file, report=Path("report"), keyword="test_third").tests == {"third": "SKIPPED"}
    assert Path("report/recordings/third.run/run.jsonl").read_bytes() == b"of an earlier run"


# -- several processes ------------------------------------------------------------------------------------------


MANY = (
    TESTS
    + """
import os

@pytest.fixture
def broken(): raise RuntimeError("broken")

def test_error(drive, broken): pass

@limit("x", hi=1)
def test_crashes(measure): os._exit(3)
"""
)


@pytest.mark.long("two more processes that load the compiled simulation")
def test_two_processes_find_what_one_does_and_one_that_crashes_is_an_error_of_its_test(accepting: Accepting) -> None:
    file = accepting.write(MANY)
    one = accepting(file, keyword="not crashes")
    told = sorted(one.screen.notes)
    assert [note for note in told if note.startswith("ERROR")] == ["ERROR   error: RuntimeError: broken"]
    one.screen.notes.clear()
    two = accepting(file, jobs=2, json=Path("a.json"))
    assert two.tests == one.tests | {"crashes": "ERROR"}
    assert re.match(r"worker 'gw\d' crashed while running 'own_", two["crashes"].why)
    assert sorted(note for note in two.screen.notes if "crashes" not in note) == told
    for name in one.tests:  # every value to its last bit
        for what in ("why", "measurements", "quality"):
            assert repr(getattr(two[name], what)) == repr(getattr(one[name], what))
    assert two.code == one.code == 1
    assert two.result.identity.keys() == one.result.identity.keys()
    assert two.result.parameters == one.result.parameters
    assert json.loads(Path("a.json").read_text()) == to_json(two.result)
    assert two.result.wall_seconds > max(test.wall_seconds for test in two.result.tests)


def test_a_drive_is_not_shared_by_several_processes(accepting: Accepting, link: SpoiltLink) -> None:
    why = refusal(lambda: accepting(TESTS, link, jobs=2))
    assert re.fullmatch(r"serial:\S+ cannot be tested by 2 processes at once: leave out --jobs", why)
    assert link.opened == []


def test_what_several_processes_need_is_said(accepting: Accepting, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.accept.accept.find_spec", lambda name: None)
    assert refusal(lambda: accepting(TESTS, jobs=2)) == "--jobs needs pytest-xdist: pip install pytest-xdist"


SLOW = """
import sys
import time

@pytest.mark.parametrize("number", range(4))
@limit("x", hi=1)
def test_quick(measure, number): measure("x", 0)

@limit("x", hi=1)
def test_slow(measure):
    print("slow", file=sys.__stderr__, flush=True)
    time.sleep(60)

def test_never(drive): time.sleep(60)

def test_plain(): pass
"""


@pytest.mark.campaign("terminal")
def test_two_processes_that_are_ended_leave_a_result_that_names_what_had_not_finished(
    accepting: Accepting, start: Callable[..., Program]
) -> None:
    file = accepting.write(SLOW)
    run = start("accept", "sim", "--tests", str(file), "--jobs", "2", "--json", "a.json")
    for done in range(2):
        run.line(f"PASS +quick.{done}.")
    run.send(signal.SIGTERM)
    assert run.end() == 130
    written = run_from_json(json.loads(Path("a.json").read_text()))
    verdicts = {test.name: str(test.verdict) for test in written.tests}
    assert verdicts["slow"] == verdicts["never"] == "ABORTED"
    assert {verdicts[f"quick[{number}]"] for number in range(2)} == {"PASS"}
    assert str(written.verdict) == "ABORTED"
    assert not any("Traceback" in line for line in run.err)


# -- the command ------------------------------------------------------------------------------------------------


TWO = """
@energises(rpm=300, current=2)
def test_one(drive, record): turn(drive, record)

@energises(rpm=150, current=4)
def test_two(drive, record): turn(drive, record, 150)
"""


REPLIES = [pytest.param(b"n\n", 2, id="no"), pytest.param(b"\x03", 130, id="Ctrl-C"), pytest.param(b"y\n", 0, id="yes")]


@pytest.mark.long("a drive in real time, and a process that asks")
@pytest.mark.parametrize(("reply", "code"), sampled("reply", REPLIES, 1, campaign="terminal"))
def test_the_question_is_asked_once_for_all_tests(accepting: Accepting, reply: bytes, code: int) -> None:
    file = accepting.write(TWO)
    # again after 10 s: a Ctrl-C in the very moment in which readline begins to wait is lost
    with closing(PhysicalDrive()) as drive:
        ended, text = on_terminal(["accept", drive.port.target, "--tests", str(file)], b"[y/N]", reply, again=10.0)
    assert ended == code, text
    question = (
        r"Spin simulated drive \(boot [0-9a-f]{8}\) on serial:\S+: up to 300 r/min, phase current up to 4 A\. "
        r"Is the shaft clear\? \[y/N\]: "
    )
    assert len(re.findall(question, text)) == 1
    answered = text[text.index("[y/N]: ") :].partition("\n")[0]
    assert not re.search("connecting|of 2", answered), "the status line runs through the question"
    assert "Traceback" not in text
    assert (DriveState.RUNNING in drive.states) == (code == 0)
    assert drive.device.drive.state == DriveState.IDLE


# -- everybody else's pytest ------------------------------------------------------------------------------------

PLAIN = """
import sys

def test_plain():
    loaded = {name.partition(".")[0] for name in sys.modules}
    assert "bench" in loaded  # the plug-in is there
    heavy = {"numba", "numpy", "rerun", "matplotlib", "pyarrow", "click", "rich", "serial", "can", "sim", "protocol"}
    assert not heavy & loaded
"""


def test_a_pytest_that_has_nothing_to_do_with_a_bench_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "test_plain.py").write_text(PLAIN)
    (tmp_path / "bench.toml").write_text("this is = of another tool")
    ended = plain_pytest(tmp_path, "--strict-markers", "-q")
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "1 passed" in ended.stdout
    assert ended.stderr == ""
    assert {path.suffix for path in tmp_path.iterdir() if path.is_file()} == {".ini", ".toml", ".py"}


def test_another_pytest_has_no_say(accepting: Accepting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the environment asks of it; of the folders above the tests none is listed but for a conftest.py's."""
    monkeypatch.setenv("PYTEST_ADDOPTS", "--color=yes -v")
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    (tmp_path / "conftest.py").write_text("import pytest\n@pytest.fixture\ndef above(): return 0\n")
    (tmp_path / "below").mkdir()
    monkeypatch.chdir("below")
    Path("test_below.py").write_text(HEAD + '@limit("x", hi=1)\ndef test_a(measure, above): measure("x", above)\n')
    listed, scandir = set(), os.scandir
    monkeypatch.setattr("os.scandir", lambda path=".": listed.add(Path(path).resolve()) or scandir(path))
    assert accepting(Path("test_below.py")).code == 0
    assert tmp_path in listed
    assert not listed & set(tmp_path.parents)
    assert os.environ["PYTEST_ADDOPTS"] == "--color=yes -v"


CONFTEST = """
import pytest

def pytest_addoption(parser): parser.addoption("--target", choices=["staging", "production"])

@pytest.fixture
def _rig(): return "of ours"
"""
OURS = 'def test_of_ours(pytestconfig, _rig): assert (pytestconfig.option.target, _rig) == ("staging", "of ours")\n'
BENCH = 'def test_of_the_bench(drive, bench_target): assert bench_target == "sim"\n'
BY_NAME = "def test_by_name(request): request.getfixturevalue('drive')\n"
NOWHERE = {"BENCH_TARGET": "tcp:nowhere:1"}  # an option that is not seen would be told


@pytest.mark.long("a pytest of its own, which loads the compiled simulation")
def test_options_and_fixtures_of_others_stay_theirs(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_own.py").write_text(OURS + BENCH)
    ended = plain_pytest(tmp_path, "-q", "--target", "staging", "--bench-target", "sim", **NOWHERE)
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.long("a pytest of its own, which loads the compiled simulation")
def test_acceptance_tests_run_in_a_plain_pytest_too(ran: Run, tmp_path: Path) -> None:
    (tmp_path / "test_own.py").write_text(HEAD + TESTS + BENCH + BY_NAME)
    ended = plain_pytest(tmp_path, "--target=sim", "-n", "1", "--bench-json", "a.json", **NOWHERE)
    assert ended.returncode == 1
    assert "bad.nan = nan deg [≤ 1 deg] FAIL" in ended.stdout
    assert "test_by_name gets a fixture of the bench by getfixturevalue: ask for it by argument" in ended.stdout
    assert "KeyError" not in ended.stdout
    run = run_from_json(json.loads((tmp_path / "a.json").read_text()))
    assert {test.name: str(test.verdict) for test in run.tests} == ran.tests | {"of_the_bench": "PASS"}
    here, there = (to_json(each)["tests"] for each in (run, ran.result))
    assert [test["measurements"] for test in here[:3]] == [test["measurements"] for test in there]

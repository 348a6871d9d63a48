"""The report as one hands it over: what it is about, names that a person reads, answers in words, pages on paper."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from accepting import Accepting
from hypothesis import given
from hypothesis import strategies as st
from page import Page

from bench.accept.marks import must_be_yes
from bench.accept.naming import in_words
from bench.accept.report import write_report
from bench.accept.results import Figure, Measurement, RunResult, TestResult, Verdict
from bench.errors import BenchError
from bench.report import style
from bench.report.html import css_string
from bench.rig.quality import ParameterValue
from bench.signal.limits import YES_NO, Limits
from tests.tools import chromium, needs

IDENTITY = {"name": "BLDC-24", "serial": "33FF-0817", "firmware": "foc", "build": "1.4.2", "node": 1}
MOTOR = (
    ParameterValue("n_p", 4.0, 4.0, ""),
    ParameterValue("R_s_hat", 0.8, 0.8, "Ω"),
    ParameterValue("L_s_hat", 0.00017600000137463212, 0.0, "H"),
    ParameterValue("k_p", 2.0, 2.0, ""),
)


def a_run(*tests: TestResult, verdict: Verdict = Verdict.PASS, **more: object) -> RunResult:
    return RunResult("2026-03-01T14:05:06+01:00", "serial:/dev/ttyACM0", verdict, tests, **more)  # type: ignore[arg-type]


def a_test(name: str, verdict: Verdict, *verdicts: Verdict, why: str = "", **more: object) -> TestResult:
    found = [
        Measurement(f"{name}.m{k}", Limits(f"m{k}", "A", 0, 2), v, 1.0 if v is Verdict.PASS else None, why)
        for k, v in enumerate(verdicts)
    ]
    return TestResult(name, f"What {name} does.", "", name, verdict, why, tuple(found), **more)  # type: ignore[arg-type]


def test_the_subject_is_what_was_tested_where_by_whom_and_with_what(tmp_path: Path) -> None:
    run = a_run(
        identity=IDENTITY,
        parameters=MOTOR,
        rig={"rated speed": "2000 r/min", "rated current": "5 A"},
        versions={"hallbench": "0.1.0", "python": "3.12.1", "numpy": "2.4"},
        station="bench 3",
        operator="A. Person",
        motor="BLY172S, no. 17",
    )
    page = Page(write_report(run, tmp_path))
    assert (page.subject["Drive"], page.subject["Serial number"]) == ("BLDC-24", "33FF-0817")
    assert page.subject["Firmware"] == "foc, build 1.4.2"
    assert page.subject["Motor"] == (
        "BLY172S, no. 17 by the drive's parameters: pole pairs 4, resistance 0.8 Ω, inductance 0.176 mH, "
        "rated speed 2000 r/min, rated current 5 A"
    )
    assert (page.subject["Station"], page.subject["Operator"]) == ("bench 3", "A. Person")
    assert page.subject["Date and time"].startswith("2026-03-01 14:05:06 UTC+01:00")
    assert page.subject["Link"] == "serial:/dev/ttyACM0"
    assert page.subject["Software"] == "hallbench 0.1.0, Python 3.12.1"
    assert "Tested by Name A. Person Date Signature Approved by Name Date Signature" in page.text
    assert "not stated" not in page.text


def test_what_nobody_has_said_is_a_line_to_write_on(tmp_path: Path) -> None:
    page = Page(write_report(a_run(identity={"name": "BLDC-24", "serial": ""}), tmp_path))
    assert page.subject["Serial number"] == "not stated by the drive"
    assert {page.subject[word] for word in ("Motor", "Station", "Operator")} == {"not stated"}
    assert (tmp_path / "report.html").read_text().count('<span class="to-fill">') == 6  # and firmware and software
    silent = Page(write_report(a_run(verdict=Verdict.ERROR, error="nothing answers"), tmp_path))
    assert silent.subject["Drive"] == "no drive answered"


def test_the_command_line_says_which_motor_it_is_before_the_file(accepting: Accepting) -> None:
    Path("bench.toml").write_text('motor = "of the file"\n')
    test = accepting.write("def test_it(drive): pass\n")
    assert accepting(test).result.motor == "of the file"
    run = accepting(test, motor="of the <b>day</b>", report=Path("out"))
    assert run.result.motor == "of the <b>day</b>"
    page = Page(Path("out/report.html"))
    assert page.subject["Motor"].startswith("of the <b>day</b> by the drive's parameters: pole pairs 6, ")
    assert page.subject["Serial number"] == "SIM-0001"


def test_what_was_not_tested_is_there_by_reason_before_any_count(tmp_path: Path) -> None:
    P, S, A = Verdict.PASS, Verdict.SKIPPED, Verdict.ABORTED
    run = a_run(
        a_test("good", P, P),
        a_test("brake", S, S, S, why="needs a load"),
        a_test("half", S, P, S, why="needs a load"),
        a_test("last", A, A, A, A, A, why="the run was ended"),
        a_test("empty", S, why="later"),
        verdict=A,
        deselected={"other[2]": "Other, wire 2"},
    )
    page = Page(write_report(run, tmp_path))
    assert page.rows[1:5] == [
        "the run was ended Last 4 ABORTED",
        "needs a load Brake; Half 3 SKIPPED",
        "later Empty SKIPPED",
        "not selected for this run Other, wire 2",
    ]
    assert page.text.index("needs a load") < page.text.index("5 tests:")
    assert "The run was ended early: 1 of 5 tests passed." in page.text


@pytest.mark.parametrize(("verdict", "tests", "words"), [
    ("PASS", "PP", "All measurements are within their limits."),
    ("PASS", "PS", "All that was tested is within its limits: 1 of 2 tests passed, 1 was skipped."),
    ("FAIL", "PFF", "The drive did not pass: 2 of 3 tests failed."),
    ("FAIL", "FEI", "The drive did not pass: 1 of 3 tests failed, 2 could not be judged."),
    ("INCOMPLETE", "PSS", "Not everything was tested: 1 of 3 tests passed, 2 were skipped."),
    ("INCOMPLETE", "SS", "Nothing was tested."),
    ("INVALID", "PI", "The data are insufficient for a verdict."),
    ("ERROR", "PE", "The bench is at fault: there is no verdict on the drive."),
])  # fmt: skip
def test_a_verdict_is_said_in_a_sentence(tmp_path: Path, verdict: str, tests: str, words: str) -> None:
    letters = {v.value[0]: v for v in (Verdict.PASS, Verdict.SKIPPED, Verdict.FAIL, Verdict.INVALID, Verdict.ERROR)}
    made = [a_test(f"t{k}", letters[letter]) for k, letter in enumerate(tests)]
    assert words in Page(write_report(a_run(*made, verdict=Verdict(verdict)), tmp_path)).text


ANSWERS = """
from bench.accept import yes
@yes("named", about="the fault has a name")
@yes("alone")
@limit("count", lo=1, hi=1)
def test_answers(drive, measure):
    measure("named", True)
    measure("alone", np.bool_({alone}))
    measure("count", 1)
"""


def test_answers_are_yes_or_no_and_counts_are_numbers(accepting: Accepting) -> None:
    run = accepting(ANSWERS.format(alone=False), report=Path("out"))
    assert run.code == 1
    page = Page(Path("out/report.html"))
    assert page.row("Named named") == "Named named the fault has a name yes yes – PASS"
    assert page.row("Alone alone") == "Alone alone yes no – FAIL"
    assert page.row("Count count") == "Count count = 1 1 0 PASS"
    assert "        answers.alone = no [yes] FAIL" in run.screen.notes
    Path("bench.toml").write_text('[limits]\n"answers.alone" = { lo = 0 }\n')
    assert str(accepting(ANSWERS.format(alone=False)).measured["answers.alone"].limits) == "yes or no"


def test_an_answer_is_no_number(accepting: Accepting) -> None:
    (test,) = accepting(ANSWERS.replace("True", "0.5").format(alone=True)).result.tests
    assert test.verdict is Verdict.ERROR
    assert test.why == "answers answers 'named' with 0.5: yes is 1 or True, no is 0 or False"
    undefined = accepting(ANSWERS.replace("True", "math.nan").format(alone=True)).measured["answers.named"]
    assert (undefined.verdict, undefined.why) == (Verdict.FAIL, "is not a number")
    Path("bench.toml").write_text('[limits]\n"answers.alone" = { lo = 2, hi = 2 }\n')
    with pytest.raises(BenchError, match="alone: the answer is 1 for yes or 0 for no, and the limit is 2"):
        accepting(ANSWERS.format(alone=True))
    assert str(must_be_yes("x")) == "yes"
    assert [str(Limits("x", YES_NO, lo, hi)) for lo, hi in ((0, 0), (None, 0), (None, None))] == [
        "no", "no", "for information",
    ]  # fmt: skip


NAMES = """
from bench.accept import called
@pytest.mark.parametrize("factor", [2, pytest.param(3, id="three")])
def test_low_speed_20_rpm(factor, drive): pass
@pytest.mark.parametrize("case", [pytest.param(object(), id="over-current")])
def test_trip(case, drive): pass
@called("Hall wires {pair[0]} and {pair[1]} exchanged")
@pytest.mark.parametrize("pair", ["ab"])
def test_swap(pair, drive): pass
@called("Observer: {id}")
@pytest.mark.parametrize("case", [pytest.param(3, id="edge-kalman")])
def test_observer(case, drive): pass
"""


def test_tests_have_names_that_a_person_reads(accepting: Accepting) -> None:
    run = accepting(NAMES, keyword="not three", report=Path("out"), allow_skipped=True)
    assert {test.name: test.label for test in run.result.tests} == {
        "low_speed_20_rpm[2]": "Low speed 20 r/min, factor 2",
        "trip[over-current]": "Trip, over-current",
        "swap[ab]": "Hall wires a and b exchanged",
        "observer[edge-kalman]": "Observer: edge-kalman",
    }
    assert run.result.deselected == {"low_speed_20_rpm[three]": "Low speed 20 r/min, factor 3"}
    page = Page(Path("out/report.html"))
    assert page.row("Low speed 20 r/min, factor 2 low_speed_20_rpm[2]")
    assert page.row("not selected for this run") == "not selected for this run Low speed 20 r/min, factor 3"


@pytest.mark.parametrize("name", ["Wire {wires}", "Wire {pair.x}", "Wire {", "Wire {}"])
def test_a_name_with_braces_for_nothing_is_refused_before_anything_runs(accepting: Accepting, name: str) -> None:
    with pytest.raises(BenchError, match=r"test_swap\[ab\]: called\('Wire .*'\) names no parameter of the test"):
        accepting(NAMES.replace("Hall wires {pair[0]} and {pair[1]} exchanged", name))


@pytest.mark.parametrize(("name", "words"), [
    ("error_std.fast.forwards", "Error standard deviation, fast, forward"),
    ("thd.proposed.load25.speed8", "THD, proposed, load 25, speed 8"),
    ("R_s_hat_low_shift_off", "R_s_hat low shift off"),
    ("i_q_light", "i_q light"),
    ("u_dc", "u_dc"),
    ("ripple_d_ratio", "Ripple d ratio"),
    ("open_a", "Open a"),
    ("low_speed_20_rpm[2]", "Low speed 20 r/min, 2"),
    ("", ""),
])  # fmt: skip
def test_names_in_words(name: str, words: str) -> None:
    assert in_words(name) == words


@given(st.text())
def test_a_string_in_a_style_sheet_ends_nothing(text: str) -> None:
    written = css_string(text)
    assert re.fullmatch(r'"([A-Za-z0-9 ]|\\[0-9a-f]{1,6} )*"', written)
    read = re.sub(r"\\([0-9a-f]+) ", lambda found: chr(int(found[1], 16)), written[1:-1])
    assert " ".join(text.split()).startswith(read)


def test_the_style_sheet_stays_whole_whatever_a_drive_is_called(tmp_path: Path) -> None:
    run = a_run(identity={"name": '</style><script>"}', "serial": "*/ } body { display: none"})
    assert "script" not in Page(write_report(run, tmp_path)).tags
    sheet = (tmp_path / "report.html").read_text().partition("<style>")[2].partition("</style>")[0]
    assert "script" not in sheet.replace("\\", "")[sheet.index("@page :first") :]
    assert sheet.count("{") == sheet.count("}")
    assert "ellipsis" not in sheet


@pytest.mark.slow
@needs("chromium", "pdftotext")
def test_on_paper_pages_are_numbered_nothing_is_folded_and_the_signatures_are_on_one_page(tmp_path: Path) -> None:
    figure, (ax,) = style.new_figure()
    style.line(ax, np.arange(2.0), np.arange(2.0), "i_q")
    style.save(figure, tmp_path / "a.png")
    tests = [
        a_test(f"t{k}", Verdict.PASS, *[Verdict.PASS] * 20, figures=(Figure("a.png", f"caption {k}"),), log=f"end {k}")
        for k in range(3)
    ]
    path = write_report(a_run(*tests, identity=IDENTITY), tmp_path)
    pdf = tmp_path / "a.pdf"
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--no-pdf-header-footer", f"--user-data-dir={tmp_path}/c")
    subprocess.run([chromium(), *options, f"--print-to-pdf={pdf}", path.as_uri()], check=True, capture_output=True)
    text = subprocess.run(["pdftotext", "-layout", str(pdf), "-"], check=True, capture_output=True, text=True).stdout
    pages = text.split("\f")[:-1]
    assert [re.findall(r"page \d+ of \d+", page) for page in pages] == [
        [f"page {k} of {len(pages)}"] for k in range(1, len(pages) + 1)
    ]
    assert ["BLDC-24, serial number 33FF-0817" in page for page in pages] == [True] * len(pages)
    assert all(word in pages[0] for word in ("Subject", "Tested by", "Approved by", "Signature"))
    assert all(f"m{m}" in text and f"end {k}" in text for m in range(20) for k in range(3))  # folded on a screen

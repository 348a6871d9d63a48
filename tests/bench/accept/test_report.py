"""The report says everything that a run found, in one file, as text, fit to be handed over; figures look the same."""

from __future__ import annotations

import base64
import hashlib
import math
import re
import struct
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
from bench.accept.report import ReportError, words, write_report
from bench.accept.results import Figure, Measurement, RunResult, TestResult, Verdict
from bench.accept.results import tightest as closest
from bench.errors import BenchError
from bench.report import style
from bench.report.html import css_string
from bench.rig.quality import ParameterValue, Quality
from bench.signal.limits import YES_NO, Limits
from tests.tools import chromium, needs

EVIL = "<script>alert('&\"')</script>"


def measurement(
    name: str, value: float | None, verdict: Verdict, lo: float | None = None, hi: float | None = None, **more
) -> Measurement:
    limits = Limits(name.split(".")[1], "A", lo, hi, more.pop("about", ""), more.pop("overridden", False))
    return Measurement(name, limits, verdict, value, **more)


def a_test(name: str, verdict: Verdict = Verdict.PASS, *found: Measurement, **more) -> TestResult:
    return TestResult(name, f"title of {name}", "", f"tests/x.py::{name}", verdict, measurements=found, **more)


LETTERS = {verdict.value[0]: verdict for verdict in Verdict if verdict is not Verdict.INCOMPLETE}


def made(name: str, verdict: str, verdicts: str = "", **more) -> TestResult:
    """A test that ended so, and so many measurements of it, by the first letters of the verdicts."""
    found = [
        measurement(f"{name}.m{k}", 1.0 if letter == "P" else None, LETTERS[letter], 0, 2, why=more.get("why", ""))
        for k, letter in enumerate(verdicts)
    ]
    return a_test(name, LETTERS[verdict], *found, **more)


def a_run(*tests: TestResult, verdict: Verdict = Verdict.PASS, **more) -> RunResult:
    return RunResult("2026-03-01T14:05:06+01:00", "serial:/dev/ttyACM0", verdict, tests, **more)


def written(run: RunResult, tmp_path: Path) -> Page:
    return Page(write_report(run, tmp_path))


# -- what it is about -------------------------------------------------------------------------------------------

IDENTITY = {"name": "BLDC-24", "serial": "33FF-0817", "firmware": "foc", "build": "1.4.2", "node": 1, "pwm_hz": 16000}
MOTOR = (
    ParameterValue("n_p", 4.0, 4.0, ""),
    ParameterValue("R_s_hat", 0.8, 0.8, "Ω"),
    ParameterValue("L_s_hat", 0.00017600000137463212, 0.0, "H"),
    ParameterValue("k_p", 2.0, 2.0, ""),
)


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
    page = written(run, tmp_path)
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
    assert "PWM 16000 Hz" in page.text
    assert "not stated" not in page.text


def test_what_nobody_has_said_is_a_line_to_write_on(tmp_path: Path) -> None:
    page = written(a_run(identity={"name": "BLDC-24", "serial": ""}), tmp_path)
    assert page.subject["Serial number"] == "not stated by the drive"
    assert {page.subject[word] for word in ("Motor", "Station", "Operator")} == {"not stated"}
    assert (tmp_path / "report.html").read_text().count('<span class="to-fill">') == 6  # and firmware and software
    silent = written(a_run(verdict=Verdict.ERROR, error="nothing answers on /dev/ttyACM0"), tmp_path)
    assert silent.subject["Drive"] == "no drive answered"
    assert "nothing answers on /dev/ttyACM0" in silent.text
    assert "No test was run." in silent.text


def test_the_command_line_says_which_motor_it_is_before_the_file(accepting: Accepting) -> None:
    Path("bench.toml").write_text('motor = "of the file"\n')
    test = accepting.write("def test_it(drive): pass\n")
    assert accepting(test).result.motor == "of the file"
    run = accepting(test, motor="of the <b>day</b>", report=Path("out"))
    assert run.result.motor == "of the <b>day</b>"
    page = Page(Path("out/report.html"))
    assert page.subject["Motor"].startswith("of the <b>day</b> by the drive's parameters: pole pairs 6, ")
    assert page.subject["Serial number"] == "SIM-0001"


def test_parameters_that_differ_from_their_defaults_come_first(tmp_path: Path) -> None:
    parameters = (
        ParameterValue("R_s", 0.158, 0.158, "ohm"),
        ParameterValue("k_p", 1268.0, 1000.0, "rad/s", "gain"),
    )
    page = written(
        a_run(a_test("test_a", parameters={"k_p": 500.0, "observer": 10.0}), parameters=parameters), tmp_path
    )
    assert "observer = 10 (edge-kalman)" in " ".join(page.text.split())
    assert page.row("gain") == "k_p 1268 rad/s 1000 rad/s changed gain"
    assert page.row("R_s") == "R_s 0.158 ohm 0.158 ohm"
    assert page.text.index("1268") < page.text.index("0.158")
    assert "k_p = 500 rad/s" in page.text
    assert "What it is" in page.text
    assert "What it is" not in written(a_run(parameters=parameters[:1]), tmp_path).text


# -- what was found ---------------------------------------------------------------------------------------------


def test_every_measurement_is_there_with_value_limits_margin_and_verdict(tmp_path: Path) -> None:
    grid = [measurement(f"test_map.at_{k}", 0.01 * k, Verdict.PASS, hi=0.9) for k in range(80)]
    grid += [measurement("test_map.too_high", 0.95, Verdict.FAIL, hi=0.9)]
    few = [
        measurement("test_few.nan", math.nan, Verdict.INVALID, -2.5, 2.5, why="a gap"),
        measurement("test_few.none", None, Verdict.ERROR, lo=1.0),
        measurement("test_few.free", -3.25, Verdict.PASS, overridden=True, about="to know it"),
    ]
    run = a_run(a_test("test_map", Verdict.FAIL, *grid), a_test("test_few", Verdict.ERROR, *few), verdict=Verdict.FAIL)
    page = written(run, tmp_path)
    for k in range(80):
        value, margin = 0.01 * k, 0.9 - 0.01 * k
        expected = f"At {k} at_{k} ≤ 0.9 A {value:.3f} A +{margin:.3f} ({100 * margin / 0.9:.0f} %) PASS"
        assert page.row(f"at_{k} ", "PASS") == expected
    assert "Too high too_high ≤ 0.9 A 0.950 A −0.050 (−6 %) FAIL" in page.rows
    assert "Nan nan a gap −2.5 … 2.5 A NaN A – INVALID" in page.rows
    assert "None none ≥ 1 A – – ERROR" in page.rows
    assert page.row("Free free") == "Free free to know it for information from bench.toml −3.25 A – –"
    assert "80 more: all passed" in page.text
    assert "84 measurements: 80 PASS" in page.text
    assert "1 for information" in page.text


def test_what_was_not_tested_comes_first_and_what_failed_leads_to_its_test_and_recording(tmp_path: Path) -> None:
    bad = measurement("test_b.peak", 9.0, Verdict.FAIL, hi=8.0, why="at the step", span=(1.25, 1.5))
    run = a_run(
        a_test("test_a"),
        a_test("test_b", Verdict.FAIL, bad, recording="recordings/test b.run"),
        a_test("test_c", Verdict.ERROR, why="no heartbeat for 1 s"),
        a_test("test_d", Verdict.SKIPPED, why="no encoder"),
        verdict=Verdict.FAIL,
        error="the link was lost",
    )
    page = written(run, tmp_path)
    first = ["What was not tested", "What could not be judged", "Subject", "What failed", "Signatures", "Overview"]
    assert page.headings[:7] == [*first, "Tests"]
    assert page.row("at the step", "1.250 … 1.500 s") == (
        "Test b: Peak test_b.peak at the step in recordings/test b.run at t = 1.250 … 1.500 s "
        "≤ 8 A 9.00 A −1.00 (−12 %) FAIL"
    )
    assert page.rows[:2] == ["Why, and which tests Measurements Verdict", "no encoder Test d SKIPPED"]
    assert page.row("Test c", "no heartbeat for 1 s") == "Test c test_c no heartbeat for 1 s ERROR"
    links = ["#test-4", "#test-3", "#test-2", "recordings/test%20b.run", "#test-1"]  # the overview's last
    assert page.links[:5] == links
    assert {link[1:] for link in page.links if link.startswith("#")} <= page.ids
    assert "the link was lost" in page.text
    assert "no encoder" in page.text


def test_what_was_not_tested_is_there_by_reason_before_any_count(tmp_path: Path) -> None:
    run = a_run(
        made("good", "P", "P"),
        made("brake", "S", "SS", why="needs a load"),
        made("half", "S", "PS", why="needs a load"),
        made("last", "A", "AAAA", why="the run was ended"),
        made("empty", "S", why="later"),
        verdict=Verdict.ABORTED,
        deselected={"other[2]": "Other, wire 2"},
    )
    page = written(run, tmp_path)
    assert page.rows[1:5] == [
        "the run was ended Last 4 ABORTED",
        "needs a load Brake; Half 3 SKIPPED",
        "later Empty SKIPPED",
        "not selected for this run Other, wire 2",
    ]
    assert page.text.index("needs a load") < page.text.index("5 tests:")
    assert "The run was ended early: 1 of 5 tests passed." in page.text


@pytest.mark.parametrize(("verdict", "letters", "words"), [
    ("PASS", "PP", "All measurements are within their limits."),
    ("PASS", "PS", "All that was tested is within its limits: 1 of 2 tests passed, 1 was skipped."),
    ("FAIL", "PFF", "The drive did not pass: 2 of 3 tests failed."),
    ("FAIL", "FEI", "The drive did not pass: 1 of 3 tests failed, 2 could not be judged."),
    ("INCOMPLETE", "PSS", "Not everything was tested: 1 of 3 tests passed, 2 were skipped."),
    ("INCOMPLETE", "SS", "Nothing was tested."),
    ("INVALID", "PI", "The data are insufficient for a verdict."),
    ("ERROR", "PE", "The bench is at fault: there is no verdict on the drive."),
])  # fmt: skip
def test_a_verdict_is_said_in_a_sentence(tmp_path: Path, verdict: str, letters: str, words: str) -> None:
    tests = [made(f"t{k}", letter) for k, letter in enumerate(letters)]
    assert words in written(a_run(*tests, verdict=Verdict(verdict)), tmp_path).text


def test_the_overview_has_a_row_for_each_test_with_its_tightest_margin(tmp_path: Path) -> None:
    wide = measurement("test_a.wide", 1.0, Verdict.PASS, 0, 2)
    tight = measurement("test_a.tight", 1.9, Verdict.PASS, 0, 2)
    none = measurement("test_b.none", None, Verdict.ERROR, 0, 2)
    page = written(a_run(a_test("test_a", Verdict.PASS, wide, tight), a_test("test_b", Verdict.ERROR, none)), tmp_path)
    assert page.rows[3:5] == [
        "PASS Test a test_a title of test_a 2 +0.100 (5 %) Tight [A]",
        "ERROR Test b test_b title of test_b 0 of 1",
    ]


PASSED, FAILED = Verdict.PASS, Verdict.FAIL


@pytest.mark.parametrize(("tightest", "others"), [
    (measurement("t.x", 9.0, PASSED, 0, 10), [measurement("t.y", 1.5, PASSED, 0, 2)]),  # 10 % against 25 %
    (measurement("t.x", 0.5, PASSED, hi=1), [measurement("t.y", 1.0, PASSED, 1, 1)]),  # a yes
    (measurement("t.x", 0.0, FAILED, 1, 1), [measurement("t.y", 2.5, FAILED, 0, 2)]),  # not a yes
    (measurement("t.x", math.nan, FAILED, 0, 2), [measurement("t.y", 1.0, PASSED, 0, 2)]),
    (measurement("t.x", 1.0, PASSED, 0, 2), [measurement("t.y", 9.0, Verdict.INVALID, 0, 2)]),
    (None, [measurement("t.y", 0.0, PASSED, hi=0), measurement("t.z", None, Verdict.ERROR, 0, 2)]),
    (None, [measurement("t.y", 3.0, PASSED)]),
])  # fmt: skip
def test_the_tightest_margin(tightest: Measurement | None, others: list[Measurement]) -> None:
    for found in ([tightest, *others], [*others, tightest]):
        assert closest(m for m in found if m) is tightest


def test_a_test_that_made_no_measurement_is_one_row(tmp_path: Path) -> None:
    made_one = measurement("test_b.made", 0.5, Verdict.PASS, hi=1.0)
    not_made = measurement("test_b.not", None, Verdict.ERROR, hi=1.0)
    tests = made("test_a", "A", 28 * "A", why="the run was ended"), a_test("test_b", Verdict.ERROR, made_one, not_made)
    page = written(a_run(*tests, verdict=Verdict.ERROR), tmp_path)
    assert page.rows[1:4:2] == ["the run was ended Test a 28 ABORTED", "Test b: Not test_b.not ≤ 1 A – – ERROR"]
    assert page.text.count("28 measurements, none made") == 1
    assert all(f"M{k}: 0 … 2 A" in page.text for k in range(28))
    assert page.tags.count("details") == 1


def test_quality_of_the_data_is_shown_and_remarked_on(tmp_path: Path) -> None:
    quality = Quality(63000, 1100, 964, 3, 12, 2, 1, 15750.0, 4.0, ("the link was down for 60 ms",))
    page = written(a_run(a_test("test_a", quality=quality), a_test("test_b")), tmp_path)
    assert page.row("Test a", "964") == "Test a 63000 15750 4.00 1100 964 3 12 2 1"
    assert page.row("the link was down for 60 ms") == "the link was down for 60 ms"


def test_markup_in_what_others_say_is_text(tmp_path: Path) -> None:
    (tmp_path / "f.png").write_bytes(b"png")
    found = measurement(f"t.{EVIL}", 1.0, Verdict.FAIL, hi=0.5, why=EVIL, about=EVIL)
    test = TestResult(
        EVIL, EVIL, EVIL, EVIL, Verdict.FAIL, EVIL, (found,), (Figure("f.png", EVIL),), EVIL, log=EVIL,
        quality=Quality(1, remarks=(EVIL,)), parameters={EVIL: 1.0},
    )  # fmt: skip
    run = a_run(
        test,
        verdict=Verdict.FAIL,
        identity={EVIL: EVIL, "name": EVIL},
        parameters=(ParameterValue(EVIL, 1.0, 2.0, EVIL, EVIL),),
        rig={EVIL: EVIL},
        versions={EVIL: EVIL},
        error=EVIL,
    )
    page = written(run, tmp_path)
    assert "script" not in page.tags
    assert page.text.count(EVIL) >= 20
    assert not any(link.startswith("javascript:") for link in page.links)


@given(st.text())
def test_a_string_in_a_style_sheet_ends_nothing(text: str) -> None:
    written = css_string(text)
    assert re.fullmatch(r'"([A-Za-z0-9 ]|\\[0-9a-f]{1,6} )*"', written)
    read = re.sub(r"\\([0-9a-f]+) ", lambda found: chr(int(found[1], 16)), written[1:-1])
    assert " ".join(text.split()).startswith(read)


def test_the_style_sheet_stays_whole_whatever_a_drive_is_called(tmp_path: Path) -> None:
    run = a_run(identity={"name": '</style><script>"}', "serial": "*/ } body { display: none"})
    assert "script" not in written(run, tmp_path).tags
    sheet = (tmp_path / "report.html").read_text().partition("<style>")[2].partition("</style>")[0]
    assert "script" not in sheet.replace("\\", "")[sheet.index("@page :first") :]
    assert sheet.count("{") == sheet.count("}")
    assert "ellipsis" not in sheet


def test_figures_are_in_the_file_and_nothing_is_fetched(tmp_path: Path) -> None:
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "a.png").write_bytes(b"any bytes")
    run = a_run(a_test("test_a", figures=(Figure("figures/a.png", "what it shows"),), recording="a.run"))
    page = written(run, tmp_path)
    (source,) = page.sources
    kind, _, data = source.partition(",")
    assert (kind, base64.b64decode(data)) == ("data:image/png;base64", b"any bytes")
    assert "what it shows" in page.text
    assert {"link", "script", "iframe"}.isdisjoint(page.tags)
    assert not any("//" in link for link in page.links)
    style_sheet = (tmp_path / "report.html").read_text("utf-8").partition("<style>")[2].partition("</style>")[0]
    assert "@media print" in style_sheet
    assert "url(" not in style_sheet
    assert "@import" not in style_sheet


def test_a_figure_or_a_directory_that_is_missing_is_named(tmp_path: Path) -> None:
    run = a_run(a_test("test_a", figures=(Figure("figures/a.png", ""),)))
    with pytest.raises(ReportError, match=r"^figure .*figures/a\.png of test test_a cannot be read: No such file"):
        write_report(run, tmp_path)
    assert not (tmp_path / "report.html").exists()
    with pytest.raises(BenchError, match=r"report .*none/report\.html cannot be written: No such file"):
        write_report(a_run(), tmp_path / "none")


@pytest.mark.long("a browser prints the page")
@needs("chromium", "pdftotext")
def test_on_paper_pages_are_numbered_nothing_is_folded_and_the_signatures_are_on_one_page(tmp_path: Path) -> None:
    figure, (ax,) = style.new_figure()
    style.line(ax, np.arange(2.0), np.arange(2.0), "i_q")
    style.save(figure, tmp_path / "a.png")
    tests = [made(f"t{k}", "P", 20 * "P", figures=(Figure("a.png", f"caption {k}"),), log=f"end {k}") for k in range(3)]
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


# -- in words ---------------------------------------------------------------------------------------------------


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
    Path("bench.toml").write_text('[limits]\n"answers.alone" = { lo = 2, hi = 2 }\n')
    with pytest.raises(BenchError, match="alone: the answer is 1 for yes or 0 for no, and the limit is 2"):
        accepting(ANSWERS.format(alone=True))
    assert str(must_be_yes("x")) == "yes"
    assert [str(Limits("x", YES_NO, lo, hi)) for lo, hi in ((0, 1), (0, 0), (None, 0), (None, None), (0, None))] == [
        "yes or no", "no", "no", "for information", "yes or no",
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


@pytest.mark.parametrize(("value", "lo", "hi", "unit", "text"), [
    (13.4567, None, 10.0, "%", "13.46 %"),
    (3000.4321, 2990.0, 3010.0, "r/min", "3000.43 r/min"),
    (0.0312345, 0.0, 0.05, "s", "0.0312 s"),
    (10.0004, None, 10.0, "%", "10.0004 %"),
    (3.0, None, 0.0, "", "3"),
    (-0.00001, -1.0, 1.0, "A", "0.000 A"),
    (-0.5, -1.0, 1.0, "A", "−0.500 A"),
    (123.456, None, None, "V", "123.5 V"),
    (0.0, None, None, "V", "0 V"),
    (math.inf, None, 1.0, "V", "∞ V"),
])  # fmt: skip
def test_digits(value: float, lo: float | None, hi: float | None, unit: str, text: str) -> None:
    assert words.value_text(Measurement("t.x", Limits("x", unit, lo, hi), Verdict.PASS, value)) == text


@given(
    st.floats(-1e8, 1e8).filter(lambda v: v == 0 or abs(v) > 1e-3),
    st.floats(-1e6, 1e6),
    st.floats(1e-3, 1e6),
    st.sampled_from(["both", "lo", "hi"]),
)
def test_a_bar_shows_on_which_side_of_a_limit_a_value_lies(value: float, lo: float, width: float, ends: str) -> None:
    limits = Limits("x", "A", None if ends == "hi" else lo, None if ends == "lo" else lo + width)
    place = words.place(Measurement("t.x", limits, Verdict.PASS, value))
    zone = words.zone(limits)
    assert place is not None
    assert 0 <= place <= 100
    if limits.allow(value):
        assert zone[0] - 1e-9 <= place <= zone[1] + 1e-9
    else:
        assert place <= zone[0] + 1e-9 or place >= zone[1] - 1e-9


@pytest.mark.parametrize(("value", "place"), [(0.0, 80.0), (1.0, 100.0), (-1.0, 0.0)])
def test_a_limit_of_nothing_has_a_bar_too(value: float, place: float) -> None:
    assert words.place(Measurement("t.x", Limits("x", "", None, 0.0), Verdict.PASS, value)) == place


def test_docstrings_are_filled_but_lists_stay() -> None:
    text = "One sentence\n    that goes on.\n\n    What counts:\n    - one,\n    - two.\n\n    The end.\n"
    assert words.paragraphs(text) == ["One sentence that goes on.", "What counts:\n- one,\n- two.", "The end."]


def test_durations() -> None:
    assert [words.duration(s) for s in (1.25, 61, 3599.7, 7322)] == ["1.2 s", "1 min 1 s", "1 h 0 min", "2 h 2 min"]


# -- figures ----------------------------------------------------------------------------------------------------


def drawn(path: Path) -> bytes:
    figure, (upper, lower) = style.new_figure(2)
    t = np.arange(0, 2, 1 / 16000)
    style.line(upper, t, np.random.default_rng(1).normal(size=len(t)), "i_q")
    style.line(upper, t, 0 * t, "i_q_ref")
    style.line(lower, t, style.wrapped_degrees((40 * t + np.pi) % (2 * np.pi) - np.pi), "theta_vt")
    style.degrees_axis(lower, "position", 180)
    style.limit_lines(upper, None, 2.0)
    style.axis_labels(upper, "", "current", "", "A")
    style.time_axes([upper, lower], 0, 2)
    style.legend_above(upper)
    style.legend_above(lower)
    style.save(figure, path)
    figure.draw_without_rendering()
    labels = [lower.xaxis.label, upper.yaxis.label, *upper.get_yticklabels(), *upper.get_legend().get_texts()]
    assert min(label.get_fontsize() for label in labels) >= 8
    assert [lower.get_xlabel(), upper.get_ylabel(), lower.get_ylabel()] == ["t [s]", "current [A]", "position [el. °]"]
    return path.read_bytes()


def test_a_figure_is_as_wide_as_a_page_and_always_the_same(tmp_path: Path) -> None:
    first, second = drawn(tmp_path / "a.png"), drawn(tmp_path / "b.png")
    assert hashlib.sha256(first).digest() == hashlib.sha256(second).digest()
    width, _ = struct.unpack(">II", first[16:24])  # of the PNG's header
    assert width == round(7.16 * 200)
    assert not any(chunk in first for chunk in (b"tEXt", b"tIME"))


@pytest.mark.parametrize(
    ("names", "rows"),
    [([f"a quantity with a long name {k}" for k in range(9)], None),
     (["vector tracking", "encoder", "reference", "last setpoint", "FAULT"], 1)],
    ids=("long names", "five of unequal length"),
)  # fmt: skip
def test_a_legend_stays_within_the_axes_and_is_as_low_as_it_can_be(names: list[str], rows: int | None) -> None:
    figure, (ax,) = style.new_figure()
    for k, name in enumerate(names):
        style.line(ax, np.arange(2.0), np.arange(2.0) + k, name, label=name)
    style.legend_above(ax)
    figure.draw_without_rendering()
    legend, axes = ax.get_legend().get_window_extent(), ax.get_window_extent()
    assert legend.x1 <= axes.x1
    assert legend.y0 >= axes.y1 - 1  # px: above the data
    lines = {round(text.get_window_extent().y0) for text in ax.get_legend().get_texts()}
    assert rows is None or len(lines) == rows


def test_limits_of_the_ordinate_are_named_once() -> None:
    _, (ax,) = style.new_figure()
    style.limit_lines(ax, -8.0, 8.0, "i_max")
    assert [line.get_ydata()[0] for line in ax.get_lines()] == [-8.0, 8.0]
    assert ax.get_legend_handles_labels()[1] == ["i_max"]


def test_the_title_of_a_column_stands_above_the_legend() -> None:
    figure, axes = style.new_figure(1, 2)
    for ax in axes:
        style.line(ax, np.arange(2.0), np.arange(2.0), "i_q")
    style.legend_above(axes[0])
    for ax, words_above in zip(axes, ("(a) average speed", "(b) proposed"), strict=True):
        style.column_title(ax, words_above)
    figure.draw_without_rendering()
    titles = [text for ax in axes for text in ax.get_children() if getattr(text, "get_text", str)()[:1] == "("]
    assert [title.get_text() for title in titles] == ["(a) average speed", "(b) proposed"]
    assert titles[0].get_window_extent().y0 >= axes[0].get_legend().get_window_extent().y1 - 4  # px: its empty border
    assert titles[1].get_window_extent().y0 >= axes[1].get_window_extent().y1
    assert titles[0].get_window_extent().y1 <= figure.bbox.y1


def test_lines_do_not_cross_the_plot_where_an_angle_wraps() -> None:
    degrees = style.wrapped_degrees(np.array([3.0, 3.1, -3.1, -3.0]))
    np.testing.assert_array_equal(np.isnan(degrees), [False, False, True, False])
    np.testing.assert_allclose(degrees[[0, 1, 3]], [171.887, 177.617, -171.887], atol=1e-3)


def test_a_quantity_has_one_colour() -> None:
    assert style.colour("theta_vt") == style.colour("omega_vt") != style.colour("theta_avg")
    assert style.colour("a name that nobody knows") in style.SERIES

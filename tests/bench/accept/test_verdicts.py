"""What makes a test PASS, FAIL, INVALID, ERROR, SKIPPED or ABORTED, and what the exit code says of it."""

from __future__ import annotations

import math
import re

import pytest
from accepting import Accepting, Run, SpoiltLink, accepting_in
from shared import table
from virtual_run import at_rest, simulated

from bench.accept.results import Verdict

pytestmark = pytest.mark.slow

CASES = table("verdicts")["tests"]
EXPECTED = {case["name"]: (case["verdict"], case.get("why", "")) for case in CASES}
TESTS = """
def may_trip(drive, record):
    with drive.may_trip():
        trip(record)
        record.wait(0.1)
    assert drive.faults == ("WATCHDOG",)

def stopped(record):
    with record.stretch() as stretch:
        record.wait(0.1)
        record.rig.drive.node.stop_streams()
        record.wait(0.1)
    return stretch.capture

@pytest.fixture
def trips_later(drive, record):
    yield
    turn(drive, record)  # it was stopped when the test returned
    trip(record)
""" + "".join(
    "\n".join(["", *case.get("marks", "").split("|"), f"def test_{case['name']}({case['given']}):", *body, ""])
    for case in CASES
    for body in [[f"    {does}" for does in case["does"].split("; ")]]
)


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Run:
    with accepting_in(tmp_path_factory.mktemp("verdicts")) as accepting:
        return accepting(TESTS)


@pytest.mark.long("the first of them runs all tests of the file")
@pytest.mark.parametrize("name", EXPECTED)
def test_the_verdict_on_a_test_and_its_reason(ran: Run, name: str) -> None:
    verdict, why = EXPECTED[name]
    assert ran[name].verdict == verdict
    assert re.fullmatch(why + ".*" if why else "", ran[name].why), ran[name].why


def test_every_test_has_its_verdict_in_the_order_of_the_file_and_the_worst_is_that_of_the_run(ran: Run) -> None:
    assert (list(ran.tests), (ran.result.verdict, ran.code)) == (list(EXPECTED), (Verdict.FAIL, 1))


def test_the_verdict_on_each_measurement(ran: Run) -> None:
    """What was measured before a test broke off keeps its verdict; what was not gets that of the test."""
    verdicts = {name: (str(m.verdict), m.value) for name, m in ran.measured.items()}
    values = {name: value for name, value in verdicts.items() if not name.startswith("nan")}
    assert values == {
        "passes.told": ("PASS", -1e9), "passes.at_hi": ("PASS", 2.0), "passes.at_lo": ("PASS", 1.0),
        "out_of_limits.low": ("FAIL", 0.9), "out_of_limits.high": ("FAIL", 1.1), "out_of_limits.after": ("PASS", 1.0),
        "assertion.x": ("FAIL", None), "pytest_fail.x": ("FAIL", None),
        "trips_while_waiting.x": ("FAIL", None), "trips_before_a_set_point.x": ("FAIL", None),
        "trips_at_the_end.x": ("PASS", 0.0), "trips_once_it_has_returned.x": ("PASS", 0.0),
        "exception.x": ("PASS", 1.0), "exception.y": ("ERROR", None), "exception_after_a_failure.x": ("FAIL", 2.0),
        "never_measured.x": ("PASS", 1.0), "never_measured.y": ("ERROR", None),
        "undeclared.x": ("PASS", 1.0), "twice.x": ("PASS", 1.0),
        "too_fast.x": ("ERROR", None), "too_much_current.x": ("ERROR", None),
        "lacks.x": ("SKIPPED", None), "lacks_nothing.x": ("PASS", 1.0), "at_standstill.x": ("PASS", 0.0),
        "samples_end_early.x": ("INVALID", 0.0),
        "skips_half_way.x": ("PASS", 0.0), "skips_half_way.y": ("SKIPPED", None),
        "skips_after_a_failure.x": ("FAIL", 2.0), "fails_as_expected.x": ("FAIL", 2.0),
        "is_not_run.x": ("SKIPPED", None), "passes_against_its_mark.x": ("PASS", 0.0),
        "passes_by_its_mark.x": ("PASS", 0.0), "answers_half.x": ("ERROR", None),
    }  # fmt: skip
    for name in ("nan.x", "nan_answer.x"):
        assert (verdicts[name][0], math.isnan(verdicts[name][1] or 0.0), ran.measured[name].why) == (
            "FAIL", True, "is not a number",
        )  # fmt: skip
    assert ran.measured["never_measured.y"].why == "declared, but never measured"
    assert re.fullmatch(r"no sample received after \d\.\d{4} s", ran.measured["samples_end_early.x"].why)


def test_only_what_broke_unforeseen_has_a_traceback(ran: Run) -> None:
    logged = {test.name for test in ran.result.tests if test.log}
    assert logged == {"assertion", "pytest_fail", "asserts_then_trips", "exception", "exception_after_a_failure"}
    assert "no such key" in ran["exception"].log


def test_the_screen_names_each_test_and_each_measurement_that_did_not_pass(ran: Run) -> None:
    notes = "\n".join(ran.screen.notes)
    for name, (verdict, _) in EXPECTED.items():
        assert re.search(rf"^{verdict} +{name}\b", notes, re.MULTILINE), name
    assert "        out_of_limits.high = 1.1 A [≤ 1 A] FAIL" in ran.screen.notes
    assert "out_of_limits.after" not in notes
    assert "PASS    passes  3 measurements" in ran.screen.notes  # those at a limit have no room to speak of
    assert "PASS    at_standstill  1 measurement, tightest x = 0 [≤ 1]" in ran.screen.notes


# -- data that cannot tell --------------------------------------------------------------------------------------

LOSS = """
NAMES = "before", "during", "too_much_during", "part_without", "part_with", "after", "both", "from_nothing"
@limits(*(Limits(name, hi=1) for name in NAMES), Limits("samples"))
def test_loses(drive, record, measure):
    turn(drive, record)
    a = record(0.1)
    link = record.rig.client.link
    with record.stretch() as stretch:
        record.wait(0.1)
        link.lose = 1
        record.wait(0.1)
    b = stretch.capture
    record.wait(0.02)
    c = record(0.1)
    gap = int(np.argmax(np.diff(b.samples.index)))
    measure("before", 0, a)
    measure("during", 0.5, b)
    measure("too_much_during", 2, b)
    measure("part_without", 0, b.between(b.t[0], b.t[gap - 1]))
    measure("part_with", 0, b.between(b.t[gap], b.t[-1]))
    measure("after", 0, c)
    measure("both", 0, a, b)
    measure("from_nothing", 0)
    measure("samples", len(b))
@limit("x", hi=1)
def test_next(record, measure): measure("x", 0, record(0.1))
"""


def test_one_lost_frame_makes_invalid_what_was_measured_from_it_and_nothing_else(accepting: Accepting) -> None:
    link = SpoiltLink(simulated())
    run = accepting(LOSS, link)
    verdicts = {name: str(m.verdict) for name, m in run.measured.items()}
    invalid = {"loses.during", "loses.too_much_during", "loses.part_with", "loses.both"}
    assert {name for name, verdict in verdicts.items() if verdict == "INVALID"} == invalid
    assert {verdict for name, verdict in verdicts.items() if name not in invalid} == {"PASS"}
    assert (run.tests, run.code) == ({"loses": "INVALID", "next": "PASS"}, 2)
    during = run.measured["loses.during"]
    assert during.value == 0.5
    match = re.fullmatch(r"(\d+) samples were lost before (\d+\.\d{4}) s", during.why)
    assert match
    # independently: how many there should be in the stretch, and when the link threw the frame away
    expected = round((during.span[1] - during.span[0]) * 16000) + 1
    assert int(match[1]) == expected - run.measured["loses.samples"].value > 0
    assert float(match[2]) == pytest.approx(link.lost_at, abs=0.05)
    quality = run["loses"].quality
    assert (quality.lost_samples, quality.remarks) == (int(match[1]), (during.why,))
    assert run["next"].quality.lost_samples == 0


# -- broken off -------------------------------------------------------------------------------------------------

BROKEN_OFF = """
@limit("x", hi=1)
def test_first(measure): measure("x", 1)
@limit("x", hi=1)
@limit("y", hi=1)
def test_second(drive, record, measure):
    turn(drive, record)
    measure("x", 1)
    END
@limit("x", hi=1)
def test_third(measure): measure("x", 1)
"""


@pytest.mark.parametrize(
    "end", ["signal.raise_signal(signal.SIGINT)", "signal.raise_signal(signal.SIGTERM)", "pytest.exit('enough')"]
)
def test_a_run_that_is_ended_is_aborted_from_the_running_test_on(accepting: Accepting, end: str) -> None:
    link = SpoiltLink(simulated())
    run = accepting(BROKEN_OFF.replace("END", end), link)
    assert run.tests == {"first": "PASS", "second": "ABORTED", "third": "ABORTED"}
    assert {name: str(m.verdict) for name, m in run.measured.items()} == {
        "first.x": "PASS", "second.x": "PASS", "second.y": "ABORTED", "third.x": "ABORTED",
    }  # fmt: skip
    assert (run.result.verdict, run.code) == (Verdict.ABORTED, 130)
    assert at_rest(link.device)


def test_a_link_that_closes_is_an_error_that_tells_both_of_the_link_and_of_the_machine(accepting: Accepting) -> None:
    text = """
@limit("x", hi=1)
def test_cut(drive, record):
    turn(drive, record)
    record.rig.client.link.close()
    record.wait(0.1)
@limit("x", hi=1)
def test_next(measure): measure("x", 1)
"""
    link = SpoiltLink(simulated())
    run = accepting(text, link)
    assert run["cut"].verdict is Verdict.ERROR
    assert run["cut"].why == (
        "virtual: is closed; then OUTPUTS MAY STILL BE ON: cut the power. STOP was not sent, or its answer not heard: "
        "virtual: is closed (3 tries); node 1 on virtual: was not confirmed off"
    )
    # time stood still on the closed link: the drive still runs, and nothing more is energised
    assert run["next"].verdict is Verdict.ERROR
    assert run["next"].why.startswith("OUTPUTS MAY STILL BE ON")
    assert run.code == 5
    link.device.advance(16000)
    assert not any(session.app.outputs_on for session in link.device.sessions)

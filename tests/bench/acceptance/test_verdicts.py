"""What makes a test PASS, FAIL, INVALID, ERROR, SKIPPED or ABORTED, and what the exit code says of it."""

from __future__ import annotations

import math
import re

import pytest
from accepting import Accepting, Run, SpoiltLink
from virtual_run import at_rest, simulated

from bench.acceptance.results import Verdict

pytestmark = pytest.mark.slow

TESTS = '''
@limit("at_lo", lo=1, hi=2)
@limit("at_hi", lo=1, hi=2)
@limit("told")
def test_passes(measure):
    assert measure("at_lo", 1) and measure("at_hi", 2) and measure("told", -1e9)

@limit("low", "A", lo=1)
@limit("high", "A", hi=1)
@limit("after", "A", hi=1)
def test_out_of_limits(measure):
    assert not measure("low", 0.9) and not measure("high", 1.1)
    measure("after", 1)

@limit("x", hi=1)
def test_nan(measure):
    measure("x", math.nan)

@limit("x", hi=1)
def test_assertion(drive):
    assert drive.n_p == 7, "seven pole pairs"

@limit("x", hi=1)
def test_pytest_fail(drive):
    pytest.fail("because I say so")

@limit("x", hi=1)
def test_trips_while_waiting(drive, record):
    turn(drive, record)
    record.rig.client.feed(1, on=False)
    record.wait(1.0)

@limit("x", hi=1)
def test_trips_before_a_set_point(drive, record):
    turn(drive, record)
    trip(record)
    drive.speed(rpm=0)

@limit("x", hi=1)
def test_trips_at_the_end(drive, record, measure):
    turn(drive, record)
    measure("x", 0)
    trip(record)

def test_may_trip(drive, record):
    turn(drive, record)
    with drive.may_trip():
        trip(record)
        record.wait(0.1)
    assert drive.faults == ("WATCHDOG",)
    record.wait(0.1)
    drive.forget_faults()
    turn(drive, record)

@limit("x", hi=1)
def test_trips_once_it_has_returned(drive, record, measure):
    turn(drive, record)
    measure("x", 0)
    record.rig.client.link.device.advance(8000)  # half a second, in which nobody listens

@pytest.fixture
def trips_later(drive, record):
    yield
    turn(drive, record)  # it was stopped when the test returned
    trip(record)

def test_trips_in_a_fixture(trips_later): pass

def test_asserts_then_trips(trips_later):
    assert False, "this first"

def test_trips_after_a_forgotten_one(drive, record):
    turn(drive, record)
    with drive.may_trip():
        trip(record)
    drive.forget_faults()
    turn(drive, record)
    trip(record)

@limit("x", hi=1)
@limit("y", hi=1)
def test_exception(measure):
    measure("x", 1)
    {}["no such key"]

@limit("x", hi=1)
def test_exception_after_a_failure(measure):
    measure("x", 2)
    {}["no such key"]

@limit("x", hi=1)
@limit("y", hi=1)
def test_never_measured(measure):
    measure("x", 1)

@limit("x", hi=1)
def test_undeclared(measure):
    measure("x", 1)
    measure("z", 1)

@limit("x", hi=1)
def test_twice(measure):
    measure("x", 1)
    measure("x", 1)

@limit("x", hi=1)
@energises(rpm=100, current=1)
def test_too_fast(drive):
    drive.start()
    drive.speed(rpm=-101)

@limit("x", hi=1)
@energises(rpm=100, current=1)
def test_too_much_current(drive):
    drive.start()
    drive.current(0.8, -0.8)

@limit("x", hi=1)
@needs("encoder", "parameter:no_such", "channel:no_such")
def test_lacks(measure):
    measure("x", 2)

@limit("x", hi=1)
@needs("encoder", "load", "load.speed", "rate:16000", "channel:i_a", "parameter:i_max")
def test_lacks_nothing(measure):
    measure("x", 1)

@needs("rate:16001")
def test_lacks_rate(measure): pass

@needs("a miracle")
def test_needs_what_there_is_not(measure): pass

@limit("x", hi=1)
def test_at_standstill(record, measure):
    """A shaft at rest has no Hall edges, and that is no flaw."""
    still = record(0.1)
    measure("x", len(still.edges), still)

@limit("x", hi=1)
def test_samples_end_early(record, measure):
    with record.stretch() as stretch:
        record.wait(0.1)
        record.rig.drive.node.stop_streams()
        record.wait(0.1)
    measure("x", 0, stretch.capture)

def test_no_samples_at_all(record):
    record.rig.drive.node.stop_streams()
    record.wait(0.1)
    record(0.1)
'''
EXPECTED = {
    "passes": ("PASS", ""),
    "out_of_limits": ("FAIL", "2 of 3 measurements did not pass"),
    "nan": ("FAIL", "1 of 1 measurements did not pass"),
    "assertion": ("FAIL", "seven pole pairs"),
    "pytest_fail": ("FAIL", "because I say so"),
    "trips_while_waiting": ("FAIL", "the drive tripped: WATCHDOG"),
    "trips_before_a_set_point": ("FAIL", "the drive tripped: WATCHDOG"),
    "trips_at_the_end": ("FAIL", "the drive tripped: WATCHDOG"),
    "may_trip": ("PASS", ""),
    "trips_once_it_has_returned": (
        "FAIL",
        r"the drive tripped: WATCHDOG: this host sent no ALIVE for 0\.5\d s.*; compute after drive\.stop",
    ),
    "trips_in_a_fixture": ("FAIL", "the drive tripped: WATCHDOG"),
    "asserts_then_trips": ("FAIL", "this first; then the drive tripped: WATCHDOG"),
    "trips_after_a_forgotten_one": ("FAIL", "the drive tripped: WATCHDOG"),
    "exception": ("ERROR", "KeyError: 'no such key'"),
    "exception_after_a_failure": ("FAIL", "KeyError: 'no such key'"),
    "never_measured": ("ERROR", "1 of 2 measurements did not pass"),
    "undeclared": ("ERROR", "undeclared measures 'z' but declares only: x"),
    "twice": ("ERROR", "twice measures 'x' twice"),
    "too_fast": ("ERROR", r"speed 101 r/min is beyond the announced limit of 100 r/min: .*rpm=…"),
    "too_much_current": ("ERROR", r"current 1\.131 A is beyond the announced limit of 1 A: .*current"),
    "lacks": ("SKIPPED", "needs the parameter no_such; needs the channel no_such"),
    "lacks_nothing": ("PASS", ""),
    "lacks_rate": ("SKIPPED", "needs 16001 samples a second; the link carries 16000"),
    "needs_what_there_is_not": ("ERROR", r"@needs\('a miracle'\): there are encoder, "),
    "at_standstill": ("PASS", ""),
    "samples_end_early": ("INVALID", "1 of 1 measurements did not pass"),
    "no_samples_at_all": ("ERROR", r"no DATA for \S+ s on virtual:"),
}


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Run:
    with pytest.MonkeyPatch.context() as patched:
        directory = tmp_path_factory.mktemp("table")
        patched.chdir(directory)
        patched.delenv("BENCH_TARGET", raising=False)
        return Accepting(directory)(TESTS)


@pytest.mark.parametrize("name", EXPECTED)
def test_the_verdict_on_a_test_and_its_reason(table: Run, name: str) -> None:
    verdict, why = EXPECTED[name]
    assert table[name].verdict == verdict
    assert re.fullmatch(why + ".*" if why else "", table[name].why), table[name].why


def test_every_test_has_its_verdict_in_the_order_of_the_file_and_the_worst_is_that_of_the_run(table: Run) -> None:
    assert list(table.tests) == list(EXPECTED)
    assert (table.result.verdict, table.code) == (Verdict.FAIL, 1)


def test_the_verdict_on_each_measurement(table: Run) -> None:
    """What was measured before a test broke off keeps its verdict; what was not gets that of the test."""
    verdicts = {name: (str(m.verdict), m.value) for name, m in table.measured.items()}
    values = {name: value for name, value in verdicts.items() if not name.startswith("nan.")}
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
    }  # fmt: skip
    nan = table.measured["nan.x"]
    assert nan.verdict is Verdict.FAIL
    assert nan.value is not None
    assert math.isnan(nan.value)
    assert table.measured["never_measured.y"].why == "declared, but never measured"
    assert re.fullmatch(r"no sample received after \d\.\d{4} s", table.measured["samples_end_early.x"].why)


def test_only_what_broke_unforeseen_has_a_traceback(table: Run) -> None:
    logged = {test.name for test in table.result.tests if test.log}
    assert logged == {"assertion", "pytest_fail", "asserts_then_trips", "exception", "exception_after_a_failure"}
    assert "no such key" in table["exception"].log


def test_the_screen_names_each_test_and_each_measurement_that_did_not_pass(table: Run) -> None:
    notes = "\n".join(table.screen.notes)
    for name, (verdict, _) in EXPECTED.items():
        assert re.search(rf"^{verdict} +{name}\b", notes, re.MULTILINE), name
    assert "        out_of_limits.high = 1.1 A [≤ 1 A] FAIL" in table.screen.notes
    assert "out_of_limits.after" not in notes
    assert "PASS    passes  3 measurements" in table.screen.notes  # those at a limit have no room to speak of
    assert "PASS    at_standstill  1 measurement, tightest x = 0 [≤ 1]" in table.screen.notes


@pytest.mark.parametrize(
    ("which", "verdict", "code"),
    [("test_passes", "PASS", 0), ("test_passes or test_lacks_rate", "INCOMPLETE", 6),
     ("test_passes or test_twice", "ERROR", 2),
     ("test_lacks_rate", "INCOMPLETE", 6), ("test_twice or test_nan", "FAIL", 1)],
    ids=("good", "one skipped", "bench", "nothing to judge", "drive"),  # -k looks at names of directories too
)  # fmt: skip
def test_the_exit_code(accepting: Accepting, which: str, verdict: str, code: int) -> None:
    run = accepting(TESTS, keyword=which)
    assert (run.result.verdict, run.code) == (verdict, code)


# -- data that cannot tell --------------------------------------------------------------------------------------

LOSS = """
@limit("before", hi=1)
@limit("during", hi=1)
@limit("too_much_during", hi=1)
@limit("part_without", hi=1)
@limit("part_with", hi=1)
@limit("after", hi=1)
@limit("both", hi=1)
@limit("from_nothing", hi=1)
@limit("samples", hi=1e9)
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
def test_next(record, measure):
    measure("x", 0, record(0.1))
"""


def test_one_lost_frame_makes_invalid_what_was_measured_from_it_and_nothing_else(accepting: Accepting) -> None:
    link = SpoiltLink(simulated())
    run = accepting(LOSS, link)
    verdicts = {name: str(m.verdict) for name, m in run.measured.items()}
    invalid = {"loses.during", "loses.too_much_during", "loses.part_with", "loses.both"}
    assert {name for name, verdict in verdicts.items() if verdict == "INVALID"} == invalid
    assert {verdict for name, verdict in verdicts.items() if name not in invalid} == {"PASS"}
    assert run.tests == {"loses": "INVALID", "next": "PASS"}
    assert run.code == 2
    during = run.measured["loses.during"]
    assert during.value == 0.5
    assert during.span is not None
    match = re.fullmatch(r"(\d+) samples were lost before (\d+\.\d{4}) s", during.why)
    assert match
    # independently: how many there should be in the stretch, and when the link threw the frame away
    expected = round((during.span[1] - during.span[0]) * 16000) + 1
    assert int(match[1]) == expected - run.measured["loses.samples"].value > 0
    assert float(match[2]) == pytest.approx(link.lost_at, abs=0.05)
    quality = run["loses"].quality
    assert quality.lost_samples == int(match[1])
    assert quality.remarks == (during.why,)
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

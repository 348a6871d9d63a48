"""However a test ends, the bench is at rest and as it was; nothing turns without consent; one run at a time."""

from __future__ import annotations

import itertools
import json
import re
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from accepting import HEAD, Accepting, SpoiltLink, never_armed
from processes import Program, Sim
from virtual_run import at_rest, physical, simulated

from bench.acceptance.targets import alone_on
from bench.errors import BenchError
from protocol.messages import DriveState, Fault

PATIENT = ("--set", "firmware.watchdog=1.0", "--set", "load.watchdog=1.0")  # other programs may want the machine

# -- however it ends --------------------------------------------------------------------------------------------

ENDINGS = """
@pytest.fixture
def turning(drive, load, record):
    drive.set("k_p_vt", 123.0)
    drive.set("i_max", 5.0)  # a drive takes it back at rest only
    load.set("tau_max", 0.5)
    load.torque(0.01)
    turn(drive, record)
    return record

@pytest.fixture
def broken(turning):
    raise RuntimeError("a user's fixture")

@pytest.fixture
def breaks_down(turning):
    yield
    raise RuntimeError("a user's fixture")

def test_returns(turning): pass
def test_assertion(turning): assert False
def test_exception(turning): raise OSError("a bug")
def test_skips(turning): pytest.skip("half-way")
def test_stopped_already(turning, drive): drive.stop()
def test_trips(turning): trip(turning)
def test_may_trip(turning, drive):
    with drive.may_trip():
        trip(turning)
def test_load_trips(turning, load):
    load.client.feed(2, on=False)
    turning.wait(0.5)
def test_overspeed(turning, load):
    load.speed(500 * RPM)
    turning.wait(0.2)
def test_behind_our_back(turning, drive):
    drive.stop()
    drive.node.arm()
    drive.node.start()
def test_fixture(broken): pass
def test_fixture_at_its_end(breaks_down): pass
def test_bench_error(turning, drive): drive.set("no_such", 1.0)
def test_last(drive): assert drive.state.name == "IDLE"
def test_deaf(turning): turning.rig.client.link.deaf = True
def test_fails_and_deaf(turning):
    turning.rig.client.link.deaf = True
    assert False, "this first"
"""
UNSTOPPED = (
    "the bench could not be left as it was: node 1 on virtual: did not answer STATE_CMD in 3 tries; the drive's "
    "watchdog switches its outputs off"
)


def test_the_next_test_finds_the_bench_at_rest_and_as_it_was(accepting: Accepting) -> None:
    link = SpoiltLink(simulated())
    run = accepting(ENDINGS, link, keyword="not deaf")
    assert run.tests == {
        "returns": "PASS", "assertion": "FAIL", "exception": "ERROR", "skips": "SKIPPED", "stopped_already": "PASS",
        "trips": "FAIL", "may_trip": "PASS", "load_trips": "PASS", "overspeed": "PASS", "behind_our_back": "PASS",
        "fixture": "ERROR", "fixture_at_its_end": "ERROR", "bench_error": "ERROR", "last": "PASS",
    }  # fmt: skip
    # before the consent, before each test, and now
    states = [*link.opened, link.left()]
    assert len(states) == len(run.tests) + 2
    for name, (rest, parameters) in zip(run.tests, states[2:], strict=True):
        assert rest, name
        assert parameters == states[0][1], name
    assert run["fixture"].why == "RuntimeError: a user's fixture"
    assert run["trips"].parameters == {"k_p_vt": 123.0, "i_max": 5.0}


@pytest.mark.parametrize(
    ("which", "verdict", "why"),
    [("test_deaf", "ERROR", UNSTOPPED), ("test_fails_and_deaf", "FAIL", f"this first; then {UNSTOPPED}")],
    ids=("else well", "failing"),
)  # fmt: skip
def test_a_stop_that_is_not_answered_is_told_and_the_watchdog_does_it(
    accepting: Accepting, which: str, verdict: str, why: str
) -> None:
    link = SpoiltLink(simulated())
    _, before = link.left()
    run = accepting(ENDINGS, link, keyword=which)
    (test,) = run.result.tests if run.result else ()
    assert (test.verdict, test.why) == (verdict, why)
    assert link.device.load.state == DriveState.IDLE
    link.device.advance(round(0.25 * link.device.pwm_hz))  # no host feeds it any more
    assert at_rest(link.device)
    assert link.device.drive.machine.faults == Fault.WATCHDOG
    at_rest_only = {"1.i_max"}  # a running drive did not take it back
    assert {name for name, value in link.left()[1].items() if value != before[name]} <= at_rest_only


def test_a_signal_at_any_point_ends_with_everything_at_rest(accepting: Accepting) -> None:
    file = accepting.write(ENDINGS)
    link = SpoiltLink(simulated())
    assert accepting(file, link, keyword="test_returns").code == 0
    states = link.states
    on = states.index(DriveState.RUNNING)
    off = len(states) - states[::-1].index(DriveState.RUNNING)
    points = [*range(2, on - 4, on // 3), *range(on - 4, on + 5, 2), *range(on + 5, off, (off - on) // 3)]
    assert len(points) >= 10
    kinds = itertools.cycle((signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
    for point, kind in zip(points, kinds, strict=False):

        def at_point(call: int, point: int = point, kind: signal.Signals = kind) -> None:
            if call == point:
                signal.raise_signal(kind)

        link = SpoiltLink(simulated(), at_point)
        before = link.left()
        run = accepting(file, link, keyword="test_returns")
        assert (run.tests, run.code) == ({"returns": "ABORTED"}, 130), point
        assert link.left() == before, point
        assert link.device.drive.machine.faults == Fault(0), point  # STOP did it, not the watchdog


def test_a_signal_while_all_is_put_back_does_not_keep_it_from_being_put_back(accepting: Accepting) -> None:
    file = accepting.write(ENDINGS)
    link = SpoiltLink(simulated())
    assert accepting(file, link, keyword="test_returns").code == 0
    off = len(link.states) - link.states[::-1].index(DriveState.RUNNING)
    for point in range(off, link.calls, (link.calls - off) // 3):

        def at_point(call: int, point: int = point) -> None:
            if call >= point:
                signal.raise_signal(signal.SIGINT)

        link = SpoiltLink(simulated(), at_point)
        before = link.left()
        accepting(file, link, keyword="test_returns")
        assert link.left() == before, point


def test_a_drive_with_a_latched_fault_is_not_touched(accepting: Accepting) -> None:
    link = SpoiltLink(simulated())
    link.device.drive.fault(Fault.OVERCURRENT)
    run = accepting("def test_turns(drive, record): turn(drive, record)", link)
    assert run["turns"].verdict == "ERROR"
    assert re.search(r"has a latched fault \(OVERCURRENT\): look into its cause", run["turns"].why)
    assert link.device.drive.state == DriveState.FAULT
    assert never_armed(link)


# -- consent ----------------------------------------------------------------------------------------------------

ANNOUNCED = """
@energises(speed_rpm=200, current=3)
def test_slow(drive, record): turn(drive, record, 200)

@energises(speed_rpm=150, current=4)
def test_strong(drive, record): turn(drive, record, 150)

@energises(speed_rpm=9999, current=99)
def test_beyond_all(drive, record): turn(drive, record)

def test_says_nothing(drive, record): turn(drive, record)
"""


@pytest.mark.parametrize(
    ("which", "speed"),
    [("test_slow", "200"), ("test_slow or test_strong", "200"), ("test_strong", "150"),
     ("test_beyond_all", "2300"), ("test_slow or test_says_nothing", "2300")],
    ids=("one", "two", "the other", "more than the drive lets", "one that does not say"),
)  # fmt: skip
def test_a_physical_drive_is_not_energised_where_nobody_can_be_asked(
    accepting: Accepting, which: str, speed: str
) -> None:
    link = SpoiltLink(physical())
    app = link.device.drive.app
    app.set_param("omega_m_max", 2300 * 3.14159265 / 30)
    with pytest.raises(BenchError) as refused:
        accepting(ANNOUNCED, link, keyword=which, json=Path("a.json"))
    boot, i_max = link.device.drive.identity.boot_id, app.get_param("i_max")
    assert re.fullmatch(
        rf"will not spin simulated drive \(boot {boot:08x}\) on serial:\S+: up to {speed}(\.\d+)? r/min, phase current "
        rf"up to {i_max:g} A: nobody to ask, give --yes if the shaft is clear",
        str(refused.value),
    )
    assert never_armed(link)
    written = json.loads(Path("a.json").read_text())
    assert (written["verdict"], written["error"], written["tests"]) == ("ERROR", str(refused.value), [])


def test_with_yes_it_turns(accepting: Accepting) -> None:
    link = SpoiltLink(physical())
    run = accepting(ANNOUNCED, link, keyword="test_slow", yes=True)
    assert run.tests == {"slow": "PASS"}
    assert DriveState.RUNNING in link.states
    assert at_rest(link.device)


def test_listing_opens_no_link(accepting: Accepting) -> None:
    link = SpoiltLink(physical())
    accepting('@limit("x", "A", hi=1)' + ANNOUNCED, link, list_only=True)
    assert link.opened == []


# -- processes --------------------------------------------------------------------------------------------------

ENDLESS = """
def test_endless(drive, record):
    turn(drive, record)
    print("turning", flush=True)
    record.wait(60)

def test_next(drive): pass
"""


@pytest.fixture
def endless(tmp_path: Path) -> Path:
    file = tmp_path / "own_endless.py"
    file.write_text(HEAD + ENDLESS)
    return file


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_in_stop_and_a_written_result(
    start: Callable[..., Program], start_sim: Callable[..., Sim], endless: Path, number: signal.Signals
) -> None:
    sim = start_sim("--pty", *PATIENT)
    file = endless.with_suffix(".json")
    run = start("accept", sim.target, "--tests", str(endless), "--json", str(file))
    run.line("turning")
    run.send(number)
    sim.line(r"outputs off: STOP \(node 1")
    assert run.end() == 130
    written = json.loads(file.read_text())
    assert written["verdict"] == "ABORTED"
    assert [test["verdict"] for test in written["tests"]] == ["ABORTED", "ABORTED"]
    assert not any("Traceback" in line for line in run.err)


def test_a_second_run_is_refused_and_a_killed_one_ends_by_the_watchdog_and_frees_the_target(
    start: Callable[..., Program], start_sim: Callable[..., Sim], endless: Path
) -> None:
    sim = start_sim("--pty", *PATIENT)
    run = start("accept", sim.target, "--tests", str(endless))
    run.line("turning")
    second = start("accept", sim.target, "--tests", str(endless))
    assert second.end() == 2
    assert second.err == [f"error: {sim.target} is in use by another acceptance run: wait for its end"]
    with pytest.raises(BenchError, match="in use"), alone_on(f"{sim.target}?baud=115200"):
        pass
    run.process.kill()
    unfed = int(sim.line(r"outputs off (\d+) ms after the last ALIVE: watchdog \(node 1").group(1))
    assert 1000 <= unfed <= 1050
    run.end()
    with alone_on(sim.target):
        pass

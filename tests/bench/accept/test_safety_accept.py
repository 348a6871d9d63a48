"""However a test ends, the bench is at rest and as it was; nothing turns without consent; one run at a time."""

from __future__ import annotations

import json
import re
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import pytest
from accepting import Accepting, SpoiltLink
from processes import Program, Sim
from virtual_run import never_armed, physical, simulated

from bench.accept.accept import closing_lines
from bench.errors import BenchError
from bench.rig.lock import alone_on
from protocol.messages import DriveState, Fault

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

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
    load.node.client.feed(2, on=False)
    turning.wait(0.5)
def test_overspeed(turning, load):
    load.speed(rpm=500)
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
def test_after_deaf(turning): pass
"""
UNSTOPPED = (
    "the bench could not be restored: node 1 on virtual: did not answer STOP (3 tries); now its heartbeat says "
    "FAULT (WATCHDOG), outputs off"
)


def test_the_next_test_finds_the_bench_at_rest_and_as_it_was(accepting: Accepting, link: SpoiltLink) -> None:
    run = accepting(ENDINGS, link, keyword="not deaf")
    assert run.tests == {
        "returns": "PASS", "assertion": "FAIL", "exception": "ERROR", "skips": "SKIPPED", "stopped_already": "PASS",
        "trips": "FAIL", "may_trip": "PASS", "load_trips": "ERROR", "overspeed": "PASS", "behind_our_back": "PASS",
        "fixture": "ERROR", "fixture_at_its_end": "ERROR", "bench_error": "ERROR", "last": "PASS",
    }  # fmt: skip
    # before the consent, before each test, and now
    states = [*link.opened, link.left()]
    assert len(states) == len(run.tests) + 2
    for name, (rest, parameters) in zip(run.tests, states[2:], strict=True):
        assert rest, name
        assert parameters == states[0][1], name
    assert run["fixture"].why == "RuntimeError: a user's fixture"
    assert re.fullmatch(
        r"the load machine, node 2 on \S+, tripped: WATCHDOG: this host sent an ALIVE at least every .*",
        run["load_trips"].why,
    )
    assert run["trips"].parameters == {"k_p_vt": 123.0, "i_max": 5.0}


@pytest.mark.parametrize(
    ("name", "verdict", "why"),
    [("deaf", "ERROR", UNSTOPPED), ("fails_and_deaf", "FAIL", f"this first; then {UNSTOPPED}")],
    ids=("else well", "failing"),
)  # fmt: skip
def test_a_stop_that_is_not_answered_is_told_and_the_watchdog_does_it_and_no_test_starts_before_somebody_has_looked(
    accepting: Accepting, link: SpoiltLink, name: str, verdict: str, why: str
) -> None:
    before = link.left()
    run = accepting(ENDINGS, link, keyword=f"test_{name} or test_after_deaf")
    assert (run[name].verdict, run[name].why) == (verdict, why)
    assert run["after_deaf"].verdict == "ERROR"
    assert re.search(r"has a latched fault \(WATCHDOG\): find the cause", run["after_deaf"].why)
    assert link.device.load.state == DriveState.IDLE
    assert link.left() == before
    assert link.device.drive.machine.faults == Fault.WATCHDOG  # for somebody to look at


def test_what_could_not_be_put_back_is_told_although_a_signal_came_meanwhile(accepting: Accepting) -> None:
    file = accepting.write(ENDINGS)

    def while_deaf(call: int) -> None:
        if link.deaf:
            signal.raise_signal(signal.SIGTERM)

    link = SpoiltLink(simulated(), while_deaf)
    run = accepting(file, link, keyword="test_deaf")
    assert (run.tests, run.code) == ({"deaf": "ABORTED"}, 130)
    assert run.result.error == UNSTOPPED
    assert closing_lines(run.result)[-1] == f"error: {UNSTOPPED}"


# -- consent ----------------------------------------------------------------------------------------------------

ANNOUNCED = """
@energises(rpm=200, current=3)
def test_slow(drive, record): turn(drive, record, 200)

@energises(rpm=150, current=4)
def test_strong(drive, record): turn(drive, record, 150)

@energises(rpm=9999, current=99)
def test_beyond_all(drive, record): turn(drive, record)

def test_says_nothing(drive, record): turn(drive, record)
"""


@pytest.mark.parametrize(
    ("which", "speed", "current"),
    [("test_slow", "200", "3"), ("test_slow or test_strong", "200", "4"), ("test_strong", "150", "4"),
     ("test_beyond_all", "2300", "8"), ("test_slow or test_says_nothing", "2300", "8")],
    ids=("one", "two", "the other", "more than the drive lets", "one that does not say"),
)  # fmt: skip
def test_a_physical_drive_is_not_energised_where_nobody_can_be_asked(
    accepting: Accepting, which: str, speed: str, current: str
) -> None:
    link = SpoiltLink(physical())
    app = link.device.drive.app
    app.set_param("omega_m_max", 2300 * 3.14159265 / 30)
    with pytest.raises(BenchError) as refused:
        accepting(ANNOUNCED, link, keyword=which, json=Path("a.json"))
    boot = link.device.drive.identity.boot_id
    assert app.get_param("i_max") == 8
    assert re.fullmatch(
        rf"refusing to energise simulated drive \(boot {boot:08x}\) on serial:\S+: up to {speed}(\.\d+)? r/min, phase "
        rf"current up to {current} A: no terminal to confirm; pass --yes \(in Python: yes=True\) if the shaft is clear",
        str(refused.value),
    )
    assert never_armed(link)
    written = json.loads(Path("a.json").read_text())
    assert (written["verdict"], written["error"], written["tests"]) == ("ERROR", str(refused.value), [])


WITHIN = """
@energises(rpm=500, current=2)
def test_blocked(drive, load, record):
    load.torque(0.9)  # more than the announced current can hold
    drive.start("encoder")
    drive.speed(rpm=400)
    record.wait(0.5)

@energises(rpm=500, current=2)
def test_raises_it(drive):
    drive.set("i_max", 2.5)

@energises(rpm=500, current=2)
def test_lowers_it(drive):
    drive.set("i_max", 1.5)

@energises(rpm=500, current=9)
def test_more(drive):
    assert drive.parameters["i_max"] == 8
"""


def test_the_drive_itself_keeps_to_the_announced_current(accepting: Accepting) -> None:
    """In the plant: the current that flows, whatever the speed controller would like."""
    flowed: list[float] = []

    def look(call: int) -> None:
        if link.device.drive.state == DriveState.RUNNING:
            flowed.append(abs(link.device.bench.truth.i_q))

    link = SpoiltLink(simulated(), look)
    before = link.left()
    run = accepting(WITHIN, link)
    assert run.tests == {"blocked": "PASS", "raises_it": "ERROR", "lowers_it": "PASS", "more": "PASS"}
    assert 1.8 < max(flowed) < 2.3
    assert run["raises_it"].why.startswith("i_max 2.5 A is beyond the announced limit of 2 A")
    assert [state for state in (*link.opened, link.left()) if state != before] == []
    assert run["blocked"].parameters == {"observer": 0.0}  # what the test has set, and not the bench
    assert run["lowers_it"].parameters == {"i_max": 1.5}


# -- processes --------------------------------------------------------------------------------------------------

ENDLESS = """
def test_endless(drive, record):
    turn(drive, record)
    print("turning", flush=True)
    record.wait(60)

def test_next(drive): pass
"""


@pytest.mark.long("two programs in real time")
def test_a_killed_run_ends_by_the_watchdog_and_frees_the_target(
    start: Callable[..., Program], start_sim: Callable[..., Sim], accepting: Accepting
) -> None:
    sim = start_sim("--pty", *PATIENT)
    run = start("accept", sim.target, "--tests", str(accepting.write(ENDLESS)))
    run.line("turning")
    where_programs_lock = patch("bench.rig.lock.folder", lambda: Path(tempfile.gettempdir()))
    with where_programs_lock, pytest.raises(BenchError, match="in use"), alone_on(f"{sim.target}?baud=115200"):
        pass
    run.process.kill()
    unfed = int(sim.line(r"outputs off (\d+) ms after the last ALIVE: watchdog \(node 1").group(1))
    assert 1000 <= unfed <= 1050
    run.end()
    with where_programs_lock, alone_on(sim.target):
        pass


DRAWS = """
def test_draws(drive, record, figure):
    turn(drive, record)
    def draw():
        from matplotlib.figure import Figure
        states = [session.state.name for session in record.rig.client.link.device.sessions]
        assert states == ["IDLE", "IDLE"], states
        return Figure()
    figure("picture", "drawn at rest", draw)
"""


def test_figures_are_drawn_when_nothing_turns_any_more(accepting: Accepting, tmp_path: Path) -> None:
    run = accepting(DRAWS, SpoiltLink(simulated()), report=tmp_path / "report")
    assert run.tests == {"draws": "PASS"}
    (figure,) = run["draws"].figures
    assert (tmp_path / "report" / figure.path).is_file()

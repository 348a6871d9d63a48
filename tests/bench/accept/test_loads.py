"""What brakes the shaft: a node, nothing, a class of the user's own, a person, a device on another link."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from unittest.mock import patch

import pytest
from accepting import Accepting, SpoiltLink
from test_prompt import on_terminal
from virtual_run import at_rest, never_armed, physical, simulated

from bench.accept.faults import HallFaults
from bench.accept.requirements import missing
from bench.device.node import Node
from bench.errors import BenchError, UnsafeError
from bench.rig.consent import require_agreement
from bench.rig.drive import DriveTripped
from bench.rig.envelope import Envelope
from bench.rig.loads import NodeLoad, PersonLoad
from bench.rig.lock import alone_on
from bench.rig.person import Answered, Ask
from bench.rig.rig import Plan, Rig
from bench.rig.settings import Settings
from bench.signal.units import RPM
from protocol.framing import Deframer, encode_frame, parse_frame
from protocol.messages import DriveState, Fault
from sim.config.params import load_params

pytestmark = pytest.mark.slow

BRAKE = """
from pathlib import Path
class Brake:
    def __init__(self): self._tell("made")
    def close(self): self._tell("close")
    def torque(self, tau): self._tell(f"torque {tau:g}")
    def off(self): self._tell("off")
    def _tell(self, text):
        with Path("told.txt").open("a") as file:
            print(text, file=file)
class Both(Brake):
    def speed(self, omega_m): self._tell(f"speed {omega_m:g}")
class Shy(Both):
    abilities = ("torque",)
class NoOff:
    def torque(self, tau): ...
def failing(error):
    def fail(self, *_): raise OSError(error)
    return fail
class Burnt(Brake): torque = failing("VI_ERROR_TMO")
class Stuck(Brake): off = failing("VI_ERROR_TMO")
class Jammed(Brake): close = failing("VI_ERROR_CLOSING")
class Absent(Brake): __init__ = failing("no such instrument")
"""
BRAKES = """
@limit("x", hi=1)
def test_brakes(drive, load, record, measure):
    turn(drive, record)
    load.torque(0.25)
    measure("x", 0)
@needs("load.speed")
def test_forces(drive, load): load.speed(rad_s=1.0)
"""


@contextmanager
def rig_with(load: str, link: SpoiltLink, **plan: object) -> Iterator[Rig]:
    with Rig(Plan(link.open, "virtual", Settings(load=load), **plan)).prepare() as rig:  # type: ignore[arg-type]
        yield rig


class OneNode:
    """A link that reaches one node of a simulated bench; the links of a bench share its time."""

    def __init__(self, link: SpoiltLink, node: int, frames: dict[int, bytes], deframer: Deframer) -> None:
        self.name = f"node {node}"
        self.clock, self.wire, self.reopen, self.close = link.clock, link.wire, link.reopen, lambda: None
        self._link, self._node, self._frames, self._deframer = link, node, frames, deframer
        self._outgoing = Deframer()

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        if not self._frames[self._node]:
            for raw in self._deframer.feed(self._link.read(timeout, settle)):
                frame = parse_frame(raw)
                self._frames[frame.node] += encode_frame(frame)
        data, self._frames[self._node] = self._frames[self._node], b""
        return data

    def write(self, data: bytes) -> None:
        for raw in self._outgoing.feed(data):
            self._link.write(encode_frame(parse_frame(raw)._replace(node=self._node)))


@contextmanager
def load_on_a_link_of_its_own(link: SpoiltLink) -> Iterator[Rig]:
    frames, deframer = {1: b"", 2: b""}, Deframer()
    drive, load = (OneNode(link, node, frames, deframer) for node in (1, 2))
    link.reopen()
    with (
        patch("bench.rig.connection.open_link", lambda target: load),
        Rig(Plan(lambda: drive, "virtual", Settings(load="tcp:brake:7000"))).prepare() as rig,
    ):
        yield rig


@pytest.fixture
def brake(accepting: Accepting) -> Accepting:
    Path("brake.py").write_text(BRAKE)
    return accepting


def with_load(kind: str) -> None:
    Path("bench.toml").write_text(f'[rig]\nload = "{kind}"\n')


# -- a node -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "connected",
    [partial(rig_with, "node"), load_on_a_link_of_its_own],
    ids=("on the drive's link", "on a link of its own"),
)
def test_a_node_brakes_with_the_torque_that_it_is_given_and_lets_go_and_forces_a_speed(connected, link) -> None:
    """In the plant: friction and load are what the current's torque holds against."""
    _, before = link.left()
    with connected(link) as rig:
        assert isinstance(rig.load, NodeLoad)
        rig.drive.start("vector-tracking")
        rig.drive.speed(rpm=500)
        rig.wait(0.8)
        free = rig.record(0.3)
        rig.load.torque(0.1)
        rig.wait(0.6)
        braked = rig.record(0.3)
        assert link.device.load.state == DriveState.RUNNING
        motor = load_params(None, {}).motor
        torque = 1.5 * motor.n_p * motor.psi_f * (braked["i_q"].mean() - free["i_q"].mean())
        assert torque == pytest.approx(0.1, rel=0.05)
        assert rig.drive.torque_constant == pytest.approx(1.5 * motor.n_p * motor.psi_f, rel=1e-6)
        rig.load.off()
        assert link.device.load.state == DriveState.IDLE
        rig.wait(0.6)
        assert rig.record(0.2)["i_q"].mean() == pytest.approx(free["i_q"].mean(), abs=0.1)
        rig.drive.stop()
        rig.load.speed(rpm=-200)
        rig.wait(0.5)
        assert link.device.bench.truth.omega_m == pytest.approx(-200 * RPM, rel=0.01)
    assert link.left() == (True, before)


TRIPPED = r"^the load machine, node 2 on \S+, tripped: OVERCURRENT$"


def test_a_node_that_trips_ends_the_test_and_the_next_can_use_it(link: SpoiltLink) -> None:
    with rig_with("node", link) as rig:
        assert isinstance(rig.load, NodeLoad)
        rig.load.torque(0.05)
        link.device.load.fault(Fault.OVERCURRENT)
        with pytest.raises(BenchError, match=TRIPPED):
            rig.record(0.3)
        with pytest.raises(BenchError, match=TRIPPED):
            rig.load.torque(0.05)
        assert link.device.load.state == DriveState.FAULT
    assert at_rest(link.device)
    with rig_with("node", link) as rig:
        rig.load.torque(0.05)
        assert link.device.load.state == DriveState.RUNNING


def test_a_node_that_trips_at_the_very_end_is_told_by_its_answer_to_stop(link: SpoiltLink) -> None:

    def trip_last() -> None:
        with rig_with("node", link) as rig:
            rig.load.torque(0.05)
            link.device.load.fault(Fault.OVERCURRENT)

    with pytest.raises(BenchError, match=r"could not be restored: the load machine, .* tripped: OVERCURRENT$"):
        trip_last()
    assert link.device.load.state == DriveState.IDLE


def test_a_fault_that_a_node_had_before_is_named_and_stays(link: SpoiltLink) -> None:
    link.device.load.fault(Fault.OVERCURRENT)
    fault = r"^node 2 has a latched fault \(OVERCURRENT\): find the cause"
    with rig_with("node", link) as rig, pytest.raises(BenchError, match=fault):
        rig.load.torque(0.05)
    assert link.device.load.state == DriveState.FAULT


@pytest.mark.parametrize("kind", ["node", "brake.py:Both"])
def test_no_load_turns_faster_than_the_test_announced(brake: Accepting, kind: str, link: SpoiltLink) -> None:
    with_load(kind)
    run = brake(FASTER, link)
    assert run.tests == {"faster": "ERROR", "as_fast": "PASS"}
    assert run["faster"].why == (
        "load.speed 101 r/min is beyond the announced limit of 100 r/min: @energises(rpm=…), or limits=Envelope(rpm=…)"
    )
    assert at_rest(link.device)


FASTER = """
@energises(rpm=100, current=1)
def test_faster(load): load.speed(rpm=-101)
@energises(rpm=101, current=1)
def test_as_fast(load): load.speed(rpm=-101)
"""


def test_a_parameter_that_is_refused_keeps_no_other_from_being_put_back(link: SpoiltLink) -> None:
    """Three of each machine, of which the second is refused at the end: they are set in the order of the test."""
    _, before = link.left()
    names = {1: ("k_p_vt", "i_max", "k_ic"), 2: ("tau_max", "hall_glitch", "hall_open")}
    values = {"k_p_vt": 123.0, "i_max": 5.0, "k_ic": 0.5, "tau_max": 0.5, "hall_glitch": 10.0, "hall_open": 1.0}
    order: list[str] = []

    def change() -> None:
        with rig_with("node", link) as rig:
            assert isinstance(rig.load, NodeLoad)
            for name in names[1]:
                rig.drive.set(name, values[name])
            for name in names[2]:
                rig.load.set(name, values[name])
            stack.enter_context(refusing(rig.drive.node, "i_max", order))
            stack.enter_context(refusing(rig.load.node, "hall_glitch", order))

    left = r"; not restored: i_max \(was 8\); not restored in the load machine: hall_glitch \(was 0\)$"
    with (
        ExitStack() as stack,
        pytest.raises(BenchError, match=r"could not be restored: hall_glitch: not now" + left),
    ):
        change()
    assert order == [*names[2], *names[1]]
    changed = {name for name, value in link.left()[1].items() if value != before[name]}
    assert changed == {"1.i_max", "2.hall_glitch"}


@contextmanager
def refusing(node: Node, refused: str, order: list[str]) -> Iterator[None]:
    """The machine refuses one parameter; `order` is what it was asked for."""
    real = node.set

    def set_one(name: str, value: float) -> float:
        order.append(name)
        if name == refused:
            raise BenchError(f"{name}: not now")
        return real(name, value)

    with patch.object(node, "set", set_one):
        yield


# -- none, or somebody ------------------------------------------------------------------------------------------


def test_a_person_who_cannot_be_asked_is_told_at_once(accepting: Accepting) -> None:
    with_load("person")
    with pytest.raises(BenchError, match=r'load = "person" needs person = true'):
        accepting(BRAKES)


def test_without_a_load_a_test_that_needs_one_is_skipped(accepting: Accepting) -> None:
    with_load("none")
    run = accepting(BRAKES)
    assert (run.tests, run["brakes"].why) == ({"brakes": "SKIPPED", "forces": "SKIPPED"}, "needs a load")
    assert (run["forces"].why, run.code) == ("needs a load that forces a speed", 6)


def somebody(asked: list[str], answered: Callable[[str], bool] = lambda words: True) -> Ask:
    """A person, who has done what the words say once `answered(words)`."""

    @contextmanager
    def ask(words: str) -> Iterator[Answered]:
        asked.append(words)
        yield lambda timeout: answered(words)

    return ask


RELEASE = "Set the brake to 0.000 N·m"


def test_a_person_is_asked_for_each_new_torque_and_to_let_go() -> None:
    asked: list[str] = []
    with rig_with("person", SpoiltLink(simulated()), ask=somebody(asked)) as rig:
        assert isinstance(rig.load, PersonLoad)
        assert set(rig.load.abilities) == {"torque"}
        for tau in (0.0, 0.2, 0.2, 0.1):
            rig.load.torque(tau)
    assert asked == [f"Set the brake to {tau} N·m" for tau in ("0.200", "0.100", "0.000")]


def test_the_bench_goes_on_while_a_person_is_asked(link: SpoiltLink) -> None:
    """For 1 s, five times as long as the drive's watchdog lets it turn unfed."""
    begun: list[float] = []

    def answered(words: str) -> bool:
        begun.append(link.clock())
        return words == RELEASE or link.clock() >= begun[0] + 1.0

    with rig_with("person", link, ask=somebody([], answered)) as rig:
        assert isinstance(rig.load, PersonLoad)
        rig.drive.start("vector-tracking")
        rig.drive.speed(rpm=300)
        rig.wait(0.5)
        with rig.recording() as stretch:
            rig.load.torque(0.1)
        assert rig.drive.state == DriveState.RUNNING
        assert (link.device.bench.truth.omega_m, stretch.capture.flaws()) == (pytest.approx(300 * RPM, rel=0.05), ())
        assert len(stretch.capture) == pytest.approx(16000, rel=0.1)


def test_a_trip_ends_the_question(link: SpoiltLink) -> None:

    def answered(words: str) -> bool:
        link.device.drive.fault(Fault.OVERCURRENT)
        return False

    with rig_with("person", link, ask=somebody([], answered)) as rig:
        rig.drive.start()
        with pytest.raises(DriveTripped, match="OVERCURRENT"):
            rig.ask("Wait for ever")


@pytest.mark.parametrize("which", ["Set the brake to 0.200 N·m", RELEASE], ids=("while it turns", "at the end"))
def test_a_signal_ends_the_question(which: str, link: SpoiltLink) -> None:
    _, before = link.left()
    asked: list[str] = []

    def answered(words: str) -> bool:
        if words == which:
            signal.raise_signal(signal.SIGINT)
        return words != which

    def brake() -> None:
        with rig_with("person", link, ask=somebody(asked, answered)) as rig:
            rig.drive.start()
            rig.load.torque(0.2)

    with pytest.raises(KeyboardInterrupt):
        brake()
    assert (asked[-1], link.left(), link.device.drive.machine.faults) == (which, (True, before), Fault(0))


def test_a_person_who_has_gone_keeps_nothing_on(link: SpoiltLink) -> None:
    asked: list[str] = []

    def answered(words: str) -> bool:
        if words == RELEASE:
            raise BenchError("the terminal has gone")
        return True

    with rig_with("person", link, ask=somebody(asked, answered)) as rig:
        rig.drive.start()
        rig.load.torque(0.2)
    assert asked[-1] == RELEASE
    assert at_rest(link.device)


def test_virtual_time_stands_still_while_a_person_is_asked(link: SpoiltLink) -> None:
    answers = iter([False, False, True])
    with rig_with("none", link, ask=somebody([], lambda words: next(answers)), virtual=True) as rig:
        before = link.clock()
        rig.ask("Think")
        assert link.clock() == before
    assert list(answers) == []


def test_somebody_breaks_a_hall_wire_while_the_motor_turns_and_puts_it_back_at_the_end(link: SpoiltLink) -> None:
    asked: list[str] = []
    _, before = link.left()

    def answered(words: str) -> bool:
        """Pulls the wire at once, and presses Enter once the drive has seen it; puts it back when asked to."""
        link.device.load.app.set_param("hall_open", float("Disconnect" in words))
        return bool(rig.drive.faults)

    with rig_with("none", link, ask=somebody(asked, answered)) as rig:
        assert missing("hall-faults", rig) is None
        hall_faults = HallFaults(rig)
        rig.drive.start("vector-tracking")
        rig.drive.speed(rpm=300)
        rig.wait(0.4)
        with rig.drive.may_trip():
            hall_faults.open("a")
            assert rig.drive.faults == ("HALL",)
        with pytest.raises(pytest.skip.Exception, match="false pulses"):
            hall_faults.glitches(100)
    assert asked == ["Disconnect the wire of Hall sensor a", "Put the Hall wires back as they belong"]
    assert link.left()[1] == before


def test_without_anybody_hall_faults_are_missing() -> None:
    with rig_with("none", SpoiltLink(simulated())) as rig:
        assert missing("hall-faults", rig) == (
            "needs a rig that inserts faults of the Hall wiring, or a person who does"
        )
        with pytest.raises(BenchError, match=r"^no terminal to ask: Disconnect"):
            HallFaults(rig).open("a")


BRAKED = """
def test_braked(drive, load, record):
    turn(drive, record)
    load.torque(0.01)
    record.wait(0.3)
    drive.stop()
"""


@pytest.mark.campaign("terminal")
def test_on_a_real_terminal_a_person_takes_longer_than_the_watchdog(accepting, start_sim) -> None:
    Path("bench.toml").write_text('[rig]\nload = "person"\nperson = true\n')
    sim = start_sim("--pty", "--set", "firmware.watchdog=0.8")  # other programs may want the machine
    tests = accepting.write(BRAKED)
    code, text = on_terminal(
        ["accept", sim.target, "--tests", str(tests), "--bench", str(Path("bench.toml").absolute())],
        b"press Enter: ", b"\n", after=1.6,
    )  # fmt: skip
    assert code == 0, text
    assert re.search("PASS +braked", text)
    assert text.count("press Enter") == 2
    assert "Traceback" not in text


# -- a class of one's own ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "forces", "told", "can"),
    [("Brake", "SKIPPED", ["off"], "torque"), ("Both", "PASS", ["speed 1", "off"], "speed, torque"),
     ("Shy", "SKIPPED", ["off"], "torque")],
)  # fmt: skip
def test_a_class_of_ones_own_is_told_what_the_test_wants_and_forces_a_speed_if_it_has_the_method_and_says_so(
    brake: Accepting, kind: str, forces: str, told: list[str], can: str
) -> None:
    with_load(f"brake.py:{kind}")
    run = brake(BRAKES)
    assert run.tests == {"brakes": "PASS", "forces": forces}
    # one object, off at each test's end, closed at the last
    assert Path("told.txt").read_text().splitlines() == ["made", "torque 0.25", "off", *told, "close"]
    assert run.result.rig["load"] == f"brake.py:{kind}: {can}"


@pytest.mark.parametrize(
    ("kind", "verdict", "why", "told"),
    [("Burnt", "ERROR", "{}: torque() raised OSError: VI_ERROR_TMO", "made off close"),
     ("Stuck", "ERROR", "the bench could not be restored: {}: off() raised OSError: VI_ERROR_TMO",
      "made torque 0.25 close"),
     ("Jammed", "PASS", "{}: close() raised OSError: VI_ERROR_CLOSING", "made torque 0.25 off")],
)  # fmt: skip
def test_its_errors_become_one_line_and_the_drive_is_stopped(brake, link, kind, verdict, why, told) -> None:
    with_load(f"brake.py:{kind}")
    _, before = link.left()
    run = brake(BRAKES, link, keyword="test_brakes")
    assert (run["brakes"].verdict, run.code) == (verdict, 2)
    # one that does not close is the run's error
    assert (run["brakes"].why or run.result.error) == why.format(f"load brake.py:{kind}")
    assert Path("told.txt").read_text().split("\n") == [*re.findall(r"torque \S+|\w+", told), ""]
    assert link.left() == (True, before)


@pytest.mark.parametrize(
    ("kind", "why"),
    [("brake.py:NoOff", r"load brake.py:NoOff: the class has no method off\(\)"),
     ("brake.py:Absent", "load 'brake.py:Absent': OSError: no such instrument"),
     ("brake.py:Brkae", "load 'brake.py:Brkae': AttributeError: .* has no attribute 'Brkae'.*"),
     ("bad.py:Brake", r"load 'bad.py:Brake': SyntaxError: [^\n]*"),
     ("nowhere.py:Brake", "load 'nowhere.py:Brake': no Python file .*nowhere.py; write it as my_brake.py:Brake")],
)  # fmt: skip
def test_what_is_no_load_is_said_and_nothing_turns(brake: Accepting, kind: str, why: str, link: SpoiltLink) -> None:
    Path("bad.py").write_text("def (:\n")
    with pytest.raises(BenchError, match=f"^{why}$"), rig_with(kind, link):
        pass
    assert link.device.drive.state == DriveState.IDLE
    assert never_armed(link)


def test_its_file_is_found_beside_bench_toml(brake: Accepting) -> None:
    (brake.directory / "benches").mkdir()
    (brake.directory / "benches" / "loads.py").write_text(BRAKE)
    (brake.directory / "benches" / "left.toml").write_text('[rig]\nload = "loads.py:Brake"\n')
    run = brake(BRAKES, keyword="test_brakes", bench_toml=Path("benches/left.toml"))
    assert run.tests == {"brakes": "PASS"}


# -- a device on a link of its own ------------------------------------------------------------------------------


def test_a_device_on_a_link_of_its_own_must_be_a_load_machine() -> None:
    link, other = SpoiltLink(simulated()), SpoiltLink(simulated(seed=2))
    with (
        patch("bench.rig.connection.open_link", other.open),
        pytest.raises(BenchError, match=r"^tcp:brake:7000 is a DRIVE, not a load machine$"),
        rig_with("tcp:brake:7000", link),
    ):
        pass
    assert [len(spoilt.opened) for spoilt in (link, other)] == [1, 1]
    for spoilt in (link, other):
        with pytest.raises(Exception, match="is closed"):
            spoilt.read(0.0)


@pytest.mark.parametrize("drive_is_real", [True, False])
def test_a_load_machine_on_a_link_of_its_own_is_asked_for(drive_is_real: bool) -> None:
    link = SpoiltLink(physical() if drive_is_real else simulated())
    other = SpoiltLink(physical(seed=2))
    frames, deframer = {1: b"", 2: b""}, Deframer()
    other.reopen()
    links = {"serial:drive": link, "tcp:brake:7000": OneNode(other, 2, frames, deframer)}
    questions: list[str] = []

    def confirm(question: str) -> bool:
        questions.append(question)
        return "load machine" not in question

    with (
        patch("bench.rig.connection.open_link", links.__getitem__),
        pytest.raises(UnsafeError, match="not confirmed"),
    ):
        require_agreement(
            "serial:drive", Settings(load="tcp:brake:7000"), lambda _: Envelope(60.0, 2.0), False, confirm
        )
    assert len(questions) == 1 + drive_is_real
    assert re.fullmatch(
        r"Spin .* on tcp:brake:7000, the load machine: up to 60 r/min, phase current up to .*\. Is the shaft clear\?",
        questions[-1],
    )
    assert never_armed(link)
    assert never_armed(other)


def test_a_load_machine_on_a_link_of_its_own_is_refused_with_the_simulated_drive(accepting: Accepting) -> None:
    with_load("tcp:brake:7000")
    with pytest.raises(BenchError, match=r"^load 'tcp:brake:7000' is not on the simulated drive's shaft"):
        accepting(BRAKES)


def test_a_lock_that_somebody_replaced_by_a_link_is_not_followed(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("bench.rig.lock.folder", lambda: tmp_path)
    with alone_on("tcp:drive:7000"):
        (lock,) = tmp_path.iterdir()
    lock.unlink(missing_ok=True)
    victim = tmp_path / "victim"
    victim.write_text("precious")
    lock.symlink_to(victim)
    why = f"^cannot lock tcp:drive:7000 for this run: {lock}: .*; remove that file$"
    with pytest.raises(BenchError, match=why), alone_on("tcp:drive:7000"):
        pass
    assert victim.read_text() == "precious"

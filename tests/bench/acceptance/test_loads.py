"""What brakes the shaft: a node, nothing, a class of the user's own, a person, a device on another link."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import pytest
from accepting import Accepting, SpoiltLink
from virtual_run import at_rest, simulated

from bench.acceptance.loads import NodeLoad, OwnLoad, PersonLoad, own_load
from bench.acceptance.rig import Plan, Rig
from bench.acceptance.settings import Settings
from bench.energise import RPM
from bench.errors import BenchError
from protocol.messages import DriveState, Fault
from sim.params import load_params

BRAKE = '''
from __future__ import annotations
from dataclasses import dataclass, field
from pathlib import Path

@dataclass
class Brake:
    """Keeps what it was told, and a speed it cannot make."""
    told: list[str] = field(default_factory=list)

    def torque(self, tau):
        self._tell(f"torque {tau:g}")

    def off(self):
        self._tell("off")

    def _tell(self, text):
        with Path("told.txt").open("a") as file:
            print(text, file=file)

class Both(Brake):
    def speed(self, omega_m):
        self._tell(f"speed {omega_m:g}")

class Burnt(Brake):
    def torque(self, tau):
        raise OSError("VI_ERROR_TMO")

class Stuck(Brake):
    def off(self):
        raise OSError("VI_ERROR_TMO")

class NoOff:
    def torque(self, tau): ...

class Absent(Brake):
    def __init__(self):
        raise OSError("no such instrument")
'''
BRAKES = """
@limit("x", hi=1)
def test_brakes(drive, load, record, measure):
    turn(drive, record)
    load.torque(0.25)
    measure("x", 0)

@needs("load.speed")
def test_forces(drive, load):
    load.speed(1.0)
"""


@contextmanager
def rig_with(load: str, link: SpoiltLink, **plan: object) -> Iterator[Rig]:
    with Rig(Plan(link.open, "virtual", Settings(load=load), **plan)) as rig:  # type: ignore[arg-type]
        yield rig


@pytest.fixture
def brake(accepting: Accepting) -> Accepting:
    Path("brake.py").write_text(BRAKE)
    return accepting


def with_load(kind: str) -> None:
    Path("bench.toml").write_text(f'[rig]\nload = "{kind}"\n')


# -- a node -----------------------------------------------------------------------------------------------------


def test_a_node_brakes_with_the_torque_that_it_is_given_and_lets_go() -> None:
    """In the plant: friction and load are what the current's torque holds against."""
    link = SpoiltLink(simulated())
    with rig_with("node", link) as rig:
        assert isinstance(rig.load, NodeLoad)
        rig.drive.start("vector-tracking")
        rig.drive.speed(500 * RPM)
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
    assert at_rest(link.device)


def test_a_node_forces_a_speed() -> None:
    link = SpoiltLink(simulated())
    with rig_with("node", link) as rig:
        assert rig.load is not None
        rig.load.speed(-200 * RPM)  # type: ignore[attr-defined]
        rig.wait(0.5)
        assert link.device.bench.truth.omega_m == pytest.approx(-200 * RPM, rel=0.01)
    assert at_rest(link.device)


def test_a_node_that_has_tripped_is_used_again() -> None:
    link = SpoiltLink(simulated())
    with rig_with("node", link) as rig:
        assert isinstance(rig.load, NodeLoad)
        rig.load.torque(0.05)
        link.device.load.fault(Fault.OVERCURRENT)
        rig.wait(0.3)
        assert rig.load.node.state == DriveState.FAULT
        rig.load.torque(0.05)
        assert link.device.load.state == DriveState.RUNNING
    assert at_rest(link.device)


def test_its_parameters_are_as_before_once_it_is_off() -> None:
    link = SpoiltLink(simulated())
    _, before = link.left()
    with rig_with("node", link) as rig:
        assert isinstance(rig.load, NodeLoad)
        rig.load.set("tau_max", 0.5)
        rig.load.set("tau_max", 0.4)
        assert link.left()[1]["2.tau_max"] == pytest.approx(0.4)
    assert link.left() == (True, before)


# -- none, or somebody ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["none", "person"])
def test_without_a_load_a_test_that_needs_one_is_skipped(accepting: Accepting, kind: str) -> None:
    with_load(kind)  # a person, but no terminal to ask on
    run = accepting(BRAKES)
    assert run.tests == {"brakes": "SKIPPED", "forces": "SKIPPED"}
    assert run["brakes"].why == "needs a load"
    assert run["forces"].why == "needs a load that forces a speed"
    assert run.code == 2


def test_a_person_is_asked_for_each_new_torque_and_to_let_go() -> None:
    asked: list[str] = []
    with rig_with("person", SpoiltLink(simulated()), ask=asked.append) as rig:
        assert isinstance(rig.load, PersonLoad)
        assert set(rig.load.abilities) == {"torque"}
        for tau in (0.0, 0.2, 0.2, 0.1):
            rig.load.torque(tau)
    assert asked == [f"Set the brake to {tau} N·m" for tau in ("0.200", "0.100", "0.000")]


@pytest.mark.parametrize("error", [BenchError("gone"), KeyboardInterrupt()])
def test_a_person_who_has_gone_keeps_nothing_on(error: BaseException) -> None:
    link = SpoiltLink(simulated())
    asked: list[str] = []

    def ask(words: str) -> None:
        asked.append(words)
        if "0.000" in words:
            raise error

    with rig_with("person", link, ask=ask) as rig:
        assert rig.load is not None
        rig.drive.start()
        rig.load.torque(0.2)
    assert asked[-1] == "Set the brake to 0.000 N·m"
    assert at_rest(link.device)


# -- a class of one's own ---------------------------------------------------------------------------------------


def test_a_class_of_ones_own_is_told_what_the_test_wants_and_off_at_its_end(brake: Accepting) -> None:
    with_load("brake.py:Brake")
    run = brake(BRAKES)
    assert run.tests == {"brakes": "PASS", "forces": "SKIPPED"}
    assert Path("told.txt").read_text().split("\n") == ["torque 0.25", "off", "off", ""]
    assert run.result is not None
    assert run.result.rig["load"] == "OwnLoad: torque"


def test_it_can_force_a_speed_if_it_has_the_method(brake: Accepting) -> None:
    with_load("brake.py:Both")
    assert brake(BRAKES).tests == {"brakes": "PASS", "forces": "PASS"}
    assert Path("told.txt").read_text().split() == ["torque", "0.25", "off", "speed", "1", "off"]


def test_its_errors_become_one_line_and_the_drive_is_stopped(brake: Accepting) -> None:
    with_load("brake.py:Burnt")
    link = SpoiltLink(simulated())
    run = brake(BRAKES, link)
    assert run["brakes"].why == "load brake.py:Burnt: torque() raised OSError: VI_ERROR_TMO"
    assert (run["brakes"].verdict, run.code) == ("ERROR", 2)
    assert Path("told.txt").read_text().split() == ["off", "off"]
    assert at_rest(link.device)


def test_one_that_does_not_go_off_is_told_and_the_drive_is_stopped_all_the_same(brake: Accepting) -> None:
    with_load("brake.py:Stuck")
    link = SpoiltLink(simulated())
    _, before = link.left()
    run = brake(BRAKES, link, keyword="test_brakes")
    assert run["brakes"].why == (
        "the bench could not be left as it was: load brake.py:Stuck: off() raised OSError: VI_ERROR_TMO"
    )
    assert run.measured["brakes.x"].verdict == "PASS"
    assert run["brakes"].verdict == "ERROR"
    assert link.left() == (True, before)


@pytest.mark.parametrize(
    ("kind", "why"),
    [("brake.py:NoOff", r"load brake.py:NoOff: the class has no method off\(\)"),
     ("brake.py:Absent", "load 'brake.py:Absent': OSError: no such instrument"),
     ("brake.py:Brkae", "load 'brake.py:Brkae': AttributeError: .* has no attribute 'Brkae'.*"),
     ("nowhere.py:Brake", "load 'nowhere.py:Brake': no Python file .*nowhere.py; it must look like my_brake.py:Brake")],
)  # fmt: skip
def test_what_is_no_load_is_said_and_nothing_turns(brake: Accepting, kind: str, why: str) -> None:
    link = SpoiltLink(simulated())
    with pytest.raises(BenchError, match=f"^{why}$"), rig_with(kind, link):
        pass
    assert link.device.drive.state == DriveState.IDLE
    assert not {DriveState.ARMED, DriveState.RUNNING} & set(link.states)


def test_its_file_is_found_beside_bench_toml(brake: Accepting) -> None:
    (brake.directory / "benches").mkdir()
    (brake.directory / "benches" / "loads.py").write_text(BRAKE)
    (brake.directory / "benches" / "left.toml").write_text('[rig]\nload = "loads.py:Brake"\n')
    run = brake(BRAKES, keyword="test_brakes", bench_toml=Path("benches/left.toml"))
    assert run.tests == {"brakes": "PASS"}


def test_abilities_are_what_the_class_says() -> None:
    class Shy:
        abilities = ("torque",)

        def torque(self, tau: float) -> None: ...
        def speed(self, omega_m: float) -> None: ...
        def off(self) -> None: ...

    assert set(OwnLoad("shy", Shy()).abilities) == {"torque"}


def test_a_file_with_an_error_in_it_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text("def (:\n")
    with pytest.raises(BenchError, match=r"^load 'bad.py:Brake': SyntaxError: [^\n]*$"):
        own_load("bad.py:Brake", tmp_path)


# -- a device on a link of its own ------------------------------------------------------------------------------


def test_a_device_on_a_link_of_its_own_must_be_a_load_machine() -> None:
    link, other = SpoiltLink(simulated()), SpoiltLink(simulated(seed=2))
    with (
        patch("bench.acceptance.rig.open_link", other.open),
        pytest.raises(BenchError, match=r"^tcp:brake:7000 answers as DRIVE, not as a load machine$"),
        rig_with("tcp:brake:7000", link),
    ):
        pass
    assert [len(spoilt.opened) for spoilt in (link, other)] == [1, 1]
    for spoilt in (link, other):
        with pytest.raises(Exception, match="is closed"):
            spoilt.read(0.0)

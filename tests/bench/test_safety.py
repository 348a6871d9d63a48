"""What ends with the outputs off, and what is never energised: in virtual time, at every point of a run."""

from __future__ import annotations

import math
import os
import re
import signal
from dataclasses import replace

import pytest
from virtual_run import (
    RecordingScreen,
    WatchedLink,
    at_rest,
    never_armed,
    of_another_host,
    physical,
    run,
    seen_in,
    simulated,
)

from bench.cli import main
from bench.device.client import Client
from bench.device.node import Node
from bench.errors import BenchError, Interrupted, NodeError, UnsafeError
from bench.live.summary import run_rows
from bench.motion.profile import SPEED, Act, Course, Profile
from bench.rig.interrupts import signals_as_exceptions, undisturbed
from bench.rig.lock import alone_on
from bench.rig.settings import Settings
from bench.signal.position import position_errors
from protocol.errors import LinkClosed
from protocol.framing import Deframer, parse_frame
from protocol.messages import Command, DriveState, Fault, MessageType
from sim.ports.device import SimulatedDevice
from sim.ports.virtual import VirtualLink

# -- signals ----------------------------------------------------------------------------------------------------


def test_a_signal_that_came_while_it_was_not_to_disturb_takes_effect_afterwards() -> None:
    done: list[str] = []

    def put_back() -> None:
        with undisturbed() as came:
            with undisturbed():  # hands on what came in it
                signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
            done.append("STOP")
            assert came == [signal.SIGTERM, signal.SIGINT]
        done.append("never")

    with signals_as_exceptions(), pytest.raises(Interrupted) as interrupt:
        put_back()
    assert interrupt.value.signum == signal.SIGTERM  # the first
    assert done == ["STOP"]


def test_an_exception_that_is_under_way_is_not_replaced_by_a_signal() -> None:
    def put_back() -> None:
        with undisturbed():
            signal.raise_signal(signal.SIGINT)
            raise BenchError("the disk is full")

    with pytest.raises(BenchError, match="the disk is full"):
        put_back()


# -- exceptions -------------------------------------------------------------------------------------------------


def failing_after(samples: int, error: Exception, times: int = 1):
    """`position_errors`, which every chunk passes through, failing as a broken sink would."""
    seen = failures = 0

    def fails(chunk):
        nonlocal seen, failures
        seen += len(chunk)
        if seen > samples and failures < times:
            failures += 1
            raise error
        return position_errors(chunk)

    return fails


class SlowLink(WatchedLink):
    """A virtual link on which a request takes 5 ms: telemetry comes before its reply."""

    def __init__(self, device: SimulatedDevice) -> None:
        super().__init__(device)
        self._under_way = b""

    def write(self, data: bytes) -> None:
        self._under_way += data

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        self.device.advance(80)
        super().write(self._under_way)
        self._under_way = b""
        before = self.device.data_to_send()
        return before or super().read(timeout, settle)


@pytest.mark.parametrize("times", [1, 1000])
def test_a_sink_that_fails_during_the_stop_itself_keeps_no_node_on(monkeypatch: pytest.MonkeyPatch, times: int) -> None:
    link = SlowLink(simulated())
    stopping: list[str] = []
    stop = Node.stop

    def noted(node: Node) -> DriveState:
        stopping.append("")
        return stop(node)

    fails = failing_after(-1, BenchError("the disk is full"), times)
    monkeypatch.setattr(Node, "stop", noted)
    monkeypatch.setattr("bench.live.summary.position_errors", lambda chunk: fails(chunk) if stopping else {})
    with pytest.raises(BenchError, match="the disk is full"):
        run(link, load_a=1.0, duration=0.3)
    assert len(stopping) == 2  # the load machine too
    assert at_rest(link.device)
    assert link.device.load.machine.faults == Fault(0)


# -- trips and lost links ---------------------------------------------------------------------------------------


class Cable(WatchedLink):
    """A virtual link that is pulled at `pull` and back at `plug`, in seconds; the bench goes on meanwhile."""

    def __init__(self, device, pull: float, plug: float) -> None:
        super().__init__(device)
        self.pull, self.plug = pull, plug

    def _down(self) -> bool:
        return self.pull <= self.clock() < self.plug

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        if self._down():
            self.close()
        return super().read(timeout, settle)

    def write(self, data: bytes) -> None:
        if self._down():
            self.close()
        super().write(data)

    def reopen(self) -> None:
        self.device.advance(160)
        self.device.data_to_send()  # what is sent into an open end is lost
        if self._down():
            raise LinkClosed("the port is not there")
        super().reopen()


@pytest.fixture
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.device.client.REOPEN_PERIOD", 0.0)


@pytest.mark.usefixtures("no_waiting")
def test_an_outage_is_counted_and_the_motor_is_not_started_again() -> None:
    link = Cable(simulated(), 0.8, 1.5)
    screen = RecordingScreen()
    ended = run(link, duration=2.0, screen=screen)
    assert ended.exit_code == 1
    why = r"this host sent no ALIVE for 0\.7\d s, because virtual: was gone for 0\.7\d s"
    assert re.fullmatch(f"the drive tripped: WATCHDOG: {why}", ended.summary.result)
    assert ended.summary.faults == ["WATCHDOG"]
    assert ended.summary.link["outages"] == 1
    assert ended.summary.link["downtime_s"] == pytest.approx(0.7, abs=0.05)
    assert ended.summary.lost.samples_by_index == pytest.approx(0.7 * 16000, rel=0.1)
    assert ended.summary.samples > 16000
    assert not any(session.app.outputs_on for session in link.device.sessions)
    assert link.device.drive.state == DriveState.FAULT  # latched: nothing has cleared or started it
    assert any("is closed; waiting up to 30 s" in note for note in screen.notes)
    assert any("the drive is back" in note for note in screen.notes)


@pytest.mark.usefixtures("no_waiting")
def test_a_link_that_does_not_come_back_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.live.run.RECONNECT", 3.0)
    watched = run(Cable(simulated(), 0.5, 1e9), speed_rpm=None, duration=100.0)
    assert watched.exit_code == 1  # it turned nothing
    assert watched.summary.link["downtime_s"] == pytest.approx(3.0, abs=0.1)
    assert [row for row in run_rows(watched.summary) if row[0].startswith("link")] == [
        ["link, outages", "1"],
        ["link, downtime", "3.0 s"],
    ]


def test_a_trip_during_the_run_ends_with_the_fault_named() -> None:
    device = simulated()

    def overspeed(call: int) -> None:
        if device.drive.state == DriveState.RUNNING and link.clock() > 0.6:
            device.drive.fault(Fault.OVERSPEED)

    link = WatchedLink(device, overspeed)
    ended = run(link, load_a=1.0, duration=1.0)
    assert ended.exit_code == 1
    assert ended.summary.result == "the drive tripped: OVERSPEED"
    assert not device.load.app.outputs_on
    with pytest.raises(BenchError, match=r"latched fault \(OVERSPEED\).*--clear-faults"):
        run(WatchedLink(device))
    assert device.drive.state == DriveState.FAULT
    watched = WatchedLink(device)
    assert run(watched, speed_rpm=None, clear_faults=True).exit_code == 0
    assert never_armed(watched)
    assert device.drive.state == DriveState.IDLE


# -- alone on its target ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", ["tcp:127.0.0.1:{}", "can:virtual/locked{}"])
@pytest.mark.parametrize(
    "command", ["live {}", "live {} --speed 300 --yes", "accept {} --yes", "hall check {} --yes", "conform {}"]
)
def test_a_target_that_another_run_holds_is_refused_by_every_command(
    command: str, target: str, capsys: pytest.CaptureFixture[str]
) -> None:
    target = target.format(os.getpid() % 60_000 + 1)  # not that of a test beside this one
    with alone_on(target), pytest.raises(SystemExit) as ended:
        main(command.format(target).split())
    printed = capsys.readouterr()
    said = " ".join((printed.out + printed.err).split())
    assert f"error: {target} is in use by another run: wait until it ends, or close its rig" in said
    assert ended.value.code == 2


# -- another host's drive ---------------------------------------------------------------------------------------


def test_watching_takes_no_streams_away_from_a_host_that_turns_the_drive() -> None:
    device = of_another_host()
    before = seen_in(device)
    with pytest.raises(BenchError, match=r"streams to another host, which has its outputs on .*: watching it would"):
        run(WatchedLink(device), speed_rpm=None)
    assert seen_in(device) == before
    device = of_another_host(streams=False)  # whoever turns it needs none: nobody is disturbed
    device.drive.app.enter_state(DriveState.RUNNING)
    link = WatchedLink(device)
    ended = run(link, speed_rpm=None)
    assert (ended.exit_code, ended.summary.result) == (0, "ok")
    assert set(link.states) == {DriveState.RUNNING}


def test_streams_that_an_earlier_host_has_left_in_a_drive_at_rest_are_taken_over() -> None:
    device = simulated()
    node = Node(Client(VirtualLink(device)), 1)
    node.set_samples(node.channels(["i_q"]), 1)
    node.start_streams()
    for options in ({"speed_rpm": None}, {}):
        assert run(WatchedLink(device), **options).exit_code == 0  # type: ignore[arg-type]


# -- what was agreed, and what is put back -----------------------------------------------------------------------


def test_no_setpoint_goes_beyond_what_was_agreed(monkeypatch: pytest.MonkeyPatch) -> None:
    def further(profile: Profile, seconds: float | None) -> list[Act]:
        (act,) = profile.acts
        faster = Course(SPEED, 900.0, 900.0)
        return [replace(act, seconds=0.3), replace(act, drive=faster, seconds=0.3, title="faster")]

    monkeypatch.setattr(Profile, "timed", further)
    speeds: list[float] = []
    link = WatchedLink(simulated(), lambda call: speeds.append(link.device.bench.truth.omega_m * 30 / math.pi))
    ended = run(link)
    assert "speed 900 r/min is beyond the announced limit of 500 r/min" in ended.summary.result
    assert ended.exit_code == 1
    assert at_rest(link.device)
    assert 500 < max(speeds) < 600


def test_what_bench_toml_allows_is_what_is_agreed_to() -> None:
    asked: list[str] = []
    link = WatchedLink(physical())
    with pytest.raises(UnsafeError, match="not confirmed"):
        run(link, asked.append, settings=Settings(rated={"current": 3.0}))  # type: ignore[arg-type]
    assert "up to 500 r/min, phase current up to 3 A" in asked[0]
    assert never_armed(link)


def test_a_load_beyond_the_current_is_refused() -> None:
    link = WatchedLink(simulated())
    with pytest.raises(BenchError, match=r"load 4 A is beyond the 3 A that the motor may get: --current"):
        run(link, load_a=4.0, current_a=3.0)
    assert never_armed(link)


def test_a_drive_that_refuses_its_old_parameters_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    device = simulated()
    link = WatchedLink(device)
    set_one = Node.set

    def refusing(node: Node, name: str, value: float) -> float:
        if DriveState.RUNNING in link.states and device.drive.state == DriveState.IDLE:
            raise NodeError(f"{name} = {value:g} was refused by node 1: READ_ONLY")
        return set_one(node, name, value)

    monkeypatch.setattr(Node, "set", refusing)
    ended = run(link, current_a=3.0, duration=1.5)
    why = "i_max = 8 was refused by node 1: READ_ONLY; not restored: i_max (was 8)"
    assert (ended.exit_code, ended.summary.result) == (2, f"the bench could not be restored: {why}")


# -- consent ----------------------------------------------------------------------------------------------------


class TripsAtStop(WatchedLink):
    """A virtual link whose drive has an overcurrent at the moment in which STOP is on its way."""

    def write(self, data: bytes) -> None:
        frames = [parse_frame(raw) for raw in Deframer().feed(b"\0" + data)]
        if any(frame.type == MessageType.STATE_CMD and frame.payload[0] == Command.STOP for frame in frames):
            self.device.drive.fault(Fault.OVERCURRENT)
        super().write(data)


def test_a_trip_in_the_last_moment_is_no_success_and_what_was_set_is_put_back() -> None:
    link = TripsAtStop(simulated())
    before = dict(link.device.bench.parameters)
    ended = run(link, observer="average-speed", current_a=3.0)
    assert (ended.exit_code, ended.summary.result) == (1, "the drive tripped: OVERCURRENT")
    assert ended.summary.faults == ["OVERCURRENT"]
    assert at_rest(link.device)
    assert link.device.drive.state == DriveState.FAULT
    assert link.device.bench.parameters == before

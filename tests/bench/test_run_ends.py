"""However a run ends, by every command and on every link: outputs off and seen to be, parameters as they were.

Two tables: what is refused before anything turns x command; way to end x command x link. What a command says beside
that is in its own tests.
"""

from __future__ import annotations

import io
import json
import os
import random
import re
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from unittest.mock import patch

import pytest
from virtual_run import of_another_host, physical, seen_in, simulated

import bench
from bench.cli import main
from bench.conform import run as conforming
from bench.conform.catalogue import chosen
from protocol.errors import LinkClosed
from protocol.messages import DriveState, Fault
from sim.ports.device import SimulatedDevice
from tests.bench.accept.accepting import HEAD, SpoiltLink
from tests.choice import CAMPAIGN, commit, sampled

TARGET = f"serial:/dev/ttyEND{os.getpid()}"  # a target is locked: no two processes of the tests have one
LINKS = ("bytes", "CAN")
OPENED = ("bench.live.run.open_link", "bench.rig.connection.open_link", "protocol.links.open_link")
SOON = 5  # reads and writes in which a signal has stopped the drive
FEW = ("state.stop-obeyed", "motion.stop")  # checks: one that energises, one that turns
ACCEPTED = """
@energises(rpm=500, current=3)
def test_turns(drive, load, record):
    drive.set("k_p_vt", 123.0)
    load.set("tau_max", 0.5)
    load.torque(0.01)
    turn(drive, record)
"""


def _notebook(*more: str) -> None:
    with bench.connect(TARGET, yes="--yes" in more, limits=bench.Envelope(current=3.0), channels="status,i_q") as rig:
        rig.drive.set("k_p_vt", 900.0)
        rig.drive.speed(rpm=300)
        rig.load.torque(0.02)
        rig.record(0.1)


def _command(line: str, *more: str) -> None:
    main([*line.replace("TARGET", TARGET).replace("OWN", f"own_{Path.cwd().name}.py").split(), *more])


SPIN = "--speed 300 --load 1 --observer average-speed --current 3 --duration 0.2 --channels status,i_q --rate 1000"


COMMANDS: dict[str, Callable[..., None]] = {
    "live": partial(_command, f"live TARGET {SPIN} --viewer none"),
    "accept": partial(_command, "accept TARGET --tests OWN --json a.json --overwrite"),
    "hall": partial(_command, "hall check TARGET --speed 480"),
    "conform": partial(_command, "conform TARGET --level 4"),
    "notebook": _notebook,
}
VARIANTS = {
    "live, a load alone": partial(_command, "live TARGET --load 1 --viewer none"),
    "live, to clear faults": partial(_command, f"live TARGET {SPIN} --viewer none --clear-faults"),
    "conform, states": partial(_command, "conform TARGET --level 3"),
}


@dataclass
class Ended:
    """What came of it."""

    link: SpoiltLink
    before: tuple[bool, dict[str, float]]
    raised: BaseException | None = None
    text: str = ""

    @property
    def code(self) -> int:
        """Exit code; that of Python for what a notebook raises."""
        if isinstance(self.raised, SystemExit):
            return int(self.raised.code or 0)
        if isinstance(self.raised, KeyboardInterrupt):
            return 130
        return 0 if self.raised is None else int(getattr(self.raised, "exit_code", 2))


def _nothing(link: SpoiltLink, number: int) -> None:
    pass


def _run(
    command: str, device: SimulatedDevice, on_call: Callable[[SpoiltLink, int], None] = _nothing, more: str = "--yes"
) -> Ended:
    """`on_call` gets the link and the number of the call, before each read and write."""
    link = SpoiltLink(device, lambda number: on_call(link, number))
    ended, said = Ended(link, link.left()), io.StringIO()
    with ExitStack() as stack:
        for place in OPENED:
            stack.enter_context(patch(place, link.open))
        stack.enter_context(
            patch.object(conforming, "chosen", lambda level, bus: [c for c in chosen(level, bus) if c.id in FEW])
        )
        stack.enter_context(patch.object(sys, "stdout", said))
        stack.enter_context(patch.object(sys, "stderr", said))
        try:
            (COMMANDS | VARIANTS)[command](*more.split())
        except (SystemExit, KeyboardInterrupt, Exception) as error:
            ended.raised = error
    ended.text = " ".join(said.getvalue().split()) + f" {ended.raised}"
    return ended


@pytest.fixture(autouse=True)
def _somewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / f"own_{tmp_path.name}.py").write_text(HEAD + ACCEPTED)


# -- what is refused --------------------------------------------------------------------------------------------


def faulty() -> SimulatedDevice:
    device = simulated()
    device.drive.fault(Fault.OVERCURRENT)
    device.advance(160)
    return device


REFUSED = {
    "nobody can be asked": (physical, "", r"refusing to energise simulated drive .* on serial:\S+: .*no terminal to"),
    "another host turns it": (
        of_another_host,
        "--yes",
        r"is not at rest \(its heartbeat says RUNNING, outputs on\): ",
    ),
    "it has a latched fault": (faulty, "--yes", r"has a latched fault \(OVERCURRENT\): find the cause, then clear it"),
}


@pytest.mark.parametrize(
    ("why", "command"),
    [
        each
        for each in product(REFUSED, COMMANDS | VARIANTS)
        if each != ("it has a latched fault", "live, to clear faults")
    ],
)
def test_a_drive_that_must_not_be_turned_is_left_as_it_is(why: str, command: str) -> None:
    make, more, words = REFUSED[why]
    device = make()
    before = seen_in(device)
    ended = _run(command, device, more=more)
    assert (ended.code, bool(re.search(words, ended.text))) == (2, True), ended.text
    assert set(ended.link.states) == {before[0]}
    assert (seen_in(device) == before) or not more  # to be asked comes last
    assert ended.link.left() == ended.before


# -- however it ends --------------------------------------------------------------------------------------------


@cache
def _states(command: str, network: str) -> tuple[DriveState, ...]:
    """Of the drive at each call of a run that ends of itself."""
    ended = _run(command, simulated(network=network))
    assert ended.code == 0, ended.text
    return tuple(ended.link.states)


@pytest.mark.parametrize(("command", "most"), {"live": 3.0, "accept": 3.0, "hall": 2.0, "notebook": 3.0}.items())
def test_the_drives_own_limit_is_lowered_from_the_first_moment_on(command: str, most: float) -> None:
    """Of the current, to what was announced."""
    limits = set()

    def look(link: SpoiltLink, number: int) -> None:
        if link.device.drive.state in (DriveState.ARMED, DriveState.RUNNING):
            limits.add(link.device.bench.parameters["i_max"])

    assert _run(command, simulated(), look).code == 0
    assert limits == {most}


def _at(command: str, network: str) -> dict[str, int]:
    """Calls at which something may happen."""
    states = _states(command, network)
    armed, on = states.index(DriveState.ARMED), states.index(DriveState.RUNNING)
    off = len(states) - states[::-1].index(DriveState.RUNNING)
    return {
        "armed": armed + 1,
        "started": on + 2,
        "turning": (on + off) // 2,
        "stopping": off,
        "off": min(off + 3, len(states) - 1),
    }


LATE = [pytest.mark.campaign("ends"), pytest.mark.long("thousands of CAN frames a second of virtual time")]
SLOW = {("hall", "CAN"), ("accept", "CAN")}
RUNS = [pytest.param(*each, marks=LATE if each in SLOW else ()) for each in product(COMMANDS, LINKS)]


@pytest.mark.parametrize(("command", "network"), RUNS)
def test_whoever_ends_it_and_when_all_is_off_and_as_it_was(command: str, network: str) -> None:
    kinds = (signal.SIGINT,) * 3 if command == "notebook" else (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    moments = _at(command, network)
    for turn, (moment, at) in enumerate(
        [*moments.items(), ("stopping, and each time after that", moments["stopping"])]
    ):
        kind = kinds[turn % 3]

        def interrupt(link: SpoiltLink, call: int, at: int = at, kind: int = kind, last: int = turn) -> None:
            if call == at or (call > at and last >= len(moments)):
                signal.raise_signal(kind)

        ended = _run(command, simulated(network=network), interrupt)
        assert ended.link.left() == ended.before, (moment, ended.text)
        assert ended.link.device.drive.machine.faults == Fault(0), moment  # STOP did it, not the watchdog
        assert sum(state == DriveState.RUNNING for state in ended.link.states[at:]) <= SOON, moment
        assert ended.code == (130 if command in ("accept", "notebook") else 128 + kind), (moment, ended.text)
        assert "Traceback" not in ended.text
        if command == "accept":
            assert json.loads(Path("a.json").read_text())["verdict"] == "ABORTED"


def _deaf(link: SpoiltLink, number: int) -> None:
    link.deaf |= link.device.drive.state == DriveState.RUNNING


def _deaf_for_ever(link: SpoiltLink, number: int) -> None:
    if link.device.drive.state == DriveState.RUNNING and not link.deaf:
        link.device.drive.app.set_param("watchdog", 10.0)  # far longer than the bench waits
        link.deaf = True


def _trips(link: SpoiltLink, number: int) -> None:
    if link.states[-9:] == [DriveState.RUNNING] * 9:
        link.device.drive.fault(Fault.OVERCURRENT)


def _unplugged(link: SpoiltLink, number: int) -> None:
    if link.states[-9:] == [DriveState.RUNNING] * 9 or getattr(link, "gone", False):
        link.gone = True  # type: ignore[attr-defined]
        link.device.advance(160)
        raise LinkClosed("unplugged")


def _fails_once(link: SpoiltLink, number: int, error: type[Exception] = LinkClosed) -> None:
    if link.states[-9:] == [DriveState.RUNNING] * 9 and not getattr(link, "failed", False):
        link.failed = True  # type: ignore[attr-defined]
        raise error("it failed")


UNSAFE = "OUTPUTS MAY STILL BE ON: cut the power"
WAYS: dict[str, tuple[Callable[[SpoiltLink, int], None], dict[str, int], str]] = {
    # what happens, how each command ends, and what all of them say
    "STOP is not answered": (_deaf, {"live": 1, "accept": 2, "hall": 2, "conform": 1, "notebook": 2}, "STOP"),
    "nor does the watchdog switch off": (_deaf_for_ever, dict.fromkeys(COMMANDS, 5), UNSAFE),
    "the drive trips": (_trips, {"live": 1, "accept": 1, "hall": 0, "conform": 6, "notebook": 1}, ""),
    "the link fails once": (_fails_once, dict.fromkeys(COMMANDS, 2) | {"live": 0, "conform": 1}, "it failed"),
    "an error of this program": (partial(_fails_once, error=RuntimeError), dict.fromkeys(COMMANDS, 2), "it failed"),
    "the cable is pulled": (_unplugged, dict.fromkeys(COMMANDS, 5), UNSAFE),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("way", WAYS)
def test_what_the_drive_or_the_link_does_leaves_nothing_on_unsaid(way: str, command: str) -> None:
    happens, codes, words = WAYS[way]
    with patch("bench.live.run.RECONNECT", 1.0), patch("bench.device.client.REOPEN_PERIOD", 0.0):
        ended = _run(command, simulated(), happens)
    assert (ended.code, words in ended.text) == (codes[command], True), ended.text
    if way == "nor does the watchdog switch off":  # what may still be on keeps its lowered limit, and all else
        left = ended.link.left()[1]
        assert left["1.i_max"] == {"hall": 2.0, "conform": 8.0}.get(command, 3.0)
        assert left["1.k_p_vt"] == {"accept": 123.0, "notebook": 900.0}.get(command, 1268.0)
    if way == "the cable is pulled" and command != "conform":  # which changes nothing
        assert re.search(r"not restored: (k_p_vt \(was 1268\), )?i_max \(was 8\)", ended.text), ended.text
    device = ended.link.device
    if way in ("the link fails once", "an error of this program"):  # STOP did it
        assert (ended.link.left(), device.drive.machine.faults) == (ended.before, Fault(0))
    device.advance(16000)  # a second: what nobody feeds any more
    if way != "nor does the watchdog switch off":
        assert not any(session.app.outputs_on for session in device.sessions)
    if way != "the cable is pulled":
        assert ended.link.left()[1]["2.tau_max"] == ended.before[1]["2.tau_max"]


# -- a host that stands still -------------------------------------------------------------------------------------

ACCUSING = (
    r"no HBP device answered|sends no heartbeat|state is unknown|did not start|left RUNNING|confirmed no setpoint|"
    r"no DATA|rebooted|devices answer|STILL BE ON|WRONG_STATE|did not answer \w+ in 3 tries: (nothing|it is heard)"
)
PAUSES = (0.1, 0.25, 0.5, 1.0, 2.5, 5.0)  # s
PAUSED = [(command, network) for command in ("live", "accept", "hall", "notebook") for network in LINKS]
AT_RANDOM = 60 if os.environ.get(CAMPAIGN) else 5


@pytest.mark.parametrize(("command", "network"), sampled("paused", PAUSED, 3, campaign="ends"))
def test_a_pause_of_this_program_is_nobodys_fault_but_its_own(command: str, network: str) -> None:
    """At any moment, before HELLO is answered as while the motor turns: nothing is said of drive or link."""
    calls = len(_states(command, network))
    rng = random.Random(f"{commit()} {command} {network}")
    for at, pause in ((rng.randrange(1, calls), rng.choice(PAUSES)) for _ in range(AT_RANDOM)):

        def stand_still(link: SpoiltLink, call: int, at: int = at, pause: float = pause) -> None:
            if call == at:
                link.device.advance(round(pause * link.device.pwm_hz))

        ended = _run(command, simulated(network=network), stand_still)
        where = f"{pause} s at call {at} of {calls}: {ended.text}"
        assert not re.search(ACCUSING, ended.text), where
        assert "Traceback" not in ended.text
        assert ended.link.left()[0] == ended.before[0], where  # all off
        if ended.code:
            assert re.search(r"WATCHDOG.*this host sent no ALIVE for \d\.\d\d s \(it was starved", ended.text), where

"""`bench init`: what it finds and writes, at which rate, what it refuses, and that it sends nothing but questions."""

from __future__ import annotations

import math
import os
import random
import re
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import pytest
import serial
from against import bench as bench_on
from against import said
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import Program, Sim
from test_prompt import dialogue
from virtual_run import WatchedLink, never_armed, simulated

from bench.device.ports import lasting
from bench.init.bench_file import Answers, text
from bench.init.search import RATES, Seen
from bench.rig.settings import Settings, read_settings
from protocol.canmap.frame import BusRates
from protocol.canmap.host import CanWire
from protocol.errors import TargetError
from protocol.links import Link, parse_target
from protocol.messages import Role
from protocol.wire import HostWire
from sim.ports.byte_ports import PtyPort
from sim.ports.device import SimulatedDevice
from tests.choice import sampled
from tests.devices.serving import serving, twins

QUESTIONS = {"HELLO", "BLOB_READ", "PARAM_GET"}
"""All that may be sent to a drive that is only looked at."""
FILE = Path("bench.toml")
NOBODY = 65534


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("BENCH_TARGET", raising=False)


@contextmanager
def reached_by(open_link: Callable[[str], Link]) -> Iterator[None]:
    with patch("bench.rig.connection.open_link", open_link):
        yield


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line of error of `bench init ARGUMENTS… --yes`, which writes no file."""
    out, err = said(capsys, "init", *arguments, "--yes", code=2)
    assert not FILE.exists()
    assert "Traceback" not in out + err
    (line,) = [line for line in err.splitlines() if line.startswith("error: ")]
    return line


# -- what is found and written -----------------------------------------------------------------------------------


@pytest.mark.real_time
def test_a_drive_is_found_and_every_command_takes_it(capsys: pytest.CaptureFixture[str]) -> None:
    with serving("full", carrier="pty") as device:
        target = device.carrier.target
        out, _ = said(capsys, "init", "--target", target, "--yes", "--station", "bench 3", "--rated-current", "2.5")
        assert set(device.seen) <= QUESTIONS
        written = read_settings(None)
        told, err = said(capsys, "info")
    words = device.vocabulary
    assert f"node 1: {words.name} (drive) on {target}" in told
    assert f"target: {target}, from bench.toml" in err
    assert (written.target, written.station, written.rated) == (target, "bench 3", {"current": 2.5})
    assert words.serial in out
    assert words.serial in FILE.read_text()


def test_what_the_simulated_drive_tells_stands_in_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    """Node 2 is its load; the paper's motor has six pole pairs; its limits are 330 rad/s and 8 A."""
    said(capsys, "init", "--target", "sim", "--yes")
    found = FILE.read_text()
    assert read_settings(None) == Settings(path=FILE, target="sim", load="node")
    for words in ("# Drive: simulated drive", "6 pole pairs", f"largest speed {330 * 30 / math.pi:.0f} r/min",
                  "largest phase current 8 A", "# Encoder: its channel theta_enc", "serial SIM-0002",
                  '# station = "bench 3"', "# current = 8.0"):  # fmt: skip
        assert words in found
    out, err = said(capsys, "accept", "--list", "-k", "fig08")
    assert "target: sim, from bench.toml" in err
    assert "fig08" in out


def test_a_file_that_is_there_stays_unless_it_may_be_replaced(capsys: pytest.CaptureFixture[str]) -> None:
    FILE.write_text("[limits]  # the work of a week")
    _, err = said(capsys, "init", "--target", "sim", "--yes", code=2)
    assert "bench.toml exists" in err
    assert FILE.read_text() == "[limits]  # the work of a week"
    said(capsys, "init", "--target", "sim", "--yes", "--overwrite")
    assert read_settings(None).target == "sim"
    assert [path.name for path in Path().iterdir()] == ["bench.toml"]


def test_the_environment_goes_before_the_file_and_that_is_told(capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BENCH_TARGET", "tcp:elsewhere:1")
    _, err = said(capsys, "init", "--target", "sim", "--yes")
    assert "$BENCH_TARGET is set, and goes before it: tcp:elsewhere:1" in err


READABLE = st.text(st.characters(exclude_categories=("Cs",)))


@settings(deadline=None, max_examples=60)
@given(
    texts=st.tuples(READABLE, READABLE, READABLE),
    name=READABLE,
    person=st.booleans(),
    encoder=st.booleans(),
    rated=st.dictionaries(st.sampled_from(["speed_rpm", "current"]), st.floats(1e-3, 1e6)),
    load=st.sampled_from(["node", "none", "person", "tcp:h:1", "my brake.py:Bräke", "serial:COM3?baud=9600"]),
)
def test_whatever_is_answered_is_read_as_it_was_written(seen: Seen, texts, name, person, encoder, rated, load) -> None:
    """Also where a drive's name, or an answer, holds what would end a line, a text or a comment."""
    told = replace(seen, target="tcp:h:1", drive=replace(seen.drive, name=name, serial=name))
    station, operator, motor = texts
    answers = Answers(load, person, encoder, rated, station, operator, motor)
    FILE.write_text(text(told, answers, "today"), encoding="utf-8")
    assert read_settings(None) == Settings(
        path=FILE, target="tcp:h:1", load=load, person=person, encoder=encoder, rated=rated,
        station=station, operator=operator, motor=motor,
    )  # fmt: skip


@pytest.fixture(scope="module")
def seen() -> Seen:
    device = simulated()
    return Seen("sim", device.drive.identity, device.load.identity, "theta_enc", {"n_p": 6.0, "i_max": 8.0})


# -- rates -------------------------------------------------------------------------------------------------------


class Unheard(WatchedLink):
    """A drive at another rate: what it sends is noise here, or nothing."""

    def __init__(self, noise: int) -> None:
        super().__init__(simulated())
        self._noise = random.Random(noise)
        self._talks = bool(noise)

    def read(self, timeout: float, settle: float = 0.0) -> bytes:
        got = super().read(timeout, settle)
        return self._noise.randbytes(len(got)) if self._talks else b""


@pytest.mark.parametrize("noise", [0, 1])
@pytest.mark.parametrize("rate", sampled("rates", [*RATES, 1_500_000], 4, campaign="links"))
def test_a_drive_is_found_at_any_usual_rate(rate: int, noise: int, capsys: pytest.CaptureFixture[str]) -> None:
    """The one that was given comes first, whatever it is, and nothing but questions is sent at any."""
    links: list[WatchedLink] = []

    def open_link(target: str) -> Link:
        baud = parse_target(target).baud  # type: ignore[attr-defined]
        links.append(WatchedLink(simulated()) if baud == rate else Unheard(noise))
        return links[-1]

    given = f"serial:x?baud={rate}" if rate not in RATES else "serial:x"
    with reached_by(open_link):
        said(capsys, "init", "--target", given, "--yes")
    assert read_settings(None).target == ("serial:x" if rate == 115_200 else f"serial:x?baud={rate}")
    assert len(links) == (1 if rate not in RATES else RATES.index(rate) + 1)
    assert never_armed(*links)


def test_where_nobody_answers_every_rate_was_tried_and_the_first_as_long_as_a_board_boots(capsys) -> None:
    asked: dict[str, float] = {}
    links: list[tuple[str, WatchedLink]] = []

    def open_link(target: str) -> Link:
        if "12000000" in target:
            raise TargetError("serial:x cannot run at 12000000 baud")
        links.append((target, Unheard(0)))
        return links[-1][1]

    with reached_by(open_link):
        line = refused(capsys, "--target", "serial:x?open_delay=1&baud=9600")
    for target, link in links:
        asked[target] = asked.get(target, 0.0) + link.clock()
    rates = [9600, *(rate for rate in RATES if rate != 12_000_000)]
    assert list(asked) == [
        f"serial:x?baud={rate}&open_delay=1" if rate != 115_200 else "serial:x?open_delay=1" for rate in rates
    ]
    assert f"on serial:x at {', '.join(map(str, rates[:-1]))} or {rates[-1]} baud: check power" in line
    assert "docs/firmware.md" in line
    assert (max(asked, key=asked.__getitem__), sorted(asked.values())[-2] < 2.0) == (
        "serial:x?baud=9600&open_delay=1",
        True,
    )


@pytest.mark.real_time
@pytest.mark.long("starts a drive of its own")
def test_the_rate_of_a_real_port_is_found(start_sim: Callable[..., Sim], capsys: pytest.CaptureFixture[str]) -> None:
    sim = start_sim("--pty", "--baud", "3000000")
    port, _, rate = sim.target.partition("?")
    assert rate == "baud=3000000"
    said(capsys, "init", "--target", port, "--yes")
    assert read_settings(None).target == sim.target
    assert not any("outputs on" in line for line in sim.out)


# -- what is refused ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("carrier", ["bytes", "CAN"])
def test_two_drives_of_one_number_are_named(carrier: str, capsys: pytest.CaptureFixture[str]) -> None:
    with twins(carrier, "LEFT-1", "RIGHT-2") as devices:
        ran = bench_on("init --target TARGET --yes", devices[0], capsys)
    assert ran.code == 2
    assert re.search(r"two devices answer as node 1 on \S+ \(serial LEFT-1 and RIGHT-2\)", ran.text), ran.text
    assert not FILE.exists()
    assert not any(device.seen["ARM"] for device in devices)


class OnABus(WatchedLink):
    """Leads to the node that its target names, as a link to CAN does."""

    def __init__(self, device: SimulatedDevice, target: str) -> None:
        super().__init__(device)
        self._node = parse_target(target).node  # type: ignore[attr-defined]

    def wire(self) -> HostWire:
        return CanWire(BusRates(1_000_000), self._node)


def test_of_several_drives_on_a_bus_one_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    device = simulated(network="CAN")
    device.load.identity = replace(device.load.identity, role=Role.DRIVE)
    with reached_by(lambda target: OnABus(device, target)):
        line = refused(capsys, "--target", "can:virtual/x")
        for node, target, serial_number in ((1, "can:virtual/x", "SIM-0001"), (2, "can:virtual/x?node=2", "SIM-0002")):
            said(capsys, "init", "--target", f"can:virtual/x?node={node}", "--yes", "--overwrite")
            assert (read_settings(None).target, read_settings(None).load) == (target, "none")
            assert f"serial {serial_number}, " in FILE.read_text().partition("target")[0]
    assert "nodes 1, 2 of can:virtual/x are drives: add node=N to the target" in line


def test_the_only_drive_on_a_bus_is_taken_whatever_its_number(capsys: pytest.CaptureFixture[str]) -> None:
    device = simulated(network="CAN")
    device.drive.identity = replace(device.drive.identity, role=Role.LOAD)
    device.load.identity = replace(device.load.identity, role=Role.DRIVE)
    with reached_by(lambda target: OnABus(device, target)):
        said(capsys, "init", "--target", "can:virtual/x", "--yes")
    assert read_settings(None).target == "can:virtual/x?node=2"
    assert "# Drive: load machine, firmware hallbench-sim, serial SIM-0002" in FILE.read_text()


def test_what_is_no_drive_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    device = simulated()
    device.drive.identity = replace(device.drive.identity, role=Role.LOAD)
    with reached_by(lambda target: WatchedLink(device)):
        assert "there is no drive on serial:x: node 1 is a LOAD" in refused(capsys, "--target", "serial:x")


@pytest.mark.parametrize(("options", "says"), [
    ("--rated-current 9", r"current = 9 .* is beyond the drive's limit of 8"),
    ("--rated-speed 4000", r"speed_rpm = 4000 .* is beyond the drive's limit of 3151"),
    ("--rated-speed 0", "must be above 0, got 0"),
    ("--load brake", "load must be node, none, person, FILE.py:Class or a target: unknown target 'brake'"),
    ("--load serial:/dev/nowhere", "no port /dev/nowhere"),
])  # fmt: skip
def test_an_answer_that_cannot_be(options: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert re.search(says, refused(capsys, "--target", "sim", *options.split()))


@pytest.mark.real_time
def test_a_load_that_does_not_answer_is_no_load(capsys: pytest.CaptureFixture[str]) -> None:
    with serving("own", carrier="pty") as device:
        line = refused(capsys, "--target", device.carrier.target, "--load", "node")
        said(capsys, "init", "--target", device.carrier.target, "--yes")
    assert "no load machine answers as node 2" in line
    assert read_settings(None).load == "none"


def test_ports_that_cannot_be_opened(capsys: pytest.CaptureFixture[str]) -> None:
    port = PtyPort()
    path = port.target.removeprefix("serial:").partition("?")[0]
    try:
        with serial.Serial(path, exclusive=True):
            assert f"{path} is held by another program" in refused(capsys, "--target", f"serial:{path}")
    finally:
        port.unplug()
    assert "no port /dev/nowhere; " in refused(capsys, "--target", "serial:/dev/nowhere")
    Path("text").touch()
    assert "text is not a serial port" in refused(capsys, "--target", "serial:text")
    assert "unknown target 'nothing'" in refused(capsys, "--target", "nothing")


@contextmanager
def as_an_ordinary_user() -> Iterator[None]:
    """May open nothing that is root's."""
    before = os.geteuid()
    os.seteuid(NOBODY if before == 0 else before)
    try:
        yield
    finally:
        os.seteuid(before)


def test_a_port_that_is_not_for_this_user(capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    refused(capsys, "--target", "serial:/dev/nowhere")  # loads what only root may read, where root runs the tests
    port = PtyPort()
    path = Path(port.target.removeprefix("serial:").partition("?")[0])
    path.chmod(0o600 if os.geteuid() == 0 else 0o000)
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o777)
        monkeypatch.chdir(folder)
        with as_an_ordinary_user():
            line = refused(capsys, "--target", f"serial:{path}")
    port.unplug()
    assert line == f"error: no permission for {path}: add your user to its group (often dialout)"


def test_without_a_terminal_nothing_is_asked(start: Callable[..., Program]) -> None:
    init = start("init")
    assert init.end() == 2
    assert init.err == ["error: bench init asks, and there is no terminal to answer: use --target TARGET --yes"]


@pytest.mark.parametrize(("there", "says"), [
    ([], "no serial ports and no CAN interfaces found"),
    (["serial:/dev/ttyA", "can:socketcan/can0"], "2 places to look at, serial:/dev/ttyA, can:socketcan/can0: choose"),
])  # fmt: skip
def test_without_a_target_only_the_one_that_is_there_is_asked(capsys, there: list[str], says: str) -> None:
    def places() -> list[dict[str, str]]:
        return [{"target": target, "description": "", "usb_id": "", "serial_number": ""} for target in there]

    with patch("bench.device.ports.places", places):
        assert says in refused(capsys)
        there[:] = ["serial:x"]
        with reached_by(lambda target: WatchedLink(simulated())):
            said(capsys, "init", "--yes")
    assert read_settings(None).target == "serial:x"


def test_a_port_is_named_by_what_stays_when_it_is_plugged_in_again(tmp_path: Path) -> None:
    links = tmp_path / "by-id"
    assert lasting("serial:/dev/ttyUSB0", links) == "serial:/dev/ttyUSB0"
    links.mkdir()
    (links / "usb-b-if00").symlink_to("/dev/ttyUSB0")
    (links / "usb-a-if00").symlink_to("../ttyUSB0")  # leads elsewhere from here
    assert lasting("serial:/dev/ttyUSB0?baud=9600", links) == f"serial:{links}/usb-b-if00?baud=9600"
    assert lasting("serial:/dev/ttyUSB1", links) == "serial:/dev/ttyUSB1"
    assert lasting("can:slcan//dev/ttyUSB0", links) == "can:slcan//dev/ttyUSB0"


# -- at a terminal -----------------------------------------------------------------------------------------------


@pytest.mark.real_time
@pytest.mark.long("a dialogue with a program of its own")
def test_a_person_is_asked_and_may_err() -> None:
    """A port that is not there, a load that is none, a current beyond the drive's: each is told, and asked again."""
    with serving("full", carrier="pty") as device:
        code, shown = dialogue(["init"], [
            (b"sim [^\n]*: ", b"serial:/dev/nowhere\n"),
            (b"no port /dev/nowhere[^$]*sim [^\n]*: ", device.carrier.target.encode() + b"\n"),
            (b"What brakes [^\n]*: ", b"brake\n"),
            (b"unknown target 'brake'[^$]*What brakes [^\n]*: ", b"none\n"),
            (b"turn knobs [^\n]*: ", b"y\n"),
            (b"encoder [^\n]*: ", b"n\n"),
            (b"Largest speed[^\n]*: ", b"\n"),
            (b"Largest phase current[^\n]*: ", b"1e9\n"),
            (b"beyond the drive's limit[^$]*Largest phase current[^\n]*: ", b"1.5\n"),
            (b"Which bench[^\n]*: ", "Prüfstand \"3\"\n".encode()),
            (b"Who runs[^\n]*: ", b"\n"),
            (b"Which motor[^\n]*: ", b"no. 17\n"),
        ])  # fmt: skip
        assert set(device.seen) <= QUESTIONS
    assert code == 0, shown
    assert read_settings(None) == Settings(
        path=FILE, target=device.carrier.target, load="none", person=True, encoder=False, rated={"current": 1.5},
        station='Prüfstand "3"', motor="no. 17",
    )  # fmt: skip
    assert stat.S_ISREG(FILE.stat().st_mode)


@pytest.mark.slow
def test_ctrl_c_at_a_question_writes_nothing() -> None:
    code, shown = dialogue(["init", "--target", "sim"], [(b"What brakes [^\n]*: ", b"\x03")])
    assert (code, FILE.exists()) == (130, False), shown
    assert "Traceback" not in shown

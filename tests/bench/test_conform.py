"""`bench conform`: sound devices pass, whatever ends it leaves the outputs off, and the command says what it found."""

from __future__ import annotations

import json
import re
import tomllib
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner, Result
from conforming import (
    OVERLOADED,
    RICH,
    TARGET,
    device_of,
    ended,
    narrow,
    on_device,
    on_simulated,
    on_uart,
    options,
    run_on,
)
from processes import Program, Sim
from stopped_host import StoppedHost
from virtual_run import NETWORKS, RecordingScreen, WatchedLink, at_rest, physical, simulated

from bench.cli import cli
from bench.conform import run as conforming
from bench.conform.catalogue import checks, chosen
from bench.conform.checks import TABLE, Carrier
from bench.conform.claim import claim, outcome
from bench.conform.levels import CAN, MOTION, STATES, STREAMS
from bench.conform.run import Options, Run, conform
from bench.errors import BenchError, UnsafeError
from bench.signal.verdict import Verdict
from protocol.errors import NoReply, Refused
from protocol.messages import DriveState, ErrorCode
from protocol.requirements import requirements
from sim.ports.virtual import VirtualLink
from tests.choice import sampled
from tests.devices import FULL, serving
from tests.devices.faults import FAULTS
from tests.devices.spec import State
from tests.tools import needs

UNCHECKED = Path(__file__).parents[2] / "docs" / "conform" / "unchecked.toml"
OF_TEXTS = ("identity.texts", "identity.descriptor", "identity.log")
LEVELS = (0, 1, STREAMS, STATES, MOTION, CAN)


# -- sound devices ----------------------------------------------------------------------------------------------------

UNSEEN = {
    ("full", "bytes"): [],
    ("own", "bytes"): ["motion.direction", "motion.undisturbed", "motion.starts-at-rest", "motion.never-clipped"],
    ("full", "CAN"): [],
    ("own", "CAN"): ["motion.direction", "motion.undisturbed", "motion.starts-at-rest", "motion.never-clipped"],
}


@pytest.mark.parametrize(("vocabulary", "carrier"), UNSEEN, ids=map(" on ".join, UNSEEN))
def test_the_device_written_from_spec_passes_every_level(vocabulary: str, carrier: str) -> None:
    run, device = on_device(CAN, vocabulary=vocabulary, carrier=carrier)
    assert not ended(run, Verdict.FAIL)
    assert ended(run, Verdict.INVALID) == UNSEEN[vocabulary, carrier]
    assert len(run.results) == len(chosen(CAN, carrier == "CAN"))
    assert (run.troubles, run.unsafe, run.ended, outcome(run).exit_code) == ([], "", "", 0)
    assert (device.state, device.outputs_on, device.streams) == (State.IDLE, False, {})
    assert device.values == pytest.approx({row.id: row.value for row in device.vocabulary.parameters}, rel=1e-7)


SIMULATED = [
    pytest.param(network, compiled, id=f"{network}, {'C' if compiled else 'Python'}",
                 marks=needs("C compiler") if compiled else ())
    for network in NETWORKS for compiled in (False, True)
]  # fmt: skip


@pytest.mark.parametrize(("network", "compiled"), sampled("simulated drive", SIMULATED, 3, campaign="conform"))
def test_the_simulated_drive_passes_every_level(network: str, compiled: bool) -> None:
    device = narrow() if network == "bytes" and not compiled else simulated(network=network, compiled=compiled)
    before = dict(device.bench.parameters)
    run = on_simulated(CAN, device)
    assert not ended(run, Verdict.FAIL)
    assert not ended(run, Verdict.INVALID)
    assert claim(run).conforms
    assert at_rest(device)
    assert device.bench.parameters == before


@pytest.mark.slow
@pytest.mark.parametrize("baud", sampled("baud", (57_600, 115_200), 1, campaign="conform"))
def test_a_slow_uart_is_no_fault_of_the_device(baud: int) -> None:
    run = on_uart(STREAMS, baud)
    assert not ended(run, Verdict.FAIL)
    assert ended(run, Verdict.INVALID) == ["stream.edges-before-samples"]  # its motor is at rest


@pytest.mark.campaign("conform")
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("baud", [9_600, 14_400, 19_200, 28_800, 31_250, 38_400, 44_000])
def test_neither_is_a_very_slow_one(baud: int, compiled: bool) -> None:
    run = on_uart(MOTION, baud, compiled)
    assert not ended(run, Verdict.FAIL)
    assert run.count(Verdict.PASS) > (140 if baud >= 28_800 else 70)
    assert not run.loses or (baud < 28_800 and "use 28800 or more" in run.loses)


RATES = {f"{hz} Hz, {carrier}": (hz, carrier)
         for hz in (1000, 5000, 20_000, 100_000) for carrier in ("bytes", "CAN")}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("pwm_hz", "carrier"), sampled("PWM", RATES, 1, campaign="conform"))
def test_no_pwm_rate_is_a_fault_of_the_device(pwm_hz: int, carrier: str) -> None:
    level = STREAMS if pwm_hz > 20_000 else CAN  # a second of 100 kHz takes a second
    run, _ = on_device(level, carrier=carrier, pwm_hz=pwm_hz)
    assert not ended(run, Verdict.FAIL)


STOPPED = {f"{kind}, {seed}": (kind, seed) for kind in ("bytes", "CAN", "simulated", "in C") for seed in range(5)}
STOPS = 5
"""In a run: 100 in all of them."""
LOOKS = 40_000
"""Of a run at the clock and at the link, among which they are chosen."""


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "seed"), sampled("stopped", STOPPED, 2, campaign="conform"))
def test_a_host_that_is_stopped_blames_nobody(kind: str, seed: int) -> None:
    with device_of(kind) as (link, idle):
        stopped = StoppedHost(link, idle, STOPS, LOOKS, seed)
        run = run_on(stopped, MOTION, idle=idle)
    assert len(stopped.stopped) >= STOPS - 1
    assert not ended(run, Verdict.FAIL)
    assert (run.ended, run.unsafe) == ("", "")
    for result in run.results:
        if result.verdict is Verdict.INVALID and result.check.id not in OVERLOADED:
            assert "this program was held up for " in result.evidence, result


def test_a_check_that_is_disturbed_each_time_is_undecided(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conforming, "chosen", lambda level, bus: [TABLE["watchdog.fed-by-alive"]])
    with serving(RICH, carrier="bytes") as device:
        read = device.link.read

        def stopped(*given: float) -> bytes:
            if device.state == State.RUNNING:
                device.link.idle(0.49)
            return read(*given)

        monkeypatch.setattr(device.link, "read", stopped)
        run = run_on(device.link, STATES, idle=device.link.idle)
    assert device.seen["START"] == conforming.ATTEMPTS
    assert ended(run, Verdict.INVALID) == ["watchdog.fed-by-alive"]
    assert re.search(r"this program was held up for \d\.\d\d s, at the last of 3 attempts", run.results[0].evidence)


# -- devices that answer late, or not at all --------------------------------------------------------------------------

SLOW_OR_MUTE = [name for name in FAULTS if name.startswith(("late-", "mute-"))]


@pytest.mark.parametrize("fault", sampled("mute", SLOW_OR_MUTE, 4, campaign="conform"))
def test_what_is_not_answered_in_time_is_one_finding_within_bounds(fault: str) -> None:
    run, device = on_device(CAN, [fault])
    assert ended(run, Verdict.FAIL) == ["link.in-time"]
    assert claim(run).conforms is False
    assert device.link.clock() < 120.0
    assert len(run.results) == len(chosen(CAN, bus=False))


REFUSALS = {"idle": "state.stop-obeyed", "armed": "state.stop-obeyed", "running": "state.stop-obeyed",
            "fault": "state.stop-in-fault", "argument": "state.stop-obeyed"}  # fmt: skip


@pytest.mark.parametrize(("kind", "check"), sampled("STOP", REFUSALS.items(), 2, campaign="conform"))
def test_one_kind_of_stop_that_is_refused_is_one_finding_within_bounds(kind: str, check: str) -> None:
    run, device = on_device(CAN, [f"stop-refused-{kind}"])
    assert ended(run, Verdict.FAIL) == [check]
    assert device.link.clock() < 120.0


def test_a_check_and_a_run_have_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conforming, "CHECK_TAKES", 0.5)
    run, _ = on_device(1)
    assert "identity.heartbeat-rate" in ended(run, Verdict.INVALID)
    assert not ended(run, Verdict.FAIL)
    monkeypatch.setattr(conforming, "MOST", 3.0)
    run, device = on_device(STATES)
    assert run.ended == "it took longer than 3 s"
    assert len(run.results) == len(chosen(STATES, bus=False))
    assert device.link.clock() < 10.0


@pytest.mark.parametrize("length", ["short", "long"])
def test_a_hello_of_another_length_is_told_in_every_form(length: str, tmp_path: Path) -> None:
    json_file, report = tmp_path / "found.json", tmp_path / "report.html"
    with (
        serving(RICH, [f"hello-{length}"], "bytes") as device,
        patch("protocol.links.open_link", lambda _: device.link),
    ):
        arguments = ["conform", TARGET, "--level", "0", "--json", str(json_file), "--report", str(report)]
        result = CliRunner().invoke(cli, arguments)
    told = json.loads(json_file.read_text())
    failed = [check["id"] for check in told["checks"] if check["verdict"] == "failed"]
    assert failed == (["link.hello"] if length == "short" else [])
    assert result.exit_code == (1 if length == "short" else 0)
    assert "link.hello" in report.read_text()


@pytest.mark.slow
def test_a_level_has_those_below_it_and_nothing_is_energised_below_the_third() -> None:
    counts = []
    for level in LEVELS[:4]:
        run, device = on_device(level, without=OVERLOADED)
        counts.append(len(run.results))
        assert {result.check.level for result in run.results} == set(range(level + 1))
        assert bool(device.seen["ARM"] + device.seen["START"] + device.seen["SETPOINT"]) == (level >= STATES)
        found = claim(run)
        assert found.level == level
        assert f"conforms to HBP 1.0 at level {level}: " in found.words
        assert (f"level {level + 1} (" in found.words) == (level < MOTION)
    assert counts == sorted(counts)


def test_on_a_bus_the_checks_of_can_run_as_far_as_the_level_allows() -> None:
    for level in (0, STREAMS, STATES):
        ids = {check.id for check in chosen(level, bus=True)}
        assert ids > {check.id for check in chosen(level, bus=False)}
        assert ("can.stop-frame" in ids) == (level >= STATES)
        assert ("can.slots" in ids) == (level >= STREAMS)
        assert "can.toggle" in ids


def test_what_was_not_seen_is_unknown_and_the_claim_names_it() -> None:
    run, _ = on_device(STREAMS, vocabulary=FULL)
    assert ended(run, Verdict.INVALID) == ["stream.edges-before-samples"]
    assert "parameter.read-only" in ended(run, Verdict.SKIPPED)
    found = claim(run)
    assert re.fullmatch(
        r"conforms to HBP 1\.0 at level 2: \d+ checks passed, 1 unknown: stream\.edges-before-samples; "
        r"not tested: level 3 \(states and setpoints\), level 4 \(motion\)",
        found.words,
    )
    assert outcome(run).exit_code == 0


@pytest.mark.slow
def test_a_level_whose_start_was_refused_is_not_claimed(monkeypatch: pytest.MonkeyPatch) -> None:
    device = simulated()
    enter = device.drive.app.enter_state

    def refusing(state: DriveState) -> None:
        if state is DriveState.RUNNING:
            raise Refused("no supply", ErrorCode.NOT_SUPPORTED, 42)
        enter(state)

    monkeypatch.setattr(device.drive.app, "enter_state", refusing)
    run = on_simulated(STATES, device)
    assert not ended(run, Verdict.FAIL)
    assert {"state.stop-obeyed", "watchdog.trips"} <= set(ended(run, Verdict.INVALID))
    found = claim(run)
    assert (found.level, found.conforms, outcome(run).exit_code) == (STREAMS, True, 6)
    assert found.words.startswith("conforms to HBP 1.1 at level 2: ")
    assert found.words.endswith(
        "; not shown: level 3 (states and setpoints), which needs state.stop-obeyed, watchdog.trips; "
        "not tested: level 4 (motion)"
    )


def test_streams_that_somebody_left_are_there_again() -> None:
    with serving(RICH, carrier="bytes") as device:
        from bench.device.client import Client
        from bench.device.node import Node

        node = Node(client := Client(device.link), client.connect().node)
        node.set_samples(node.channels(["hall", "i_q"]), 8)
        node.start_streams()
        run_on(device.link, 0, idle=device.link.idle)
        (stream,) = device.streams.values()
        assert [channel.name for channel in stream.channels] == ["hall", "i_q"]
        assert (stream.decimation, stream.running) == (8, True)


# -- what must be said before anything is energised --------------------------------------------------------------------


def test_a_physical_drive_is_energised_by_consent_only() -> None:
    asked: list[str] = []

    def refuse(question: str) -> bool:
        asked.append(question)
        return False

    with pytest.raises(UnsafeError, match="not confirmed"):
        conform(lambda: VirtualLink(physical()), options(MOTION, yes=False), RecordingScreen(), refuse, print)
    assert "up to 100 r/min" in asked[0]
    link = WatchedLink(physical())
    run_on(link, 0, yes=False)
    assert set(link.states) == {DriveState.IDLE}


def test_a_speed_beyond_the_limit_is_refused_and_a_latched_fault_may_be_looked_at() -> None:
    with pytest.raises(BenchError, match="speed 9999 r/min is beyond the drive's limit"):
        run_on(VirtualLink(simulated()), MOTION, speed_rpm=9999.0)
    with serving(RICH, carrier="bytes") as device:
        device.trip(1)  # type: ignore[arg-type]
        assert not ended(run_on(device.link, 1), Verdict.FAIL)


def test_a_device_that_cannot_be_worked_with_is_looked_at_all_the_same() -> None:
    run, device = on_device(STATES, ["pwm-hz-zero"])
    assert "identity.hello-fields" in ended(run, Verdict.FAIL)
    assert not device.seen["ARM"]
    assert claim(run).conforms is False


# -- every way out ----------------------------------------------------------------------------------------------------


def test_a_drive_that_does_not_stop_is_not_energised_again_and_shouted_at_the_end() -> None:
    run, device = on_device(MOTION, ["stop-ignored"], without=OVERLOADED)
    assert ended(run, Verdict.FAIL) == ["state.stop-obeyed"]
    assert device.seen["START"] == 0  # STOP was not obeyed in ARMED
    run, _ = on_device(MOTION, ["stop-outputs-stay"], without=OVERLOADED)
    assert "MAY STILL BE ON" in run.unsafe
    assert outcome(run).exit_code == 5


# -- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found() -> dict[str, Run]:
    """A run that passes, and one in which a check fails."""
    faulty, _ = on_device(1, ["wrong-detail", "control-characters"], without=OF_TEXTS)
    return {"sound": on_device(STREAMS)[0], "faulty": faulty}


@pytest.fixture
def invoke() -> Any:
    """Run the command; what it connects to has already been looked at."""

    def invoke(run: Run | Exception, *arguments: str) -> Result:
        def instead(link: object, asked: Options, screen: Any, confirm: Any, told: Any) -> Run:
            if isinstance(run, Exception):
                raise run
            for result in run.results:
                told(result)
            return replace(run, options=asked)

        with patch.object(conforming, "conform", instead):
            return CliRunner().invoke(cli, ["conform", TARGET, *arguments])

    return invoke


def test_it_prints_a_table_of_each_level_and_the_claim(invoke: Any, found: dict[str, Run]) -> None:
    result = invoke(found["sound"])
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert [line.split()[1] for line in lines if line.startswith("level ")] == ["0:", "1:", "2:"]
    assert lines[-1].startswith("conforms to HBP 1.0 at level 2")
    assert any(re.match(r"identity\.schema-crc +passed +[0-9a-f]{8} over \d+ bytes", line) for line in lines)


def test_a_check_that_fails_is_told_in_every_form(invoke: Any, found: dict[str, Run], tmp_path: Path) -> None:
    assert "does not conform to HBP 1.0: 1 check failed: identity.other-blobs" in invoke(found["faulty"]).stdout
    junit, report = tmp_path / "junit.xml", tmp_path / "report.html"
    result = invoke(found["faulty"], "--json", "-", "--junit", str(junit), "--report", str(report))
    assert result.exit_code == 1
    told = json.loads(result.stdout, parse_constant=pytest.fail)  # nothing else goes to standard output
    assert told["conforms"] is False
    assert told["about"]["target"] == TARGET
    assert {"name", "firmware", "serial", "build", "boot_id", "started"} <= told["about"].keys()
    assert sum(told["counts"].values()) == len(told["checks"])
    (failed,) = (check for check in told["checks"] if check["verdict"] == "failed")
    assert (failed["id"], failed["requirements"]) == ("identity.other-blobs", ["5.20", "17.1"])
    assert "UNKNOWN_ID, detail 0" in failed["evidence"]

    root = ElementTree.parse(junit).getroot()
    suites = root.findall("testsuite")
    assert [suite.get("name") for suite in suites] == ["level 0: link", "level 1: identity and parameters"]
    for suite in suites:
        for count, of in (("tests", "testcase"), ("failures", "testcase/failure"), ("skipped", "testcase/skipped")):
            assert int(suite.get(count, "")) == len(suite.findall(of))
    assert [case.get("name") for case in root.iter("testcase")] == [r.check.id for r in found["faulty"].results]
    assert root.find(".//failure") is not None

    text = report.read_text()  # what the device says of itself is text in it
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e]", text)
    assert "What failed" in text


def test_the_report_begins_with_what_was_not_tested(invoke: Any, found: dict[str, Run], tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    assert f"report: {file}" in invoke(found["sound"], "--report", str(file), "--operator", "A. Person").stdout
    text = file.read_text()
    assert text.index("What was not tested") < text.index("The device") < text.index("Level 0: link")
    for words in ("A. Person", TARGET, "9f2c61e-dirty", "33FFD8054D48383611571943", "level 4 (motion)"):
        assert words in text
    for result in found["sound"].results:
        assert result.check.id in text
    assert "http" not in text
    refused = invoke(found["sound"], "--report", str(file))
    assert refused.exit_code != 0
    assert "exists" in str(refused.exception)
    assert invoke(found["sound"], "--report", str(file), "--overwrite").exit_code == 0


def test_arguments_that_are_wrong(invoke: Any, found: dict[str, Run]) -> None:
    for arguments in (("--level", "6"), ("--speed", "0"), ("--junit", "-"), ("--report", "-")):
        assert invoke(found["sound"], *arguments).exit_code == 2
    assert isinstance(invoke(NoReply("nobody"), "--level", "1").exception, NoReply)


# -- the checks themselves --------------------------------------------------------------------------------------------


def test_every_check_cites_requirements_of_devices_and_says_what_it_looks_at() -> None:
    for check in checks():
        assert all(requirements()[number].device for number in check.cites), check.id
        assert check.says == requirements()[check.cites[0]].text
        assert check.body.__doc__, check.id
        assert re.fullmatch(r"[a-z]+\.[a-z0-9-]+", check.id)
        assert check.needs <= check.level
        assert (check.carrier is Carrier.BUS) == (check.level == CAN)


def test_every_requirement_of_a_device_has_a_check_or_the_page_says_why_not() -> None:
    why = tomllib.loads(UNCHECKED.read_text())
    cited = {number for check in checks() for number in check.cites}
    assert cited.isdisjoint(why)
    assert cited | why.keys() == {number for number, each in requirements().items() if each.device}
    assert all(why.values())


def test_checks_run_by_level_and_stop_is_the_first_that_is_looked_at_once_outputs_go_on() -> None:
    levels = [check.level for check in checks()]
    assert levels == sorted(levels)
    energising = [check.id for check in checks() if check.needs >= STATES]
    assert energising[0] == "state.stop-obeyed"
    assert next(each for each in energising if each.startswith("motion.")) == "motion.stop"


@pytest.mark.real_time
@pytest.mark.long("a level of checks in real time")
def test_the_command_on_a_pty() -> None:
    with closing(Sim("--pty")) as sim:
        program = Program("bench", "conform", sim.target, "--level", "0", "--json", "-")
        with closing(program):
            assert program.end() == 0, program.err
            told = json.loads("\n".join(program.out))
    assert told["conforms"] is True
    assert told["counts"]["passed"] > 20
    assert told["counts"]["unknown"] == 0

"""A device that misbehaves in each way of `tests.devices.faults` gets the right word and exit code from each command.

Exit codes: 0 done, 1 the drive failed, 2 an error or no verdict, 5 the outputs may still be on, 6 `accept` incomplete.

Each case runs in virtual time, on a byte link or a CAN bus; `pytest --real-links` runs it over pty, TCP and CAN too.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from against import ACCEPT, CAN, HALL, INFO, LOOK, SPIN, WATCH, bench
from conforming import MEANT_FOR

from tests.devices import FAULTS, serving
from tests.devices.device import Device
from tests.devices.spec import State

pytestmark = pytest.mark.slow

BYTES, ALL = ("pty", "tcp"), ("pty", "tcp", "slcan")
SHOUT = ("OUTPUTS MAY STILL BE ON", "cut the power")
LONGER = SPIN.replace("0.8", "2.0")
FITTED = f"{SPIN} --fit"
REFUSED = SPIN.replace(" --yes", "")  # nobody can be asked
UNFED = ACCEPT.replace("test_stop", "test_watchdog")
NAMES = {
    SPIN: "spin", LONGER: "spin_longer", REFUSED: "spin_refused", WATCH: "watch", INFO: "info", LOOK: "hall_passive",
    FITTED: "spin_fitted", HALL: "hall", ACCEPT: "accept", UNFED: "accept_watchdog",
}  # fmt: skip


class Case(NamedTuple):
    """With these faults a command ends with one of `codes` and says all of `words` (regular expressions)."""

    faults: str
    command: str
    codes: tuple[int, ...]
    words: tuple[str, ...] = ()
    links: tuple[str, ...] = ("tcp",)
    never: str = r"(?!)"
    """What it must not say."""


UNSAFE = (
    Case("stop-ignored", SPIN, (5,), SHOUT, ALL),
    Case("stop-ignored", ACCEPT, (5,), SHOUT, ("pty",)),
    Case("stop-ignored", HALL, (5,), SHOUT, ("tcp",)),
    Case("stop-outputs-stay", SPIN, (5,), SHOUT, ALL),
    Case("stop-outputs-stay", ACCEPT, (5,), SHOUT),
    Case("stop-says-running watchdog-dead", SPIN, (5,), SHOUT, ALL),
    Case("stop-refused watchdog-dead", SPIN, (5,), SHOUT, ALL),
    Case("stop-refused watchdog-dead", ACCEPT, (5,), SHOUT, ("pty",)),
    Case("stop-unanswered watchdog-dead", SPIN, (5,), SHOUT, ALL),
    Case("stop-unanswered watchdog-dead", ACCEPT, (5,), SHOUT),
)
"""The end is never safe."""

SAFE_AT_LAST = (
    Case("stop-third-time", SPIN, (0, 1), (), ALL, never="MAY STILL BE ON"),
    Case("stop-says-running", SPIN, (1,), ("STOP", "watchdog|WATCHDOG"), BYTES, never="MAY STILL BE ON"),
    Case("stop-refused", SPIN, (1,), ("STOP", "watchdog|WATCHDOG"), BYTES, never="MAY STILL BE ON"),
    Case("stop-unanswered", SPIN, (1,), ("STOP", "watchdog|WATCHDOG"), BYTES, never="MAY STILL BE ON"),
)
"""STOP is repeated until it is obeyed, or the watchdog does it."""

STATES = (
    Case("start-stays-armed", SPIN, (1,), ("did not start",), ALL),
    Case("start-stays-armed", ACCEPT, (1, 2), ("did not start",)),
    Case("start-stays-armed", HALL, (1, 2), ("did not start",)),
    Case("start-says-armed", SPIN, (1,), ("did not start",), ALL),
    Case("leaves-running", SPIN, (1,), ("left RUNNING", "IDLE"), ALL),
    Case("leaves-running", ACCEPT, (1,), ("left RUNNING", "FAIL")),
    Case("leaves-running", HALL, (1, 2), ("left RUNNING",), ("pty",)),
    Case("foreign-stop", SPIN, (1,), ("left RUNNING", "IDLE"), ("slcan", "virtual")),
    Case("foreign-stop", ACCEPT, (1,), ("left RUNNING", "FAIL"), ("slcan",)),
    Case("reboots", SPIN, (1,), ("reboot",), ALL),
    Case("reboots", ACCEPT, (1,), ("reboot", "FAIL")),
    Case("heartbeats-stop", SPIN, (1, 5), ("heartbeat",), BYTES),
    Case("no-watchdog", LONGER, (1,), ("watchdog", "inactive"), ALL),
    Case("no-watchdog", ACCEPT, (1, 2), ("watchdog", "inactive")),
    Case("no-watchdog", HALL, (1, 2), ("watchdog", "inactive"), ("pty",)),
    Case("no-watchdog-running", LONGER, (1,), ("watchdog", "inactive"), ALL),
    Case("no-watchdog-running", ACCEPT, (1, 2), ("watchdog", "inactive"), ("pty",)),
    Case("watchdog-dead", UNFED, (1,), ("FAIL +watchdog",)),
)

MOTORS = (
    Case("does-not-turn", LONGER, (1,), ("result +implausible:", "bench hall check"), BYTES),
    Case("wrong-pole-pairs", LONGER, (1,), ("result +implausible:", "n_p", "bench hall check"), BYTES),
    Case("wrong-pole-pairs", HALL, (1,), ("pole pairs",)),
    Case("estimate-off", LONGER, (1,), ("result +implausible:", "bench hall check"), BYTES),
    Case("overcurrent", LONGER, (1,), ("result +implausible:", "i_max"), BYTES),
    Case("backwards", LONGER, (1,), ("result +implausible:",), BYTES),
)

SETPOINTS = (
    Case("rejects-out-of-range", SPIN, (1,), ("OUT_OF_RANGE", "31.4"), ALL),
    Case("rejects-wrong-state", SPIN, (1,), ("WRONG_STATE", "31.4"), BYTES),
    Case("rejects-bad-value", SPIN, (1,), ("BAD_VALUE", "31.4"), BYTES),
)


def _numbers() -> Iterator[Case]:
    for number in ("inf", "nan", "1e20", "negative"):
        yield Case(f"event-fault-{number}", WATCH, (0,), links=BYTES)
        yield Case(f"event-fault-{number}", SPIN, (0, 1), links=ALL)
        yield Case(f"event-fault-{number}", ACCEPT, (0, 1, 2))
    for number in ("nan", "inf", "negative"):
        yield Case(f"fits-{number}", WATCH, (2,), ("not fit",), BYTES, never=r"nan\b|\binf\b|--rate -|--rate 0\b")
        yield Case(f"fits-{number}", ACCEPT, (2,), ("not fit",))
        yield Case(f"load-{number}", FITTED, (0,), ("--fit: ", r"result +ok"))
    for number in ("zero", "nan", "inf", "negative"):
        yield Case(f"n-p-{number}", WATCH, (0, 2), never="nan r/min")
        yield Case(f"n-p-{number}", SPIN, (0, 1, 2), links=BYTES, never="nan r/min")
        yield Case(f"n-p-{number}", INFO, (0,), (r"odd: n_p: its value \S+ is not in 1 … 64",), BYTES)
        yield Case(f"n-p-{number}", HALL, (2,), ("n_p",))
        yield Case(f"n-p-{number}", ACCEPT, (0, 1, 2, 6))
    yield Case("i-max-nan", SPIN, (2,), ("i_max", "nan"), BYTES, never="--load")
    yield Case("i-max-nan", ACCEPT, (0, 1, 2))
    yield Case("watchdog-nan", SPIN, (0, 1, 2), links=BYTES)
    yield Case("watchdog-nan", INFO, (0,), ("odd: watchdog: its value nan",))


def _hellos() -> Iterator[Case]:
    bad = {
        "pwm-hz-zero": ("pwm_hz", r"\b0\b"),
        "tick-hz-zero": ("tick_hz", r"\b0\b"),
        "tick-hz-odd": ("tick_hz", "1000001"),
    }
    for fault, words in bad.items():
        yield Case(fault, SPIN, (2,), words, BYTES)
        for command in (INFO, LOOK, ACCEPT):
            yield Case(fault, command, (2,), words)
    yield Case("role-7", SPIN, (2,), ("role 7",), BYTES, never="baud")
    yield Case("role-7", INFO, (0,), ("odd: its role 7 is not in SPEC",))
    yield Case("role-7", ACCEPT, (2,), ("role 7",))
    yield Case("state-9", INFO, (0,), (r"\b9\b",), BYTES, never="baud")
    yield Case("state-9", SPIN, (1, 2, 5), never="baud")  # nobody knows whether it is off
    yield Case("nodes-zero", INFO, (0, 2))
    yield Case("nodes-absent", INFO, (0, 2), ("node",))
    yield Case("tx-max-zero", WATCH, (0, 2))


DESCRIPTORS = (
    *(Case("descriptor-endless", command, (2,), ("descriptor",)) for command in (INFO, WATCH, LOOK, ACCEPT)),
    *(Case("descriptor-crc", command, (2,), ("schema_crc",)) for command in (INFO, WATCH)),
    Case("no-channels", INFO, (0,), ("n_p",), BYTES),
    Case("no-channels", WATCH, (0, 2), ("channel",), BYTES),
    Case("no-channels", LOOK, (2,), ("channel",)),
    Case("channels-600", INFO, (0,), ("c600",), BYTES),
    Case("channels-600", WATCH, (0, 2), ("channel",), BYTES),
)

REPLIES = tuple(
    Case(fault, command, (2,), ("did not answer",), links)
    for fault in ("tid-zero", "tid-other")
    for command, links in ((WATCH, ALL), (INFO, ("pty",)), (LOOK, ("pty",)), (ACCEPT, ("pty",)))
)

TEXTS = tuple(
    Case(fault, command, codes, (), links)
    for fault in ("control-characters", "bad-utf8")
    for command, codes, links in (
        (INFO, (0,), ALL),
        (WATCH, (0,), ALL),
        (SPIN, (0,), BYTES),
        (LOOK, (0, 1, 2), ("tcp",)),
        (ACCEPT, (0, 1, 2, 6), ("tcp",)),
        (REFUSED, (2,), ("tcp",)),  # its name stands in the refusal
    )
)

SAMPLES = (
    Case("nan-samples", WATCH, (0,), links=BYTES),
    Case("nan-samples", SPIN, (1,), ("result +implausible:", "u_dc"), ALL),
    Case("log-flood", SPIN, (0,), links=BYTES),
    Case("log-flood", INFO, (0,)),
)

NUMBERS, HELLOS = tuple(_numbers()), tuple(_hellos())
TABLES = (UNSAFE, SAFE_AT_LAST, STATES, MOTORS, SETPOINTS, NUMBERS, HELLOS, REPLIES, SAMPLES, DESCRIPTORS, TEXTS)


def cases(*rows: Case, real: int = 0) -> pytest.MarkDecorator:
    """A test for each row and link; those on real links only where they were asked for, but for the first `real`."""
    found = []
    for number, row in enumerate(rows):
        for link in row.links:
            marks = pytest.mark.real_time if number < real else pytest.mark.real_links
            found.append(pytest.param(row, link, id=_id(row, link), marks=marks))
        in_virtual_time = {"CAN" if link in CAN else "bytes": None for link in row.links}
        found += [pytest.param(row, link, id=_id(row, link)) for link in in_virtual_time]
    return pytest.mark.parametrize(("case", "link"), found)


def _id(row: Case, link: str) -> str:
    return "-".join((row.faults.replace(" ", "+"), NAMES[row.command], link))


def judge(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> tuple[str, Device]:
    """Run it and look at code and words; returns what was printed, and the device."""
    with serving("full", case.faults.split(), link, after=0.3) as device:
        ran = bench(case.command, device, capsys)
    assert ran.code in case.codes, ran.text
    for words in case.words:
        assert re.search(words, ran.text), f"no '{words}' in {ran.text}"
    assert not re.search(case.never, ran.text), ran.text
    return ran.out + ran.err, device


@cases(*UNSAFE, real=1)
def test_an_end_that_is_not_safe_is_shouted(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    assert device.outputs_on  # or the case would be none
    assert device.seen["STOP"] >= 3


@cases(*SAFE_AT_LAST)
def test_stop_is_repeated_until_the_outputs_are_off(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    assert device.seen["STOP"] >= (2 if link in CAN else 3)  # on CAN a frame of class 0 goes ahead
    assert not device.outputs_on


@cases(*STATES)
def test_states_and_watchdog(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    assert not device.outputs_on
    if case.faults.startswith("no-watchdog") and device.started_at is not None:
        assert device.stops[0] - device.started_at < 1.0


@cases(*MOTORS)
def test_a_run_that_cannot_be_right_is_not_ok(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    printed, device = judge(case, link, capsys)
    assert not re.search("result +ok", printed)
    assert device.state == State.IDLE


@cases(*SETPOINTS)
def test_a_rejected_setpoint_says_why(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    judge(case, link, capsys)


@cases(*NUMBERS, *HELLOS, *REPLIES, *SAMPLES)
def test_odd_numbers_and_replies(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    assert not device.outputs_on


@cases(*DESCRIPTORS)
def test_odd_descriptors(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    if case.faults == "descriptor-endless":
        assert device.seen["BLOB_READ"] <= 2


@cases(*TEXTS)
def test_text_of_a_device_cannot_write_on_the_terminal(
    case: Case, link: str, capsys: pytest.CaptureFixture[str]
) -> None:
    printed, _ = judge(case, link, capsys)
    kinds = {character: unicodedata.category(character) for character in set(printed) - {"\n", "\t"}}
    assert not {character for character, kind in kinds.items() if kind in ("Cc", "Cf", "Cs")}
    for line in printed.splitlines():
        assert line.strip() != "error: not ours"


def test_255_nodes(capsys: pytest.CaptureFixture[str]) -> None:
    with serving("full", ["nodes-255"], "bytes") as device:
        ran = bench(INFO, device, capsys, patience=90.0)
    assert ran.code == 0
    assert "node 255" in ran.out


def test_every_fault_is_tried() -> None:
    tried = {fault for table in TABLES for row in table for fault in row.faults.split()} | {"nodes-255"}
    assert tried | MEANT_FOR.keys() == set(FAULTS)

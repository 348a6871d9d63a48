"""A device that misbehaves in each way of `tests.devices.faults` gets the right word and exit code from each command.

Exit codes: 0 done, 1 the drive failed, 2 an error or no verdict, 5 the outputs may still be on, 6 `accept` incomplete.

Each case runs in virtual time, on a byte link or a CAN bus; `pytest --real-links` runs it over pty, TCP and CAN too.
"""

from __future__ import annotations

import re
import unicodedata
from typing import NamedTuple

import pytest
from against import ACCEPT, CAN, HALL, INFO, LOOK, SPIN, WATCH, bench
from conforming import MEANT_FOR
from shared import table

from tests.choice import sampled
from tests.devices import FAULTS, serving
from tests.devices.device import Device
from tests.devices.spec import State

pytestmark = pytest.mark.slow

LONGER = SPIN.replace("0.8", "2.0")
FITTED = f"{SPIN} --fit"
REFUSED = SPIN.replace(" --yes", "")  # nobody can be asked
UNFED = ACCEPT.replace("test_stop", "test_watchdog")
COMMANDS = {
    "spin": SPIN, "spin_longer": LONGER, "spin_refused": REFUSED, "watch": WATCH, "info": INFO, "hall_passive": LOOK,
    "spin_fitted": FITTED, "hall": HALL, "accept": ACCEPT, "accept_watchdog": UNFED,
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


TABLES = {name: [Case(**row) for row in rows] for name, rows in table("bad_drive").items()}


def cases(*rows: Case, share: int = 1) -> pytest.MarkDecorator:
    """A test for each row, or one of `share` of them, in virtual time; and on each real link, if it was asked for.

    On the bus it is a third of them.
    """
    found = [pytest.param(row, link, id=_id(row, link), marks=pytest.mark.real_links)
             for row in rows for link in row.links]  # fmt: skip
    on_the_bus = [row for row in rows if {*row.links} & {*CAN}]
    bus = [pytest.param(row, "CAN", id=_id(row, "CAN")) for row in on_the_bus]
    in_bytes = [pytest.param(row, "bytes", id=_id(row, "bytes")) for row in rows if {*row.links} - {*CAN}]
    found += sampled(f"in bytes {rows[0]}", in_bytes, -(-len(in_bytes) // share), campaign="links")
    found += sampled(f"on the bus {rows[0]}", bus, -(-len(bus) // 3), campaign="links")
    return pytest.mark.parametrize(("case", "link"), found)


def _id(row: Case, link: str) -> str:
    return "-".join((row.faults.replace(" ", "+"), row.command, link))


def judge(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> tuple[str, Device]:
    """Run it and look at code and words; returns what was printed, and the device."""
    with serving("full", case.faults.split(), link, after=0.3) as device:
        ran = bench(COMMANDS[case.command], device, capsys)
    assert ran.code in case.codes, ran.text
    for words in case.words:
        assert re.search(words, ran.text), f"no '{words}' in {ran.text}"
    assert not re.search(case.never, ran.text), ran.text
    return ran.out + ran.err, device


@cases(*TABLES["unsafe"], share=2)
def test_an_end_that_is_not_safe_is_shouted(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    assert device.outputs_on  # or the case would be none
    assert device.seen["STOP"] >= 3


@cases(*TABLES["safe_at_last"])
def test_stop_is_repeated_until_the_outputs_are_off(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    assert device.seen["STOP"] >= (2 if link in CAN else 3)  # on CAN a frame of class 0 goes ahead
    assert not device.outputs_on


@cases(*TABLES["states"], share=2)
def test_states_and_watchdog(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    assert not device.outputs_on
    if case.faults.startswith("no-watchdog") and device.started_at is not None:
        assert device.stops[0] - device.started_at < 1.0


@cases(*TABLES["motors"])
def test_a_run_that_cannot_be_right_is_not_ok(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    printed, device = judge(case, link, capsys)
    assert not re.search("result +ok", printed)
    assert device.state == State.IDLE


@cases(*TABLES["setpoints"])
def test_a_rejected_setpoint_says_why(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    judge(case, link, capsys)


@cases(*TABLES["numbers"], share=3)
def test_odd_numbers(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    assert not device.outputs_on


@cases(*(case for name in ("hellos", "replies", "samples") for case in TABLES[name]))
def test_odd_replies(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    assert not device.outputs_on


@cases(*TABLES["descriptors"])
def test_odd_descriptors(case: Case, link: str, capsys: pytest.CaptureFixture[str]) -> None:
    _, device = judge(case, link, capsys)
    if case.faults == "descriptor-endless":
        assert device.seen["BLOB_READ"] <= 2


@cases(*TABLES["texts"])
def test_text_of_a_device_cannot_write_on_the_terminal(case: Case, link: str, capsys) -> None:
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
    tried = {fault for rows in TABLES.values() for row in rows for fault in row.faults.split()} | {
        "nodes-255",
        "hello-long",
    }
    assert tried | MEANT_FOR.keys() == set(FAULTS)

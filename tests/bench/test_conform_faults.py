"""Each fault of a device fails exactly the check that is meant for it, and no other up to its level.

What costs most is left out where the fault is of another kind: a link that is not read, where it is none of losses, and
streams and the 5 s of ARMED, where it is one of states.
"""

from __future__ import annotations

import pytest
from conforming import ON_CAN, OVERLOADED, TO_MOTION, TO_STATES, TO_STREAMS, ended, on_device

from bench.conform.catalogue import checks
from bench.conform.checks import TABLE
from bench.conform.levels import MOTION, STATES, STREAMS
from bench.signal.verdict import Verdict
from tests.choice import sampled

CASES = [
    *((fault, check, max(1, TABLE[check].needs), "bytes") for fault, check in TO_STREAMS.items()),
    *((fault, check, STATES, "bytes") for fault, check in TO_STATES.items()),
    *((fault, check, MOTION, "bytes") for fault, check in TO_MOTION.items()),
    *((fault, check, STATES, "CAN") for fault, check in ON_CAN.items()),
]


@pytest.mark.parametrize(
    ("fault", "check", "level", "carrier"), sampled("conform", {c[0]: c for c in CASES}, 20, campaign="conform")
)
def test_a_fault_fails_the_check_that_is_meant_for_it_and_no_other(fault: str, check: str, level: int, carrier: str):
    run, _ = on_device(level, [fault], carrier=carrier, without=left_out(check))
    failed = [f"{result.check.id}: {result.evidence}" for result in run.results if result.verdict is Verdict.FAIL]
    assert ended(run, Verdict.FAIL) == [check], failed


def left_out(check: str) -> set[str]:
    """The checks that a fault meant for `check` does not need to pass."""
    if check in OVERLOADED:
        return set()
    streams = {each.id for each in checks() if each.level == STREAMS}
    of_states = {*streams, "state.arm-lapses"} if TABLE[check].level > STREAMS else set()
    return ({*OVERLOADED} | of_states) - {check}


def test_the_checks_of_the_table_are_there() -> None:
    assert {check for _, check, _, _ in CASES} <= {check.id for check in checks()}

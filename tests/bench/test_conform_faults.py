"""A device that breaks a requirement of SPEC fails the check that is meant for it: tables/conform_faults.toml,
conform_mutants.toml and conform_python_mutants.toml.

What costs most is left out where the fault is of another kind: a link that is not read, where it is none of losses, and
streams and the 5 s of ARMED, where it is one of states.
"""

from __future__ import annotations

import pytest
from conform_power import Violation, changed, in_c, in_python, run_on
from conforming import ON_CAN, OVERLOADED, TO_MOTION, TO_STATES, TO_STREAMS, ended, on_device

from bench.conform.catalogue import checks
from bench.conform.checks import TABLE
from bench.conform.levels import MOTION, STATES, STREAMS
from bench.signal.verdict import Verdict
from protocol.requirements import requirements
from tests.choice import sampled
from tests.tools import needs

CASES = [
    *((fault, check, max(1, TABLE[check].needs), "bytes") for fault, check in TO_STREAMS.items()),
    *((fault, check, STATES, "bytes") for fault, check in TO_STATES.items()),
    *((fault, check, MOTION, "bytes") for fault, check in TO_MOTION.items()),
    *((fault, check, STATES, "CAN") for fault, check in ON_CAN.items()),
]


@pytest.mark.parametrize(
    ("fault", "check", "level", "carrier"), sampled("conform", {c[0]: c for c in CASES}, 8, campaign="conform")
)
def test_a_fault_fails_the_check_that_is_meant_for_it(fault: str, check: str, level: int, carrier: str):
    run, _ = on_device(level, [fault], carrier=carrier, without=left_out(check))
    failed = [f"{result.check.id}: {result.evidence}" for result in run.results if result.verdict is Verdict.FAIL]
    assert check in ended(run, Verdict.FAIL), failed


def left_out(check: str) -> set[str]:
    """The checks that a fault meant for `check` does not need to pass."""
    if check in OVERLOADED:
        return set()
    streams = {each.id for each in checks() if each.level == STREAMS}
    of_states = {*streams, "state.arm-lapses"} if TABLE[check].level > STREAMS else set()
    return ({*OVERLOADED} | of_states) - {check}


IN_C = {f"{v.chapter}: {v.name}, {v.link}": v for v in in_c(both=True)}


@needs("C compiler")
@pytest.mark.parametrize("violation", sampled("violations", IN_C, 6, campaign="violations"))
def test_a_change_of_the_device_in_c_fails_a_check_that_is_meant_for_it(violation: Violation) -> None:
    run = run_on(violation, violation.level)
    assert set(violation.checks) & set(ended(run, Verdict.FAIL)), ended(run, Verdict.FAIL)


IN_PYTHON = {f"{v.chapter}: {v.name}, {v.link}": v for v in in_python(both=True)}


@pytest.mark.parametrize("violation", sampled("violations in Python", IN_PYTHON, 3, campaign="violations"))
def test_a_change_of_the_device_in_python_fails_a_check_that_is_meant_for_it(violation: Violation) -> None:
    run = run_on(violation, violation.level)
    assert set(violation.checks) & set(ended(run, Verdict.FAIL)), ended(run, Verdict.FAIL)


def test_each_change_stands_in_the_source_and_breaks_a_requirement() -> None:
    for violation in (*IN_C.values(), *IN_PYTHON.values()):
        assert changed(violation)
        for check in violation.checks:
            assert all(requirements()[number].device for number in TABLE[check].cites)


def test_the_checks_of_the_tables_are_there() -> None:
    named = {check for _, check, _, _ in CASES} | {
        check for v in (*IN_C.values(), *IN_PYTHON.values()) for check in v.checks
    }
    assert named <= {check.id for check in checks()}

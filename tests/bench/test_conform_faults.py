"""Each fault of a device fails exactly the check that is meant for it, and no other up to its level.

What costs most is left out where the fault is of another kind: a link that is not read, where it is none of losses, and
streams and the 5 s of ARMED, where it is one of states.
"""

from __future__ import annotations

import pytest
from conforming import OVERLOADED, ended, on_device

from bench.conforming.catalogue import checks
from bench.conforming.checks import TABLE
from bench.conforming.levels import MOTION, STATES, STREAMS
from bench.conforming.verdicts import Verdict

TO_STREAMS = {
    "answers-damaged": "link.crc-damage-is-silent",
    "rx-bad-zero": "link.damage-is-counted",
    "length-before-type": "link.order-of-checks",
    "retry-executed": "link.retry-not-executed",
    "reply-kept-once": "link.retry-four-kept",
    "wrong-detail": "identity.other-blobs",
    "blob-past-end": "identity.blob-past-end",
    "descriptor-crc": "identity.schema-crc",
    "bad-utf8": "identity.texts",
    "nodes-zero": "identity.hello-fields",
    "last-tid-of-refused": "identity.last-tid",
    "heartbeats-slow": "identity.heartbeat-rate",
    "state-9": "identity.heartbeat-fields",
    "tick-back": "identity.tick-goes-on",
    "read-only-set": "parameter.read-only",
    "parameter-clipped": "parameter.beyond-range",
    "busy-ignored": "stream.busy",
    "get-stale": "stream.get",
    "cfg-id-stale": "stream.cfg-id-in-frames",
    "index-odd": "stream.index-divisible",
    "sample-tick-back": "stream.tick-of-index",
    "channels-sorted": "stream.channel-order",
    "stop-drops": "stream.stop-sends",
    "drop-uncounted": "stream.tx-dropped",
    "seq-of-sent": "stream.seq-counts-dropped",
    "overrun-missing": "stream.overrun-flag",
}
"""Levels 0 to 2, on a byte link."""

TO_STATES = {
    "stop-confirmed-only": "state.stop-obeyed",
    "stop-outputs-stay": "state.stop-obeyed",
    "stop-once": "state.stop-each-time",
    "stop-refused-in-fault": "state.stop-in-fault",
    "state-before-token": "state.arguments-first",
    "start-without-arm": "state.start-needs-arm",
    "outputs-told-off": "state.outputs-as-told",
    "fault-clear-any": "state.fault-clear",
    "armed-for-ever": "state.arm-lapses",
    "watchdog-dead": "watchdog.trips",
    "watchdog-early": "watchdog.not-early",
    "watchdog-late": "watchdog.not-late",
    "watchdog-fed-by-requests": "watchdog.not-fed-by-requests",
    "watchdog-fed-by-rejected": "watchdog.not-fed-by-rejected",
    "rejections-uncounted": "setpoint.rejected-counted",
}
TO_MOTION = {
    "backwards": "motion.direction",
    "edges-uncounted": "motion.edges-counted",
    "edges-after-samples": "motion.edges-before-samples",
    "setpoint-clipped": "motion.never-clipped",
}
ON_CAN = {
    "can-repeated-executed": "can.repeated-frame",
    "can-toggle-unchecked": "can.toggle",
    "can-node-0-answered": "can.node-0-others",
    "can-stop-frame-ignored": "can.stop-frame",
}

CASES = [
    *((fault, check, STREAMS, "bytes") for fault, check in TO_STREAMS.items()),
    *((fault, check, STATES, "bytes") for fault, check in TO_STATES.items()),
    *((fault, check, MOTION, "bytes") for fault, check in TO_MOTION.items()),
    *((fault, check, STATES, "CAN") for fault, check in ON_CAN.items()),
]


@pytest.mark.parametrize(("fault", "check", "level", "carrier"), CASES, ids=[case[0] for case in CASES])
def test_a_fault_fails_the_check_that_is_meant_for_it_and_no_other(
    fault: str, check: str, level: int, carrier: str
) -> None:
    run, _ = on_device(level, [fault], carrier=carrier, without=left_out(check))
    failed = [f"{result.check.id}: {result.evidence}" for result in run.results if result.verdict is Verdict.FAILED]
    assert ended(run, Verdict.FAILED) == [check], failed


def left_out(check: str) -> set[str]:
    """The checks that a fault meant for `check` does not need to pass."""
    if check in OVERLOADED:
        return set()
    streams = {each.id for each in checks() if each.level == STREAMS}
    of_states = {*streams, "state.arm-lapses"} if TABLE[check].level > STREAMS else set()
    return ({*OVERLOADED} | of_states) - {check}


def test_the_checks_of_the_table_are_there() -> None:
    assert {check for _, check, _, _ in CASES} <= {check.id for check in checks()}

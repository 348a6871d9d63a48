"""The words for a device's events, whatever numbers come with them."""

from __future__ import annotations

import math

import pytest

from bench.rerunio.states import event_text
from protocol.messages import DeviceEvent, EventCode


@pytest.mark.parametrize(
    ("code", "arg", "detail", "words"),
    [
        (EventCode.STATE_CHANGED, 3.0, 0.0, "state RUNNING"),
        (EventCode.STATE_CHANGED, 9.0, 0.0, "state 9"),
        (EventCode.STATE_CHANGED, math.nan, 0.0, "state nan"),
        (EventCode.FAULT, 33.0, 0.0, "FAULT WATCHDOG HALL"),
        (EventCode.FAULT, 2.0**23, 0.0, "FAULT 0x800000"),
        (EventCode.FAULT, math.inf, 0.0, "FAULT INTERNAL"),
        (EventCode.FAULT, -1.0, 0.0, "FAULT INTERNAL"),
        (EventCode.SETPOINT_REJECTED, 4.0, 300.0, "setpoint rejected: OUT_OF_RANGE (300)"),
        (EventCode.SETPOINT_REJECTED, 99.0, math.nan, "setpoint rejected: error 99 (nan)"),
        (EventCode.ARM_LAPSED, 5.0, 0.0, "ARMED lapsed after 5 s without START"),
        (9, -math.inf, 0.0, "event 9 (-inf)"),
    ],
)
def test_event_text(code: int, arg: float, detail: float, words: str) -> None:
    assert event_text(2, DeviceEvent(1, code, 2, arg, detail)) == f"node 2: {words}"

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import synthetic
from hypothesis import given
from hypothesis import strategies as st

from bench.record.info import RunInfo, ns_from_tick, stream_from_json, stream_to_json
from bench.view import schema, states
from bench.view.log import _Column
from protocol.descriptor import Channel
from protocol.messages import DeviceEvent, EventCode
from protocol.signals import SECTOR_OF_CODE, Flag, RawType, Unit
from sim.observers import hall_speed

INTEGERS = [kind for kind in RawType if kind != RawType.F32]


def column(channel: Channel, raw: np.ndarray) -> np.ndarray:
    records = np.zeros(len(raw), [(channel.name, channel.raw.dtype)])
    records[channel.name] = raw
    return _Column(channel).physical(records)


def test_sixteen_bits_are_stored_as_float32_and_thirty_two_as_float64() -> None:
    kinds = {kind: schema.storage(Channel(1, "x", Unit.A, kind, 0.5, Flag.CHANNEL)) for kind in INTEGERS}
    wide = {RawType.U32, RawType.I32}
    assert kinds == {kind: np.float64 if kind in wide else np.float32 for kind in INTEGERS}


@given(tick_hz=st.integers(1, 999_999_999), seconds=st.floats(0, 9e9))
def test_ticks_are_nanoseconds_without_overflow(tick_hz: int, seconds: float) -> None:
    tick = int(seconds * tick_hz)
    ns = int(ns_from_tick(tick, tick_hz))
    assert ns == (tick * 10**9 + tick_hz // 2) // tick_hz  # Python's integers do not overflow


def test_a_run_and_its_streams_survive_json() -> None:
    run = synthetic.run_info()
    assert RunInfo.from_json(json.loads(json.dumps(run.to_json())), run.recording_id) == run
    for config in (synthetic.config(), synthetic.EDGE_CONFIG):
        described = json.loads(json.dumps(stream_to_json(config, "fast")))
        assert stream_from_json(described, synthetic.run_info()) == config


@pytest.mark.parametrize("n_p", [None, 0.0, -3.0, 2.5, math.nan, math.inf, -math.inf])
def test_speeds_stay_electrical_where_the_pole_pairs_are_not_known(n_p: float | None) -> None:
    run = synthetic.run_info(parameters={} if n_p is None else {"n_p": n_p})
    assert run.n_p is None
    assert (run.speed_unit, run.speed_factor) == ("rad/s", 1.0)


@pytest.mark.parametrize("i_max", [None, 0.0, -1.0, math.nan, math.inf])
def test_the_range_of_the_currents_is_known_or_it_is_not(i_max: float | None) -> None:
    assert synthetic.run_info(parameters={} if i_max is None else {"i_max": i_max}).i_max is None


def test_hall_lanes_follow_the_bit_order() -> None:
    assert (SECTOR_OF_CODE, states.HALL_WORDS[0b011].as_py()) == (hall_speed.SECTOR_OF_CODE, ["1", "1", "0", "II"])
    assert states.HALL_WORDS[0b111].as_py()[3] == states.HALL_WORDS[0].as_py()[3] == "invalid"


def test_faults_of_a_later_version_keep_their_number() -> None:
    assert (states.fault_text(0), states.fault_text(0x100)) == ("no fault", "0x100")
    assert states.fault_text(0x101) == "WATCHDOG 0x100"


@pytest.mark.parametrize(("code", "arg", "detail", "words"), [
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
])  # fmt: skip
def test_event_text(code: int, arg: float, detail: float, words: str) -> None:
    assert states.event_text(2, DeviceEvent(1, code, 2, arg, detail)) == f"node 2: {words}"

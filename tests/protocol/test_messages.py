"""Messages beyond their vectors: what is wrong is named, what is unknown is kept."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_spec import KINDS

from protocol import messages as m
from protocol.errors import LocalProtocolError


@given(st.sampled_from(KINDS), st.binary(max_size=128))
def test_any_bytes_unpack_or_are_refused(kind: type[m.Payload], payload: bytes) -> None:
    try:
        message = kind.unpack(payload)
    except m.PayloadError:
        pass
    else:
        escaped = 4 if isinstance(message, m.Log) else 1  # bytes of \\x1b
        assert len(message.pack()) <= escaped * max(len(payload), 1)


def test_a_request_has_its_exact_length_and_a_reply_and_hello_may_grow() -> None:
    with pytest.raises(m.PayloadError, match="ParamGet of 5 bytes, expected 4") as caught:
        m.ParamGet.unpack(bytes(5))
    assert caught.value.bad_length
    reply = m.ParamStored(7, 1.5)
    assert m.ParamStored.unpack(reply.pack() + b"later") == reply
    with pytest.raises(m.PayloadError):
        m.ParamStored.unpack(reply.pack()[:-1])
    assert m.Hello.unpack(m.Hello(5).pack() + b"more") == m.Hello(5)  # of a later major


@pytest.mark.parametrize(
    ("raw", "text"),
    [
        (b"33FFD8054D48383611571943", "33FFD8054D48383611571943"),
        (bytes(24), ""),
        (b"old\0left over", "old"),
        (b"\xff" * 24, "\ufffd" * 24),
        (b"a" * 23 + b"\xce", "a" * 23 + "\ufffd"),  # half a letter
        (b"v\x1b[2J\r\xe2\x80\xae", r"v\x1b[2J\r\u202e"),
    ],
)
def test_serial_and_build_are_text_whatever_comes(raw: bytes, text: str) -> None:
    reply = m.HelloReply.unpack(bytes(68) + raw.ljust(24, b"\0") + bytes(24))
    assert (reply.serial, reply.build) == (text, "")
    reply = m.HelloReply.unpack(bytes(92) + raw.ljust(24, b"\0"))
    assert (reply.serial, reply.build) == ("", text)


def test_unknown_values_keep_their_numbers() -> None:
    assert m.StateReply.unpack(bytes((9, 0, 0, 0))).state.name == "state 9"
    assert m.Setpoint.unpack(bytes((9, *bytes(11)))).mode == 9
    with pytest.raises(m.PayloadError, match=r"StateCommand.command: 9 is not a valid Command"):
        m.StateCommand.unpack(bytes((9, *bytes(7))))
    assert m.ErrorReply.unpack(m.ErrorReply(999, 1, 0).pack()).code == 999  # a later minor's code is no damage
    assert m.Heartbeat.unpack(bytes(16) + b"\0\0\0\x80" + bytes(24)).first_fault == 0x80000000


@pytest.mark.parametrize("code", [*m.EventCode, 9])
@pytest.mark.parametrize("arg", [0.0, 0.5, -1.0, 1.0, 48.0, 2.0**31, 2.0**32, 3e38, math.inf, -math.inf, math.nan])
def test_the_number_of_an_event_is_whole_or_none(code: int, arg: float) -> None:
    event = m.DeviceEvent.unpack(m.DeviceEvent(1, code, 1, arg).pack())
    whole = arg in (0.0, 1.0, 48.0, 2.0**31)
    assert event.number == (arg if whole else None)
    if code != m.EventCode.FAULT:
        assert not event.faults
    else:  # that there is a fault is never lost
        assert event.faults == (int(arg) if whole and arg else m.Fault.INTERNAL)


def test_a_load_that_is_none_is_unknown() -> None:
    for load in (math.nan, math.inf, -math.inf, -0.5):
        assert m.StreamReply.unpack(m.StreamReply(0, 1, 2, 3, load).pack()).load == 0.0


def test_ticks_stay_below_2_to_the_62() -> None:
    assert m.DeviceEvent.unpack(m.DeviceEvent((1 << 62) - 1, 1, 1, 1.0).pack()).tick == (1 << 62) - 1
    for message in (
        m.DeviceEvent(1 << 62, 1, 1, 1.0),
        m.TimeSyncReply(0, 1 << 63),
        m.StreamReply(0, 1, 2, 3, 0, 0, 1 << 62),
    ):
        with pytest.raises(m.PayloadError, match="is not below 2\\^62"):
            type(message).unpack(message.pack())


def test_values_that_do_not_fit_are_refused() -> None:
    for message in (m.ParamGet(65536), m.ParamSet(1, 1e39), m.StreamSet(0, m.StreamEvent.PWM, 1, 20, (70000,))):
        with pytest.raises(LocalProtocolError, match=f"{type(message).__name__}.*cannot be sent"):
            message.pack()


def test_error_reply_reads_well() -> None:
    assert str(m.ErrorReply(m.ErrorCode.OUT_OF_RANGE, 0x12, 30.0)) == "OUT_OF_RANGE (30)"
    assert str(m.ErrorReply(4711, 0x12, 0.5)) == "error 4711 (0.5)"

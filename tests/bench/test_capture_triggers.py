"""Triggers of captures as people write them, and what a request makes of what is wanted."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.capture.trigger import KINDS, Trigger
from bench.errors import BenchError
from protocol.messages import CaptureTrigger
from protocol.signals import DRIVE_CHANNELS, Unit

NAMES = st.sampled_from([signal.name for signal in DRIVE_CHANNELS])
NUMBERS = st.floats(allow_nan=False, allow_infinity=False, width=32)
SPACE = st.sampled_from(["", " ", "  "])
COMPARED = {
    ">": CaptureTrigger.ABOVE,
    "<": CaptureTrigger.BELOW,
    " rises ": CaptureTrigger.RISES,
    " falls ": CaptureTrigger.FALLS,
}
SECONDS = {"s": 0, "ms": 3, "us": 6, "µs": 6, "ns": 9}


@given(NAMES, st.sampled_from(sorted(COMPARED)), NUMBERS, SPACE, st.booleans())
def test_a_comparison_is_read_with_its_channel_and_level(name, how, value, space, with_unit) -> None:
    channel = next(signal for signal in DRIVE_CHANNELS if signal.name == name)
    unit = channel.unit.symbol if with_unit else ""
    trigger = Trigger.parse(f"{space}{name}{space}{how}{space}{value!r}{space}{unit}")
    assert (trigger.kind, trigger.channel, trigger.level, trigger.unit) == (COMPARED[how], name, value, unit)
    assert trigger.channel_of(DRIVE_CHANNELS) is channel


@given(NAMES, st.sampled_from(sorted(COMPARED)), st.sampled_from([unit for unit in Unit if unit.symbol]))
def test_a_level_in_another_unit_is_refused(name, how, unit) -> None:
    channel = next(signal for signal in DRIVE_CHANNELS if signal.name == name)
    trigger = Trigger.parse(f"{name} {how} 1.5 {unit.symbol}")
    if unit == channel.unit:
        assert trigger.channel_of(DRIVE_CHANNELS) is channel
    else:
        with pytest.raises(BenchError, match=f"{name} is (in|a pure number).*not in"):
            trigger.channel_of(DRIVE_CHANNELS)


@given(st.floats(1e-3, 1e3), st.sampled_from(sorted(SECONDS)), SPACE)
def test_a_pulse_has_a_time_with_a_unit(value, unit, space) -> None:
    trigger = Trigger.parse(f"pulse{space}<{space}{value!r}{space}{unit}")
    assert (trigger.kind, trigger.channel) == (CaptureTrigger.PULSE, "")
    assert trigger.level == pytest.approx(value / 10 ** SECONDS[unit], rel=1e-12)


@pytest.mark.parametrize("word", ["now", "fault", "state", "illegal"])
def test_words_alone(word) -> None:
    for written in (word, word.upper(), f" {word} "):
        trigger = Trigger.parse(written)
        assert trigger.kind == CaptureTrigger[word.upper()]
        assert trigger.channel_of(DRIVE_CHANNELS) is None


@given(NAMES)
def test_a_change_has_no_level(name) -> None:
    trigger = Trigger.parse(f"{name} changes")
    assert (trigger.kind, trigger.channel) == (CaptureTrigger.CHANGES, name)


def test_every_trigger_of_the_protocol_has_words_and_a_form() -> None:
    assert set(KINDS) == set(CaptureTrigger)
    read = {
        Trigger.parse(text).kind
        for text in ("now", "fault", "state", "illegal", "a > 1", "a < 1", "a rises 1", "a falls 1", "a changes")
    }
    assert read | {Trigger.parse("pulse < 1 us").kind} == set(CaptureTrigger) - {CaptureTrigger.OFF}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "a drive knows"),
        ("i_q", "a drive knows"),
        ("i_q >", "finite number"),
        ("i_q > much", "finite number"),
        ("i_q > nan", "finite number"),
        ("i_q > 1e400", "finite number"),
        ("i_q >= 4", "with > or < only"),
        ("abs(i_q) > 4", "with > or < only"),
        ("i_q crosses 4", "'rises' or 'falls'"),
        ("i_q jumps 4", "a drive knows"),
        ("status changes 4", "a drive knows"),
        ("pulse < 5", "with its unit"),
        ("pulse < 5 h", "with its unit"),
        ("i_q > 4 5", "a drive knows"),
    ],
)
def test_what_is_none_is_refused_with_what_to_write(text, words) -> None:
    with pytest.raises(BenchError, match=words) as refused:
        Trigger.parse(text)
    assert f"'{text}'" in str(refused.value)


def test_a_channel_that_the_drive_lacks_is_named_with_what_is_near() -> None:
    with pytest.raises(BenchError, match="no channel 'i_qq': did you mean i_q"):
        Trigger.parse("i_qq > 4").channel_of(DRIVE_CHANNELS)
    assert math.isfinite(Trigger.parse("i_q > 4").level)

"""Triggers: what their words mean, and where they mark, against the samples themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.device.heard import ClockRestarted, Heard
from bench.errors import BenchError
from bench.live.triggers import Condition, Triggers
from protocol.descriptor import Channel
from protocol.messages import StreamEvent
from protocol.signals import Flag, RawType, Unit
from protocol.streams import SampleChunk, StreamConfig

I_Q = Channel(1, "i_q", Unit.A, RawType.I16, 0.001, Flag(0), 0.0)
LEVEL = Channel(2, "level", Unit.NONE, RawType.F32, 1.0, Flag(0), 0.0)
CONFIG = StreamConfig(1, 0, 1, StreamEvent.PWM, 1, (I_Q, LEVEL), 15, tick_hz=16_000_000, pwm_hz=16_000)


def chunk(i_q: np.ndarray, level: np.ndarray, first: int = 0, node: int = 1) -> SampleChunk:
    raw = np.zeros(len(i_q), CONFIG.dtype)
    raw["i_q"], raw["level"] = np.rint(i_q * 1000), level
    index = first + np.arange(len(i_q), dtype=np.int64)
    return SampleChunk(replace(CONFIG, node=node), index, index * 1000, raw, ())


def hits(text: str, *items: Heard) -> list[tuple[int, float]]:
    found: list[tuple[int, float]] = []
    triggers = Triggers([Condition.parse(text)], 1, lambda _, tick, value: found.append((tick // 1000, value)))
    for item in items:
        triggers.take(item)
    return found


@pytest.mark.parametrize(("text", "of"), [
    ("i_q>8", ("i_q", False, ">", 8.0)),
    (" abs(i_q) >= 8.5 ", ("i_q", True, ">=", 8.5)),
    ("theta_vt<-1e-3", ("theta_vt", False, "<", -0.001)),
    ("u_dc<=+18", ("u_dc", False, "<=", 18.0)),
])  # fmt: skip
def test_words_of_a_trigger(text: str, of: tuple[str, bool, str, float]) -> None:
    condition = Condition.parse(text)
    assert (condition.channel, condition.absolute, condition.comparison, condition.value) == of


@pytest.mark.parametrize(
    "text", ["", "i_q", "i_q=8", "i_q>", ">8", "i_q>eight", "i_q>nan", "i_q>inf", "abs(i_q>8", "8<i_q"]
)
def test_what_is_no_trigger_is_told_with_an_example(text: str) -> None:
    with pytest.raises(BenchError, match="such as 'i_q>8'"):
        Condition.parse(text)


def test_a_channel_that_is_not_streamed_is_told_with_its_neighbour() -> None:
    with pytest.raises(BenchError, match=r"--trigger 'iq>8': iq is not streamed; did you mean i_q\?"):
        Condition.parse("iq>8").check(["i_q", "u_dc"])
    Condition.parse("i_q>8").check(["i_q"])


@pytest.mark.parametrize("pieces", [1, 7, 160, 4000])
def test_it_triggers_where_it_begins_to_hold_and_then_not_for_a_second(pieces: int) -> None:
    """Steps at 0.1, 0.5 and 1.2 s: the second is within a second of the first."""
    i_q = np.zeros(32_000)
    for begin, end in ((1600, 1700), (8000, 9000), (19_200, 32_000)):
        i_q[begin:end] = -9.0
    singly = (k for at in (1600, 8000, 19_200) for k in range(at - 10, at + 10))
    cuts = [*singly] if pieces == 1 else range(pieces, len(i_q), pieces)
    parts = np.split(np.arange(len(i_q)), cuts)
    chunks = [chunk(i_q[part], np.zeros(len(part)), int(part[0])) for part in parts]
    assert hits("abs(i_q)>8", *chunks) == [(1600, -9.0), (19_200, -9.0)]
    assert hits("i_q>8", *chunks) == []
    assert hits("i_q>=0", *chunks) == [(0, 0.0)]  # it holds again at 1700 and 9000, within a second


def test_values_that_are_none_and_other_nodes_do_not_trigger() -> None:
    level = np.full(1000, np.nan)
    level[500:] = 3.0
    assert hits("level<5", chunk(np.zeros(1000), level)) == [(500, 3.0)]
    assert hits("level<5", chunk(np.zeros(1000), level, node=2)) == []


def test_after_a_reboot_it_triggers_again() -> None:
    high = np.full(100, 9.0)
    late = chunk(high, high, 1_600_000)
    low, again, anew = chunk(0 * high, high, 1_600_100), chunk(high, high, 1_600_200), chunk(high, high, 50)
    assert hits("i_q>8", late, low, again) == [(1_600_000, 9.0)]
    for restarted in (ClockRestarted(1, 0), ClockRestarted(1, 0, rebooted=False)):
        assert hits("i_q>8", late, low, restarted, anew) == [(1_600_000, 9.0), (50, 9.0)]
    assert hits("i_q>8", late, low, ClockRestarted(2, 0), anew) == [(1_600_000, 9.0)]

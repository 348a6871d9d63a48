"""What was lost after the last frame that came: heartbeats tell, at every decimation and across every wrap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from small_drive import TICKS
from test_streams import BLOCK, DESCRIPTOR, config, data_frame, run_of_frames

from protocol.descriptor import sample_dtype
from protocol.framing import Frame
from protocol.messages import MessageType, StreamEvent
from protocol.streams import EDGE_RECORD, STREAM_HEADER, Beat, EdgeDecoder, SampleDecoder, StreamConfig, TickReference

WRAP = 1 << 32


def edges_frame(first: int, n: int) -> bytes:
    head = STREAM_HEADER.pack(1, 0, n, 78, 0, first & 0xFFFFFFFF, 0)
    return Frame(MessageType.EDGES, 1, 0, 1, head + np.zeros(n, EDGE_RECORD).tobytes()).pack()


def edge_decoder() -> EdgeDecoder:
    return EdgeDecoder(
        StreamConfig(1, 1, 78, StreamEvent.EDGES, 1, (), 8, tick_hz=20_000_000, pwm_hz=16_000), TickReference()
    )


@given(st.integers(1, 5), st.sampled_from([1, 3]), st.integers(-5, 200_000), st.integers(0, 2 * WRAP))
@example(1, 1, 0, 0)
@example(1, 1, TICKS - 1, 0)
@example(1, 1, TICKS, WRAP - 1)
def test_the_samples_up_to_a_heartbeat(frames: int, decimation: int, after: int, tick0: int) -> None:
    """`tick0`: of the first sample; `after`: how long after the last one that came the heartbeat is, in ticks."""
    decoder = SampleDecoder(config(decimation), TickReference(tick0))
    decoder.decode(run_of_frames(frames, 0, tick0, decimation=decimation))
    newest = tick0 + (frames * BLOCK - 1) * decimation * TICKS
    made = range(newest + decimation * TICKS, newest + after + 1, decimation * TICKS)  # ticks of the others
    assert decoder.missing(None, Beat(newest + after, 0)) == len(made)
    assert decoder.missing(Beat(0, 0), Beat(newest + after, 0)) == len(made)  # what came says more
    assert decoder.counters.lost_by_index == 0  # it only tells


def test_samples_of_which_none_has_come_count_from_a_heartbeat_on() -> None:
    decoder = SampleDecoder(config(3), TickReference())
    assert decoder.missing(None, Beat(10**9, 0)) == 0
    assert decoder.missing(Beat(10**9, 0), Beat(10**9 + 30 * TICKS, 0)) == 10
    assert decoder.missing(Beat(10**9, 0), Beat(10**9 - 1, 0)) == 0
    decoder.decode([data_frame(0, 0, 0, np.zeros(0, sample_dtype(DESCRIPTOR.channels)))])  # no records: malformed
    assert decoder.missing(Beat(0, 0), Beat(30 * TICKS, 0)) == 10


@pytest.mark.parametrize("first", [0, 7, WRAP - 10, WRAP - 3])
def test_the_edges_up_to_a_heartbeat(first: int) -> None:
    decoder = edge_decoder()
    assert decoder.missing(None, Beat(0, first)) == 0
    assert decoder.missing(Beat(0, first), Beat(0, (first + 12) % WRAP)) == 12
    decoder.decode([edges_frame(first, 5)])
    for count in range(6):  # heartbeats that came before those edges
        assert decoder.missing(None, Beat(0, (first + count) % WRAP)) == 0
    assert decoder.missing(Beat(0, first), Beat(0, (first + 250) % WRAP)) == 245


def test_a_device_that_counts_no_edges_has_lost_none() -> None:
    decoder = edge_decoder()
    decoder.decode([edges_frame(100, 5)])
    assert decoder.missing(Beat(0, 0), Beat(10**9, 0)) == 0

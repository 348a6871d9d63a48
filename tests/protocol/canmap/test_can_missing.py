"""What was lost at the end of the streams on a CAN bus: whole frames, for STREAM_STOP sends no others."""

from __future__ import annotations

import numpy as np
import pytest
from can_pair import TICKS, CanPair
from test_can_streams import CASES, kinds, pair

from protocol.canmap.frame import BusRates
from protocol.host import HeartbeatReceived
from protocol.streams import Beat


def newest(bus: CanPair) -> Beat:
    heartbeat = next(e for e in reversed(bus.events) if isinstance(e, HeartbeatReceived)).heartbeat
    return Beat(heartbeat.tick, heartbeat.edges)


@pytest.mark.parametrize(("rates", "names", "decimation"), CASES)
@pytest.mark.parametrize("half", [False, True])  # only one group of the channels is lost
def test_all_that_is_lost_at_the_end_is_missing(
    rates: BusRates, names: tuple[str, ...], decimation: int, half: bool
) -> None:
    bus = pair(rates, names, decimation)
    bus.run(4800, tuple(range(3, 4800, 31)))
    before = bus.edges_made
    lost = bus.decoders[0].ids[-1:] if half else bus.decoders[0].ids
    gone = (*lost, *bus.decoders[1].ids)
    bus.run(8000, tuple(range(0, 8000, 20)), spoil=lambda records: records[~np.isin(records["id"], gone)])
    beat = newest(bus)
    assert beat.tick > 11000 * TICKS
    block = bus.decoders[0].config.block
    made = len(range(0, beat.tick // TICKS + 1, decimation)) // block * block
    came = len(bus.samples())
    if half:
        assert made <= came + bus.decoders[0].missing(None, beat) <= len(range(0, 12_800, decimation))
    else:
        assert bus.decoders[0].missing(None, beat) == made - came > 6000 / decimation - block
    assert bus.decoders[1].missing(None, beat) == beat.edges - before > 300


@pytest.mark.parametrize(("rates", "names", "decimation"), CASES)
def test_streams_of_which_nothing_came_count_from_a_heartbeat_on(
    rates: BusRates, names: tuple[str, ...], decimation: int
) -> None:
    bus = pair(rates, names, decimation)
    bus.run(3200, spoil=lambda records: records[kinds(records) < 4])
    first = newest(bus)
    bus.run(6400, (10, 20, 30), spoil=lambda records: records[kinds(records) < 4])
    last = newest(bus)
    made = (last.tick - first.tick) // TICKS / decimation
    block = bus.decoders[0].config.block
    assert made - block - 1 <= bus.decoders[0].missing(first, last) <= made + 1
    assert bus.decoders[1].missing(first, last) == 3
    assert [decoder.missing(None, last) for decoder in bus.decoders.values()] == [0, 0]

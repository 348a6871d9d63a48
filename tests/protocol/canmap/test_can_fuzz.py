"""Noise and mutated traffic at both ends of a CAN bus: no exception, no wrong value, nothing moves, all is counted."""

from __future__ import annotations

import numpy as np
import pytest
from can_pair import CLASSIC, FD, CanPair

from protocol.canmap.frame import CAN_RECORD, FD_LENGTHS, BusRates
from protocol.canmap.ids import CanId
from protocol.host import HeartbeatReceived, RequestTimedOut
from protocol.messages import DriveState

pytestmark = pytest.mark.slow

RANDOM, MUTATED = 100_000, 20_000
NAMES = {CLASSIC: ("hall",), FD: ("hall", "status", "theta", "i_a", "count")}


def noise(rng: np.random.Generator, n: int, fd: bool, extended: bool) -> np.ndarray:
    """Frames with any identifier and content; half of them with an identifier of HBP."""
    records = np.zeros(n, CAN_RECORD)
    ours = CanId(0, 0, 0).pack(extended) | rng.integers(0, 0x800, n)
    records["id"] = np.where(rng.random(n) < 0.5, ours, rng.integers(0, 1 << 32, n))
    records["length"] = rng.choice(FD_LENGTHS if fd else FD_LENGTHS[:9], n)
    records["flags"] = rng.integers(0, 8, n)
    records["data"] = rng.integers(0, 256, (n, 64))
    return records


@pytest.mark.parametrize("rates", [CLASSIC, FD], ids=str)
@pytest.mark.parametrize("extended", [False, True])
def test_noise_moves_nothing(rates: BusRates, extended: bool) -> None:
    bus = CanPair(rates, extended)
    bus.connect()
    bus.stream(NAMES[rates], edges=False)
    bus.run(800)
    rng = np.random.default_rng(1)
    mine = list(bus.decoders[0].ids)
    before = bus.device.counters.frames + bus.device.counters.foreign
    for _ in range(RANDOM // 1000):
        records = noise(rng, 1000, rates.fd, extended)
        bus.receive(records[~np.isin(records["id"], mine)])
        bus.device.receive(records.tobytes())
    assert bus.device.session.state is DriveState.IDLE
    assert not bus.app.outputs_on
    assert not bus.app.setpoints
    heard, seen = bus.wire.counters, bus.device.counters
    assert heard.foreign + heard.frames + heard.error_frames > 0.9 * RANDOM
    assert seen.foreign + seen.frames + seen.error_frames == before + RANDOM
    assert heard.orphans + heard.bad + heard.stale > 0
    bus.run(1600)
    assert (np.diff(bus.samples().index) == 1).all()
    assert any(isinstance(event, HeartbeatReceived) for event in bus.events)


@pytest.mark.parametrize("rates", [CLASSIC, FD], ids=str)
def test_mutated_traffic_gives_no_wrong_value(rates: BusRates) -> None:
    """Frames of a real conversation, some with another identifier, length or content, some gone, some twice.

    The content of frames that stand alone, as a heartbeat in FD does, is left as it is: CAN's own CRC protects that.
    """
    bus = CanPair(rates)
    bus.connect()
    bus.stream(NAMES[rates])
    bus.run(1600)
    rng = np.random.default_rng(2)
    mutated = 0

    def spoil(records: np.ndarray) -> np.ndarray:
        nonlocal mutated
        records = records.copy()
        stream = (records["id"] >> 8 & 7) >= 4
        what = rng.random(len(records))
        ids = what < 0.02
        records["id"][ids] = rng.integers(0, 0x400, int(ids.sum()))  # never that of a stream
        lengths = (what > 0.02) & (what < 0.04)
        records["length"][lengths] = rng.choice(FD_LENGTHS if rates.fd else FD_LENGTHS[:9], int(lengths.sum()))
        contents = (what > 0.04) & (what < 0.3) & ~stream & (not rates.fd)
        records["data"][contents, rng.integers(0, 8)] ^= np.uint8(rng.integers(1, 256))
        copies = np.where(what > 0.97, 0, np.where(what > 0.94, 2, 1))
        mutated += int(ids.sum() + lengths.sum() + contents.sum() + (copies != 1).sum())
        keep = ~(lengths & stream & (records["length"] == bus.decoders[0]._layout.length(0)))
        return np.repeat(records, copies * keep)

    while mutated < 300:
        bus.run(1600, tuple(range(1, 1600, 40)), spoil=spoil)
    bus.run(4800)
    got, counters = bus.samples(), bus.decoders[0].counters
    assert counters.samples + counters.lost_by_index == got.index[-1] - got.index[0] + 1
    assert counters.malformed > 0
    assert counters.out_of_order > 0
    heard = bus.wire.counters
    assert heard.orphans if rates.fd else heard.bad_crc + heard.bad_length + heard.aborted
    assert not [event for event in bus.events if isinstance(event, RequestTimedOut)]
    for chunk in bus.edges():
        assert (chunk.encoder == chunk.tick % 4096).all()


@pytest.mark.parametrize("rates", [CLASSIC, FD], ids=str)
def test_mutated_requests_are_refused_or_ignored(rates: BusRates) -> None:
    bus = CanPair(rates)
    bus.connect()
    rng = np.random.default_rng(3)
    said = len(bus.to_device)
    bus.stream(NAMES[rates])
    real = np.concatenate(bus.to_device[said:])
    before = dict(bus.app.values)
    for _ in range(MUTATED // len(real)):
        records = real.copy()
        at = rng.integers(len(records))
        records["data"][at, rng.integers(0, 16 if rates.fd else 8)] ^= rng.integers(1, 256)
        records = np.delete(records, rng.integers(len(records), size=rng.integers(0, 3)))
        bus.device.receive(records.tobytes())
        bus.device.tx.take()
    assert bus.app.values == before
    assert bus.device.session.state is DriveState.IDLE
    assert bus.device.counters.bad + bus.device.counters.orphans > 100

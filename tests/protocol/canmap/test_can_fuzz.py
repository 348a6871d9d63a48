"""Noise at both ends of a CAN bus: no exception, no wrong value, nothing moves, all is counted."""

from __future__ import annotations

import numpy as np
import pytest
from can_pair import CLASSIC, FD, CanPair

from protocol.canmap.frame import CAN_RECORD, FD_LENGTHS, BusRates
from protocol.canmap.ids import CanId
from protocol.host import HeartbeatReceived
from protocol.messages import DriveState

pytestmark = pytest.mark.slow

RANDOM = 20_000
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

"""Streams of means on a CAN bus: the same windows, in frames of 4 bytes a channel."""

from __future__ import annotations

import numpy as np
import pytest
from can_pair import CLASSIC, FD, CanPair
from capture_model import Kind, mean
from small_drive import CHANNELS, samples

from protocol.canmap.frame import BusRates
from protocol.messages import Feature, StreamEvent
from protocol.streams import SampleChunk
from tests.tools import needs


@pytest.mark.parametrize("side", ["python", pytest.param("c", marks=needs("C compiler"))])
@pytest.mark.parametrize("rates", [CLASSIC, FD])
@pytest.mark.parametrize("names", [("i_a",), ("theta", "i_a", "count")])
def test_means_on_can(rates: BusRates, names: tuple[str, ...], side: str) -> None:
    bus = CanPair(rates, in_c=side == "c", features=Feature.MEANS | Feature.EDGES)
    bus.connect()
    bus.stream(names, 16, event=StreamEvent.MEAN)
    bus.run(1600)
    chunks: list[SampleChunk] = bus.chunks[0]
    index = np.concatenate([chunk.index for chunk in chunks])
    assert index.tolist() == list(range(16, 16 * len(index) + 1, 16))
    assert len(index) >= 90
    made = samples(0, 1601)
    for name in names:
        wraps = Kind("i16", wraps=name == "theta")
        told = np.concatenate([chunk.raw[name] for chunk in chunks]).tolist()
        exact = [mean(made[name][last - 15 : last + 1].tolist(), wraps) for last in index]
        assert told == pytest.approx(list(map(float, exact)), rel=2.0**-23)
        scale = float(np.float32(next(channel.scale for channel in CHANNELS if channel.name == name)))
        assert chunks[0].physical(name)[0] == told[0] * scale

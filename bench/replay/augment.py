"""Puts the host's own estimates beside the drive's: chunks in, the same chunks with more channels out.

The channels are `theta_<short>_host` and `omega_<short>_host`, flagged ESTIMATE like the drive's, in the raw format of
its estimates, so dashboard, recording and statistics treat them alike. Every sample has a value, because observers are
initialised anew after a loss (see `bench.replay.estimators`). Nothing that the drive sent is changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.device.heard import ParameterSet
from bench.record.info import HOST_SUFFIX
from bench.replay.estimators import PORTION, Estimators, raw_counts
from bench.signal.chunks import part, with_columns
from bench.signal.parameters import Change
from protocol.descriptor import Channel
from protocol.signals import ANGLE, SPEED, Flag, RawType, Signal, Unit
from protocol.streams import EdgeChunk, SampleChunk, StreamConfig

_FIRST_ID = 0xFF00  # past the ids of any drive's channels


def host_channels(shorts: Sequence[str], beside: Sequence[Channel | Signal]) -> tuple[Channel, ...]:
    """Angle and speed of each observer, by short name; their format is that of the estimates among `beside`."""
    angle = _like(beside, Unit.RAD, Channel(0, "", Unit.RAD, RawType.I16, ANGLE, Flag.WRAPS))
    speed = _like(beside, Unit.RAD_PER_S, Channel(0, "", Unit.RAD_PER_S, RawType.I16, SPEED, Flag(0)))
    return tuple(
        replace(like, id=_FIRST_ID + 2 * k + second, name=f"{what}_{short}{HOST_SUFFIX}")
        for k, short in enumerate(shorts)
        for second, (what, like) in enumerate((("theta", angle), ("omega", speed)))
    )


def _like(channels: Sequence[Channel | Signal], unit: Unit, otherwise: Channel) -> Channel:
    known = [c for c in channels if c.unit == unit and c.flags & Flag.ESTIMATE and not c.name.endswith(HOST_SUFFIX)]
    chosen = known[0] if known else otherwise
    flags = Flag.CHANNEL | Flag.ESTIMATE | (chosen.flags & Flag.WRAPS)
    return Channel(0, "", unit, chosen.raw, chosen.scale, flags, chosen.offset)


class Augmenter:
    """Runs the `observers` over the chunks of a drive that streams `stream`, and adds what they find."""

    def __init__(self, observers: Sequence[str], parameters: Mapping[str, float], stream: StreamConfig) -> None:
        self.estimators = Estimators(observers, parameters, stream)
        self.channels = host_channels([entry.short for entry in self.estimators.entries], stream.channels)
        self._node = stream.node
        self._configs: dict[StreamConfig, StreamConfig] = {}

    def change(self, told: ParameterSet) -> None:
        """A parameter of the drive has changed: it counts for the samples after that which have not come yet."""
        self.estimators.kernels.change(Change(told.tick, told.name, told.value))

    def take(self, chunk: SampleChunk | EdgeChunk) -> SampleChunk | EdgeChunk:
        """Samples of the drive with the estimates, after its edges up to them; all else as it is."""
        if chunk.config.node != self._node or not len(chunk):
            return chunk
        if isinstance(chunk, SampleChunk):
            return self.samples(chunk)
        self.estimators.edges(chunk)
        return chunk

    def samples(self, chunk: SampleChunk) -> SampleChunk:
        """The chunk, one sample or more, with the host's estimates as further channels."""
        return with_columns(chunk, self._config(chunk.config), self.columns(chunk))

    def columns(self, chunk: SampleChunk) -> list[NDArray[np.generic]]:
        """Raw values of the further channels at the samples of the chunk, one or more, (n,) each."""
        columns: list[NDArray[np.generic]] = [np.empty(len(chunk), channel.raw.dtype) for channel in self.channels]
        for first in range(0, len(chunk), PORTION):
            rows = slice(first, first + PORTION)
            found = self.estimators.samples(part(chunk, rows.start, rows.stop))
            values = [value for entry in self.estimators.entries for value in found[entry.name]]
            for channel, column, value in zip(self.channels, columns, values, strict=True):
                column[rows] = raw_counts(channel, value)
        return columns

    def _config(self, config: StreamConfig) -> StreamConfig:
        if config not in self._configs:
            self._configs[config] = replace(config, channels=(*config.channels, *self.channels))
        return self._configs[config]

"""A stretch of what a drive streamed during a test, as arrays, and what is wrong with it.

A `Capture` is what measurements are made from. It knows no link and never waits; `bench.rig.recorder` fills it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.signal.channels import reference_angle, speed_channel
from bench.signal.chunks import as_bytes, between, join, part, streams_none
from bench.signal.parameters import course_of
from bench.signal.position import position_error, unwrapped
from protocol.frames import data_frame
from protocol.signals import Flag
from protocol.streams import EdgeChunk, Gap, SampleChunk

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

F64 = NDArray[np.float64]

_NEARLY = 0.998  # share of a sensor's range that counts as all of it: two counts of twelve bits


@dataclass(frozen=True, repr=False)
class Capture:
    """Samples and Hall edges from one device tick to another.

    `parameters`: the drive's, by name, when the capture began; as a `ParameterCourse` with what changed later.
    `dropped`: stretches (tick, tick, words) in which something was lost, wherever the loss was seen.
    """

    samples: SampleChunk
    edges: EdgeChunk
    parameters: Mapping[str, float] = field(default_factory=dict)
    dropped: tuple[tuple[int, int, str], ...] = ()
    looked_at: frozenset[str] | None = None
    """Channels whose range matters; None is all of them."""
    edge_step: float = 0.0
    """s by which the time of an edge may be late, as the recording tells; 0: what its ticks tell."""

    def __len__(self) -> int:
        return len(self.samples)

    def __repr__(self) -> str:
        if not len(self):
            return "Capture of no samples"
        first, last = self.span
        what = f"{len(self)} samples of {len(self.names)} channels at {self.rate:g} Hz"
        return f"Capture of {what}, {len(self.edges)} Hall edges, {first:.3f} … {last:.3f} s"

    @property
    def names(self) -> tuple[str, ...]:
        """The channels, in the drive's order."""
        return self.samples.raw.dtype.names or ()

    @property
    def units(self) -> dict[str, str]:
        """The unit of each channel, such as rad/s; empty for a pure number."""
        return {channel.name: channel.unit.symbol for channel in self.samples.config.channels}

    def __getitem__(self, channel: str) -> F64:
        """A channel in its unit, shape (n,), read-only. BenchError if it is not streamed."""
        if channel not in self._physical:
            self._require(channel)
            self._physical[channel] = values = self.samples.physical(channel)
            values.flags.writeable = False
        return self._physical[channel]

    @cached_property
    def _physical(self) -> dict[str, F64]:
        return {}

    def __contains__(self, channel: str) -> bool:
        return channel in self.names

    def _require(self, channel: str) -> None:
        if channel not in self:
            raise BenchError(f"channel '{channel}' is not in the stream; it has {', '.join(self.names)}")

    # -- time ---------------------------------------------------------------------------------------------------

    @cached_property
    def t(self) -> F64:
        """Device time of each sample in s, shape (n,): the time line of the recording."""
        return self.samples.tick / self.tick_hz

    @property
    def span(self) -> tuple[float, float]:
        """Device time in s of the first and the last sample."""
        return float(self.t[0]), float(self.t[-1])

    @property
    def rate(self) -> float:
        """Samples a second, where none is lost."""
        return self.samples.config.rate

    @property
    def measured_rate(self) -> float:
        """Samples a second, as they came."""
        return (len(self) - 1) / float(self.t[-1] - self.t[0])

    @property
    def tick_hz(self) -> int:
        """Device ticks a second."""
        return self.samples.config.tick_hz

    @property
    def edge_t(self) -> F64:
        """Device time of each Hall edge in s, shape (m,)."""
        return self.edges.tick / self.tick_hz

    def between(self, first: float, last: float) -> Capture:
        """The part from device time `first` to `last` in s, both included."""
        return self.ticks(int(np.ceil(first * self.tick_hz - 0.5)), int(np.floor(last * self.tick_hz + 0.5)))

    def ticks(self, first: int, last: int) -> Capture:
        """The part from device tick `first` to `last`, both included. BenchError if no sample lies in it."""
        samples = between(self.samples, first, last)
        if not len(samples):
            raise BenchError(f"no sample between {first / self.tick_hz:.4f} s and {last / self.tick_hz:.4f} s")
        return replace(
            self,
            samples=samples,
            edges=between(self.edges, first, last),
            parameters=course_of(self.parameters).since(int(samples.tick[0])),
            dropped=tuple(stretch for stretch in self.dropped if stretch[0] <= last and stretch[1] >= first),
        )

    # -- for other tools ----------------------------------------------------------------------------------------

    def to_arrow(self) -> pa.Table:
        """A column `t` in s and one for each channel in its unit, float64, which the column's metadata names."""
        import pyarrow as pa

        columns = {"t": self.t} | {name: self[name] for name in self.names}
        units = {"t": "s"} | self.units
        fields = [pa.field(name, pa.float64(), metadata={"unit": units[name]}) for name in columns]
        return pa.table(list(columns.values()), schema=pa.schema(fields))

    def to_pandas(self) -> pd.DataFrame:
        """A column for each channel in its unit, by the device time `t` in s; `attrs["units"]` has the units.

        Raises ImportError where pandas is not installed, as every `to_pandas` does.
        """
        return data_frame({name: self.samples.physical(name) for name in self.names}, self.t, units=self.units)

    # -- angles -------------------------------------------------------------------------------------------------

    @cached_property
    def reference(self) -> str:
        """Name of the channel that position estimates are compared with. BenchError without an encoder."""
        if name := reference_angle(self.samples.config.channels):
            return name
        raise BenchError("the drive streams no reference angle: the test needs an encoder")

    @cached_property
    def speed(self) -> str:
        """See `bench.signal.channels.speed_channel`. BenchError without one."""
        if name := speed_channel(self.samples.config.channels, self.parameters):
            return name
        raise BenchError("the drive streams no speed: a channel in rad/s with the flag REFERENCE or ESTIMATE")

    @cached_property
    def theta(self) -> F64:
        """Electrical angle by the encoder, unwrapped, rad, shape (n,)."""
        return unwrapped(self[self.reference])

    def position_error(self, estimate: str) -> F64:
        """Actual minus estimated electrical angle, rad in [-pi, pi), shape (n,)."""
        return position_error(self[self.reference], self[estimate])

    def theta_at_edges(self) -> F64:
        """Electrical angle by the encoder at each Hall edge, unwrapped, rad, shape (m,): in line between samples."""
        angles: F64 = np.interp(self.edges.tick, self.samples.tick, self.theta)
        return angles

    # -- quality ------------------------------------------------------------------------------------------------

    def only(self, *channels: str) -> Capture:
        """The same stretch, for a measurement that looks at these channels only: others may be at their range's end.

        BenchError for a channel that is not streamed.
        """
        for channel in channels:
            self._require(channel)
        return replace(self, looked_at=frozenset(channels))

    def flaws(self) -> tuple[str, ...]:
        """What makes it unfit for measuring, in words; empty if nothing does."""
        lost = [words for _, _, words in self.dropped]
        return (*lost, *(self._clock_jumps() or self._edges_missing_at_the_end()), *self._saturation())

    def _edges_missing_at_the_end(self) -> list[str]:
        """Codes that changed after the last edge: no later edge had come to tell of a gap when it was captured.

        A change may show one sample after its edge, which may lie just before the capture.
        """
        if "hall" not in self or len(self) < 2 or streams_none(self.edges.config):
            return []
        tick = self.samples.tick
        last = int(self.edges.tick[-1]) if len(self.edges) else int(tick[0])
        changed = np.diff(self.samples.raw["hall"].astype(np.int64)) != 0
        count = int(np.count_nonzero(changed & (2 * tick[:-1] - tick[1:] >= last)))
        where = f"after {last / self.tick_hz:.4f} s"
        return [f"Hall edges were lost: the code changed {count} times {where} without one"] if count else []

    def _clock_jumps(self) -> list[str]:
        index, tick = np.diff(self.samples.index), np.diff(self.samples.tick)
        if not len(index):
            return []
        period = int(np.median(tick)) / max(int(np.median(index)), 1)
        wrong = np.flatnonzero(np.abs(tick - index * period) > 0.5 * period)
        return [
            f"the clock jumped by {(tick[k] - index[k] * period) / self.tick_hz * 1e3:+.3f} ms at {self.t[k]:.4f} s"
            for k in wrong[:3]
        ]

    def _saturation(self) -> list[str]:
        flaws = []
        i_range = self.parameters.get("i_range", np.inf)
        for channel in self.samples.config.channels:
            if self.looked_at is not None and channel.name not in self.looked_at:
                continue
            raw, full = np.ascontiguousarray(self.samples.raw[channel.name]), None
            if raw.dtype.kind in "iu" and raw.dtype.itemsize > 1 and not channel.flags & Flag.WRAPS and len(raw):
                info = np.iinfo(raw.dtype)
                if raw.max() == info.max or (info.min < 0 and raw.min() == info.min):  # of most channels none is
                    full = (raw == info.max) | ((raw == info.min) & (info.min < 0))
            if channel.name in ("i_a", "i_b", "i_c"):
                near = np.abs(self[channel.name]) >= _NEARLY * i_range
                full = near if full is None else full | near
            if full is not None and full.any():
                flaws.append(
                    f"{channel.name} was at the end of its range in {int(full.sum())} samples, first at "
                    f"{self.t[int(np.argmax(full))]:.4f} s"
                )
        return flaws


def joined(captures: Sequence[Capture]) -> Capture:
    """Captures of one drive, one or more, that follow each other, as one."""
    if len(captures) == 1:
        return captures[0]
    edges = [capture.edges for capture in captures if len(capture.edges)] or [captures[0].edges]
    dropped = tuple(stretch for capture in captures for stretch in capture.dropped)
    samples = join([capture.samples for capture in captures])
    return replace(captures[0], samples=samples, edges=join(edges), dropped=dropped)


def gathered(captures: Iterable[Capture], most: int) -> Capture:
    """The same of one or more that are made as they are taken, `most` samples in all at most: none is held twice."""
    rest: list[Capture] = []  # without samples
    gaps: list[Gap] = []
    n = 0
    for capture in captures:
        samples = capture.samples
        if not rest:
            index, tick = np.empty((2, most), np.int64)
            raw = np.empty(most, samples.raw.dtype)
        rows = slice(n, n + len(samples))
        index[rows], tick[rows] = samples.index, samples.tick
        as_bytes(raw)[rows] = as_bytes(samples.raw)  # numpy copies field by field otherwise
        gaps += [replace(gap, position=n + gap.position) for gap in samples.gaps]
        rest.append(replace(capture, samples=part(samples, 0, 0)))
        n += len(samples)
    whole = joined(rest)
    config = whole.samples.config
    return replace(whole, samples=SampleChunk(config, index[:n], tick[:n], raw[:n], tuple(gaps)))

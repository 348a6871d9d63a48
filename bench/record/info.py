"""What is known of a run: which drive, at which rate, with which channels and parameters, and what was marked in it.

All of it is plain JSON in a run's log. Device ticks are the only time; `ns_from_tick` makes nanoseconds of them.
"""

from __future__ import annotations

import math
import uuid
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.device.heard import Heard
from bench.signal.channels import reference_angle
from bench.signal.colours import RGB, apart, quantity
from bench.signal.units import RPM, pole_pairs
from bench.signal.verdict import Verdict
from protocol.descriptor import Channel
from protocol.messages import StreamEvent
from protocol.signals import DRIVE_CHANNELS, Flag, RawType, Signal, Unit
from protocol.streams import StreamConfig

CAPTURE = "capture"
"""In what a run says of itself: that it came out of the drive's memory, and which trigger froze it."""
HOST_SUFFIX = "_host"  # of channels that the host has estimated itself
UNITS = {signal.name: signal.unit for signal in DRIVE_CHANNELS}
"""Units of the vocabulary's channels: under the same name, a channel in another unit is something else."""

_NS = 1_000_000_000

AnyChannel = Channel | Signal


@dataclass(frozen=True, slots=True)
class Mark:
    """The stretch of a run, in device ticks, over which the measurement `name` was made, and how it ended.

    Raises ValueError for a stretch that ends before it begins.
    """

    name: str
    first_tick: int
    last_tick: int
    verdict: Verdict | None = None
    """None of one that somebody has set by hand."""
    asked: str | None = None
    """The number under which another terminal has asked for it."""
    routine: bool = False
    """Whether it comes again and again, as steps of a profile do: a ring keeps nothing for it."""

    def __post_init__(self) -> None:
        if self.last_tick < self.first_tick:
            raise ValueError(f"mark {self.name}: it ends at tick {self.last_tick}, before its first, {self.first_tick}")


class SummaryText(NamedTuple):
    """The text that a reader of the run sees first; it replaces an earlier one."""

    markdown: str


Kept = Heard | Mark | SummaryText
"""What a recording and a view take: all that the run hears, and what is said about it."""


@dataclass(frozen=True)
class RunInfo:
    """What is known of a run before its first sample.

    `channels` are those of the stream that the dashboard shows (node `node`), `parameters` the drive's by name in SI
    units, `identity` anything else that tells what was tested (HELLO's fields, target, host version), as plain JSON,
    and `started` the date and time, empty where nobody knows.
    """

    tick_hz: int
    pwm_hz: int
    channels: tuple[AnyChannel, ...]
    parameters: Mapping[str, float] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    node: int = 1
    recording_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    started: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    edge_step: float = 0.0
    """s from one look at the Hall inputs to the next, by which an edge may be late; 0: what its ticks tell."""

    @cached_property
    def n_p(self) -> int | None:
        """Pole pairs, if the drive says, and says a whole number from 1 up."""
        return pole_pairs(self.parameters)

    @property
    def i_max(self) -> float | None:
        """Largest current reference in A, if the drive says one above 0."""
        i_max = self.parameters.get("i_max", math.nan)
        return i_max if 0 < i_max < math.inf else None

    @property
    def trigger_tick(self) -> int | None:
        """Of a capture out of the drive's memory the device tick of its trigger; None of any other run."""
        told = self.identity.get(CAPTURE)
        tick = told.get("trigger_tick") if isinstance(told, Mapping) else None
        return tick if isinstance(tick, int) else None

    @property
    def hall(self) -> bool:
        """Whether Hall codes are to be expected: from the channel `hall`, or from a drive that streams edges."""
        return "hall" in self.words or "edges" in self.identity.get("features", ("edges",))

    @cached_property
    def words(self) -> frozenset[str]:
        """`hall` and `status` where they are streamed as whole numbers: their bits are shown, not their values."""
        whole = {channel.name for channel in self.channels if channel.raw != RawType.F32}
        return frozenset(name for name in ("hall", "status") if self.has(name) and name in whole)

    @cached_property
    def colours(self) -> Mapping[str, RGB]:
        """Colour of every channel: no two that are compared with each other, or shown by their unit, have the same.

        A host's estimate has its observer's colour where the drive's own is not streamed.
        """
        compared = {self.position_reference, *self.position_estimates, *self.speeds}
        together = defaultdict[Unit | None, dict[str, str]](dict)  # what channels stand for: the name in the table
        stands: dict[str, tuple[Unit | None, str]] = {}
        for channel in sorted(self.channels, key=lambda channel: channel.name.endswith(HOST_SUFFIX)):
            name, unit = channel.name, channel.unit
            own = name.removesuffix(HOST_SUFFIX)
            group = None if name in compared else unit
            thing = quantity(name) if unit == Unit.RAD_PER_S else name
            together[group][thing] = quantity(own) if UNITS.get(own, unit) == unit else ""
            stands[name] = group, thing
        looks = {group: apart(wanted) for group, wanted in together.items()}
        return {name: looks[group][thing].rgb for name, (group, thing) in stands.items()}

    def has(self, *names: str) -> bool:
        """Whether all these channels of the vocabulary are streamed, in the units that it gives them."""
        return self._names.issuperset(names)

    @cached_property
    def _names(self) -> frozenset[str]:
        return frozenset(channel.name for channel in self.channels if UNITS.get(channel.name) == channel.unit)

    @cached_property
    def position_estimates(self) -> tuple[str, ...]:
        """Channels flagged as position estimates, but for the reference."""
        return tuple(n for n in self._flagged(Flag.ESTIMATE, Unit.RAD) if n != self.position_reference)

    @cached_property
    def position_reference(self) -> str | None:
        """The channel that position estimates are compared with."""
        return reference_angle(self.channels) or None

    @cached_property
    def speeds(self) -> tuple[str, ...]:
        """Measured and estimated electrical speeds, in drawing order."""
        return self._flagged(Flag.ESTIMATE, Unit.RAD_PER_S) + self._flagged(Flag.REFERENCE, Unit.RAD_PER_S)

    def _flagged(self, flag: Flag, unit: Unit) -> tuple[str, ...]:
        return tuple(c.name for c in self.channels if c.flags & flag and c.unit == unit)

    @property
    def speed_unit(self) -> str:
        """Unit in which speeds are shown: mechanical r/min where the pole pairs are known, else electrical rad/s."""
        return "r/min" if self.n_p else "rad/s"

    @property
    def speed_factor(self) -> float:
        """Factor from electrical rad/s to `speed_unit`."""
        return 1.0 / (RPM * self.n_p) if self.n_p else 1.0

    def to_json(self) -> dict[str, Any]:
        """All of it but the id as plain JSON."""
        return {name: getattr(self, name) for name in _OF_RUN} | {
            "parameters": {name: float(value) for name, value in self.parameters.items()},
            "channels": [channel_to_json(channel) for channel in self.channels],
            "identity": dict(self.identity),
            **({"edge_step": self.edge_step} if self.edge_step else {}),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any], recording_id: str) -> RunInfo:
        """The inverse of `to_json`."""
        parameters = {name: float(value) for name, value in data["parameters"].items()}
        channels = tuple(map(channel_from_json, data["channels"]))
        plain = {name: data[name] for name in (*_OF_RUN, "identity")}
        step = float(data.get("edge_step", 0.0))
        return cls(**plain, channels=channels, parameters=parameters, recording_id=recording_id, edge_step=step)


_OF_RUN = ("tick_hz", "pwm_hz", "node", "started")
_OF_STREAM = ("node", "stream", "cfg_id", "decimation", "block")
_OF_CHANNEL = ("id", "name", "scale", "offset")
"""What stands in JSON as it is."""


def channel_to_json(channel: AnyChannel) -> dict[str, Any]:
    """A channel as plain JSON."""
    numbers = {"unit": int(channel.unit), "raw": int(channel.raw), "flags": int(channel.flags)}
    return {name: getattr(channel, name) for name in _OF_CHANNEL} | numbers | {"symbol": channel.unit.symbol}


def channel_from_json(data: Mapping[str, Any]) -> Channel:
    """The inverse of `channel_to_json`."""
    plain = {name: data[name] for name in _OF_CHANNEL}
    return Channel(**plain, unit=Unit(data["unit"]), raw=RawType(data["raw"]), flags=Flag(data["flags"]))


def stream_to_json(config: StreamConfig, name: str) -> dict[str, Any]:
    """A stream that is stored under `name`, as plain JSON."""
    channels = [channel_to_json(channel) for channel in config.channels]
    plain = {name: getattr(config, name) for name in _OF_STREAM}
    return {"name": name, **plain, "event": int(config.event), "channels": channels}


def stream_from_json(data: Mapping[str, Any], run: RunInfo) -> StreamConfig:
    """The inverse of `stream_to_json`, without the name, in `run`."""
    channels = tuple(map(channel_from_json, data["channels"]))
    plain = {name: data[name] for name in _OF_STREAM}
    event = StreamEvent(data["event"])
    return StreamConfig(**plain, event=event, channels=channels, tick_hz=run.tick_hz, pwm_hz=run.pwm_hz)


def ns_from_tick(tick: NDArray[np.int64] | int, tick_hz: int) -> NDArray[np.int64]:
    """Nanoseconds since the device's tick 0, rounded to the nearest; exact integers, no overflow below 292 years."""
    if _NS % tick_hz == 0:
        return np.asarray(tick, np.int64) * (_NS // tick_hz)
    seconds, rest = np.divmod(np.asarray(tick, np.int64), np.int64(tick_hz))
    ns: NDArray[np.int64] = seconds * _NS + (rest * _NS + tick_hz // 2) // tick_hz
    return ns

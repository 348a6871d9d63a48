"""What a recording holds and how it is named: entities, components, units, number formats.

Writer, reader and dashboard share this module, so they cannot drift apart. It imports no rerun.

Every channel of a stream is a float column in its physical unit. Whole raw values are recovered exactly from it:
float32 holds them where its rounding stays below a quarter of a count, float64 elsewhere (`storage`). Device ticks
become nanoseconds on the time line `t`, and come back exactly for any tick rate below 1 GHz.
"""

from __future__ import annotations

import math
import uuid
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.analysis.channels import reference_angle
from bench.analysis.colours import RGB, apart, quantity
from bench.analysis.units import RPM, pole_pairs
from bench.analysis.verdict import Verdict
from protocol.descriptor import Channel
from protocol.messages import StreamEvent
from protocol.signals import DRIVE_CHANNELS, SHORT, Flag, RawType, Signal, Unit
from protocol.streams import StreamConfig

APPLICATION = "hallbench"
SCHEMA = 1  # version of everything below; a reader refuses a newer one
TIMELINE = "device_time"

# entities
META = "meta"  # static: the run's identity
STREAMS = "meta/streams"  # static: one description a stream, as META/<entity>
FAST = "fast"  # the drive's samples at full rate, and the position errors
TREND = "trend"  # minima and maxima over 10 ms of what the long plots show
HALL = "hall"  # Hall edges, tick-exact
HALL_LANES = "hall/lanes"  # the Hall code at each edge, and again in between, to look at
EVENTS = "log/drive"
NOTES = "log/host"
HEALTH = "health"  # loss and error counters, once a second
HEALTH_TEXT = "health/text"  # the same for people
TOUCH = "touch"  # nothing, in a live view only
DRIVE = "drive"  # state, faults, angle source, correction, telemetry: one lane each
ACCEPTANCE = "acceptance"  # marks of an acceptance run, and one lane that shows them
PLANE = "stator/plane"
VECTORS = "stator/vectors"
LEGEND = f"{VECTORS}/legend"
SUMMARY = "summary"

# components
RUN_JSON = "hallbench:run"
STREAM_JSON = "hallbench:stream"
INDEX = "index:first"  # index of this row, on the first row of each contiguous stretch
GAP_FIELDS = ("gap:lost_samples", "gap:lost_frames", "gap:overrun")  # on the first row after a gap
EDGE_FIELDS = {"hall_old": np.uint8, "hall_new": np.uint8, "illegal": np.bool_, "encoder": np.uint16}  # as edge:NAME
EVENT_FIELDS = ("event:tick", "event:code", "event:node", "event:arg")
MARK_FIELDS = ("mark:name", "mark:first_tick", "mark:last_tick", "mark:verdict")
LOSS_FIELDS = ("lost:samples", "lost:sample_frames", "lost:edges", "lost:by_device", "lost:live_blocks")

HOST_SUFFIX = "_host"  # of channels that the host has estimated itself

UNITS = {signal.name: signal.unit for signal in DRIVE_CHANNELS}
"""Units of the vocabulary's channels: under the same name, a channel in another unit is something else."""
DQ_CURRENTS, DQ_REFERENCES = ("i_d", "i_q"), ("i_d_ref", "i_q_ref")
SPEED_REFERENCE = "omega_ref"

_NS = 1_000_000_000
DEG = 180 / math.pi


def value_component(channel: str) -> str:
    """Component of a channel's physical value."""
    return f"value:{channel}"


def error_component(channel: str) -> str:
    """Component of a position estimate's error, actual minus estimated, in electrical degrees."""
    return f"error_deg:{channel}"


def speed_component(channel: str) -> str:
    """Component of a mechanical speed in r/min: for runs whose pole pairs are known."""
    return f"mech_rpm:{channel}"


def mean_component(component: str) -> str:
    """Component of the mean over a bin of what `component` holds."""
    return f"mean_{component}"


LABELS = {
    f"{what}_{short}": source.name.lower().replace("_", " ").replace("hall", "Hall")
    for source, short in SHORT.items()
    for what in ("theta", "omega")
} | {
    "theta_true": "plant",
    "omega_true": "plant",
    "omega_ref": "reference",
    "i_d_ref": "i_d reference",
    "i_q_ref": "i_q reference",
}

AnyChannel = Channel | Signal


@dataclass(frozen=True, slots=True)
class Mark:
    """The stretch of a run, in device ticks, over which the measurement `name` was made, and how it ended.

    Raises ValueError for a stretch that ends before it begins.
    """

    name: str
    first_tick: int
    last_tick: int
    verdict: Verdict

    def __post_init__(self) -> None:
        if self.last_tick < self.first_tick:
            raise ValueError(f"mark {self.name}: it ends at tick {self.last_tick}, before its first, {self.first_tick}")


def label(name: str) -> str:
    """What a plot calls a channel; one that the host has estimated says so."""
    drives = name.removesuffix(HOST_SUFFIX)
    return LABELS.get(name, name) if name == drives else f"{LABELS.get(drives, drives)}, host"


@dataclass(frozen=True)
class RunInfo:
    """What is known of a run before its first sample.

    `channels` are those of the stream that the dashboard shows (node `node`), `parameters` the drive's by name in SI
    units, `identity` anything else that tells what was tested (HELLO's fields, target, host version), as plain JSON.
    """

    tick_hz: int
    pwm_hz: int
    channels: tuple[AnyChannel, ...]
    parameters: Mapping[str, float] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    node: int = 1
    recording_id: str = field(default_factory=lambda: uuid.uuid4().hex)
    started: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

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
        """Channels flagged as position estimates."""
        return self._flagged(Flag.ESTIMATE, Unit.RAD)

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
        """All of it as plain JSON, for the recording."""
        return {
            "schema": SCHEMA,
            "tick_hz": self.tick_hz,
            "pwm_hz": self.pwm_hz,
            "node": self.node,
            "started": self.started,
            "parameters": {name: float(value) for name, value in self.parameters.items()},
            "channels": [channel_to_json(channel) for channel in self.channels],
            "identity": dict(self.identity),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any], recording_id: str) -> RunInfo:
        """The inverse of `to_json`."""
        return cls(
            tick_hz=data["tick_hz"],
            pwm_hz=data["pwm_hz"],
            channels=tuple(channel_from_json(channel) for channel in data["channels"]),
            parameters=data["parameters"],
            identity=data["identity"],
            node=data["node"],
            recording_id=recording_id,
            started=data["started"],
        )


def channel_to_json(channel: AnyChannel) -> dict[str, Any]:
    """Describe a channel, with the number format of its column."""
    return {
        "id": channel.id,
        "name": channel.name,
        "unit": int(channel.unit),
        "symbol": channel.unit.symbol,
        "raw": int(channel.raw),
        "scale": channel.scale,
        "offset": channel.offset,
        "flags": int(channel.flags),
        "storage": np.dtype(storage(channel)).name,
    }


def channel_from_json(data: Mapping[str, Any]) -> Channel:
    """The inverse of `channel_to_json`."""
    return Channel(
        data["id"],
        data["name"],
        Unit(data["unit"]),
        RawType(data["raw"]),
        data["scale"],
        Flag(data["flags"]),
        data["offset"],
    )


def stream_to_json(config: StreamConfig, entity: str) -> dict[str, Any]:
    """Describe a stream that is logged under `entity`."""
    return {
        "entity": entity,
        "node": config.node,
        "stream": config.stream,
        "cfg_id": config.cfg_id,
        "event": int(config.event),
        "decimation": config.decimation,
        "block": config.block,
        "channels": [channel_to_json(channel) for channel in config.channels],
    }


def stream_from_json(data: Mapping[str, Any], run: RunInfo) -> StreamConfig:
    """The inverse of `stream_to_json`, without the entity, in a recording of `run`."""
    return StreamConfig(
        node=data["node"],
        stream=data["stream"],
        cfg_id=data["cfg_id"],
        event=StreamEvent(data["event"]),
        decimation=data["decimation"],
        channels=tuple(channel_from_json(channel) for channel in data["channels"]),
        block=data["block"],
        tick_hz=run.tick_hz,
        pwm_hz=run.pwm_hz,
    )


@cache
def storage(channel: AnyChannel) -> type[np.float32] | type[np.float64]:
    """Number format of a channel's column: the smaller one from which its raw values come back exactly."""
    if channel.raw == RawType.F32:
        return np.float32 if channel.scale == 1 and channel.offset == 0 else np.float64
    info = np.iinfo(channel.raw.dtype)
    largest = max(abs(int(info.min)), int(info.max)) + abs(channel.offset / channel.scale)  # in counts
    return np.float32 if largest * float(np.finfo(np.float32).eps) < 0.25 else np.float64


def raw_from_physical(channel: AnyChannel, values: NDArray[Any]) -> NDArray[Any]:
    """Raw wire values for a column of physical ones, in the channel's own type: whole numbers come back exactly, by
    `storage`; a float32 with an offset may differ in its last bits.
    """
    if channel.raw == RawType.F32 and storage(channel) is np.float32:
        return values.astype(np.float32)
    counts = (values.astype(np.float64) - channel.offset) / channel.scale
    return (counts if channel.raw == RawType.F32 else np.rint(counts)).astype(channel.raw.dtype)


def nice_ceiling(value: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten, from 0.1 up, that is not below `value`."""
    power = 10.0 ** math.floor(math.log10(max(value, 0.1)))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= value - 1e-12)


def ns_from_tick(tick: NDArray[np.int64] | int, tick_hz: int) -> NDArray[np.int64]:
    """Nanoseconds since the device's tick 0, rounded to the nearest; exact integers, no overflow below 292 years."""
    if _NS % tick_hz == 0:
        return np.asarray(tick, np.int64) * (_NS // tick_hz)
    seconds, rest = np.divmod(np.asarray(tick, np.int64), np.int64(tick_hz))
    ns: NDArray[np.int64] = seconds * _NS + (rest * _NS + tick_hz // 2) // tick_hz
    return ns


def tick_from_ns(ns: NDArray[np.int64], tick_hz: int) -> NDArray[np.int64]:
    """The inverse of `ns_from_tick`, exact for `tick_hz` below 1 GHz."""
    seconds, rest = np.divmod(np.asarray(ns, np.int64), np.int64(_NS))
    tick: NDArray[np.int64] = seconds * tick_hz + (rest * tick_hz + _NS // 2) // _NS
    return tick

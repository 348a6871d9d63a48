"""What the viewer is given and how it is named: entities, components, number formats.

Log and dashboard share this module, so they cannot drift apart. It imports no rerun. Nothing is read back from it: the
stored form of a run is `bench.record`'s.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from bench.record.info import HOST_SUFFIX, AnyChannel
from bench.record.layout import EDGES, SAMPLES
from protocol.signals import AngleSource, RawType

APPLICATION = "hallbench"
TIMELINE = "device_time"

# entities
FAST = SAMPLES  # the drive's samples at full rate, and the position errors
TREND = "trend"  # minima and maxima over 10 ms of what the long plots show
HALL = EDGES  # Hall edges, tick-exact
RETURNS = "hall-returns"  # bounces and pulses in each second, by Hall sensor
HALL_LANES = "a-b-c-sector"  # the Hall code at each edge, and again in between; its name tells the rows
EVENTS = "log/drive"
NOTES = "log/host"
HEALTH = "health"  # loss and error counters, once a second
TOUCH = "touch"  # nothing, in a live view only
DRIVE = "state-faults-angle-telemetry"  # one lane each, named in their order; without a channel `status` no angle
DRIVE_WITHOUT_ANGLE = "state-faults-telemetry"
GUIDE = "view/guide"  # lines without a colour, which give the plots of the last moments a least range
BEYOND = "view/beyond"  # marks at the edge of a long plot where it leaves peaks out
ROOM = "view/room"  # the same for the long plots, and room for their legends; in rerun's order after what is seen
ACCEPTANCE = "acceptance"  # marks of an acceptance run, and one lane that shows them
PLANE = "stator/plane"
VECTORS = "stator/vectors"
LEGEND = f"{VECTORS}/legend"
RUN_TEXT = "run"  # who is tested and what was lost so far, once a second; at the end the summary

# close-ups of the last electrical revolution
SCOPE = "scope"

# of the last second
BY_ANGLE = "by_angle"  # mean position errors over the electrical angle, by estimate
HARMONICS = "harmonics"  # of the phase currents, by phase
LATE = "late"  # by how much each Hall edge is, by direction
DQ = "dq"  # i_d and i_q as a vector
NUMBERS = "numbers"  # the same and more, to read

# components: rerun's own, of pictures, and ours
STRIPS, STRIP_COLOURS, PLACES, TEXTS = (
    "LineStrips2D:strips",
    "LineStrips2D:colors",
    "Points2D:positions",
    "Points2D:labels",
)
LOSS_FIELDS = ("lost:samples", "lost:sample_frames", "lost:edges", "lost:by_device", "lost:live_blocks")

PHASES, DQ_CURRENTS, DQ_REFERENCES = ("i_a", "i_b", "i_c"), ("i_d", "i_q"), ("i_d_ref", "i_q_ref")
VOLTAGE_VECTOR = ("u_alpha", "u_beta")
SPEED_REFERENCE = "omega_ref"

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


def derived_component(quantity: str) -> str:
    """Component of a quantity that no channel holds."""
    return f"derived:{quantity}"


U_ABS, U_LIMIT = "u_abs", "u_limit"
"""Derived quantities: the size of the voltage vector, and u_dc/sqrt(3), the most that it is without overmodulation."""


LABELS = {
    f"{what}_{source.short}": source.name.lower().replace("_", " ").replace("hall", "Hall")
    for source in AngleSource
    for what in ("theta", "omega")
} | {
    "theta_true": "plant",
    "omega_true": "plant",
    "omega_ref": "reference",
    "i_d_ref": "i_d reference",
    "i_q_ref": "i_q reference",
    U_ABS: "|u|",
    U_LIMIT: "limit u_dc/√3",
}


def label(name: str) -> str:
    """What a plot calls a channel; one that the host has estimated says so."""
    drives = name.removesuffix(HOST_SUFFIX)
    return LABELS.get(name, name) if name == drives else f"{LABELS.get(drives, drives)}, host"


@cache
def storage(channel: AnyChannel) -> type[np.float32] | type[np.float64]:
    """Number format of a channel's column: the smaller one in which its raw values differ."""
    if channel.raw == RawType.F32:
        return np.float32 if channel.scale == 1 and channel.offset == 0 else np.float64
    info = np.iinfo(channel.raw.dtype)
    largest = max(abs(int(info.min)), int(info.max)) + abs(channel.offset / channel.scale)  # in counts
    return np.float32 if largest * float(np.finfo(np.float32).eps) < 0.25 else np.float64


def nice_ceiling(value: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten, from 0.1 up, that is not below `value`."""
    power = 10.0 ** math.floor(math.log10(max(value, 0.1)))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= value - 1e-12)

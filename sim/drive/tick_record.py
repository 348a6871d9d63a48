"""Raw telemetry records of one control period, laid out as `protocol.signals` says, ready for the wire.

Values round half to even and saturate at the ends of their type; angles wrap. Nothing here computes a value.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from protocol.signals import ANGLE, DRIVE_CHANNELS, LOAD_CHANNELS, MILLI, SPEED
from protocol.streams import EDGE_ILLEGAL
from sim.numba_cache import kernel

SAMPLE_DTYPE = np.dtype([(channel.name, channel.raw.dtype) for channel in DRIVE_CHANNELS])
LOAD_DTYPE = np.dtype([(channel.name, channel.raw.dtype) for channel in LOAD_CHANNELS])
ENCODER_CHANNELS = ("theta_enc", "omega_enc")  # what a drive without an encoder does not have

_SCALES = {channel.name: channel.scale for channel in DRIVE_CHANNELS}
TWO_PI = 2.0 * math.pi
PER_RAD = 1.0 / ANGLE
PER_RAD_PER_S = 1.0 / SPEED
PER_UNIT = 1.0 / MILLI
PER_NM = 1.0 / _SCALES["tau_e_true"]


@kernel
def angle(value: float) -> Any:
    """An angle (rad, wrapped or not) as an i16 that covers a turn; the scale is no exact part of a turn."""
    if not -math.pi <= value < math.pi:
        value -= TWO_PI * math.floor((value + math.pi) / TWO_PI)
    return np.int16(np.int64(np.rint(value * PER_RAD)))


@kernel
def clipped(value: float) -> Any:
    """A count as an i16."""
    return np.int16(min(max(np.rint(value), -32768.0), 32767.0))


@kernel
def quantised(value: float) -> float:
    """A current or voltage (A, V) as telemetry carries it: a whole number of `MILLI` within an i16."""
    return float(min(max(np.rint(value * PER_UNIT), -32768.0), 32767.0)) * MILLI


@kernel
def quantised_u16(value: float) -> float:
    """The same for the DC link voltage, within a u16."""
    return float(min(max(np.rint(value * PER_UNIT), 0.0), 65535.0)) * MILLI


@kernel
def edge_codes(old: int, new: int) -> int:
    """The field `codes` of an EDGE_RECORD for an edge between two Hall codes."""
    changed = old ^ new
    illegal = new == 0 or new == 7 or changed & (changed - 1) != 0
    return old | new << 3 | (EDGE_ILLEGAL if illegal else 0)

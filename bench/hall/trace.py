"""What was recorded, made ready for measuring Hall sensors: edges with angle, speed and current, false pulses apart.

A false pulse is an input that changes and is back within `PULSE` seconds: no shaft passes two edges so quickly. Its two
edges are taken out of the others and kept as a pulse. Edges of which no angle is known (beside a gap, or before the
first sample) and edges of a shaft that hardly moves are left out, and counted. Nothing here judges.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.analysis.capture import Capture
from bench.analysis.channels import reference_angle
from bench.analysis.delays import SLOW, speed
from bench.analysis.position import states
from bench.errors import BenchError
from protocol.codes import DriveState

if TYPE_CHECKING:
    from bench.recording.reader import Run

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PULSE = 20e-6
"""s between the two edges of a false pulse, at most: a shaft at 30 000 electrical r/min takes 330 us a sector."""
INPUTS = "abc"


@dataclass(frozen=True)
class Edges:
    """Edges of the Hall inputs, each array (m,)."""

    tick: Ints
    old: Ints
    """Code before, 0..7."""
    new: Ints
    theta: Floats
    """Electrical angle by the encoder, rad, unwrapped; NaN without an encoder."""
    omega: Floats
    """Electrical speed by the encoder, rad/s; NaN without an encoder."""


@dataclass(frozen=True)
class FalsePulses:
    """False pulses, each array (k,)."""

    input: Ints
    """0..2: a, b, c."""
    width: Floats
    """s."""
    current: Floats
    """Size of the current vector then, A; NaN where no current was recorded."""


@dataclass(frozen=True)
class Trace:
    """A stretch of time in which a shaft turned."""

    hall: Ints
    """(n,) codes of the samples."""
    theta: Floats | None
    """(n,) electrical angle by the encoder, rad, unwrapped; None without an encoder."""
    omega: Floats | None
    """(n,) electrical speed from that, rad/s."""
    current: Floats
    """(n,) size of the current vector, A; NaN where no current was recorded."""
    on: NDArray[np.bool_]
    """(n,) whether the outputs were on."""
    sample_time: float
    """s from sample to sample."""
    edges: Edges
    pulses: FalsePulses
    unplaced: int
    """Edges left out because their angle is not known: beside a gap, or where no samples were recorded."""
    slow: int
    """Edges left out because the shaft hardly moved."""
    capture: Capture
    """What all of this was made from."""

    @property
    def seconds(self) -> float:
        """Time covered by samples."""
        return len(self.hall) * self.sample_time


def recorded(run: Run) -> Capture:
    """The whole of a recording. BenchError where it holds no samples with Hall codes, or no Hall edges."""
    if not run.edge_streams or not run.streams:
        why = "; ".join(run.damage) or "record both"
        raise BenchError(f"{run.path} holds no samples or no Hall edges of a drive: {why}")
    from bench.recording.reader import capture_of

    whole = capture_of(run)
    return whole.ticks(int(whole.samples.tick[0]), int(whole.samples.tick[-1]))


def trace(capture: Capture) -> Trace:
    """Make ready what was captured. BenchError without the channel `hall`."""
    hall = capture.samples.raw["hall"].astype(np.int64) if "hall" in capture else np.empty(0, np.int64)
    if not len(hall):
        raise BenchError("the channel 'hall' was not recorded: record it (bench live --save, all channels)")
    period = float(np.median(np.diff(capture.samples.tick))) if len(hall) > 1 else 1.0
    theta = omega = None
    if reference_angle(capture.samples.config.channels):
        theta = capture.theta
        omega = speed(theta, capture.t)
    current = _current(capture)
    raw = capture.edges
    tick, old, new = raw.tick, raw.hall_old.astype(np.int64) & 7, raw.hall_new.astype(np.int64) & 7
    first = _pulse_starts(tick, old, new, PULSE * capture.tick_hz)
    paired = np.zeros(len(tick), bool)
    paired[first] = paired[first + 1] = True
    pulses = FalsePulses(
        np.array([int(bits).bit_length() - 1 for bits in old[first] ^ new[first]], np.int64),
        (tick[first + 1] - tick[first]) / capture.tick_hz,
        current[np.clip(np.searchsorted(capture.samples.tick, tick[first]), 0, len(current) - 1)],
    )
    edges, unplaced, slow = _placed(capture, theta, omega, period, tick[~paired], old[~paired], new[~paired])
    on = np.ones(len(hall), bool)
    if (told := states(capture.samples)) is not None:
        on = told == DriveState.RUNNING
    return Trace(hall, theta, omega, current, on, period / capture.tick_hz, edges, pulses, unplaced, slow, capture)


def _current(capture: Capture) -> Floats:
    """Size of the current vector: by its dq components, else by two phases."""
    if "i_d" in capture and "i_q" in capture:
        return np.hypot(capture["i_d"], capture["i_q"])
    if "i_a" in capture and "i_b" in capture:
        return np.hypot(capture["i_a"], (capture["i_a"] + 2.0 * capture["i_b"]) / math.sqrt(3.0))
    return np.full(len(capture), math.nan)


def _pulse_starts(tick: Ints, old: Ints, new: Ints, width: float) -> Ints:
    """Indices of edges that the next one undoes within `width` ticks; no edge is in two pulses."""
    single = np.isin(old ^ new, (1, 2, 4))
    candidates = np.flatnonzero(single[:-1] & (new[1:] == old[:-1]) & (np.diff(tick) <= width))
    starts: list[int] = []
    for k in candidates.tolist():
        if not starts or k > starts[-1] + 1:
            starts.append(k)
    return np.array(starts, np.int64)


def _placed(
    capture: Capture, theta: Floats | None, omega: Floats | None, period: float, tick: Ints, old: Ints, new: Ints
) -> tuple[Edges, int, int]:
    """Edges with angle and speed, and how many have none or are slow."""
    if theta is None or omega is None:
        nothing = np.full(len(tick), math.nan)
        return Edges(tick, old, new, nothing, nothing), 0, 0
    at = capture.samples.tick
    after = np.clip(np.searchsorted(at, tick), 1, len(at) - 1)
    known = (tick >= at[after - 1]) & (tick <= at[after]) & (at[after] - at[after - 1] < 1.5 * period)
    tick, old, new = tick[known], old[known], new[known]
    angle, speed = np.interp(tick, at, theta), np.interp(tick, at, omega)
    moving = np.abs(speed) >= SLOW
    edges = Edges(tick[moving], old[moving], new[moving], angle[moving], speed[moving])
    return edges, int(np.count_nonzero(~known)), int(np.count_nonzero(~moving))

"""What a drive was asked for, by what it streamed: state, references after its own ramp, and a load where it was seen.

No message of a host is in a recording. The speed's reference after the ramp is, and so are those of the currents: a
drive that is given the former, period by period, ramps to just that. Where there is no speed's reference the drive
controls currents, and their references are what it was asked for; unless that of i_q changes all the time, as a speed
controller's does at standstill.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.commission.window import Booleans, Integers
from bench.errors import BenchError
from bench.signal.capture import Capture
from protocol.messages import DriveState, SetpointMode
from protocol.signals import STATUS_STATE_MASK
from sim.ports.followed import Asked

NEEDED = ("status", "omega_ref", "i_q_ref", "i_d_ref")
NEAR = 8
"""Samples to either side, of which half must differ from their neighbour where a speed controller is at work."""


def asked(capture: Capture, n_p: int, before: int | None = None, cuts: Sequence[int] = ()) -> list[Asked]:
    """What was asked for in the periods that end at a capture's samples; `before`: index of the sample before it.

    What goes on at one of the periods `cuts` begins anew there. BenchError without a channel that it takes.
    """
    if lacking := [name for name in NEEDED if name not in capture]:
        raise BenchError(f"the recording does not tell what the drive was asked for: no channel {', '.join(lacking)}")
    index = capture.samples.index
    first = int(index[0]) if before is None else before + 1
    periods = np.arange(first, int(index[-1]) + 1)
    at = np.searchsorted(index, periods)  # the sample that a period is up to
    state = (capture["status"].astype(np.int64) & STATUS_STATE_MASK)[at]
    speed, i_q, i_d = (np.interp(periods, index, capture[name]) for name in NEEDED[1:])
    load = capture["tau_load_true"][at] if "tau_load_true" in capture else np.zeros(len(periods))
    mode = _mode(capture)[at]
    on = state == DriveState.RUNNING
    by_speed = mode == SetpointMode.SPEED
    value = np.where(by_speed, speed / n_p, i_q)
    columns = np.stack([state, *(np.where(on, one, 0.0) for one in (mode, value, i_d)), load])
    anew = np.any(np.diff(columns, axis=1) != 0.0, axis=0) | np.isin(periods[1:], cuts)
    begins = np.flatnonzero(np.concatenate([[True], anew]))
    lengths = np.diff(np.append(begins, len(periods)))
    return [
        Asked(int(n), int(columns[0, k]), int(columns[1, k]), *map(float, columns[2:, k]))
        for n, k in zip(lengths, begins, strict=True)
    ]


def _mode(capture: Capture) -> Integers:
    moving: Booleans = np.concatenate([[False], np.diff(capture["i_q_ref"]) != 0.0])
    sums = np.concatenate([[0], np.cumsum(moving)])
    at = np.arange(len(moving))
    a, b = np.maximum(at - NEAR, 0), np.minimum(at + NEAR, len(moving))
    busy = sums[b] - sums[a] > 0.5 * (b - a)
    by_speed = (capture["omega_ref"] != 0.0) | busy
    return np.where(by_speed, int(SetpointMode.SPEED), int(SetpointMode.CURRENT))
